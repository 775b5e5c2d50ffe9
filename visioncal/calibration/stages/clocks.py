"""Robot poses, from streams, for rows with a time and no pose.

Every pair of a camera and a robot has its own clock offset, estimated from the motion that both
observed: where they turn alike, then by the whole chain of frames.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from visioncal.calibration.stages.cameras import locate_targets
from visioncal.calibration.stages.cell import Cell, robot_key
from visioncal.calibration.stages.clock_offset import (
    LARGEST_SIGMA_S,
    LEAST_CORRELATION,
    STATED_SIGMA_S,
    SWEEP,
    WITH_INVERSE,
    ClockedViews,
    ClockPair,
    change_doubt,
    motion_notes,
    offset_doubts,
    speed_words,
    undetermined_error,
    why_undetermined,
)
from visioncal.calibration.stages.observed import Observed
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.linalg import covariance_from
from visioncal.core.number_format import counted
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert
from visioncal.core.types import Camera, FloatArray, Mount, Rejection
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.clock import ClockFit, clear_fit, clock_change, fit_offset, fit_readout
from visioncal.estimation.clock_correlation import ImageTimes, far_offset, turning_matches
from visioncal.estimation.effects.clock import clock_effect
from visioncal.estimation.effects.rolling_shutter import (
    compress_delayed,
    delayed_points,
    target_twists,
)
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem_parts import Effect
from visioncal.results import CameraResult
from visioncal.results.sections import ClockResult
from visioncal.robot import Robot
from visioncal.robot.trajectory import Trajectory
from visioncal.session import Session, View, frame_name
from visioncal.session.kinds import is_camera_observation
from visioncal.session.motion import (
    RobotMotion,
    is_standing_still,
    lacks_robot_state,
    motion_of,
    slow_and_new,
    stream_of,
)
from visioncal.vision.corners import CornerStack, floored_sigma_px, reproject
from visioncal.vision.intrinsics import estimate_intrinsics
from visioncal.vision.pnp import ViewPoses
from visioncal.vision.targets import numbered_positions

T = TypeVar("T", bound=Observed)

_SHOW_OFFSET = Remedy(
    "Take the views at rest, or record a sweep that turns fast enough to show the clocks' offset."
)
# Up to this number all views are used; of more, slow ones.
_MANY_VIEWS = 60


def waits_for_clock(session: Session) -> bool:
    """Tells whether rows have a time, and need a robot's pose that its stream may give."""
    return bool(_waiting(session))


def set_clocks(seen: T) -> T:
    """Gives rows the poses of robots at their times.

    Raises:
        DataError: The stream of a single robot has no poses and no usable joints, or no view of the
            single camera lies within it.
        DegenerateError: The motion of a single pair does not determine the offset, it is not
            stated, and too few views were taken at rest.
    """
    for pair, rows in _waiting(seen.session).items():
        seen = _beside_shutter(seen, pair, rows)
    return seen


def _beside_shutter(seen: T, pair: ClockPair, rows: list[View]) -> T:
    """Adds the clock of a pair, with an estimated lens by corners where they were at the stamp.

    By images whose rows are apart in time, a lens takes some of the motion for its own, and leaves
    less of it to the shutter.
    """
    found, targets = _with_clock(seen, pair, rows), tuple(seen.session.boards.values())
    # Most rounds of lens and readout, and the change of the readout, over its sigma, that ends
    # them.
    for _ in range(5):
        look, clocked = seen.cameras.get(pair.camera), found.clocks.get(pair)
        shutter = None if clocked is None else clocked.clock.shutter
        is_open = look is not None and look.lens is not None and look.lens.estimated
        if clocked is None or look is None or look.resolution is None or not is_open:
            break
        if shutter is None or not shutter.is_rolling:
            break
        # Beside views at rest, those whose corners were put where they were at the stamp.
        moving = {row.number for row in rows}
        at_stamp = {view: corners for view, corners in look.corners.items() if view not in moving}
        at_stamp |= {
            view: pose.corners for view, pose in clocked.poses.items() if pose.corners is not None
        }
        at_stamp = {view: at for view, at in at_stamp.items() if view not in seen.held_back}
        try:
            fit = estimate_intrinsics(at_stamp, targets, look.resolution, look.table.model)
        except VisioncalError:
            break
        lens = CameraResult(fit.camera, estimated=True, covariance=fit.covariance)
        seen = locate_targets(seen.with_camera(pair.camera, replace(look, lens=lens)))
        found = _with_clock(seen, pair, rows)
        now = found.clocks[pair].clock.shutter if pair in found.clocks else None
        if now is None or abs(now.readout_s - shutter.readout_s) < 0.3 * now.readout_sigma_s:
            break
    return found


