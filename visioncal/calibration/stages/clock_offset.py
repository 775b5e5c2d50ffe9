"""Offset between the clocks of camera and robot: result, messages, and correction of corners.

Corners may have been exposed before or after their image's stamp. Once these delays are estimated,
the corners are moved to where they would have been at the stamp.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from visioncal.calibration.stages.motion import RobotMotion
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import figure, mm_and_deg, some_of
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Camera, FloatArray, Mask
from visioncal.core.verdict import GUESS, Finding, Remedy
from visioncal.estimation.clock import ClockChange, ClockFit, DelayEstimate
from visioncal.estimation.clock_correlation import ImageTimes, Match
from visioncal.estimation.corners import CornerStack, floored_sigma_px, reproject
from visioncal.estimation.effects.delays import (
    compress_delayed,
    delayed_points,
    shares_of,
    target_twists,
)
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.trajectory import LONGEST_GAP_S
from visioncal.results.sections import ClockResult
from visioncal.session import View, too_far_apart

# Least correlation of turning angles of the same motion; largest sigma of a usable offset, and of
# any information at all [s].
LEAST_CORRELATION, LARGEST_SIGMA_S, _ANY_SIGMA_S = 0.5, 0.01, 1.0
# Fewest views at rest that make a calibration.
FEWEST_VIEWS = 3
# A stated offset is reported as wrong beyond this many sigmas and this share of a frame period.
_STATED_SIGMAS, _STATED_SHARE = 3.0, 0.1
# Images with equal stamps show different poses where targets are farther apart than this share of
# their distance.
_DIFFERENT_SHARE = 0.05
# Shortest interval of images by which stamps can be milliseconds [ms].
_LEAST_STEP_MS = 5.0
# Stamps fall in a tenth of the steps for rows sorted by image name ("10" before "2"), and in half
# for shuffled ones.
_SHUFFLED = 0.25

ClockMethod: TypeAlias = Literal["motion", "turning", "stated", "rest"]


def correct_corners(
    frames: ImageTimes,
    flange: tuple[FloatArray, FloatArray],
    seen: Sequence[ViewPoses],
    camera: Camera,
    fit: ClockFit,
) -> tuple[Mapping[int, ViewPoses], Mapping[int, FloatArray]]:
    """Corrects corners for the delays within images.

    Args:
        frames: The camera's observations in v views, with corners.
        flange: (v, 4, 4) `base_from_flange` and (v, 6) its twists a second, in the flange frame.
        seen: The poses of the same views.
        camera: The intrinsics.
        fit: The k delays, and the camera's extrinsics.

    Returns:
        The views' poses by the corrected corners, of which ambiguous ones stay as they are; and the
        (6, k) Jacobian of each by the delays; both by view.
    """
    stack, starts = frames.stack, frames.cam_from_target
    if stack is None or not len(seen):
        return {}, {}
    with one_blas_thread():
        x, times_s = fit.fit.state.edges[0], np.array([delay.time_s for delay in fit.delays])
        twists = target_twists(frames.mount, flange[0], x, starts, flange[1])
        shares = shares_of([delay.of for delay in fit.delays], stack, camera)
        delayed = compress_delayed(stack, camera, shares, twists, times_s, starts)
        unknowns = 6 * len(seen) + len(times_s)
        sigma_px = floored_sigma_px(stack.sigma_px(delayed.residuals, unknowns))
        points, _ = delayed_points(stack, shares, twists, times_s)
        plain = replace(stack, weights=None)
        delayed_px = _projected(plain.with_points(points), camera, delayed.cam_from_target)
        px = stack.px + _projected(plain, camera, delayed.cam_from_target) - delayed_px
    covariance = sigma_px**2 * covariance_from(delayed.information)
    poses = {
        view.view: _with_corners(
            view, px[stack.view_of == at], delayed.cam_from_target[at], covariance[at]
        )
        for at, view in enumerate(seen)
    }
    return poses, dict(zip(poses, delayed.by_shared, strict=True))


def _projected(stack: CornerStack, camera: Camera, poses: FloatArray) -> FloatArray:
    """Predicted positions (n, 2) of the corners [px]."""
    return reproject(stack, camera, poses, lens=False).residuals + stack.px


def _with_corners(
    view: ViewPoses, px: FloatArray, pose: FloatArray, covariance: FloatArray
) -> ViewPoses:
    if view.corners is None:
        return view
    view = replace(view, corners=replace(view.corners, px=px))
    if len(view.cam_from_target) > 1:
        return view
    return replace(view, cam_from_target=pose[None], covariance=covariance[None])


@dataclass(frozen=True, eq=False)
class ClockOffset:
    """Offset of the camera's clock ahead of the robot's, and its source."""

    camera_minus_robot_s: float  # The offset [s].
    sigma_s: float  # Its standard deviation [s]; 0 where views at rest make it immaterial.
    # Estimated from the motion, or from its rotation alone; stated by the session; or immaterial
    # for views at rest.
    method: ClockMethod
    stated_s: float | None  # Offset stated by the session [s]; None without one.
    frames: int  # Number of frames in motion that determined it.
    # Correlation of the rotation angles of camera and robot; None without any.
    correlation: float | None
    # (6,) twist of the flange by view, in its own frame [rad/s, m/s].
    speeds: Mapping[int, FloatArray]
    delays: tuple[DelayEstimate, ...] = ()  # Delays within the images.

    def prior_sigma_s(self, *, erring: bool = False) -> float:
        """Prior sigma of the offset in the fit of the used views [s].

        The used views determine it in the fit themselves; of the motion, only the share of the
        other frames is prior information.

        Args:
            erring: Whether errors of the arm are unknowns of that fit. The motion determined the
                offset with the nominal arm, whose errors are common to all frames.
        """
        if self.method != "motion":
            return self.sigma_s
        share = 0.0 if erring else max(0.0, 1.0 - len(self.speeds) / self.frames)
        return 1.0 / max(1.0 / LARGEST_SIGMA_S, float(np.sqrt(share)) / self.sigma_s)

    def result(self) -> ClockResult:
        """The clock as a section of a calibration."""
        return ClockResult(
            camera_minus_robot_s=self.camera_minus_robot_s,
            method=self.method,
            sigma_s=None if self.method == "rest" else self.sigma_s,
            stated_s=self.stated_s,
            frames=self.frames or None,
            correlation=self.correlation,
            **{name: value for delay in self.delays for name, value in delay.result().items()},
        )


def clock_words(fit: ClockFit, match: Match, stream: str) -> str:
    """Offset by the motion, in words."""
    return (
        f"The camera's clock is {1e3 * fit.offset_s:+.2f} ms ahead of the robot's (sigma "
        f"{figure(1e3 * fit.sigma_s)} ms), by the motion in {fit.frames} frames and "
        f"streams/{stream}.csv (the turning of both goes along with a correlation of "
        f"{match.correlation:.2f})."
    )


def turning_doubt(match: Match) -> Finding:
    """Finding about an offset by the rotation alone."""
    return Finding(
        "clock",
        f"The camera's clock is {1e3 * match.offset_s:+.1f} ms ahead of the robot's (sigma "
        f"{figure(1e3 * match.sigma_s)} ms), by the turning of both (correlation "
        f"{match.correlation:.2f}). It is known no better, because the chain of frames does not "
        "close over the motion.",
        Remedy("Try other conventions of the poses.", GUESS),
    )


def change_doubt(change: ClockChange, views: Sequence[View]) -> Finding:
    """Finding about a change of the offset between the clocks, with the views' original stamps."""
    if change.is_drift:
        how = (
            f"drifts against the robot's, by {1e6 * change.step_s:+.0f} ppm (sigma "
            f"{figure(1e6 * change.sigma_s)})"
        )
    else:
        later = [view.number for view in views if (view.stamp_s or 0.0) >= change.from_s]
        how = (
            f"jumps against the robot's: from view {(*later, 0)[0]} on it is "
            f"{1e3 * change.step_s:+.1f} ms (sigma {figure(1e3 * change.sigma_s)} ms) farther "
            "ahead than before"
        )
    return Finding(
        "clock_changed",
        f"The camera's clock {how}. The times were taken as they would be without that.",
        Remedy(
            "Stamp images and robot by one clock, which no time server sets while it records; then "
            "record again."
        ),
        mahalanobis_sq=(change.step_s / change.sigma_s) ** 2,
    )


