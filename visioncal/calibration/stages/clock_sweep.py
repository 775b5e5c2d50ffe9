"""Where the flange was when a view was taken, out of a stream with a clock of its own.

A view that has a time and no pose of the robot gets it from the robot's stream. How far the
camera's clock is ahead of the robot's is estimated from the motion that both have seen.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.calibration.guess.joints import JointReading, declared_reading, unit_readings
from visioncal.calibration.stages.clock_offset import (
    FEWEST_VIEWS,
    LARGEST_SIGMA_S,
    LEAST_CORRELATION,
    ClockOffset,
    change_doubt,
    clock_words,
    find_delays,
    no_offset,
    not_ascending,
    shared_times,
    speed_words,
    stated_doubts,
    straighten,
    turning_doubt,
    why_undetermined,
)
from visioncal.calibration.stages.motion import RobotMotion, at_rest, is_open, slow_and_new
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.errors import DataError
from visioncal.core.types import Camera, FloatArray, IntArray, Mask, Mount, Rejection
from visioncal.core.verdict import Finding
from visioncal.estimation.clock import (
    ClockChange,
    ClockFit,
    DelayedFit,
    clear_fit,
    clock_change,
    fit_offset,
    left_by,
    refined_change,
)
from visioncal.estimation.clock_correlation import ImageTimes, Match, turning_matches
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.effects.delays import Delay
from visioncal.estimation.trajectory import Trajectory
from visioncal.robot import Robot
from visioncal.session import View

# A stated offset is taken to be known so well [s].
_STATED_SIGMA_S = 1e-3
_SPARED = "not needed: slower views stand for it, at the same places"
_NO_TIME = "no pose of the robot: neither a pose nor a time is there"
_BEYOND = "no pose of the robot: it was taken before or after the robot's stream"
_IN_A_GAP = "no pose of the robot: samples of its stream are missing around that time"
_IN_MOTION = "no pose of the robot: taken in motion, and how far the clocks differ is not known"
# So many views are all used; of more, slow ones.
_MANY_VIEWS = 60
# A change of the offset must leave so much less of rotations times positions; it is refined in so
# many rounds at most, or until it moves by less than this share of its sigma.
_CLEARLY_LESS, _ROUNDS, _AT_REST = 0.9, 6, 0.3
# What turns together goes along by so much.
_SURELY_ALIKE = 0.9


@dataclass(frozen=True)
class ClockPair:
    """A camera's frame and the name of a robot that parts it from what it sees."""

    camera: str
    robot: str

    @property
    def words(self) -> str:
        """Both, as messages and results name them."""
        return f"{self.camera} and robot {self.robot or 'robot'}"

    @property
    def effect(self) -> str:
        """The effect of their clocks' offset, by its name."""
        return f"clock of {self.words}"

    def delay(self, of: Delay) -> str:
        """The effect of a time within the camera's images, by its name."""
        return f"{of.name} of {self.words}"


@dataclass(frozen=True, eq=False)
class Clocked:
    """Views with the robot's poses at their time.

    Attributes:
        clock: The offset.
        views: Those that have a pose now, or had one before, in the session's order.
        rejections: Those that have none, and why.
        spared: Why the others of very many are not needed, by view.
        poses: Poses that were made anew of corners taken before or after their stamp.
        warnings: What gives reason for doubt.
        notes: What is good to know.
    """

    clock: ClockOffset
    views: tuple[View, ...]
    rejections: tuple[Rejection, ...]
    spared: Mapping[int, str]
    warnings: tuple[Finding, ...]
    notes: tuple[str, ...]
    poses: Mapping[int, ViewPoses] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class CameraSweep:
    """What one camera saw while one robot moved.

    Attributes:
        motion: The robot's stream.
        mount: Where the camera is.
        views: The rows; those that have a time and no pose of the robot wait for the clock.
        stated_s: The stated offset; None where none is stated.
        camera: The camera's intrinsics; None where it is not known how it took its images.
        positions: (c, 3) corners of all boards, numbered through [m].
    """

    motion: RobotMotion
    mount: Mount
    views: tuple[View, ...]
    stated_s: float | None
    camera: Camera | None = None
    positions: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def frames(self, seen: Sequence[tuple[View, ViewPoses]]) -> ImageTimes:
        """What the camera saw over time, each view by its best pose."""
        known = [view.corners for _, view in seen]
        corners = {
            view.number: corners for (view, _), corners in zip(seen, known, strict=True) if corners
        }
        measured = bool(seen) and len(corners) == len(seen)
        stacked = measured and self.camera is not None
        return ImageTimes(
            "eye-in-hand" if self.mount == "eye-in-hand" else "eye-to-hand",
            np.array([view.stamp_s for view, _ in seen], dtype=float),
            np.array([view.cam_from_target[0] for _, view in seen]).reshape(-1, 4, 4),
            np.array([view.covariance[0] for _, view in seen]) if measured else None,
            CornerStack.of(corners, self.positions) if stacked else None,
        )


