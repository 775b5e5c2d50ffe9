"""The joints that bend, in the report: stiffnesses, and deflection against load."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import significant
from visioncal.present.recording.elastic import Elastic, Spring
from visioncal.present.recording.kinematics import joint_words
from visioncal.present.report import svg
from visioncal.present.report.content import Fact

_COLUMNS, _WIDE_IN, _HIGH_IN = 3, 9.2, 2.3


@dataclass(frozen=True)
class SpringRow:
    """A joint as text."""

    joint: str
    stiffness: str
    sigma: str
    torque: str


def spring_rows(elastic: Elastic) -> tuple[SpringRow, ...]:
    """The table of the joints."""
    return tuple(_row(it) for it in elastic.springs)


def _row(spring: Spring) -> SpringRow:
    low, high = (f"{round(it, 1) + 0.0:g}" for it in spring.torque_nm)
    stiffness, sigma = spring.stiffness, spring.stiffness_sigma
    told = stiffness is not None and sigma is not None
    return SpringRow(
        joint_words(spring.joint),
        f"{1e-3 * stiffness:.4g}" if stiffness is not None else "taken for rigid",
        significant(1e-3 * sigma) if told and sigma is not None else "",
        f"{low} to {high}",
    )


def spring_facts(elastic: Elastic) -> tuple[Fact, ...]:
    """What the loads of the stops do."""
    return tuple(_facts(elastic))


def _facts(elastic: Elastic) -> Iterator[Fact]:
    median, most = map(significant, elastic.sag_mm)
    yield Fact("the flange gives way by", f"{median} mm", f"median; at most {most} mm")
    low, high = map(significant, elastic.payload_kg)
    if elastic.payload_kg[1] > 0.0:
        yield Fact("payload", f"{low} to {high} kg")
    if elastic.payload_factor is not None:
        value, sigma = elastic.payload_factor
        note = f"\N{PLUS-MINUS SIGN} {significant(sigma)}; 1 where load and bend fit"
        yield Fact("load as stated, times", f"{value:.2f}", note)


def deflection_against_load(elastic: Elastic) -> Markup:
    """How far each stop sees each told joint bend, over the torque on it.

    Returns:
        The figure; empty where no joint is told.
    """
    told = [it for it in elastic.springs if it.stiffness is not None and len(it.bends_mrad)]
    if not told:
        return Markup("")
    rows = -(-len(told) // _COLUMNS)
    with svg.style():
        figure = svg.new_figure(_WIDE_IN, _HIGH_IN * rows)
        panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
        for axes, spring in zip(panels, told, strict=False):
            ends = np.array([min(spring.torques_nm.min(), 0.0), max(spring.torques_nm.max(), 0.0)])
            axes.plot(ends, 1e3 * spring.compliance * ends, color=svg.LINE, linewidth=1.6)
            axes.plot(spring.torques_nm, spring.bends_mrad, "o", color=svg.ACCENT, markersize=3.0)
            axes.set_title(joint_words(spring.joint), fontsize=9)
            axes.set_xlabel("torque [N m]")
            axes.set_ylabel("bend [mrad]")
        for axes in panels[len(told) :]:
            axes.set_axis_off()
        return svg.inline(figure, "springs", "How far each joint bends over the torque on it")
