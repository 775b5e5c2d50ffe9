"""The report of a dynamic identification, as one HTML file."""

from collections.abc import Iterator, Sequence

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import matched, significant
from visioncal.core.types import FloatArray
from visioncal.dynamics import (
    Identified,
    Prediction,
    Run,
    friction_at,
    judge,
    measured_friction,
    stribeck_rows,
)
from visioncal.present import facts
from visioncal.present.facts import PLUS_MINUS
from visioncal.present.report import svg
from visioncal.present.report.axes import Box, Margins, Panel, Scale, boxes, spanning
from visioncal.present.report.svg import Figure
from visioncal.present.report.templates import template
from visioncal.present.tables import Fact

# Number of fitted motions shown: more look alike.
_MOST_FITTED = 2
_WIDE_IN, _PANEL_IN, _SQUARE_IN = 9.2, 1.15, 3.0
# Relative widths of torque and error panels.
_SHARES = (2.2, 1.0)
# Largest number of points per line, and of marks.
_MOST_POINTS, _MOST_MARKS = 1500, 600
_COLUMNS = 3
_CURVE_POINTS, _TICKS = 401, 5
# Gaps between columns and between rows.
_FRICTION_GAPS_IN = (0.55, 0.5)


def render_dynamics(run: Run) -> str:
    """Renders the report as HTML text."""
    identified = run.identified
    source = identified.facts.get("session", {})
    shown = [] if run.predicted is None else [(run.predicted, "not fitted")]
    shown += [(prediction, "fitted") for prediction in run.fitted[:_MOST_FITTED]]
    origin = {"session": source.get("name", ""), "sha256": source.get("sha256", "")}
    created = facts.readable_time(str(identified.facts.get("created", "")))
    judged = judge(identified)
    return template("dynamics.html.j2").render(
        kind="Dynamic identification",
        name=identified.robot.name,
        subtitle=" \N{MIDDLE DOT} ".join(value for value in (origin["session"], created) if value),
        notes=tuple(note for stream in identified.streams for note in stream.notes),
        judged=judged,
        steps=judged.next_steps,
        key_figures=tuple(_key_figures(identified)),
        provenance={name: value for name, value in origin.items() if value},
        identified=identified,
        counts=_counts(identified),
        humps=tuple(_hump_facts(identified)),
        plots=tuple((f"{each.label}, {use}", torques(each)) for each, use in shown),
        friction_plot=friction(identified, run.predictions),
    )


def _key_figures(identified: Identified) -> Iterator[Fact]:
    base, validation = identified.base, identified.validation
    yield Fact("base parameters", str(base.rank), f"of {len(base.model.names)}")
    shares = identified.determined
    yield Fact("known to 2 %", str(shares.count("2 %")), f"to 10 %: {shares.count('10 %')} more")
    if validation is not None:
        worst = int(np.argmax(validation.shares))
        median = significant(100.0 * float(np.median(validation.shares)))
        high = significant(100.0 * float(validation.shares[worst]))
        yield Fact("error on unseen motion", f"{median} %", f"up to {high} % (joint {worst + 1})")
    samples = sum(stream.samples for stream in identified.streams)
    yield Fact("samples", str(samples), f"{identified.robot.joint_count} torques each")


def _counts(identified: Identified) -> str:
    shares = identified.determined
    kinds = dict.fromkeys(("2 %", "10 %", *shares))
    return "; ".join(f"{kind}: {shares.count(kind)}" for kind in kinds)


def _hump_facts(identified: Identified) -> Iterator[Fact]:
    for row in stribeck_rows(identified):
        share, share_sigma = row["static_over_coulomb"], row["static_over_coulomb_sigma"]
        speed, speed_sigma = 1e3 * row["speed_rad_s"], 1e3 * row["speed_sigma_rad_s"]
        yield Fact(
            identified.robot.joint_names[row["joint"] - 1],
            f"{matched(share, share_sigma)} {PLUS_MINUS} {significant(share_sigma)} times",
            f"fading over {matched(speed, speed_sigma)} {PLUS_MINUS} "
            f"{significant(speed_sigma)} mrad/s",
        )


