"""Plots of a dynamic identification: torques over time, and friction over speed."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from visioncal.core.types import FloatArray
from visioncal.dynamics import Identified, Prediction, friction_at, left_for_friction
from visioncal.present.report import svg

_WIDE_IN, _PANEL_IN, _SQUARE_IN = 9.2, 1.15, 3.0
# Widths of torques and of errors beside them.
_SHARES = (2.2, 1.0)
# More points than these a line hide each other.
_MOST_POINTS, _MOST_MARKS = 1500, 600
_COLUMNS = 3
_CURVE_POINTS, _TICKS = 401, 5


def torques(found: Prediction, number: int) -> Markup:
    """Measured and predicted torques of each joint over time, and what the prediction is off.

    Args:
        found: What to show.
        number: Its place among those of the page.
    """
    some = slice(None, None, max(len(found.times_s) // _MOST_POINTS, 1))
    times = (found.times_s - found.times_s[0])[some]
    measured, predicted = found.measured_nm[some], found.predicted_nm[some]
    off = np.where(found.used[some], measured - predicted, np.nan)
    with svg.style():
        joints = measured.shape[1]
        figure = svg.new_figure(_WIDE_IN, _PANEL_IN * joints + 0.4)
        panels = figure.subplots(joints, 2, sharex=True, squeeze=False, width_ratios=_SHARES)
        for joint, (axes, beside) in enumerate(panels):
            axes.plot(times, measured[:, joint], color=svg.MUTED, linewidth=2.0, label="measured")
            axes.plot(times, predicted[:, joint], color=svg.ACCENT, linewidth=0.9,
                      label="predicted")  # fmt: skip
            axes.set_ylabel(f"joint {joint + 1}\n[N m]")
            beside.plot(times, off[:, joint], color=svg.BAD, linewidth=0.7, label="error")
        for axes in panels[0]:
            axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.0)
        for axes in panels[-1]:
            axes.set_xlabel("time [s]")
            axes.set_xlim(float(times[0]), float(times[-1]))
            axes.xaxis.set_major_locator(MaxNLocator(_TICKS))
        return svg.inline(figure, f"torques-{number}", f"Torques over time: {found.label}")


def friction(identified: Identified, found: Sequence[Prediction]) -> Markup:
    """Each joint's friction over its speed: what the torques leave for it, and the fit.

    Args:
        identified: The fit.
        found: The motions.
    """
    if not identified.base.model.terms.symbols:
        return Markup("")
    joints = identified.robot.joint_count
    rows = -(-joints // _COLUMNS)
    with svg.style():
        figure = svg.new_figure(_WIDE_IN, 0.75 * _SQUARE_IN * rows)
        panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
        for joint, axes in enumerate(panels[:joints]):
            _friction_panel(axes, identified, found, joint)
            axes.set_title(identified.robot.joint_names[joint], fontsize=9.0)
        for axes in panels[joints:]:
            axes.set_visible(False)
        for axes in panels[max(joints - _COLUMNS, 0) : joints]:
            axes.set_xlabel("speed [rad/s]")
        for axes in panels[:joints:_COLUMNS]:
            axes.set_ylabel("friction [N m]")
        return svg.inline(figure, "friction", "Friction of each joint over its speed")


def _friction_panel(
    axes: Axes, identified: Identified, found: Sequence[Prediction], joint: int
) -> None:
    samples = np.concatenate([_samples(identified, it, joint) for it in found])
    speeds, left = samples[:: max(len(samples) // _MOST_MARKS, 1)].T
    reach = max(float(np.abs(speeds).max(initial=0.0)), 1e-3)
    axes.plot(speeds, left, ".", color=svg.MUTED, markersize=2.0, alpha=0.5, rasterized=True)
    # Close to rest, where dry friction turns over, in small steps.
    around = np.linspace(-1.0, 1.0, _CURVE_POINTS)
    curve = np.zeros((_CURVE_POINTS, identified.robot.joint_count))
    curve[:, joint] = reach * np.sign(around) * np.abs(around) ** 3
    taken = friction_at(identified, curve)[:, joint]
    axes.plot(curve[:, joint], taken, color=svg.ACCENT, linewidth=1.6)


def _samples(identified: Identified, found: Prediction, joint: int) -> FloatArray:
    """(k, 2) speeds and what is left for friction, of samples that count."""
    left = left_for_friction(identified, found)
    return np.column_stack([found.dq[:, joint], left[:, joint]])[found.used[:, joint]]
