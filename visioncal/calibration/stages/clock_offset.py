"""Offset between the clocks of a camera and a robot: the result, and messages about it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.limits import CONTRADICTION, FEWEST_VIEWS
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.types import FloatArray, Mask, Rejection
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.clock import ClockChange, ClockFit
from visioncal.estimation.clock_correlation import WIDEST_OFFSET_S, Match
from visioncal.results.sections import ClockResult
from visioncal.robot.trajectory import LONGEST_GAP_S
from visioncal.session import View, too_far_apart
from visioncal.session.motion import RobotMotion
from visioncal.vision.pnp import ViewPoses

# Least correlation of turning angles of the same motion; largest sigma of a usable offset [s].
LEAST_CORRELATION, LARGEST_SIGMA_S = 0.5, 0.01
# Assumed sigma of a stated offset [s].
STATED_SIGMA_S = 1e-3
# Why an offset is left open, and what to do.
WITH_INVERSE = (
    "camera and robot move alike where the target's poses are taken for the camera's in the "
    "target, their inverse",
    "Convert the recording again with --camera-inverse.",
)
SWEEP = (
    "Sweep the robot to and fro, about different axes, with the target in view, each row's stamp_s "
    f"that of its own image; or take {FEWEST_VIEWS} views or more at rest; or state [clock] "
    "camera_minus_robot_s."
)


@dataclass(frozen=True)
class ClockPair:
    """A camera's frame and the name of the robot between it and what it observes."""

    camera: str
    robot: str

    @property
    def words(self) -> str:
        """Names of camera and robot in words, as in messages and results."""
        return f"{self.camera} and robot {self.robot or 'robot'}"

    @property
    def effect(self) -> str:
        """Name of the effect of the offset of their clocks."""
        return f"clock of {self.words}"

    @property
    def readout(self) -> str:
        """Name of the effect of the readout time of the camera's images."""
        return f"rolling shutter of {self.words}"


@dataclass(frozen=True, eq=False)
class ClockedViews:
    """Views with the robot's poses at their time."""

    clock: ClockResult  # The offset of the camera's clock ahead of the robot's.
    # Those that have a pose now, or had one before, in the session's order.
    views: tuple[View, ...]
    # (6,) twist of the flange by view, in its own frame [rad/s, m/s]; empty for views at rest.
    speeds: Mapping[int, FloatArray]
    rejections: tuple[Rejection, ...]  # Those without a pose, and why.
    spared: Mapping[int, str]  # Why redundant views are not needed, by view.
    warnings: tuple[Finding, ...]  # Findings against the clock.
    notes: tuple[str, ...]  # Remarks for the user.
    # Target poses by corners that were corrected for a significant readout time, and their (6,)
    # Jacobian by it, by view.
    poses: Mapping[int, ViewPoses] = field(default_factory=dict)
    by_readout: Mapping[int, FloatArray] = field(default_factory=dict)

    def prior_sigma_s(self, *, erring: bool = False) -> float:
        """Prior sigma of the offset in the fit of the used views [s].

        The used views determine it in the fit themselves; of the motion, only the share of the
        other frames is prior information.

        Args:
            erring: Whether errors of the arm are unknowns of that fit. The motion determined the
                offset with the nominal arm, whose errors are common to all frames.
        """
        sigma_s, frames = self.clock.sigma_s or 0.0, self.clock.frames
        if frames is None:
            return sigma_s
        share = 0.0 if erring else max(0.0, 1.0 - len(self.speeds) / frames)
        return 1.0 / max(1.0 / LARGEST_SIGMA_S, float(np.sqrt(share)) / sigma_s)


def motion_notes(clock: ClockResult, stream: str) -> Iterator[str]:
    """The offset and the readout by the motion, in words."""
    sigma_ms = figure(1e3 * (clock.sigma_s or 0.0))
    yield (
        f"The camera's clock is {1e3 * clock.camera_minus_robot_s:+.2f} ms ahead of the robot's "
        f"(sigma {sigma_ms} ms), by the motion in {clock.frames} frames and "
        f"streams/{stream}.csv (the turning of both goes along with a correlation of "
        f"{clock.correlation:.2f})."
    )
    shutter = clock.shutter
    if shutter is not None and shutter.is_rolling:
        yield (
            "The camera has a rolling shutter, which is taken into account: the image's last line "
            f"is taken {1e3 * abs(shutter.readout_s):.2f} ms "
            f"{'after' if shutter.readout_s > 0.0 else 'before'} the first (sigma "
            f"{figure(1e3 * shutter.readout_sigma_s)} ms)."
        )