def _waiting(session: Session) -> dict[ClockPair, list[View]]:
    """Rows that lack the pose of one robot with a stream, by pair; at least one has a time."""
    if not session.streams or not any(lacks_robot_state(view) for view in session.views):
        return {}
    waiting: dict[ClockPair, list[View]] = {}
    for observation in session.observations:
        view, lacks = observation.view, observation.missing_robots
        if len(lacks) == 1 and is_camera_observation(view) and stream_of(session, lacks[0]):
            waiting.setdefault(ClockPair(observation.seer, lacks[0]), []).append(view)
    return {pair: rows for pair, rows in waiting.items() if any(map(lacks_robot_state, rows))}


def _with_clock(seen: T, pair: ClockPair, rows: list[View]) -> T:
    """Adds the clock of a pair; one of several without a clock is only reported."""
    session, lens = seen.session, seen.lenses.get(pair.camera)
    document = session.robot_documents.get(pair.robot)
    # A single pair needs no name, and cannot do without its clock.
    is_only = max(len(session.cameras), len(session.robots)) < 2
    of = "" if is_only else pair.words
    declared = session.declaration
    table = declared.clocks.get(pair.camera.partition("_")[2], declared.clock)
    on_flange = session.frames[pair.camera] == frame_name("flange", pair.robot)
    try:
        model = None if document is None else Robot.from_document(document)
        sweep = _Sweep(
            motion_of(session, model, stream_of(session, pair.robot)),
            "eye-in-hand" if on_flange else "eye-to-hand",
            tuple(rows),
            seen.poses,
            table.camera_minus_robot_s,
            None if lens is None else lens.camera,
            numbered_positions(tuple(session.boards.values())),
        )
        clocked = _clocked(sweep)
    except VisioncalError as error:
        if is_only:
            raise
        lost = [Rejection(row.number, f"no pose: {error.message}") for row in rows]
        step = Remedy(error.next_step) if error.next_step else None
        return seen.noting(lost, (Finding("clock", error.message, step).of(of),))
    robot_text = {"robot": pair.robot} if pair.robot else {}
    views = tuple(replace(view, text={**view.text, **robot_text}) for view in clocked.views)
    seen = replace(
        seen,
        clocks={**seen.clocks, pair: replace(clocked, views=views)},
        poses={**seen.poses, **clocked.poses},
        notes=(*seen.notes, *(f"{of}: {note}" if of else note for note in clocked.notes)),
    )
    return seen.noting(clocked.rejections, (warning.of(of) for warning in clocked.warnings))