def stated_doubts(clock: ClockOffset, views: Sequence[View]) -> Iterator[Finding]:
    """Finding where the motion contradicts the stated offset."""
    if clock.stated_s is None:
        return
    difference_s = abs(clock.stated_s - clock.camera_minus_robot_s)
    frame_s = float(np.median(np.diff([view.stamp_s or 0.0 for view in views])))
    if difference_s > max(_STATED_SIGMAS * clock.sigma_s, _STATED_SHARE * frame_s):
        yield Finding(
            "clock",
            f"[clock] camera_minus_robot_s is stated as {1e3 * clock.stated_s:+.2f} ms, but the "
            f"motion gives {1e3 * clock.camera_minus_robot_s:+.2f} ms (sigma "
            f"{figure(1e3 * clock.sigma_s)} ms), which was taken.",
            Remedy("Correct [clock] in session.toml, or look at how the stamps are made."),
        )


def why_undetermined(fits: Sequence[ClockFit], matches: Sequence[Match]) -> str:
    """Why the motion does not determine the offset, in words."""
    best = max(matches, key=lambda match: match.correlation, default=None)
    if best is None:
        return "camera and robot are not seen to turn together for long enough"
    if best.correlation < LEAST_CORRELATION:
        return (
            f"the turning of robot and camera goes along with a correlation of "
            f"{best.correlation:.2f} at best ({LEAST_CORRELATION} is needed), so they are not of "
            "the same motion, or it was too slow"
        )
    if best.at_end:
        return (
            f"the turning of robot and camera goes along best {best.offset_s:+.2f} s apart, where "
            "the search ends"
        )
    if not fits or fits[0].sigma_s > _ANY_SIGMA_S:
        return "the motion is too even: any offset explains it"
    if fits[0].sigma_s > LARGEST_SIGMA_S:
        return (
            f"the motion determines the offset to {figure(1e3 * fits[0].sigma_s)} ms only "
            f"({1e3 * LARGEST_SIGMA_S:g} ms are needed)"
        )
    several = " and ".join(f"{1e3 * fit.offset_s:+.0f}" for fit in fits)
    return f"the motion repeats itself: offsets of {several} ms explain it alike"