def torques(prediction: Prediction) -> Markup:
    """Measured and predicted torques of each joint over time, and their difference."""
    subset = slice(None, None, max(len(prediction.times_s) // _MOST_POINTS, 1))
    times = (prediction.times_s - prediction.times_s[0])[subset]
    measured, predicted = prediction.measured_nm[subset], prediction.predicted_nm[subset]
    errors = np.where(prediction.used[subset], measured - predicted, np.nan)
    joints = measured.shape[1]
    figure = Figure(_WIDE_IN, _PANEL_IN * joints + 0.4)
    margins, gaps_in = Margins(left=0.85, top=0.3), (0.75, 0.15)
    span = Scale(float(times[0]), float(times[-1]))
    for joint, pair in enumerate(boxes(figure, joints, 2, margins, gaps_in, _SHARES)):
        is_last = joint == joints - 1
        heights = spanning(np.concatenate([measured[:, joint], predicted[:, joint]]))
        panel = Panel(figure, pair[0], span, heights)
        error_panel = Panel(figure, pair[1], span, spanning(errors[:, joint]))
        for part, title in ((panel, f"joint {joint + 1}\n[N m]"), (error_panel, "")):
            part.x_axis("time [s]" if is_last else "", _TICKS, words=is_last)
            part.y_axis(title, 3)
        panel.line(times, measured[:, joint], svg.MUTED, 2.0)
        panel.line(times, predicted[:, joint], svg.ACCENT, 0.9)
        error_panel.line(times, errors[:, joint], svg.BAD, 0.7)
        if joint == 0:
            line, above = 2 * "\N{BOX DRAWINGS HEAVY HORIZONTAL}", pair[0].top - 6.0
            entries = [(line, svg.MUTED, "measured"), (line, svg.ACCENT, "predicted")]
            figure.legend(pair[0].left, above, entries, anchor="start")
            figure.legend(pair[1].left, above, [(line, svg.BAD, "error")], anchor="start")
    return figure.inline(f"Torques over time: {prediction.label}")


def friction(identified: Identified, predictions: Sequence[Prediction]) -> Markup:
    """Friction of each joint against its speed: by the torques, and by the model."""
    if not identified.base.model.terms.symbols:
        return Markup("")
    joints = identified.robot.joint_count
    rows = -(-joints // _COLUMNS)
    figure = Figure(_WIDE_IN, 0.75 * _SQUARE_IN * rows)
    grid = boxes(figure, rows, _COLUMNS, Margins(top=0.25), _FRICTION_GAPS_IN)
    panels = [box for row in grid for box in row]
    for joint, box in enumerate(panels[:joints]):
        speed = "speed [rad/s]" if joint >= joints - _COLUMNS else ""
        torque = "" if joint % _COLUMNS else "friction [N m]"
        panel = _friction_panel(figure, box, (speed, torque), identified, predictions, joint)
        panel.title(identified.robot.joint_names[joint])
    return figure.inline("Friction of each joint over its speed")


def _friction_panel(
    figure: Figure,
    box: Box,
    titles: tuple[str, str],
    identified: Identified,
    predictions: Sequence[Prediction],
    joint: int,
) -> Panel:
    samples = np.concatenate(
        [_samples(identified, prediction, joint) for prediction in predictions]
    )
    speeds, measured = samples[:: max(len(samples) // _MOST_MARKS, 1)].T
    max_speed = max(float(np.abs(speeds).max(initial=0.0)), 1e-3)
    # Small steps near standstill, where dry friction changes sign.
    steps = np.linspace(-1.0, 1.0, _CURVE_POINTS)
    curve = np.zeros((_CURVE_POINTS, identified.robot.joint_count))
    curve[:, joint] = max_speed * np.sign(steps) * np.abs(steps) ** 3
    modelled = friction_at(identified, curve)[:, joint]
    panel = Panel(
        figure, box, spanning(curve[:, joint]), spanning(np.concatenate([measured, modelled]))
    )
    panel.x_axis(titles[0], 5)
    panel.y_axis(titles[1], 5)
    panel.marks(speeds, measured, "dot", svg.MUTED, 3.0, 0.5)
    panel.line(curve[:, joint], modelled, svg.ACCENT)
    return panel


def _samples(identified: Identified, prediction: Prediction, joint: int) -> FloatArray:
    """(k, 2) speed and friction torque of the samples in the fit."""
    friction_nm = measured_friction(identified, prediction)
    return np.column_stack([prediction.dq[:, joint], friction_nm[:, joint]])[
        prediction.used[:, joint]
    ]
