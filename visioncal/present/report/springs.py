"""The joints that bend, in the report: stiffnesses, and deflection against load."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import significant
from visioncal.present.report import svg
from visioncal.present.report.axes import Margins, Panel, boxes, spanning
from visioncal.present.report.content import Fact
from visioncal.present.report.svg import Figure
from visioncal.present.words import joint_words, spring_words
from visioncal.results.arm import ElasticResult

_COLUMNS, _WIDE_IN, _HIGH_IN = 3, 9.2, 2.3
# Between the panels, for their labels.
_ACROSS_IN, _DOWN_IN = 0.75, 0.75


@dataclass(frozen=True)
class SpringRow:
    """A joint as text."""

    joint: str
    stiffness: str
    sigma: str
    torque: str


def spring_rows(elastic: ElasticResult) -> tuple[SpringRow, ...]:
    """The table of the joints."""
    return tuple(SpringRow(joint_words(it.joint), *spring_words(it)) for it in elastic.joints)


def spring_facts(elastic: ElasticResult) -> tuple[Fact, ...]:
    """What the loads of the stops do."""
    return tuple(_facts(elastic))


def _facts(elastic: ElasticResult) -> Iterator[Fact]:
    median, most = significant(elastic.sag_mm.median), significant(elastic.sag_mm.most)
    yield Fact("the flange gives way by", f"{median} mm", f"median; at most {most} mm")
    low, high = map(significant, elastic.payload_kg)
    if elastic.payload_kg[1] > 0.0:
        yield Fact("payload", f"{low} to {high} kg")
    if elastic.payload_factor is not None:
        factor = elastic.payload_factor
        note = f"\N{PLUS-MINUS SIGN} {significant(factor.sigma)}; 1 where load and bend fit"
        yield Fact("load as stated, times", f"{factor.value:.2f}", note)


def deflection_against_load(elastic: ElasticResult) -> Markup:
    """How far each stop sees each determined joint bend, over the torque on it.

    Returns:
        The figure; empty where no joint is determined.
    """
    bending = {
        spring: np.array(seen)
        for at, spring in enumerate(elastic.joints)
        if spring.stiffness_nm_per_rad is not None and (seen := elastic.bends(at))
    }
    if not bending:
        return Markup("")
    rows = -(-len(bending) // _COLUMNS)
    figure = Figure(_WIDE_IN, _HIGH_IN * rows)
    gaps_in = (_ACROSS_IN, _DOWN_IN)
    grid = boxes(figure, rows, _COLUMNS, Margins(top=0.25), gaps_in)
    panels = (box for row in grid for box in row)
    for box, (spring, points) in zip(panels, bending.items(), strict=False):
        torques_nm, bends_mrad = points.T
        ends = np.array([min(torques_nm.min(), 0.0), max(torques_nm.max(), 0.0)])
        line = 1e3 * spring.compliance_rad_per_nm * ends
        heights = spanning(np.concatenate([bends_mrad, line]))
        panel = Panel(figure, box, spanning(ends), heights)
        panel.x_axis("torque [N m]", 5)
        panel.y_axis("bend [mrad]", 5)
        panel.title(joint_words(spring.joint))
        panel.line(ends, line, svg.LINE)
        panel.marks(torques_nm, bends_mrad, "dot", svg.ACCENT, 4.0)
    return figure.inline("How far each joint bends over the torque on it")