def set_clock(sweep: CameraSweep, poses: Mapping[int, ViewPoses]) -> Clocked:
    """Gives views the robot's poses at their time.

    Args:
        sweep: What a camera saw while a robot moved.
        poses: What the camera saw, by view.

    Raises:
        DataError: No view lies within the stream, or the views' times are wrong.
        DegenerateError: The motion does not determine the offset, it is not stated, and too few
            views were taken at rest.
    """
    found = _match(sweep, poses)
    change = None if found.fit is None else _change(sweep, found.frames, found.fit)
    if change is None:
        return _placed_by(sweep, found, poses)
    doubt = change_doubt(change, found.views)
    sweep = replace(sweep, views=tuple(_corrected(view, change) for view in sweep.views))
    placed = _placed_by(sweep, _match(sweep, poses), poses)
    return replace(placed, warnings=(*placed.warnings, doubt))


@dataclass(frozen=True, eq=False)
class _Matched:
    """What the motion says of the clocks.

    Attributes:
        views: The views that wait for a pose, by their times.
        frames: What those in the fit saw.
        matches: The offsets at which camera and robot turn alike.
        sound: Those that are no chance.
        fits: The fits from them.
        fit: The one that stands out; None where none does.
    """

    views: Sequence[View]
    frames: ImageTimes
    matches: Sequence[Match]
    sound: Sequence[Match]
    fits: Sequence[ClockFit]
    fit: ClockFit | None


def _match(sweep: CameraSweep, poses: Mapping[int, ViewPoses]) -> _Matched:
    flange, stated_s = sweep.motion.flange, sweep.stated_s
    views = [view for view in sweep.views if is_open(view) and view.number in poses]
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


def _placed_by(sweep: CameraSweep, found: _Matched, poses: Mapping[int, ViewPoses]) -> Clocked:
    """Gives views their poses by the best that the motion says."""
    fit, sound = found.fit, found.sound
    if fit is not None and fit.sigma_s <= LARGEST_SIGMA_S:
        nearest_s = fit.offset_s
        match = min(sound, key=lambda value: abs(value.offset_s - nearest_s))
        return _by_motion(sweep, found.views, (fit, match), found.frames, poses)
    if len(sound) == 1 and found.frames.are_dense and sound[0].sigma_s <= LARGEST_SIGMA_S:
        return _by_turning(sweep, found.views, sound[0])
    wrong = shared_times(found.views, poses)
    if wrong is not None:
        raise wrong
    return _undetermined(sweep, found.views, (found.fits, found.matches))


def _change(sweep: CameraSweep, frames: ImageTimes, fit: ClockFit) -> ClockChange | None:
    """How the offset changes over the frames; None where it does not, or that explains little."""
    # A fit to both sides of a jump misleads about its size, which is found in a few rounds.
    flange, change = sweep.motion.flange, clock_change(sweep.motion.flange, frames, fit)
    for _ in range(_ROUNDS if change else 0):
        if change is None:
            return None
        there = replace(frames, stamps_s=change.corrected(frames.stamps_s))
        fits = fit_offset(flange, there, [fit.offset_s])
        if not fits or left_by(fits[0]) > _CLEARLY_LESS * left_by(fit):
            return None
        if frames.stack is not None:
            # What a rolling shutter does goes with the motion, and would be taken for the clock's.
            break
        before_s, change = change.step_s, refined_change(flange, there, fits[0], frames, change)
        if abs(change.step_s - before_s) < _AT_REST * change.sigma_s:
            break
    return change


def _corrected(view: View, change: ClockChange) -> View:
    """A view with the time that a clock without the change would have given it."""
    if view.stamp_s is None:
        return view
    (stamp_s,) = change.corrected(np.array([view.stamp_s])).tolist()
    return replace(view, numbers={**view.numbers, "stamp_s": stamp_s})


