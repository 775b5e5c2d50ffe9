"""Tool frame from touches (TCP calibration), with its verdict."""

from collections.abc import Iterator
from typing import cast

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.limits import ToolLimits
from visioncal.core.number_format import figure
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.verdict import AGAIN, Finding, Remedy
from visioncal.estimation.pivot import PivotFit, Touches, TouchKind, fit_pivot
from visioncal.estimation.placing import assumed_words
from visioncal.frames.fixture import FitSettings, PointsFit
from visioncal.frames.touches import TouchRows, flange_poses, refuse_copies, robot_noise
from visioncal.results import Calibration, Edge, Frame
from visioncal.robot import Robot

TOUCH_KINDS = ("point", "z", "xz")


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
    numbers = {name: at for at, name in enumerate(dict.fromkeys(rows.points))}
    touches = Touches(
        poses,
        np.array([numbers[point] for point in rows.points], dtype=np.int64),
        cast("tuple[TouchKind, ...]", rows.kinds),
        rows.labels,
        tuple(numbers),
    )
    fit = fit_pivot(touches, robot_noise(calibration), touch_noise_m)
    fitted = PointsFit(
        rows.source,
        rows.labels,
        [f"Touch {label}" for label in rows.labels],
        rows.places,
        rows.kinds,
        Edge(fit.flange_from_tool, fit.covariance),
        fit.agreement,
        ["the tip had slipped, it is of another point, or the pose is of another moment"]
        * len(touches),
        fit.agreement.fit.sigma,
        fit.worst,
        fit.oriented,
    )
    doubts: tuple[Finding, ...] = ()
    is_calibrated = calibration is not None and calibration.arm_is_calibrated
    if is_calibrated and (rows.joints_rad is None or not np.isfinite(rows.joints_rad).all()):
        words = (
            "The calibration is of a calibrated arm, but touches come without joint angles: their "
            "poses are the nominal arm's, off by as much as its errors."
        )
        doubts = (Finding("nominal_poses", words, Remedy("Write down q1_rad ... too.")),)
    setting = FitSettings(
        touch_noise_m,
        doubts,
        options=options or ToolLimits(),
        noisy="Touch again with a sharp tip; an arm that was never calibrated is off by a "
        "millimetre from posture to posture, and poses that are read wrongly (--robot-form, "
        "--robot-inverse) by more.",
        weak="Add touches tilted by 30 to 45 degrees about other axes.",
    )
    more = tuple(_findings(fit, touches, setting))
    counts = {kind: rows.kinds.count(kind) for kind in TOUCH_KINDS}
    pairs = zip(rows.points, rows.kinds, strict=True)
    points = len({point for point, kind in pairs if kind == "point"})
    of = "one point" if points == 1 else f"{points} points"
    method = f"pivot of {counts['point']} touches of {of}"
    if counts["z"]:
        method += f"; rotation from {counts['z']} along z and {counts['xz']} in the xz plane"
    turns = invert(poses)[:, None] @ poses[None]
    names = [name or "point" for name in touches.names]
    sigmas_mm = [1e3 * float(np.sqrt(np.trace(array))) for array in fit.points_covariance]
    details = {
        "turn_deg": float(np.rad2deg(rotation_angle(turns).max())),
        "points_m": dict(zip(names, fit.agreement.fit.state.points.tolist(), strict=True)),
        "points_sigma_mm": dict(zip(names, sigmas_mm, strict=True)),
    }
    return fitted.frame(method, more, details, setting)


def _findings(fit: PivotFit, touches: Touches, setting: FitSettings) -> Iterator[Finding]:
    """Findings on what the poses are of, and on too few touches."""
    if fit.looks_inverse:
        yield Finding(
            "inverse_poses",
            "The tip would be farther from the flange than the point from the base: poses read the "
            "other way round look like this.",
            Remedy("If the columns hold flange_from_base, say so.", f"{AGAIN} --robot-inverse"),
        )
    tip_m = float(np.linalg.norm(fit.flange_from_tool[:3, 3]))
    # A tip nearer to the poses' origin than any tool is long: the poses are a tool's already [m].
    if tip_m < 2e-3:
        yield Finding(
            "active_tool",
            f"The tip is {figure(1e3 * tip_m)} mm from the origin of the "
            "poses' own frame: they look like those of a tool that was active in the controller, "
            "and of that tool's tip.",
            Remedy("Set the controller's tool to zero, and write the poses of the flange."),
        )
    used = int(np.sum(fit.agreement.mask & touches.are("point")))
    needed, sigma_m = setting.fewest, fit.agreement.fit.sigma
    if used < needed:
        assumed = assumed_words(sigma_m, setting.touch_noise_m)
        yield Finding(
            "few_touches",
            f"Only {used} touches of a point are used: {needed} or more give the result "
            f"something to be checked with.{assumed}",
            Remedy("Touch the point from more directions."),
        )