@dataclass(frozen=True, eq=False)
class _Sweep:
    """Observations of one camera while one robot moved."""

    motion: RobotMotion  # The robot's stream.
    mount: Mount  # Mount of the camera.
    # The rows; those that have a time and no pose of the robot wait for the clock.
    views: tuple[View, ...]
    poses: Mapping[int, ViewPoses]  # The target's pose by view.
    stated_s: float | None  # The stated offset [s]; None without one.
    camera: Camera | None  # The camera's intrinsics; None where unknown.
    positions: FloatArray  # (c, 3) corners of all boards, numbered consecutively [m].

    @property
    def waiting(self) -> list[View]:
        """The views that wait for a pose, sorted by time."""
        views = [
            view for view in self.views if lacks_robot_state(view) and view.number in self.poses
        ]
        return sorted(views, key=lambda view: view.stamp_s or 0.0)

    def frames(self, views: Sequence[View]) -> ImageTimes:
        """The camera's observations over time, by the best pose of each view."""
        seen = [self.poses[view.number] for view in views]
        corners = {pose.view: pose.corners for pose in seen if pose.corners}
        measured = bool(seen) and len(corners) == len(seen)
        stacked = measured and self.camera is not None
        return ImageTimes(
            self.mount,
            np.array([view.stamp_s for view in views], dtype=float),
            np.array([pose.cam_from_target[0] for pose in seen]).reshape(-1, 4, 4),
            np.array([pose.covariance[0] for pose in seen]) if measured else None,
            CornerStack.of(corners, self.positions) if stacked else None,
        )

    def fitted_frames(self, views: Sequence[View]) -> ImageTimes:
        """Frames of the board seen most often, without ambiguous poses where enough are clear."""
        free = [view for view in views if not view.holdout]
        boards = [self.poses[view.number].board for view in free]
        most = max(sorted(set(boards)), key=boards.count, default=0)
        free = [view for view, board in zip(free, boards, strict=True) if board == most]
        clear = [view for view in free if len(self.poses[view.number].cam_from_target) == 1]
        return self.frames(clear if 2 * len(clear) > len(free) else free)


def _clocked(sweep: _Sweep, change: Finding | None = None) -> ClockedViews:
    """Gives views their poses at the best available offset; `change` is what was corrected."""
    flange, stated_s, views = sweep.motion.flange, sweep.stated_s, sweep.waiting
    frames = sweep.fitted_frames(views)
    about_s = stated_s or 0.0
    if stated_s is None and len(frames) and not flange.covers(frames.stamps_s).any():
        # Clocks of other epochs, as of a tracker and of a camera's driver.
        about_s = far_offset(flange, frames) or 0.0
    matches = turning_matches(flange, frames, about_s)
    sound = [
        match for match in matches if match.correlation >= LEAST_CORRELATION and not match.at_end
    ]
    starts = [match.offset_s for match in sound] + ([] if stated_s is None else [stated_s])
    fits = fit_offset(flange, frames, starts) if sound else ()
    fit = clear_fit(fits, stated_s)
    changed = None if fit is None or change else clock_change(flange, frames, fit)
    if changed is not None:
        corrected = list(sweep.views)
        for at, view in enumerate(corrected):
            if view.stamp_s is not None:
                stamp_s = changed.corrected(np.array([view.stamp_s])).item()
                corrected[at] = replace(view, numbers={**view.numbers, "stamp_s": stamp_s})
        return _clocked(replace(sweep, views=tuple(corrected)), change_doubt(changed, views))
    clock = ClockResult(
        camera_minus_robot_s=stated_s or 0.0,
        method="rest",
        stated_s=stated_s,
        correlation=matches[0].correlation if matches else None,
    )
    if fit is not None and fit.sigma_s <= LARGEST_SIGMA_S:
        delayed = fit_readout(flange, frames, sweep.camera, fit)
        shutter = None if delayed is None else delayed.shutter
        is_rolling = shutter is not None and shutter.is_rolling
        fit = delayed if delayed is not None and is_rolling else fit
        clock = replace(
            clock,
            camera_minus_robot_s=fit.offset_s,
            sigma_s=fit.sigma_s,
            method="motion",
            frames=fit.frames,
            shutter=shutter,
        )
        notes = tuple(motion_notes(clock, sweep.motion.name))
        doubts = (*offset_doubts(clock), *([] if change is None else [change]))
        clocked = _at_offset(sweep, clock, doubts, notes)
        return _with_shutter(sweep, clocked, fit) if is_rolling else clocked
    if sound and _are_inverse(flange, frames, starts):
        clock = replace(clock, camera_minus_robot_s=about_s)
        return _undetermined(sweep, clock, *WITH_INVERSE)
    span_s = float(np.ptp(flange.stamps_s))
    return _undetermined(sweep, clock, why_undetermined(fits, matches, span_s), SWEEP)


