"""Flange poses at the times of views, from a robot stream with its own clock.

A view that has a time and no pose of the robot gets it from the robot's stream. The offset between
the clocks of camera and robot is estimated from the motion that both observed.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.calibration.guess.joint_readings import JointReading, declared_reading, unit_readings
from visioncal.calibration.stages.clock_offset import (
    FEWEST_VIEWS,
    LARGEST_SIGMA_S,
    LEAST_CORRELATION,
    ClockOffset,
    change_doubt,
    clock_words,
    correct_corners,
    not_ascending,
    shared_stamps_error,
    speed_words,
    stated_doubts,
    turning_doubt,
    undetermined_error,
    why_undetermined,
)
from visioncal.calibration.stages.motion import (
    RobotMotion,
    is_standing_still,
    lacks_robot_state,
    slow_and_new,
)
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted
from visioncal.core.types import Camera, FloatArray, IntArray, Mask, Mount, Rejection
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.clock import (
    ClockChange,
    ClockFit,
    clear_fit,
    clock_change,
    fit_delays,
    fit_offset,
    refined_change,
)
from visioncal.estimation.clock_correlation import ImageTimes, Match, turning_matches
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.effects.delays import Delay
from visioncal.estimation.trajectory import Trajectory
from visioncal.robot import Robot
from visioncal.session import View

# Assumed sigma of a stated offset [s].
_STATED_SIGMA_S = 1e-3
_SHOW_OFFSET = Remedy(
    "Take the views at rest, or record a sweep that turns fast enough to show the clocks' offset."
)
_SPARED = "not needed: slower views stand for it, at the same places"
_NO_TIME = "no pose of the robot: neither a pose nor a time is there"
_BEYOND = "no pose of the robot: it was taken before or after the robot's stream"
_IN_A_GAP = "no pose of the robot: samples of its stream are missing around that time"
_IN_MOTION = "no pose of the robot: taken in motion, and how far the clocks differ is not known"
# Up to this number all views are used; of more, slow ones.
_MANY_VIEWS = 60
# A change of the offset must reduce the misfit (rotations times positions) to this share. It is
# refined for this number of rounds at most, or until its step is below this share of its sigma.
_CLEARLY_LESS, _ROUNDS, _CONVERGED = 0.9, 6, 0.3
# Correlation that shows that camera and robot turn together.
_SURELY_ALIKE = 0.9


@dataclass(frozen=True)
class ClockPair:
    """A camera's frame and the name of the robot between it and what it observes."""

    camera: str
    robot: str

    @property
    def words(self) -> str:
        """Both in words, as in messages and results."""
        return f"{self.camera} and robot {self.robot or 'robot'}"

    @property
    def effect(self) -> str:
        """Name of the effect of the offset of their clocks."""
        return f"clock of {self.words}"

    def delay(self, of: Delay) -> str:
        """Name of the effect of a delay within the camera's images."""
        return f"{of.name} of {self.words}"


@dataclass(frozen=True, eq=False)
class ClockedViews:
    """Views with the robot's poses at their time."""

    clock: ClockOffset  # The offset.
    # Those that have a pose now, or had one before, in the session's order.
    views: tuple[View, ...]
    rejections: tuple[Rejection, ...]  # Those without a pose, and why.
    spared: Mapping[int, str]  # Why redundant views are not needed, by view.
    warnings: tuple[Finding, ...]  # Findings against the clock.
    notes: tuple[str, ...]  # Remarks for the user.
    # Target poses by corners that were corrected for delays.
    poses: Mapping[int, ViewPoses] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class CameraSweep:
    """Observations of one camera while one robot moved."""

    motion: RobotMotion  # The robot's stream.
    mount: Mount  # Mount of the camera.
    # The rows; those that have a time and no pose of the robot wait for the clock.
    views: tuple[View, ...]
    stated_s: float | None  # The stated offset [s]; None without one.
    camera: Camera | None = None  # The camera's intrinsics; None where unknown.
    # (c, 3) corners of all boards, numbered consecutively [m].
    positions: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def frames(self, seen: Sequence[tuple[View, ViewPoses]]) -> ImageTimes:
        """The camera's observations over time, by the best pose of each view."""
        corners = {view.number: pose.corners for view, pose in seen if pose.corners}
        measured = bool(seen) and len(corners) == len(seen)
        stacked = measured and self.camera is not None
        return ImageTimes(
            "eye-in-hand" if self.mount == "eye-in-hand" else "eye-to-hand",
            np.array([view.stamp_s for view, _ in seen], dtype=float),
            np.array([view.cam_from_target[0] for _, view in seen]).reshape(-1, 4, 4),
            np.array([view.covariance[0] for _, view in seen]) if measured else None,
            CornerStack.of(corners, self.positions) if stacked else None,
        )


