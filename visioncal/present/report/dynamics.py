"""The report of a dynamic identification: one HTML file, as that of a calibration."""

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
    left_for_friction,
    stribeck_rows,
)
from visioncal.present import facts
from visioncal.present.facts import PLUS_MINUS
from visioncal.present.report import svg
from visioncal.present.report.axes import Box, Margins, Panel, Scale, boxes, spanning
from visioncal.present.report.svg import Figure
from visioncal.present.report.templates import template
from visioncal.present.tables import Fact

# So many of the fitted motions are shown: more look alike.
_MOST_FITTED = 2
_WIDE_IN, _PANEL_IN, _SQUARE_IN = 9.2, 1.15, 3.0
# Widths of torques and of errors beside them.
_SHARES = (2.2, 1.0)
# More points than these a line hide each other.
_MOST_POINTS, _MOST_MARKS = 1500, 600
_COLUMNS = 3
_CURVE_POINTS, _TICKS = 401, 5
# Between columns and between rows.
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
        plots=tuple(_plots(shown)),
        friction_plot=friction(identified, run.predictions),
    )


def _plots(shown: Sequence[tuple[Prediction, str]]) -> Iterator[tuple[str, Markup]]:
    """Torques over time, with a title each."""
    for prediction, how in shown:
        yield f"{prediction.label}, {how}", torques(prediction)


def _key_figures(identified: Identified) -> Iterator[Fact]:
    base, found = identified.base, identified.validation
    yield Fact("base parameters", str(base.rank), f"of {len(base.model.names)}")
    shares = identified.determined
    yield Fact("known to 2 %", str(shares.count("2 %")), f"to 10 %: {shares.count('10 %')} more")
    if found is not None:
        worst = int(np.argmax(found.shares))
        median = significant(100.0 * float(np.median(found.shares)))
        high = significant(100.0 * float(found.shares[worst]))
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


def torques(found: Prediction) -> Markup:
    """Measured and predicted torques of each joint over time, and what the prediction is off."""
    some = slice(None, None, max(len(found.times_s) // _MOST_POINTS, 1))
    times = (found.times_s - found.times_s[0])[some]
    measured, predicted = found.measured_nm[some], found.predicted_nm[some]
    off = np.where(found.used[some], measured - predicted, np.nan)
    joints = measured.shape[1]
    figure = Figure(_WIDE_IN, _PANEL_IN * joints + 0.4)
    margins, gaps_in = Margins(left=0.85, top=0.3), (0.75, 0.15)
    span = Scale(float(times[0]), float(times[-1]))
    for joint, pair in enumerate(boxes(figure, joints, 2, margins, gaps_in, _SHARES)):
        last = joint == joints - 1
        heights = spanning(np.concatenate([measured[:, joint], predicted[:, joint]]))
        panel = Panel(figure, pair[0], span, heights)
        beside = Panel(figure, pair[1], span, spanning(off[:, joint]))
        for item, title in ((panel, f"joint {joint + 1}\n[N m]"), (beside, "")):
            item.x_axis("time [s]" if last else "", _TICKS, words=last)
            item.y_axis(title, 3)
        panel.line(times, measured[:, joint], svg.MUTED, 2.0)
        panel.line(times, predicted[:, joint], svg.ACCENT, 0.9)
        beside.line(times, off[:, joint], svg.BAD, 0.7)
        if joint == 0:
            line, above = 2 * "\N{BOX DRAWINGS HEAVY HORIZONTAL}", pair[0].top - 6.0
            entries = [(line, svg.MUTED, "measured"), (line, svg.ACCENT, "predicted")]
            figure.legend(pair[0].left, above, entries, anchor="start")
            figure.legend(pair[1].left, above, [(line, svg.BAD, "error")], anchor="start")
    return figure.inline(f"Torques over time: {found.label}")


def friction(identified: Identified, found: Sequence[Prediction]) -> Markup:
    """Each joint's friction over its speed: what the torques leave for it, and the fit."""
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
        panel = _friction_panel(figure, box, (speed, torque), identified, found, joint)
        panel.title(identified.robot.joint_names[joint])
    return figure.inline("Friction of each joint over its speed")


def _friction_panel(
    figure: Figure,
    box: Box,
    titles: tuple[str, str],
    identified: Identified,
    found: Sequence[Prediction],
    joint: int,
) -> Panel:
    samples = np.concatenate([_samples(identified, prediction, joint) for prediction in found])
    speeds, left = samples[:: max(len(samples) // _MOST_MARKS, 1)].T
    reach = max(float(np.abs(speeds).max(initial=0.0)), 1e-3)
    # Close to rest, where dry friction turns over, in small steps.
    around = np.linspace(-1.0, 1.0, _CURVE_POINTS)
    curve = np.zeros((_CURVE_POINTS, identified.robot.joint_count))
    curve[:, joint] = reach * np.sign(around) * np.abs(around) ** 3
    taken = friction_at(identified, curve)[:, joint]
    panel = Panel(figure, box, spanning(curve[:, joint]), spanning(np.concatenate([left, taken])))
    panel.x_axis(titles[0], 5)
    panel.y_axis(titles[1], 5)
    panel.marks(speeds, left, "dot", svg.MUTED, 3.0, 0.5)
    panel.line(curve[:, joint], taken, svg.ACCENT)
    return panel


def _samples(identified: Identified, found: Prediction, joint: int) -> FloatArray:
    """(k, 2) speeds and what is left for friction, of samples that count."""
    left = left_for_friction(identified, found)
    return np.column_stack([found.dq[:, joint], left[:, joint]])[found.used[:, joint]]