def shared_stamps_error(views: Sequence[View], poses: Mapping[int, ViewPoses]) -> DataError | None:
    """Error for views of a camera with equal stamps that show the same target in different poses.

    It is None where these are no more than half of the views.
    """
    groups: dict[tuple[float | None, int], list[View]] = {}
    for view in views:
        groups.setdefault((view.stamp_s, poses[view.number].board), []).append(view)
    shared = [group for group in groups.values() if _differ(group, poses)]
    if 2 * sum(map(len, shared)) <= len(views):
        return None
    largest = max(shared, key=len)
    return DataError(
        f"{sum(map(len, shared))} of {len(views)} views have the same stamp_s as others that show "
        f"the target elsewhere: it is {largest[0].stamp_s:.6f} s in views "
        f"{some_of([str(view.number) for view in largest])}.",
        culprits=["views.csv: stamp_s"],
        next_step="Write the time at which each image was taken into stamp_s, in seconds with all "
        "the digits that the camera gives.",
    )


def _differ(views: Sequence[View], poses: Mapping[int, ViewPoses]) -> bool:
    """Whether views show the target in different places."""
    first_m, *others = (poses[view.number].cam_from_target[:, :3, 3] for view in views)
    at_m = first_m[0]
    # A board that looks the same upside down has several candidate poses.
    distances_m = [np.linalg.norm(other - at_m, axis=1).min() for other in others]
    return max(distances_m, default=0.0) > _DIFFERENT_SHARE * float(np.linalg.norm(at_m))