def set_clock(sweep: CameraSweep, poses: Mapping[int, ViewPoses]) -> ClockedViews:
    """Gives views the robot's poses at their time.

    Raises:
        DataError: No view lies within the stream, or the views' times are wrong.
        DegenerateError: The motion does not determine the offset, it is not stated, and too few
            views were taken at rest.
    """
    matched = _match(sweep, poses)
    change = None if matched.fit is None else _change(sweep, matched.frames, matched.fit)
    if change is None:
        return _clocked(sweep, matched, poses)
    doubt = change_doubt(change, matched.views)
    sweep = replace(sweep, views=tuple(_corrected(view, change) for view in sweep.views))
    clocked = _clocked(sweep, _match(sweep, poses), poses)
    return replace(clocked, warnings=(*clocked.warnings, doubt))


@dataclass(frozen=True, eq=False)
class _Matched:
    """Evidence of the motion on the offset of the clocks."""

    views: Sequence[View]  # The views that wait for a pose, sorted by time.
    frames: ImageTimes  # Observations of those that are not held back.
    matches: Sequence[Match]  # Offsets at which camera and robot turn alike.
    sound: Sequence[Match]  # The significant ones.
    fits: Sequence[ClockFit]  # Fits started from these.
    fit: ClockFit | None  # The clear one; None without one.


def _match(sweep: CameraSweep, poses: Mapping[int, ViewPoses]) -> _Matched:
    flange, stated_s = sweep.motion.flange, sweep.stated_s
    views = [view for view in sweep.views if lacks_robot_state(view) and view.number in poses]
    views.sort(key=lambda view: view.stamp_s or 0.0)
    frames = _frames(sweep, [view for view in views if not view.holdout], poses)
    matches = turning_matches(flange, frames, stated_s or 0.0)
    sound = [
        match for match in matches if match.correlation >= LEAST_CORRELATION and not match.at_end
    ]
    starts = [match.offset_s for match in sound] + [
        value for value in (stated_s,) if value is not None
    ]
    fits = fit_offset(flange, frames, starts) if sound else ()
    return _Matched(views, frames, matches, sound, fits, clear_fit(fits, stated_s))


def _clocked(sweep: CameraSweep, matched: _Matched, poses: Mapping[int, ViewPoses]) -> ClockedViews:
    """Gives views their poses by the best available offset."""
    fit, sound = matched.fit, matched.sound
    if fit is not None and fit.sigma_s <= LARGEST_SIGMA_S:
        offset_s = fit.offset_s
        match = min(sound, key=lambda value: abs(value.offset_s - offset_s))
        return _by_motion(sweep, matched.views, (fit, match), matched.frames, poses)
    if len(sound) == 1 and matched.frames.are_dense and sound[0].sigma_s <= LARGEST_SIGMA_S:
        # By rotation alone, where the chain of frames does not close.
        (match,), stated_s = sound, sweep.stated_s
        clock = ClockOffset(
            match.offset_s, match.sigma_s, "turning", stated_s, 0, match.correlation, speeds={}
        )
        warnings = [turning_doubt(match), *stated_doubts(clock, matched.views)]
        return _at_offset(sweep, matched.views, clock, warnings, [])
    error = shared_stamps_error(matched.views, poses)
    if error is not None:
        raise error
    return _undetermined(sweep, matched.views, (matched.fits, matched.matches))


def _change(sweep: CameraSweep, frames: ImageTimes, fit: ClockFit) -> ClockChange | None:
    """Change of the offset over the frames; None without one, or where it explains little."""
    # A fit to both sides of a jump is biased, so that the jump is refined in a few rounds.
    flange, change = sweep.motion.flange, clock_change(sweep.motion.flange, frames, fit)
    for _ in range(_ROUNDS if change else 0):
        if change is None:
            return None
        corrected = replace(frames, stamps_s=change.corrected(frames.stamps_s))
        fits = fit_offset(flange, corrected, [fit.offset_s])
        if not fits or fits[0].residual > _CLEARLY_LESS * fit.residual:
            return None
        if frames.stack is not None:
            # A rolling shutter follows the motion, and would be taken for the clock's change.
            break
        before_s, change = change.step_s, refined_change(flange, corrected, fits[0], frames, change)
        if abs(change.step_s - before_s) < _CONVERGED * change.sigma_s:
            break
    return change


def _corrected(view: View, change: ClockChange) -> View:
    """A view with the stamp of a clock without the change."""
    if view.stamp_s is None:
        return view
    (stamp_s,) = change.corrected(np.array([view.stamp_s])).tolist()
    return replace(view, numbers={**view.numbers, "stamp_s": stamp_s})


