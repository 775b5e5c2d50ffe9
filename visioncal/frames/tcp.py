"""Tool frame from touches (TCP calibration), with its verdict."""

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import Any, cast

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError, DegenerateError, VisioncalError
from visioncal.core.limits import ToolLimits
from visioncal.core.number_format import figure
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray
from visioncal.core.verdict import AGAIN, AGREEMENT, Finding, Remedy, Verdict
from visioncal.estimation.pivot import PivotFit, fit_pivot
from visioncal.estimation.placing import assumed_words
from visioncal.estimation.readings import PoseReading, readings_that_close
from visioncal.estimation.touching import Touches, TouchKind
from visioncal.frames.findings import (
    RENAMED,
    noise_findings,
    off_words,
    outlier_findings,
    placed_name,
    sigma_findings,
)
from visioncal.frames.touches import (
    TouchRows,
    flange_poses,
    nominal_pose_findings,
    numbered,
    refuse_copies,
    robot_noise,
)
from visioncal.results import Calibration, Edge, Frame, Observation
from visioncal.robot import Robot

TOUCH_KINDS = ("point", "z", "xz")
# A tip nearer to the poses' origin than any tool is long: the poses are a tool's already [m].
_NO_TOOL_M = 2e-3


@typed
def touched_tool(
    rows: TouchRows,
    calibration: Calibration | None = None,
    robot: Robot | None = None,
    *,
    touch_noise_m: float | None = None,
    options: ToolLimits | None = None,
) -> Frame:
    """Estimates a tool's tip, and its rotation where touches determine it.

    Args:
        rows: The touches. Of kind `point`, the tip is at the point; of kind `z`, the point lies on
            the tool's positive z axis; of kind `xz`, in its xz plane on the side of positive x.
        calibration: Of the same robot, for its noise and arm; optional.
        robot: The model for joint angles, where the calibration has none.
        touch_noise_m: Known repeatability of a touch, per axis [m].
        options: Limits of the verdict.

    Returns:
        `flange_from_tool`.

    Raises:
        DataError: Touches are missing, wrongly written, or contradict each other.
        DegenerateError: They do not determine the tool in every direction.
    """
    rows = rows.of_kinds(TOUCH_KINDS, "point")
    poses = flange_poses(rows, robot, calibration)
    refuse_copies(poses, rows.places)
    touches = _touches(rows, poses)
    try:
        fit = fit_pivot(touches, robot_noise(calibration), touch_noise_m)
    except (DataError, DegenerateError) as error:
        raise _with_reading(error, touches) from error
    assumed = assumed_words(fit.sigma_m, touch_noise_m)
    findings = list(_findings(fit, touches, rows.places, options or ToolLimits(), assumed))
    findings += nominal_pose_findings(rows, calibration)
    return Frame(
        Edge(fit.flange_from_tool, fit.covariance),
        fit.oriented,
        _method(rows),
        rows.source,
        datetime.now(UTC).isoformat(timespec="seconds"),
        1e3 * fit.rms_m,
        1e3 * fit.sigma_m,
        tuple(_observations(fit, touches)),
        Verdict.by(findings, Finding(AGREEMENT, _praise(fit, touches))),
        _details(fit, touches),
    )


def _touches(rows: TouchRows, poses: FloatArray) -> Touches:
    numbers = numbered(rows.points)
    return Touches(
        poses,
        np.array([numbers[point] for point in rows.points], dtype=np.int64),
        cast("tuple[TouchKind, ...]", rows.kinds),
        rows.labels,
        tuple(numbers),
    )


def _with_reading(error: VisioncalError, touches: Touches) -> VisioncalError:
    """Adds a hint where another reading of the poses explains the error."""
    hint = _reading_hint(touches)
    if not hint:
        return error
    step = f"{hint} {error.next_step}".strip()
    return type(error)(error.message, culprits=error.culprits, next_step=step)


def _reading_hint(touches: Touches) -> str:
    readings = readings_that_close(touches)
    if not readings:
        return ""
    words, options = _closing_words(readings[0]), readings[0].options
    if options == "--robot-inverse":
        return f"{words}: do the columns hold it? Then add {options}."
    return f"{words}: are the columns in that order?"


def _closing_words(best: PoseReading) -> str:
    return (
        f"Read {best.words}, the touches close to {figure(1e3 * best.rms_m)} mm instead of "
        f"{figure(1e3 * best.as_read_m)} mm"
    )


