"""Tool frame from touches (TCP calibration), with its verdict."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import cast

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.conventions import ROTATION_FORMS, PoseNumbers
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.limits import CLEAR_RATIO, WIDE_RAD, ToolLimits
from visioncal.core.number_format import figure, some_of
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.verdict import AGAIN, Finding, Option, Remedy, again
from visioncal.estimation.points import FEWEST_POINTS
from visioncal.frames.pivot import (
    PivotFit,
    Touches,
    TouchKind,
    fit_pivot,
    looks_inverse,
    scatter_m,
    tip_start,
    tips_and_points,
    two_points,
)
from visioncal.frames.placing import assumed_words
from visioncal.frames.points_frame import FitSettings, PointsFit
from visioncal.frames.touches import TouchRows, flange_poses, refuse_copies, robot_noise
from visioncal.results import Calibration, Edge, Frame
from visioncal.robot import Robot

TOUCH_KINDS = ("point", "z", "xz")
_INVERSE = Finding(
    "inverse_poses",
    "The tip would be farther from the flange than the point from the base: poses read the other "
    "way round look like this.",
    again("If the columns hold flange_from_base, say so.", Option("robot-inverse")),
)


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
    options = options or ToolLimits()
    limit_m = 1e-3 * options.noise_mm[0]
    try:
        fit = fit_pivot(touches, robot_noise(calibration), touch_noise_m)
    except (DataError, DegenerateError) as error:
        if rows.kinds.count("point") < FEWEST_POINTS:
            raise
        other = _other_reading(touches, rows.numbers, limit_m)
        other = other or next(_two_points(touches, rows.places, limit_m), None)
        # Touches of axes disagree then, and not those of the tip.
        is_sound = scatter_m(touches) < limit_m
        if other is None and is_sound and looks_inverse(tip_start(touches)):
            other = _INVERSE
        if other is None or other.do is None:
            raise
        option = f": {other.do.option}" if other.do.option.name else ""
        step = f"{other.do.words.removesuffix('.')}{option}."
        raise DataError(f"tcp: {other.words}", culprits=[rows.source], next_step=step) from error
    fitted = PointsFit(
        rows.source,
        rows.labels,
        [f"Touch {label}" for label in rows.labels],
        rows.places,
        rows.kinds,
        Edge(fit.flange_from_tool, fit.covariance),
        fit.agreement,
        ["the tip had slipped, it is of another point, or the pose is of another moment or tool"]
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
        options=options,
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
    other = _other_reading(touches, rows.numbers, limit_m)
    first = [other] if other is not None else [*_other_points(fit, touches, rows.places)]
    first = first or [*_two_points(touches, rows.places, limit_m)]
    return fitted.frame(method, more, details, setting, first)


def _other_reading(touches: Touches, numbers: PoseNumbers | None, limit_m: float) -> Finding | None:
    """The finding that rotations are in another form, by which all touches agree, if any."""
    declared_m = scatter_m(touches)
    # Poses by joint angles are in none.
    is_read = numbers is not None and np.array_equal(numbers.poses(), touches.base_from_flange)
    if numbers is None or not is_read or declared_m < limit_m:
        return None
    given = numbers.reading
    tried: dict[str, float] = {}
    for name in ROTATION_FORMS.keys() - {given.rotation}:
        # Beyond two turns, radians are none; and other numbers are no rotation in some forms.
        if name.endswith("-rad") and np.nanmax(np.abs(numbers.rotations)) > WIDE_RAD:
            continue
        with suppress(DataError):
            poses = numbers.read_as(replace(given, rotation=name)).poses()
            tried[name] = scatter_m(replace(touches, base_from_flange=poses))
    least_m = min(tried.values(), default=np.inf)
    if not CLEAR_RATIO * least_m < declared_m:
        return None
    rivals = sorted(name for name, off_m in tried.items() if off_m < CLEAR_RATIO * least_m)
    words = (
        f"The touches agree to {figure(1e3 * least_m)} mm (rms) with their rotations in another "
        f"form, {some_of(rivals, 3)}; and to {figure(1e3 * declared_m)} mm as they are read."
    )
    remedy = again(
        "Look up the controller's form, and state it.",
        Option("robot-form", rivals[0]),
    )
    return Finding("other_reading", words, remedy, is_fatal=True)


def _other_points(fit: PivotFit, touches: Touches, places: Sequence[str]) -> Iterator[Finding]:
    """Findings on touches that were left out, and agree on a point of their own."""
    inliers = fit.agreement
    tips = touches.base_from_flange @ np.append(fit.flange_from_tool[:3, 3], 1.0)
    for at in range(len(touches.names)):
        of_point = touches.are("point") & (touches.points == at)
        out = np.flatnonzero(of_point & ~inliers.mask)
        middle = np.median(tips[out, :3], axis=0) if len(out) else np.zeros(3)
        off_m = np.linalg.norm(tips[out, :3] - middle, axis=1)
        # Distance within which touches are of one point, over the noise of a touch per axis.
        near = off_m < 6.0 * inliers.fit.sigma
        if near.sum() < 2:
            continue
        apart_m = float(np.linalg.norm(middle - inliers.fit.state.points[at]))
        chosen = out[near].tolist()
        yield _other_point(touches, places, chosen, apart_m, float(off_m[near].max()))


def _two_points(touches: Touches, places: Sequence[str], limit_m: float) -> Iterator[Finding]:
    """The finding that touches agree as of two points, of which a consensus finds neither."""
    tips = touches.are("point")
    touches, places = touches.subset(tips), [places[row] for row in np.flatnonzero(tips).tolist()]
    declared_m, split = scatter_m(touches), two_points(touches)
    if split is not None and max(limit_m, CLEAR_RATIO * scatter_m(split)) < declared_m:
        chosen = np.flatnonzero(split.points != split.points[0]).tolist()
        apart_m = float(np.linalg.norm(np.diff(tips_and_points(split)[1], axis=0)))
        finding = _other_point(touches, places, chosen, apart_m, scatter_m(split))
        yield replace(finding, is_fatal=True)


def _other_point(
    touches: Touches, places: Sequence[str], chosen: Sequence[int], apart_m: float, agree_m: float
) -> Finding:
    """The finding that chosen touches are of another point."""
    words = (
        f"Touches {some_of([touches.labels[row] for row in chosen])} ({places[chosen[0]]} and "
        f"below) agree on a point of their own, {figure(1e3 * apart_m)} mm from that of the "
        f"others, to {figure(1e3 * agree_m)} mm."
    )
    step = "Name the points in a column point, this one otherwise: then both count."
    return Finding("other_point", words, Remedy(step, AGAIN))


def _findings(fit: PivotFit, touches: Touches, setting: FitSettings) -> Iterator[Finding]:
    """Findings on what the poses are of, and on too few touches."""
    if fit.looks_inverse:
        yield _INVERSE
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