def _frames(
    sweep: CameraSweep, views: Sequence[View], poses: Mapping[int, ViewPoses]
) -> ImageTimes:
    """Observations of the board seen most often, without ambiguous poses where enough are clear."""
    seen = [(view, poses[view.number]) for view in views]
    boards = [pose.board for _, pose in seen]
    most = max(sorted(set(boards)), key=boards.count, default=0)
    seen = [(view, pose) for view, pose in seen if pose.board == most]
    clear = [(view, pose) for view, pose in seen if len(pose.cam_from_target) == 1]
    return sweep.frames(clear if 2 * len(clear) > len(seen) else seen)


def misread_joints(
    sweep: CameraSweep, poses: Mapping[int, ViewPoses], robot: Robot
) -> DataError | None:
    """Error for a stream of joint angles that explains the camera's motion in another unit.

    It is None where no other unit explains the motion.
    """
    if sweep.motion.reported or sweep.motion.joints is None:
        return None
    samples, q = sweep.motion.joints
    frames = _match(sweep, poses).frames

    def correlation(reading: JointReading) -> float:
        flange = Trajectory(samples.stamps_s, reading.poses(q))
        matches = turning_matches(flange, frames, sweep.stated_s or 0.0)
        return max((match.correlation for match in matches), default=0.0)

    declared, file = declared_reading(robot), f"streams/{sweep.motion.name}.csv"
    recorded = correlation(declared)
    for reading in unit_readings(declared):
        reread = correlation(reading)
        if recorded < LEAST_CORRELATION and reread > _SURELY_ALIKE:
            return DataError(
                f"{file}: the joint angles are misread. With {reading.words}, robot and camera "
                f"turn alike with a correlation of {reread:.2f}; as recorded, of {recorded:.2f}.",
                culprits=[f"{file}: q{at + 1}_rad" for at in range(robot.joint_count)],
                next_step=reading.fix,
            )
    return None


def _by_motion(
    sweep: CameraSweep,
    views: Sequence[View],
    found: tuple[ClockFit, Match],
    frames: ImageTimes,
    poses: Mapping[int, ViewPoses],
) -> ClockedViews:
    fit, match = found
    delayed = fit_delays(sweep.motion.flange, frames, sweep.camera, fit)
    delays = () if delayed is None else delayed.delays
    clear = [delay for delay in delays if delay.is_clear]
    if delayed is not None and clear:
        fit = delayed
    clock = ClockOffset(
        fit.offset_s,
        fit.sigma_s,
        "motion",
        sweep.stated_s,
        fit.frames,
        match.correlation,
        speeds={},
        delays=delays,
    )
    words, warnings = clock_words(fit, match, sweep.motion.name), list(stated_doubts(clock, views))
    notes = [words, *(delay.words for delay in clear)]
    clocked = _at_offset(sweep, views, clock, warnings, notes)
    return _with_corrected(sweep, clocked, views, poses, fit) if clear else clocked


def _with_corrected(
    sweep: CameraSweep,
    clocked: ClockedViews,
    views: Sequence[View],
    poses: Mapping[int, ViewPoses],
    fit: ClockFit,
) -> ClockedViews:
    """Corrects the corners of all views that the stream covers for delays."""
    flange, clock = sweep.motion.flange, clocked.clock
    seen = [(view, poses[view.number]) for view in views if poses[view.number].corners is not None]
    at_s = np.array([view.stamp_s for view, _ in seen], dtype=float) - clock.camera_minus_robot_s
    covered = flange.covers(at_s)
    seen, at_s = [pair for pair, ok in zip(seen, covered, strict=True) if ok], at_s[covered]
    if sweep.camera is None:
        return clocked
    corrected, by_delays = correct_corners(
        sweep.frames(seen),
        (flange.at(at_s), flange.speeds(at_s)),
        [view for _, view in seen],
        sweep.camera,
        fit,
    )
    delays = tuple(
        replace(
            delay,
            jacobian={view: by[:, at] for view, by in by_delays.items() if view in clock.speeds},
        )
        for at, delay in enumerate(fit.delays)
    )
    return replace(clocked, clock=replace(clock, delays=delays), poses=corrected)