def _frames(
    sweep: CameraSweep, views: Sequence[View], poses: Mapping[int, ViewPoses]
) -> ImageTimes:
    """What the camera saw over time: of several boards one, and where it can be of clear poses."""
    seen = [(view, poses[view.number]) for view in views]
    boards = [view.board for _, view in seen]
    most = max(sorted(set(boards)), key=boards.count, default=0)
    seen = [pair for pair in seen if pair[1].board == most]
    clear = [pair for pair in seen if len(pair[1].cam_from_target) == 1]
    return sweep.frames(clear if 2 * len(clear) > len(seen) else seen)


def misread_joints(
    sweep: CameraSweep, poses: Mapping[int, ViewPoses], robot: Robot
) -> DataError | None:
    """The error of a stream of joint angles alone that turn as the camera sees in another unit.

    Args:
        sweep: What a camera saw while a robot moved, which its stream does not explain.
        poses: What the camera saw, by view.
        robot: The model by which the stream's poses are.

    Returns:
        The error; None where no other unit explains it.
    """
    if sweep.motion.reported or sweep.motion.joints is None:
        return None
    samples, q = sweep.motion.joints
    frames = _match(sweep, poses).frames

    def alike(reading: JointReading) -> float:
        flange = Trajectory(samples.stamps_s, reading.poses(q))
        matches = turning_matches(flange, frames, sweep.stated_s or 0.0)
        return max((match.correlation for match in matches), default=0.0)

    declared, file = declared_reading(robot), f"streams/{sweep.motion.name}.csv"
    recorded = alike(declared)
    for reading in unit_readings(declared):
        read = alike(reading)
        if recorded < LEAST_CORRELATION and read > _SURELY_ALIKE:
            return DataError(
                f"{file}: the joint angles are misread. With {reading.words}, robot and camera "
                f"turn alike with a correlation of {read:.2f}; as recorded, of {recorded:.2f}.",
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
) -> Clocked:
    fit, match = found
    late, delays = find_delays(sweep.motion.flange, frames, sweep.camera, fit)
    fit = fit if late is None else late.clock
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
    notes = [words, *(delay.words for delay in delays if delay.is_clear)]
    placed = _placed(sweep, views, clock, warnings, notes)
    return placed if late is None else _straightened(sweep, placed, views, poses, late)


def _straightened(
    sweep: CameraSweep,
    placed: Clocked,
    views: Sequence[View],
    poses: Mapping[int, ViewPoses],
    late: DelayedFit,
) -> Clocked:
    """Sets the corners straight of all views that the stream covers."""
    flange, clock = sweep.motion.flange, placed.clock
    seen = [(view, poses[view.number]) for view in views if poses[view.number].corners is not None]
    at_s = np.array([view.stamp_s for view, _ in seen], dtype=float) - clock.camera_minus_robot_s
    covered = flange.covers(at_s)
    seen, at_s = [pair for pair, ok in zip(seen, covered, strict=True) if ok], at_s[covered]
    if sweep.camera is None:
        return placed
    found = straighten(
        sweep.frames(seen),
        (flange.at(at_s), flange.speeds(at_s)),
        [view for _, view in seen],
        sweep.camera,
        late,
    )
    jacobian = {view: array for view, array in found.jacobian.items() if view in clock.speeds}
    places = {delay: at for at, delay in enumerate(late.delays)}
    delays = tuple(
        replace(delay, jacobian={view: by[:, places[delay.of]] for view, by in jacobian.items()})
        if delay.of in places
        else delay
        for delay in clock.delays
    )
    return replace(placed, clock=replace(clock, delays=delays), poses=found.poses)


def _by_turning(sweep: CameraSweep, views: Sequence[View], match: Match) -> Clocked:
    """Takes the offset at which both turn alike, where the chain as it is read does not close."""
    clock = ClockOffset(
        match.offset_s, match.sigma_s, "turning", sweep.stated_s, 0, match.correlation, speeds={}
    )
    warnings = [turning_doubt(match), *stated_doubts(clock, views)]
    return _placed(sweep, views, clock, warnings, [])


