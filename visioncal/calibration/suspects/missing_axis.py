"""An axis that moved the robot and is in no pose, as a rail under its base."""

from collections.abc import Iterable, Iterator

import numpy as np

from visioncal.calibration.guess.fit import distance_rows, robust_fits
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.conventions import UNITS_M
from visioncal.core.limits import CLEAR_RATIO, FEWEST_COMPARED, CalibrationLimits
from visioncal.core.number_format import figure
from visioncal.core.transforms import robot_part
from visioncal.core.types import FloatArray, IntArray, Mount
from visioncal.core.verdict import CALIBRATE, Finding, Option, Remedy, calibrating, mending
from visioncal.estimation.observability import too_little_motion
from visioncal.session.columns import MEASURED_CAM_POSE, POSE

# Steps by which the direction is found, and what a direction differs by from an axis of the base
# [rad]: as a rail is mounted.
_STEPS, _ALONG_RAD = 20, 0.03
# Share of the views that have the axis in common; the others may be wrong.
_MOST = 0.7
# A column is the axis where its factor is that of a unit but for this share.
_UNIT = 0.03
# Columns that number, time or place a view, and are no axis.
_KNOWN = {"view", "stop", "stamp_s", *POSE, *MEASURED_CAM_POSE}


def missing_axes(run: RunState, views: IntArray, pairs: FloatArray) -> Iterator[Finding]:
    """The finding that positions lack a motion along one line, which the camera saw.

    Rotations of robot and camera determine the rotation of X; places then are linear in the
    translations of both edges, and what remains of them lies on a line of the base.

    Args:
        run: The run, of one robot and camera.
        views: (m,) numbers of the views that have both poses.
        pairs: (m, 2, 4, 4) poses of the robot, and of the target by each image alone.
    """
    if not run.session.has_one_pair or len(views) <= FEWEST_COMPARED:
        return
    # Without turns, positions alone leave a line open that no axis moved along.
    if too_little_motion(pairs[:, 0], run.session.mount)[0]:
        return
    direction, motion, away_m, angles = _line(pairs, run.session.mount)
    # Across the line, no more is left than an arm errs by; along it, more moved than one thing
    # once, or than a few views.
    limits, moved_m = CalibrationLimits().arm_errors, float(np.ptp(motion))
    is_right = away_m < 1e-3 * limits[0] and np.quantile(angles, _MOST) < np.deg2rad(limits[1])
    many_m = np.quantile(np.abs(motion - np.median(motion)), _MOST)
    if not is_right or min(_left_by_step(motion), many_m) < CLEAR_RATIO * away_m:
        return
    axis = int(np.abs(direction).argmax())
    is_axis = np.arccos(min(abs(direction[axis]), 1.0)) < _ALONG_RAD
    name = "xyz"[axis] if is_axis else f"({', '.join(f'{part:.2f}' for part in direction)})"
    words = (
        f"The robot's positions lack a motion along {name} of its base: across it, robot and "
        f"camera agree to {figure(1e3 * away_m)} mm, and along it they differ by up to "
        f"{figure(1e3 * moved_m)} mm, as where a rail, a gantry or another external "
        "axis moved that is in no pose."
    )
    step = "Write poses that contain this axis"
    if is_axis:
        step = f"In views.csv, add this axis's position to {name}_m of each row (m; or as a column "
        step += "of its own, whose motion is then found)"
    do = calibrating(f"{step}, or", "views at one place of it.", "")
    if is_axis and _is_in_other_order(pairs[:, 0, axis, 3], motion, away_m):
        words = (
            f"The robot's {name} has the numbers of other rows, as where its column was sorted by "
            f"itself: in the order that the images show, robot and camera agree to "
            f"{figure(1e3 * away_m)} mm, and in that of the rows they differ by up to "
            f"{figure(1e3 * moved_m)} mm."
        )
        step = f"In views.csv, write column {name}_m anew, each number in the row of its own pose."
        do = Remedy(f"{step} Calibrate again.", CALIBRATE, of_check=f"{step} Verify again.")
        yield Finding("misread_poses", words, do)
        return
    by_view = dict(zip(views.tolist(), motion.tolist(), strict=True))
    every = tuple(view.number for view in run.session.views)
    for _, factor in _columns(run, by_view, away_m, [POSE[axis]] if is_axis else []):
        share = 1.0 + factor
        if (unit := _unit_of(share)) != "m" and abs(np.log(abs(share))) > _UNIT:
            # A wrong power of ten, or what the motion tells.
            ten = float(np.copysign(10.0 ** np.round(np.log10(abs(share))), share))
            size = UNITS_M.get(unit, ten if abs(share / ten - 1.0) < _UNIT else round(share, 4))
            words = (
                f"The robot's {name} is in {unit or 'another unit'}, its other positions in m: "
                f"multiplied by {size:g}, it lets robot and camera agree to "
                f"{figure(1e3 * away_m)} mm."
            )
            mended = (f"{size:g}*{at}" if at == name else at for at in "xyz")
            do = mending("all of them are in m", Option("positions", ",".join(mended), every))
            yield Finding("misread_poses", words, do)
            return
    # Columns that no stage reads.
    columns = [column for column in run.session.columns if column not in _KNOWN]
    for column, factor in _columns(run, by_view, away_m, columns):
        if not (unit := _unit_of(abs(factor))):
            continue
        size = np.copysign(UNITS_M[unit], factor)
        terms = ",".join(
            f"{at}{size * part:+g}*{column}" if abs(part) > np.sin(_ALONG_RAD) else at
            for at, part in zip("xyz", np.round(direction, 3 if not is_axis else 0), strict=True)
        )
        words += f" Column {column} of views.csv has it."
        do = mending("it is added to the positions", Option("positions", terms, every))
        break
    yield Finding("misread_poses", words, do)