def not_ascending(views: Sequence[View]) -> str:
    """Says where stamps do not ascend with the views' numbers; empty where they do."""
    ordered = sorted(views, key=lambda view: view.number)
    stamps_s = np.array([view.stamp_s for view in ordered], dtype=float)
    falls = np.flatnonzero(np.diff(stamps_s) < 0.0)
    if len(falls) <= _SHUFFLED * max(len(ordered) - 1, 0):
        return ""
    before, after = ordered[falls[0]], ordered[falls[0] + 1]
    return (
        f"the column stamp_s of views.csv does not ascend with the views: it falls {len(falls)} "
        f"times in {len(ordered)} rows, first from {before.stamp_s:.6f} s (view {before.number}) "
        f"to {after.stamp_s:.6f} s (view {after.number})"
    )


def undetermined_error(
    motion: RobotMotion, views: Sequence[View], resting: Mask, why: str
) -> DegenerateError | DataError:
    """Error where the robot's poses cannot be determined."""
    stamps_s = np.array([view.stamp_s for view in views], dtype=float)
    begin_s, end_s = motion.flange.stamps_s[[0, -1]]
    if not len(views):
        return DataError(
            "No view has both a time and a pose of the target.",
            culprits=["views.csv: stamp_s"],
            next_step="Fill in stamp_s where the target is in the image.",
        )
    outside = not motion.flange.covers(stamps_s).any()
    step_s = float(np.median(np.abs(np.diff(stamps_s)))) if len(stamps_s) > 1 else np.inf
    if outside and motion.flange.covers(1e-3 * stamps_s).any() and step_s > _LEAST_STEP_MS:
        return DataError(
            f"The views' times look like milliseconds: {stamps_s[0]:.6g} to {stamps_s[-1]:.6g}, "
            f"where streams/{motion.name}.csv goes from {begin_s:.6f} to {end_s:.6f} s.",
            culprits=["views.csv: stamp_s"],
            next_step="Divide the column stamp_s of views.csv by 1000; it is in seconds.",
        )
    if outside and motion.flange.step_s >= LONGEST_GAP_S:
        label = f"streams/{motion.name}.csv"
        return too_far_apart(label, motion.flange.step_s, LONGEST_GAP_S)
    if outside:
        return DataError(
            f"No view lies within streams/{motion.name}.csv: it goes from {begin_s:.6f} to "
            f"{end_s:.6f} s, the views from {stamps_s[0]:.6f} to {stamps_s[-1]:.6f} s.",
            culprits=[f"streams/{motion.name}.csv", "views.csv: stamp_s"],
            next_step="Stamp both with clocks that differ by seconds at most, or state about what "
            "they differ by: [clock] camera_minus_robot_s.",
        )
    more = (
        "Sweep the robot to and fro, about different axes, with the target in view; or take "
        f"{FEWEST_VIEWS} views or more at rest; or state [clock] camera_minus_robot_s."
    )
    disorder = not_ascending(views)
    if disorder:
        return DataError(
            f"{disorder[0].upper()}{disorder[1:]}; and the motion does not tell the offset between "
            f"the clocks of camera and robot: {why}.",
            culprits=["views.csv: stamp_s"],
            next_step="Write into each row's stamp_s the time at which its own image was taken. "
            f"Where the rows are in another order on purpose: {more[0].lower()}{more[1:]}",
        )
    return DegenerateError(
        f"clock: the offset between the clocks of camera and robot is left open by {len(views)} "
        f"views, of which {int(resting.sum())} were taken at rest: {why}.",
        culprits=[f"streams/{motion.name}.csv", "views.csv: stamp_s"],
        next_step=more,
    )


def speed_words(clock: ClockOffset, speeds: FloatArray, inside: int) -> str:
    """Largest flange speed in the used views and the resulting uncertainty, in words."""
    if not len(speeds):
        return "No view lies within the stream."
    fastest_mm, fastest_deg = (
        1e3 * float(np.linalg.norm(speeds[:, 3:], axis=1).max()),
        float(np.rad2deg(np.linalg.norm(speeds[:, :3], axis=1).max())),
    )
    return (
        f"{len(speeds)} of {inside} views with a time are used, taken while the flange moved by up "
        f"to {figure(fastest_mm)} mm/s and {figure(fastest_deg)} deg/s: the uncertainty of the "
        f"clocks makes {mm_and_deg(clock.sigma_s * fastest_mm, clock.sigma_s * fastest_deg)} of "
        "it, and counts in the covariance."
    )