def _method(rows: TouchRows) -> str:
    counts = {kind: rows.kinds.count(kind) for kind in TOUCH_KINDS}
    points = len(
        {point for point, kind in zip(rows.points, rows.kinds, strict=True) if kind == "point"}
    )
    of = "one point" if points == 1 else f"{points} points"
    tip = f"pivot of {counts['point']} touches of {of}"
    if not counts["z"]:
        return tip
    return f"{tip}; rotation from {counts['z']} along z and {counts['xz']} in the xz plane"


def _observations(fit: PivotFit, touches: Touches) -> Iterator[Observation]:
    agreement = fit.agreement
    for at, label in enumerate(touches.labels):
        is_suspect = not agreement.mask[at] or bool(agreement.doubtful[at])
        yield Observation(
            label,
            used=bool(agreement.mask[at]),
            reason=_outlier_reason(fit, touches, at) if is_suspect else "",
            kind=touches.kinds[at],
            residual_mm=1e3 * float(agreement.off_m[at]),
        )


def _outlier_reason(fit: PivotFit, touches: Touches, at: int) -> str:
    """Why a touch is an outlier or in doubt."""
    words = off_words(fit.agreement, at)
    if fit.agreement.doubtful[at]:
        return f"{words}: one of the touches that contradict each other"
    belongs = fit.belongs_to[at]
    if belongs is not None:
        return f"{words}; it fits point {touches.names[belongs]!r}{RENAMED}"
    return f"{words}: the tip had slipped, or the pose is of another moment"


def _findings(
    fit: PivotFit, touches: Touches, places: Sequence[str], options: ToolLimits, assumed: str
) -> Iterator[Finding]:
    for best in readings_that_close(touches)[:1]:
        command = f"{AGAIN} {best.options}" if best.options else ""
        step = Remedy("If the columns are in that order, say so.", command)
        words = f"{_closing_words(best)}."
        yield Finding("misread_poses", words, step, probability=1.0, by_limit=True, is_fatal=True)
    rows = range(len(touches))
    yield from outlier_findings(
        [placed_name(f"Touch {touches.labels[row]}", places[row]) for row in rows],
        [_outlier_reason(fit, touches, row) for row in rows],
        fit.agreement,
        "Touch what is named once more, and write the new poses in its rows.",
    )
    yield from noise_findings(
        1e3 * fit.sigma_m,
        options.noise_mm,
        "Touch again with a sharp tip; an arm that was never calibrated is off by a millimetre "
        "from posture to posture.",
        explained=fit.agreement.explained,
    )
    if fit.looks_inverse:
        yield Finding(
            "inverse_poses",
            "The tip would be farther from the flange than the point from the base: poses read the "
            "other way round look like this.",
            Remedy("If the columns hold flange_from_base, say so.", f"{AGAIN} --robot-inverse"),
        )
    tip_m = float(np.linalg.norm(fit.flange_from_tool[:3, 3]))
    if tip_m < _NO_TOOL_M:
        yield Finding(
            "active_tool",
            f"The tip is {figure(1e3 * tip_m)} mm from the origin of the "
            "poses' own frame: they look like those of a tool that was active in the controller, "
            "and of that tool's tip.",
            Remedy("Set the controller's tool to zero, and write the poses of the flange."),
        )
    yield from sigma_findings(
        fit.worst,
        options.sigma_mm,
        options.sigma_deg,
        "Add touches tilted by 30 to 45 degrees about other axes.",
    )
    used = int(np.sum(fit.agreement.mask & touches.are("point")))
    if used < options.touches:
        yield Finding(
            "few_touches",
            f"Only {used} touches of a point are used: {options.touches} or more give the result "
            f"something to be checked with.{assumed}",
            Remedy("Touch the point from more directions."),
        )


def _praise(fit: PivotFit, touches: Touches) -> str:
    worst = fit.worst[0]
    rotation = "" if fit.oriented else " The rotation was not touched: it is the flange's own."
    return (
        f"{len(touches)} touches agree to {figure(1e3 * fit.sigma_m)} mm per axis, and "
        f"{worst.words}, the worst direction, is known to {figure(1e3 * worst.sigma)} mm.{rotation}"
    )


def _details(fit: PivotFit, touches: Touches) -> dict[str, Any]:
    turns = invert(touches.base_from_flange)[:, None] @ touches.base_from_flange[None]
    return {
        "noise_95_mm": [1e3 * value for value in fit.agreement.fit.sigma_95],
        "turn_deg": float(np.rad2deg(rotation_angle(turns).max())),
        "points_m": {
            _point_name(name): point.tolist()
            for name, point in zip(touches.names, fit.points, strict=True)
        },
        "points_sigma_mm": {
            _point_name(name): 1e3 * float(np.sqrt(np.trace(covariance)))
            for name, covariance in zip(touches.names, fit.points_covariance, strict=True)
        },
    }


def _point_name(name: str) -> str:
    return name or "point"