def _are_inverse(flange: Trajectory, frames: ImageTimes, starts: Sequence[float]) -> bool:
    """Whether measured poses of the target determine the offset once they are inverted."""
    if frames.stack is not None:
        return False
    inverse = replace(frames, cam_from_target=invert(frames.cam_from_target), covariance=None)
    fit = clear_fit(fit_offset(flange, inverse, starts), None)
    return fit is not None and fit.sigma_s <= LARGEST_SIGMA_S


def _undetermined(sweep: _Sweep, clock: ClockResult, why: str, step: str) -> ClockedViews:
    """Gives views their poses without an estimate: at the stated offset, or for views at rest."""
    views, offset_s = sweep.waiting, clock.camera_minus_robot_s
    stamps_s = np.array([view.stamp_s for view in views], dtype=float)
    resting = is_standing_still(sweep.motion.flange, stamps_s - offset_s)
    if resting.all() and len(views):
        note = (
            f"The clocks of camera and robot are taken to be {1e3 * offset_s:+.4g} ms apart, "
            f"{'as nothing is stated' if clock.stated_s is None else 'as stated'}: the views were "
            "taken at rest, where this does not count."
        )
        return _at_offset(sweep, clock, (), (note,))
    if clock.stated_s is not None:
        words = (
            f"[clock] camera_minus_robot_s is taken as stated, {1e3 * offset_s:+.4g} ms, to "
            f"{1e3 * STATED_SIGMA_S:g} ms, although views were taken in motion: {why}."
        )
        clock = replace(clock, method="stated", sigma_s=STATED_SIGMA_S)
        return _at_offset(sweep, clock, (Finding("clock", words, _SHOW_OFFSET),))
    if resting.sum() < FEWEST_VIEWS:
        raise undetermined_error(sweep.motion, views, resting, offset_s, why, step)
    moving = {view.number for view, is_still in zip(views, resting, strict=True) if not is_still}
    words = (
        f"{counted(len(moving), 'view', ('that was', 'that were'))} taken in motion "
        f"{'is' if len(moving) == 1 else 'are'} left out, as the offset between the clocks is not "
        f"known: {why}."
    )
    kept = tuple(view for view in sweep.views if view.number not in moving)
    warnings = (Finding("clock", words, _SHOW_OFFSET),)
    clocked = _at_offset(replace(sweep, views=kept), clock, warnings)
    reason = "no pose of the robot: taken in motion, and how far the clocks differ is not known"
    rejected = (Rejection(view, reason) for view in sorted(moving))
    return replace(clocked, rejections=(*clocked.rejections, *rejected))


def _at_offset(
    sweep: _Sweep,
    clock: ClockResult,
    warnings: tuple[Finding, ...] = (),
    notes: tuple[str, ...] = (),
) -> ClockedViews:
    """Gives views their poses at an offset, and selects among very many."""
    flange, views = sweep.motion.flange, sweep.waiting
    at_s = np.array([view.stamp_s for view in views], dtype=float) - clock.camera_minus_robot_s
    covered = flange.covers(at_s)
    inside = [view for view, is_covered in zip(views, covered, strict=True) if is_covered]
    poses, speeds = flange.at(at_s[covered]), flange.speeds(at_s[covered])
    selected = np.arange(len(inside))
    if len(inside) > _MANY_VIEWS:
        # Of many, slow ones and those held back.
        held = np.array([view.holdout for view in inside])
        free = selected[~held]
        selected = np.sort([*free[slow_and_new(poses[free], speeds[free])], *selected[held]])
    taken = [inside[at].number for at in selected]
    rows = dict(zip(taken, sweep.motion.numbers(at_s[covered][selected]), strict=True))
    if clock.method != "rest":
        notes = (*notes, speed_words(clock, speeds[selected], len(inside)))
    reason = "no pose of the robot: its stream has no samples around that time"
    lost = [view.number for view, ok in zip(views, covered, strict=True) if not ok]
    redundant = "not needed: slower views stand for it, at the same places"
    spared = {view.number: redundant for view in inside if view.number not in rows}
    return ClockedViews(
        clock,
        tuple(
            replace(view, numbers={**view.numbers, **rows.get(view.number, {})})
            for view in sweep.views
            if view.number in rows or not lacks_robot_state(view)
        ),
        {} if clock.method == "rest" else dict(zip(taken, speeds[selected], strict=True)),
        # Of a long sweep they are no loss.
        () if len(views) > _MANY_VIEWS else tuple(Rejection(view, reason) for view in lost),
        spared | (dict.fromkeys(lost, reason) if len(views) > _MANY_VIEWS else {}),
        warnings,
        notes,
    )