def _undetermined(
    sweep: CameraSweep, views: Sequence[View], tried: tuple[Sequence[ClockFit], Sequence[Match]]
) -> ClockedViews:
    """Gives views their poses without an estimate: at the stated offset, or for views at rest."""
    why, stated_s = why_undetermined(*tried), sweep.stated_s
    reason = not_ascending(views) or why
    offset_s = stated_s or 0.0
    correlation = max((match.correlation for match in tried[1]), default=None)
    stamps_s = np.array([view.stamp_s for view in views], dtype=float)
    resting = is_standing_still(sweep.motion.flange, stamps_s - offset_s)
    clock = ClockOffset(offset_s, 0.0, "rest", stated_s, 0, correlation, speeds={})
    if resting.all() and len(views):
        note = (
            f"The clocks of camera and robot are taken to be {1e3 * offset_s:+.4g} ms apart, "
            f"{'as stated' if stated_s is not None else 'as nothing is stated'}: the views were "
            "taken at rest, where this does not count."
        )
        return _at_offset(sweep, views, clock, [], [note])
    if stated_s is not None:
        warning = Finding(
            "clock",
            f"[clock] camera_minus_robot_s is taken as stated, {1e3 * stated_s:+.4g} ms, to "
            f"{1e3 * _STATED_SIGMA_S:g} ms, although views were taken in motion: {reason}.",
            _SHOW_OFFSET,
        )
        clock = replace(clock, method="stated", sigma_s=_STATED_SIGMA_S)
        return _at_offset(sweep, views, clock, [warning], [])
    if resting.sum() < FEWEST_VIEWS:
        raise undetermined_error(sweep.motion, views, resting, why)
    moving = int((~resting).sum())
    warning = Finding(
        "clock",
        f"{counted(moving, 'view', ('that was', 'that were'))} taken in motion "
        f"{'is' if moving == 1 else 'are'} left out, as the offset between the clocks is not "
        f"known: {reason}.",
        _SHOW_OFFSET,
    )
    kept = [view for view, is_still in zip(views, resting, strict=True) if is_still]
    clocked = _at_offset(sweep, kept, clock, [warning], [])
    rejected = {rejection.view: rejection for rejection in clocked.rejections} | {
        view.number: Rejection(view.number, _IN_MOTION)
        for view, is_still in zip(views, resting, strict=True)
        if not is_still
    }
    return replace(clocked, rejections=tuple(rejected.values()))


def _at_offset(
    sweep: CameraSweep,
    views: Sequence[View],
    clock: ClockOffset,
    warnings: Sequence[Finding],
    notes: Sequence[str],
) -> ClockedViews:
    """Gives views their poses at an offset, and selects among very many."""
    at_s = np.array([view.stamp_s for view in views], dtype=float) - clock.camera_minus_robot_s
    covered = sweep.motion.flange.covers(at_s)
    inside = [view for view, is_covered in zip(views, covered, strict=True) if is_covered]
    poses, speeds = sweep.motion.flange.at(at_s[covered]), sweep.motion.flange.speeds(at_s[covered])
    selected = _selected(inside, poses, speeds)
    taken = [inside[at].number for at in selected]
    rows = dict(zip(taken, sweep.motion.numbers(at_s[covered][selected]), strict=True))
    if clock.method != "rest":
        clock = replace(clock, speeds=dict(zip(taken, speeds[selected], strict=True)))
        notes = [*notes, speed_words(clock, speeds[selected], len(inside))]
    lost = dict(_uncovered(sweep.motion, views, at_s, covered))
    # Of a sweep that is longer than the stream, the rest is no loss.
    beyond = {key for key, why in lost.items() if why == _BEYOND and len(views) > _MANY_VIEWS}
    spared = {view.number: _SPARED for view in inside if view.number not in rows}
    lost |= {view.number: _NO_TIME for view in sweep.views if _has_no_pose_or_time(view)}
    return ClockedViews(
        clock,
        tuple(
            replace(view, numbers={**view.numbers, **rows.get(view.number, {})})
            for view in sweep.views
            if view.number in rows or not (lacks_robot_state(view) or _has_no_pose_or_time(view))
        ),
        tuple(Rejection(view, why) for view, why in lost.items() if view not in beyond),
        spared | dict.fromkeys(beyond, _BEYOND),
        tuple(warnings),
        tuple(notes),
    )


def _selected(views: Sequence[View], poses: FloatArray, speeds: FloatArray) -> IntArray:
    """Indices of the views to use: all of few; of many, slow ones and those held back."""
    everything = np.arange(len(views))
    if len(views) <= _MANY_VIEWS:
        return everything
    held = np.array([view.holdout for view in views])
    free = everything[~held]
    return np.sort([*free[slow_and_new(poses[free], speeds[free])], *everything[held]])


def _uncovered(
    motion: RobotMotion, views: Sequence[View], at_s: FloatArray, covered: Mask
) -> Iterator[tuple[int, str]]:
    """The views that the stream does not cover, and why."""
    first_s, last_s = motion.flange.stamps_s[[0, -1]]
    for view, view_s, is_covered in zip(views, at_s, covered, strict=True):
        if not is_covered:
            yield view.number, _IN_A_GAP if first_s <= view_s <= last_s else _BEYOND


def _has_no_pose_or_time(view: View) -> bool:
    return view.stamp_s is None and view.base_from_flange() is None and view.joints_rad is None