def speed_words(clock: ClockResult, speeds: FloatArray, inside: int) -> str:
    """Largest flange speed in the used views and the resulting uncertainty, in words."""
    if not len(speeds):
        return "No view lies within the stream."
    sigma_s, fastest_mm = clock.sigma_s or 0.0, 1e3 * np.linalg.norm(speeds[:, 3:], axis=1).max()
    fastest_deg = float(np.rad2deg(np.linalg.norm(speeds[:, :3], axis=1).max()))
    return (
        f"{len(speeds)} of {inside} views with a time are used, taken while the flange moved by up "
        f"to {figure(fastest_mm)} mm/s and {figure(fastest_deg)} deg/s: the uncertainty of the "
        f"clocks makes {mm_and_deg(sigma_s * fastest_mm, sigma_s * fastest_deg)} of "
        "it, and counts in the covariance."
    )


def offset_doubts(clock: ClockResult) -> Iterator[Finding]:
    """Finding on a stated offset that the motion refutes."""
    if clock.stated_s is None:
        return
    sigma_s = clock.sigma_s or 0.0
    difference_s = abs(clock.stated_s - clock.camera_minus_robot_s)
    if difference_s > CONTRADICTION * np.hypot(sigma_s, STATED_SIGMA_S):
        yield Finding(
            "clock",
            f"[clock] camera_minus_robot_s is stated as {1e3 * clock.stated_s:+.2f} ms, but the "
            f"motion gives {1e3 * clock.camera_minus_robot_s:+.2f} ms (sigma "
            f"{figure(1e3 * sigma_s)} ms), which was taken.",
            Remedy("Correct [clock] in session.toml, or look at how the stamps are made."),
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


def why_undetermined(fits: Sequence[ClockFit], matches: Sequence[Match], span_s: float) -> str:
    """Why the motion of a recording of some length [s] does not determine the offset, in words."""
    if not matches:
        return "camera and robot are not seen to turn together for long enough"
    if matches[0].correlation < LEAST_CORRELATION:
        return (
            "the turning of robot and camera goes along with a correlation of "
            f"{matches[0].correlation:.2f} at best (below {LEAST_CORRELATION}), so they are "
            "not of the same motion, or it was too slow"
        )
    if not fits:
        return (
            "camera and robot turn alike, but move alike at no offset of up to "
            f"{WIDEST_OFFSET_S:g} s from the stated one, as far as is searched: the clocks are "
            "farther apart (state [clock] camera_minus_robot_s roughly), these are not the times "
            "of the images, or the poses are meant otherwise (visioncal convert --guess)"
        )
    if fits[0].sigma_s > span_s:
        return "the motion says nothing of it, as it is too even, or too slow"
    if fits[0].sigma_s > LARGEST_SIGMA_S:
        return (
            "the motion is too even: it determines the offset to "
            f"{figure(1e3 * fits[0].sigma_s)} ms only (over {1e3 * LARGEST_SIGMA_S:g} ms)"
        )
    several = " and ".join(f"{1e3 * fit.offset_s:+.0f}" for fit in fits)
    return f"the motion repeats itself: offsets of {several} ms explain it alike"


def undetermined_error(
    motion: RobotMotion, views: Sequence[View], resting: Mask, offset_s: float, why: str, step: str
) -> DegenerateError | DataError:
    """Error where the robot's poses cannot be determined at an offset, by reason and next step."""
    if not len(views):
        return DataError(
            "No view has both a time and a pose of the target.",
            culprits=["views.csv: stamp_s"],
            next_step="Fill in stamp_s where the target is in the image.",
        )
    stamps_s = np.array([view.stamp_s for view in views], dtype=float)
    label, (begin_s, end_s) = f"streams/{motion.name}.csv", motion.flange.stamps_s[[0, -1]]
    if not motion.flange.covers(stamps_s - offset_s).any():
        if motion.flange.step_s >= LONGEST_GAP_S:
            return too_far_apart(label, motion.flange.step_s, LONGEST_GAP_S)
        return DataError(
            f"No view lies within {label}: it goes from {begin_s:.6f} to {end_s:.6f} s, the views "
            f"from {stamps_s[0]:.6f} to {stamps_s[-1]:.6f} s.",
            culprits=[label, "views.csv: stamp_s"],
            next_step="Write both stamps in seconds, by clocks that differ by seconds at most, or "
            "state their approximate difference: [clock] camera_minus_robot_s.",
        )
    return DegenerateError(
        f"clock: the offset between the clocks of camera and robot is left open by {len(views)} "
        f"views, of which {int(resting.sum())} were taken at rest: {why}.",
        culprits=[label, "views.csv: stamp_s"],
        next_step=step,
    )