def _with_shutter(sweep: _Sweep, clocked: ClockedViews, fit: ClockFit) -> ClockedViews:
    """Moves the corners of all views that the stream covers to where they were at the stamp.

    Ambiguous poses stay as they are.
    """
    flange, clock, camera = sweep.motion.flange, clocked.clock, sweep.camera
    views = [view for view in sweep.waiting if sweep.poses[view.number].corners is not None]
    at_s = np.array([view.stamp_s for view in views], dtype=float) - clock.camera_minus_robot_s
    covered = flange.covers(at_s)
    views, at_s = [view for view, ok in zip(views, covered, strict=True) if ok], at_s[covered]
    frames = sweep.frames(views)
    stack, readout_s = frames.stack, 0.0 if fit.shutter is None else fit.shutter.readout_s
    if stack is None or camera is None:
        return clocked
    with one_blas_thread():
        twists = target_twists(
            sweep.mount,
            flange.at(at_s),
            fit.fit.state.edges[0],
            frames.cam_from_target,
            flange.speeds(at_s),
        )
        found = compress_delayed(stack, camera, twists, readout_s, frames.cam_from_target)
        sigma_px = floored_sigma_px(stack.sigma_px(found.residuals, 6 * len(views) + 1))
        plain = replace(stack, weights=None)
        delayed = replace(plain, points=delayed_points(stack, camera, twists, readout_s)[0])
        at_stamp_px, delayed_px = (
            reproject(corners, camera, found.cam_from_target, lens=False).residuals
            for corners in (plain, delayed)
        )
        px = stack.px + at_stamp_px - delayed_px
    covariance = sigma_px**2 * covariance_from(found.information)
    poses = {}
    for at, view in enumerate(views):
        pose = sweep.poses[view.number]
        if pose.corners is not None:
            pose = replace(pose, corners=replace(pose.corners, px=px[stack.view_of == at]))
        if len(pose.cam_from_target) == 1:
            cam_from_target = found.cam_from_target[at][None]
            pose = replace(pose, cam_from_target=cam_from_target, covariance=covariance[at][None])
        poses[view.number] = pose
    by_readout = dict(zip(poses, found.by_shared[:, :, 0], strict=True))
    return replace(clocked, by_readout=by_readout, poses=poses)


def clock_effects(
    cell: Cell, clocks: Mapping[ClockPair, ClockedViews], erring: Collection[str] = ()
) -> tuple[Effect, ...]:
    """Errors of clock offsets and readout times [s], as effects on the cell's rows.

    `erring` are names in the problem of robots whose arm errors are unknowns of the fit.
    """
    effects: list[Effect] = []
    for pair, clocked in clocks.items():
        speeds, robot = clocked.speeds, robot_key(pair.robot)
        if not speeds or robot not in cell.poses:
            continue
        twists, none = np.zeros((len(cell.poses[robot]), 6)), np.zeros(6)
        for row in cell.rows:
            if row.view in speeds:
                twists[row.station] = speeds[row.view]
        sigma_s = clocked.prior_sigma_s(erring=robot in erring)
        effect = clock_effect(twists, sigma_s, pair.effect, robot)
        concerned = np.array([row.view in speeds for row in cell.rows], dtype=bool)
        effects.append(replace(effect, rows_concerned=concerned))
        shutter = clocked.clock.shutter
        if shutter is not None and shutter.is_rolling:
            jacobian = np.array([clocked.by_readout.get(row.view, none) for row in cell.rows])
            prior = PriorInformation(np.array([[shutter.readout_sigma_s**-2.0]]), np.zeros(1))
            effects.append(Effect.free(pair.readout, prior, jacobian.reshape(-1, 6, 1)))
    return tuple(effects)