def _undetermined(
    sweep: CameraSweep,
    views: Sequence[View],
    tried: tuple[Sequence[ClockFit], Sequence[Match]],
) -> Clocked:
    """Does without an estimate: by what is stated, or with views at rest."""
    why, stated_s = why_undetermined(*tried), sweep.stated_s
    likeliest = not_ascending(views) or why
    offset_s = stated_s or 0.0
    correlation = max((match.correlation for match in tried[1]), default=None)
    stamps_s = np.array([view.stamp_s for view in views], dtype=float)
    resting = at_rest(sweep.motion.flange, stamps_s - offset_s)
    clock = ClockOffset(offset_s, 0.0, "rest", stated_s, 0, correlation, speeds={})
    if resting.all() and len(views):
        note = (
            f"The clocks of camera and robot are taken to be {1e3 * offset_s:+.4g} ms apart, "
            f"{'as stated' if stated_s is not None else 'as nothing is stated'}: the views were "
            "taken at rest, where this does not count."
        )
        return _placed(sweep, views, clock, [], [note])
    if stated_s is not None:
        warning = Finding(
            "clock",
            f"[clock] camera_minus_robot_s is taken as stated, {1e3 * stated_s:+.4g} ms, to "
            f"{1e3 * _STATED_SIGMA_S:g} ms, although views were taken in motion: {likeliest}.",
        )
        clock = replace(clock, method="stated", sigma_s=_STATED_SIGMA_S)
        return _placed(sweep, views, clock, [warning], [])
    if resting.sum() < FEWEST_VIEWS:
        raise no_offset(sweep.motion, views, resting, why)
    warning = Finding(
        "clock",
        f"{int((~resting).sum())} views that were taken in motion are left out, as the offset "
        f"between the clocks is not known: {likeliest}.",
    )
    kept = [view for view, value in zip(views, resting, strict=True) if value]
    placed = _placed(sweep, kept, clock, [warning], [])
    rejected = {rejection.view: rejection for rejection in placed.rejections} | {
        view.number: Rejection(view.number, _IN_MOTION)
        for view, value in zip(views, resting, strict=True)
        if not value
    }
    return replace(placed, rejections=tuple(rejected.values()))


def _placed(
    sweep: CameraSweep,
    views: Sequence[View],
    clock: ClockOffset,
    warnings: Sequence[Finding],
    notes: Sequence[str],
) -> Clocked:
    """Gives views their poses at an offset, and chooses among very many."""
    at_s = np.array([view.stamp_s for view in views], dtype=float) - clock.camera_minus_robot_s
    covered = sweep.motion.flange.covers(at_s)
    inside = [view for view, value in zip(views, covered, strict=True) if value]
    poses, speeds = sweep.motion.flange.at(at_s[covered]), sweep.motion.flange.speeds(at_s[covered])
    chosen = _chosen(inside, poses, speeds)
    taken = [inside[at].number for at in chosen]
    rows = dict(zip(taken, sweep.motion.numbers(at_s[covered][chosen]), strict=True))
    if clock.method != "rest":
        clock = replace(clock, speeds=dict(zip(taken, speeds[chosen], strict=True)))
        notes = [*notes, speed_words(clock, speeds[chosen], len(inside))]
    lost = dict(_uncovered(sweep.motion, views, at_s, covered))
    # A sweep may be longer than the stream beside it.
    beyond = {key for key, why in lost.items() if why == _BEYOND and len(views) > _MANY_VIEWS}
    spared = {view.number: _SPARED for view in inside if view.number not in rows}
    lost |= {view.number: _NO_TIME for view in sweep.views if _knows_nothing(view)}
    return Clocked(
        clock,
        tuple(
            replace(view, numbers={**view.numbers, **rows.get(view.number, {})})
            for view in sweep.views
            if view.number in rows or not (is_open(view) or _knows_nothing(view))
        ),
        tuple(Rejection(view, why) for view, why in lost.items() if view not in beyond),
        spared | dict.fromkeys(beyond, _BEYOND),
        tuple(warnings),
        tuple(notes),
    )


def _chosen(views: Sequence[View], poses: FloatArray, speeds: FloatArray) -> IntArray:
    """Which views to use: all of few, of many the slow ones, and those that are held back."""
    everything = np.arange(len(views))
    if len(views) <= _MANY_VIEWS:
        return everything
    held = np.array([view.holdout for view in views])
    free = everything[~held]
    return np.sort([*free[slow_and_new(poses[free], speeds[free])], *everything[held]])


def _uncovered(
    motion: RobotMotion, views: Sequence[View], at_s: FloatArray, covered: Mask
) -> Iterator[tuple[int, str]]:
    """The views about which the stream says nothing, and why."""
    first_s, last_s = motion.flange.stamps_s[[0, -1]]
    for view, it_s, there in zip(views, at_s, covered, strict=True):
        if not there:
            within = first_s <= it_s <= last_s
            yield view.number, _IN_A_GAP if within else _BEYOND


def _knows_nothing(view: View) -> bool:
    """Whether neither a pose of the robot nor a time is there."""
    return view.stamp_s is None and view.base_from_flange() is None and view.joints_rad is None
