"""The report of a dynamic identification, as one HTML file."""

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.figure import Figure

from visioncal.core.number_format import matched, significant
from visioncal.dynamics import Identified
from visioncal.dynamics.identified import judge, stribeck_rows
from visioncal.dynamics.identify import Prediction, friction_at
from visioncal.dynamics.run import Run
from visioncal.present import facts
from visioncal.present.report.plotting import (
    ACCENT,
    BAD,
    MUTED,
    WIDE_IN,
    drawn,
    few_ticks,
    legend,
    panels,
)
from visioncal.present.report.templates import template
from visioncal.present.tables import Fact

_COLUMNS = 3
_CURVE_POINTS = 401  # Speeds of a curve of friction.


def render_dynamics(run: Run) -> str:
    """Renders the report as HTML text."""
    identified = run.identified
    source = identified.facts.get("session", {})
    shown = [] if run.predicted is None else [(run.predicted, "not fitted")]
    # More look alike.
    shown += [(prediction, "fitted") for prediction in run.fitted[:2]]
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
        counts="; ".join(
            f"{kind}: {identified.determined.count(kind)}"
            for kind in dict.fromkeys(("2 %", "10 %", *identified.determined))
        ),
        humps=stribeck_rows(identified),
        matched=matched,
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


@drawn
def torques(prediction: Prediction) -> tuple[Figure, str]:
    """Measured and predicted torques of each joint over time, and their difference."""
    subset = slice(None, None, max(len(prediction.times_s) // 1500, 1))
    times = (prediction.times_s - prediction.times_s[0])[subset]
    measured, predicted = prediction.measured_nm[subset], prediction.predicted_nm[subset]
    errors = np.where(prediction.used[subset], measured - predicted, np.nan)
    joints = measured.shape[1]
    figure, grid = panels(
        WIDE_IN,
        1.15 * joints + 0.4,
        joints,
        2,
        (0.8, 0.45, 0.06, 0.3),
        sharex=True,
        width_ratios=(2.2, 1.0),
    )
    for joint, (axes, error_axes) in enumerate(grid):
        axes.plot(times, measured[:, joint], color=MUTED, linewidth=2.0)
        axes.plot(times, predicted[:, joint], color=ACCENT, linewidth=0.9)
        error_axes.plot(times, errors[:, joint], color=BAD, linewidth=0.7)
        axes.set_ylabel(f"joint {joint + 1}\n[N m]")
        few_ticks(axes, y=3)
        few_ticks(error_axes, 4, 3)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    entries = [("line", MUTED, "measured"), ("line", ACCENT, "predicted")]
    legend(figure, [*entries, ("line", BAD, "error")])
    return figure, f"Torques over time: {prediction.label}"


@drawn
def friction(
    identified: Identified, predictions: Sequence[Prediction]
) -> tuple[Figure, str] | None:
    """Friction of each joint against its speed: by the torques, and by the model."""
    if not identified.base.model.terms.symbols:
        return None
    joints = identified.robot.joint_count
    rows = -(-joints // _COLUMNS)
    figure, grid = panels(WIDE_IN, 2.3 * rows, rows, _COLUMNS, (0.8, 0.45, 0.06, 0.3))
    figure.subplots_adjust(wspace=0.22, hspace=0.3)
    for axes in grid.flat[joints:]:
        axes.set_visible(False)
    # Measured torques less all predicted ones but friction's.
    measured_nm = [
        friction_at(identified, each.dq) + each.measured_nm - each.predicted_nm
        for each in predictions
    ]
    for joint, axes in enumerate(grid.flat[:joints]):
        shown = (
            np.column_stack([each.dq[:, joint], torque_nm[:, joint]])[each.used[:, joint]]
            for each, torque_nm in zip(predictions, measured_nm, strict=True)
        )
        samples = np.concatenate([*shown])
        samples = samples[:: max(len(samples) // 600, 1)]
        max_speed = max(float(np.abs(samples[:, 0]).max(initial=0.0)), 1e-3)
        # Small steps near standstill, where dry friction changes sign.
        steps = np.linspace(-1.0, 1.0, _CURVE_POINTS)
        curve = np.zeros((_CURVE_POINTS, identified.robot.joint_count))
        curve[:, joint] = max_speed * np.sign(steps) * np.abs(steps) ** 3
        modelled = friction_at(identified, curve)[:, joint]
        axes.plot(*samples.T, ".", color=MUTED, alpha=0.5, markersize=3.0)
        axes.plot(curve[:, joint], modelled, color=ACCENT, linewidth=1.6)
        few_ticks(axes, 5, 5)
        axes.set_title(identified.robot.joint_names[joint])
        axes.set_xlabel("speed [rad/s]" if joint >= joints - _COLUMNS else "")
        axes.set_ylabel("" if joint % _COLUMNS else "friction [N m]")
    return figure, "Friction of each joint over its speed"