def _is_in_other_order(values: FloatArray, motion: FloatArray, away_m: float) -> bool:
    """Whether values (m,) with the motion (m,) that they lack are the same ones in other rows."""
    apart = np.sort(values + motion) - np.sort(values)
    apart -= np.median(apart)
    return float(np.quantile(np.abs(apart), 0.9)) < max(CLEAR_RATIO * away_m, 1e-4)


def _left_by_step(motion: FloatArray) -> float:
    """Least rms [m] of a motion (m,) beside one step."""
    parts = ((motion[:at], motion[at:]) for at in range(1, len(motion)))
    squares = (sum(float(np.sum((part - part.mean()) ** 2)) for part in each) for each in parts)
    return float(np.sqrt(min(squares) / len(motion)))


def _line(pairs: FloatArray, mount: Mount) -> tuple[FloatArray, FloatArray, float, FloatArray]:
    """The line in the base with the least residuals across it.

    Returns:
        The direction (3,), the motion along it (m,) [m], the rms by axis across it [m], and how far
        the rotations are from agreeing (m,) [rad].
    """
    flanges, camera = pairs[:, 0], pairs[:, 1]
    robot = robot_part(flanges, mount)
    (fit,) = robust_fits(robot[None], camera[None])
    by_edges, seen = distance_rows(robot, camera, fit.x)
    rows, places = by_edges[..., :6], seen + by_edges[..., 6]
    if mount == "eye-to-hand":
        # In the axes of the base, in which a rail lies still.
        turned = -flanges[:, :3, :3]
        rows, places = turned @ rows, (turned @ places[..., None])[..., 0]
    best = np.eye(3)[0], np.zeros(len(pairs)), np.inf
    for start in np.eye(3):
        direction = start
        for _ in range(_STEPS):
            across = np.eye(3) - np.outer(direction, direction)
            edges = np.linalg.lstsq((across @ rows).reshape(-1, 6), -(places @ across).ravel())[0]
            left = places + rows @ edges
            # A shift that is the same in all views is a place of the target.
            left -= np.median(left, axis=0)
            direction = np.linalg.svd(left, full_matrices=False)[2][0]
        outside = left - np.outer(left @ direction, direction)
        # Half of the views may be wrong.
        away = float(np.sqrt(np.median(np.sum(outside**2, axis=1)) / 2.0))
        if away < best[2]:
            direction = direction * np.sign(direction[np.abs(direction).argmax()])
            best = direction, -left @ direction, away
    return *best, fit.angle


def _columns(
    run: RunState, motion: dict[int, float], away_m: float, names: Iterable[str]
) -> Iterator[tuple[str, float]]:
    """Columns that this motion [m] follows, with their factors."""
    rows = {view.number: view for view in run.session.views if view.number in motion}
    along = np.array([motion[view] for view in rows])
    for column in names:
        try:
            values = np.array([float(view.cell(column)) for view in rows.values()])
        except ValueError:
            continue
        if not np.isfinite(values).all() or np.ptp(values) == 0.0:
            continue
        factor, _ = np.polyfit(values, along, 1)
        left = along - factor * values
        if np.median(np.abs(left - np.median(left))) <= max(3.0 * away_m, 1e-4):
            yield column, float(factor)


def _unit_of(factor: float) -> str:
    """The unit that a factor stands for; empty for none."""
    near = (unit for unit, size_m in UNITS_M.items() if abs(factor / size_m - 1.0) < _UNIT)
    return next(near, "")
