"""A few stops of a session, seen with a calibration's own lens, boards and arm."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from reprlib import repr as shorten

import numpy as np

from visioncal.calibration.pipeline import STAGES
from visioncal.calibration.pipeline.observed_poses import ObservedPoses
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.observed import CameraLook
from visioncal.calibration.stages.pose_ambiguity import choose_by
from visioncal.calibration.verification.calibration_prior import CalibrationPrior
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.transforms import invert, pose_difference
from visioncal.core.types import Corners, FloatArray, IntArray, Progress, Rejection, Target
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.chain import robot_part
from visioncal.estimation.corners import CornerStack, reproject
from visioncal.estimation.lens_field import depths_m
from visioncal.estimation.parts import ROBOT, State
from visioncal.estimation.problem import Problem
from visioncal.results import CameraResult
from visioncal.results.picking import check_mount, check_resolution
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.boards import COLUMN
from visioncal.vision.targets import numbered_positions, target_document

# Models that place the flange alike to this are of one robot; tables are written with six digits.
_ONE_ROBOT_MM, _ONE_ROBOT_DEG = 0.01, 0.001
_POSTURES = 5
_STAGES = {stage.name: stage.run for stage in STAGES}
# Corners that scatter by so many times as much as when they were calibrated with are mentioned.
_MENTIONED = 2.0


@dataclass(frozen=True, eq=False)
class PredictedStops:
    """The stops of a session as a calibration sees them.

    Attributes:
        known: What is known of the session, with the calibration's lens, boards and arm.
        problem: The m sights of a board at a stop, with the calibration's unknowns.
        views: (m,) the views of each sight.
        warnings: What is odd, in sentences.
    """

    known: ObservedPoses
    problem: Problem
    views: tuple[tuple[int, ...], ...]
    warnings: tuple[str, ...]

    @property
    def stops(self) -> int:
        """How many stops there are."""
        return len(self.problem.poses[ROBOT])

    @property
    def joints_rad(self) -> FloatArray | None:
        """(s, n) joint angles of the stops [rad]; None where not all have them."""
        return self.known.arm_at_stops.joints_rad

    @property
    def boards(self) -> IntArray:
        """(m,) which of the calibration's boards each sight is of."""
        return np.array(
            [self.problem.unknown[name] - 1 for name in self.problem.observations.observed]
        )

    def away(self, prior_calibration: CalibrationPrior) -> FloatArray:
        """(m, 4, 4) by how much its board has moved, on its right, as each sight places it."""
        return asked_of_boards(self.problem, prior_calibration.state)

    @property
    def from_corners(self) -> bool:
        """Whether the target's poses come from corners, whose noise is known."""
        return not self.problem.is_combined


def predict_stops(
    session: Session,
    prior_calibration: CalibrationPrior,
    progress: Progress | None = None,
    without: Mapping[int, str] | None = None,
) -> PredictedStops:
    """Looks at a session with what a calibration rests on, and estimates nothing anew.

    Args:
        session: Of the same cell.
        prior_calibration: The calibration's.
        progress: Told of long work.
        without: Views that are not to be looked at, and why not.

    Raises:
        DataError: It is of another mount, camera, target or robot, lacks joint angles that the
            calibrated arm needs, or shows nothing.
    """
    known = _STAGES["robot"](known_before(session, prior_calibration, progress))
    known = _STAGES["detect"](known)
    rejected = {key: why for key, why in (without or {}).items() if key not in known.held_back}
    return seen_by(known.noting(Rejection(*pair) for pair in rejected.items()), prior_calibration)


def known_before(
    session: Session, prior_calibration: CalibrationPrior, progress: Progress | None = None
) -> RunState:
    """What is known before anything is looked at: that the session is of the same cell.

    Raises:
        DataError: It is of another mount, target or robot.
    """
    calibration = prior_calibration.calibration
    check_mount(session, calibration)
    session = _with_its_targets(session, prior_calibration)
    document, robot = session.robot_document, calibration.robot
    if robot is not None and document is not None:
        check_robot(session, Robot.from_document(document), robot)
    if robot is not None:
        # As calibrated, with its base in the frame of the poses.
        session = replace(session, robot_document=robot.document)
    return RunState(session, progress)


def seen_by(known: RunState, prior_calibration: CalibrationPrior) -> PredictedStops:
    """Carries on where targets have been detected; see `predict_stops`."""
    calibration, detected = prior_calibration.calibration, known.cameras
    for frame, look in known.cameras.items():
        if look.resolution is None:
            continue
        if calibration.camera is None:
            raise DataError(
                f"calibration {calibration.session_name!r} holds no camera, and session "
                f"{known.session.name!r} has images.",
                next_step="Give the target's poses (cft_x_m ...) as when it was calibrated.",
            )
        check_resolution(known.session, calibration, look.resolution)
        lens = CameraResult(calibration.camera.camera, estimated=False)
        straight = _straightened(look.corners, calibration.camera, {})
        known = known.with_camera(frame, replace(look, lens=lens, corners=straight))
    known = _breathed(known, detected, calibration.camera)
    # Of a sweep the slower views are taken, in which the offset's error is lost in the robot's.
    known = replace(_STAGES["clock"](_STAGES["pnp"](known)), clocks={})
    looked = _posed(_with_arm(ObservedPoses.of(known), prior_calibration), prior_calibration)
    problem = looked.problem(looked.used)
    sights = problem.of_one_stop
    return PredictedStops(
        looked,
        problem.merged(),
        tuple(
            tuple(np.array(looked.used)[sights == at].tolist()) for at in range(sights.max() + 1)
        ),
        tuple(_warnings(looked, prior_calibration)),
    )


def _breathed(
    known: RunState, detected: Mapping[str, CameraLook], lens: CameraResult | None
) -> RunState:
    """Corners where a lens that breathes would show them at the views' mean distance."""
    if lens is None or lens.field is None or lens.field.breathing == 0.0:
        return known
    targets = tuple(known.session.boards.values())
    placed = _STAGES["pnp"](known).poses
    for frame, look in detected.items():
        shown = {
            view: view_corners for view, view_corners in look.corners.items() if view in placed
        }
        if not shown:
            continue
        stack = CornerStack.of(shown, numbered_positions(targets))
        poses = np.array([placed[view].cam_from_target[0] for view in stack.views])
        far = dict(zip(stack.views, depths_m(stack, poses).tolist(), strict=True))
        straight = _straightened(look.corners, lens, far)
        known = known.with_camera(frame, replace(known.cameras[frame], corners=straight))
    return known


def _straightened(
    corners: Mapping[int, Corners], lens: CameraResult, depths: Mapping[int, float]
) -> dict[int, Corners]:
    """Corners by view where the lens would show them, were it what its model says."""
    return {
        view: replace(view_corners, px=lens.in_model(view_corners.px, depths.get(view)))
        for view, view_corners in corners.items()
    }


def asked_of_boards(problem: Problem, state: State) -> FloatArray:
    """(m, 4, 4) the change of its board's edge, on the right, that each observation asks for."""
    asked, observed = np.zeros((len(problem), 4, 4)), np.array(problem.observations.observed)
    for board in set(problem.observations.observed):
        mine = observed == board
        asked[mine] = problem.change_of(board, state)[mine]
    return asked


def _with_arm(known: ObservedPoses, prior_calibration: CalibrationPrior) -> ObservedPoses:
    """Takes the arm for what the calibration has it for."""
    known = replace(known, calibrated=replace(known.robot_arm, model=prior_calibration.model))
    if prior_calibration.arm in ("none", "poses"):
        return known
    if known.robot_arm.joints_rad is None:
        missing = [view.number for view in known.session.views if view.joints_rad is None]
        raise DataError(
            f"session {known.session.name!r}: the calibration is of an arm by its joints, and "
            + (f"{len(missing)} views have no joint angles." if missing else "its joints differ."),
            culprits=[f"views.csv: view {index}" for index in missing],
            next_step="Record q1_rad ... with every view.",
        )
    return known


def _posed(known: ObservedPoses, prior_calibration: CalibrationPrior) -> ObservedPoses:
    """Chooses each view's pose by the calibration, and makes it by its lens and boards."""
    mount, targets = known.session.mount, tuple(prior_calibration.targets.values())
    x, *placed = prior_calibration.state.edges
    order = {board: at for at, board in enumerate(prior_calibration.boards)}
    views, chosen = [], []
    for view in (view.number for view in known.session.views):
        poses = known.poses.get(view)
        if poses is None or view not in known.base_from_flange or view in known.reasons:
            continue
        if poses.board not in order:
            continue
        robot = robot_part(known.arm_at([view]).poses, mount)[0]
        predicted = invert(robot @ x) @ placed[order[poses.board]]
        views.append(view)
        chosen.append(choose_by(poses, predicted, targets[poses.board] if targets else None))
    if not views:
        raise DataError(
            f"session {known.session.name!r}: no view shows the target from a known pose of the "
            "robot.",
            culprits=known.lost_views,
        )
    known = replace(
        known, used=tuple(views), boards=prior_calibration.boards, free=prior_calibration.free
    )
    known = replace(known, frames=known.framed(prior_calibration.state.edges)).posed(chosen)
    if known.free is not None and all(view.corners is not None for view in chosen):
        known = known.with_noise(_noise_px(known)).posed(chosen)
    return _with_errors(known, prior_calibration)


def _with_errors(known: ObservedPoses, prior_calibration: CalibrationPrior) -> ObservedPoses:
    """Adds the arm's errors as unknowns, as the calibration's covariance has them."""
    if prior_calibration.arm == "none":
        return known
    arm = known.robot_arm
    if prior_calibration.arm == "poses":
        arm = replace(arm, joints_rad=None)
    errors = ArmErrors(arm.basis, 1.0, np.inf, of_links=True)
    return replace(known, calibrated=replace(arm, errors=errors))


def _noise_px(known: ObservedPoses) -> float:
    """Noise of a corner's coordinate around the poses, by lens and boards as calibrated [px]."""
    corners = {
        view: corners
        for view, corners in zip(known.used, known.seen(known.used), strict=True)
        if corners
    }
    free = known.free
    if free is None or not corners:
        return known.pixel_px or 0.0
    shaped = free.positions + free.basis @ free.appearance.board
    stack = CornerStack.of(corners, shaped)
    poses = np.array([known.poses[view].cam_from_target[0] for view in corners])
    left = reproject(stack, free.appearance.camera, poses).residuals
    return stack.sigma_px(left, 6 * len(corners))


def _with_its_targets(session: Session, prior_calibration: CalibrationPrior) -> Session:
    """Numbers the session's targets as the calibration does, by their names."""
    # The only one of a session has no name: where several were calibrated with, it is the one among
    # them that is printed alike.
    known, shown = prior_calibration.targets, session.boards
    if len(known) < 2 and len(shown) < 2:
        if any(view.image or view.has_corners for view in session.views):
            _check_targets(session, prior_calibration)
        return session
    name = ""
    if "" in shown:
        alike = [name for name, target in known.items() if not _differing(target, shown[""])]
        name = alike[0] if len(alike) == 1 else ""
    if not name:
        _check_targets(session, prior_calibration)
    if not shown:
        raise DataError(
            f"session {session.name!r} does not say which of the targets that were calibrated with "
            f"({', '.join(known)}) its rows show.",
            culprits=["session.toml: targets"],
            next_step="Declare them as in the calibration's session, and name one in each row's "
            "column target.",
        )
    views = session.views
    if name:
        views = tuple(replace(view, text={**view.text, COLUMN: name}) for view in views)
    return replace(session, target=None, targets=known, views=views)


def _differing(ours: Target, theirs: Target) -> list[str]:
    """The fields in which two targets are printed differently."""
    one, other = target_document(ours), target_document(theirs)
    differing = [name for name in {**one, **other} if one.get(name) != other.get(name)]
    return [name for name in differing if name != "square_sigma_m"]


def _check_targets(session: Session, prior_calibration: CalibrationPrior) -> None:
    """Refuses other targets than were calibrated with; how well a size is known may differ."""
    if not prior_calibration.targets:
        raise DataError(
            f"calibration {prior_calibration.calibration.session_name!r} was made from measured "
            f"poses, and does not say of which target; session {session.name!r} has images.",
            culprits=["session.toml: target"],
            next_step="Give the target's poses (cft_x_m ...) as when it was calibrated.",
        )
    for name, target in session.boards.items():
        known = prior_calibration.targets.get(name)
        if known is None:
            there = ", ".join(
                target or "one without a name" for target in prior_calibration.targets
            )
            raise DataError(
                f"session {session.name!r}: target {name or target.name!r} is none of those that "
                f"were calibrated with ({there}).",
                culprits=["session.toml: target"],
                next_step="Verify with views of that target alone."
                if "" in prior_calibration.targets
                else "Name the targets as in the calibration's session.",
            )
        ours, theirs = target_document(known), target_document(target)
        for field in _differing(known, target):
            raise DataError(
                f"session {session.name!r}: target {name or target.name!r} has {field} = "
                f"{shorten(theirs.get(field))}, and the calibration was made with "
                f"{shorten(ours.get(field))}: it is another target.",
                culprits=[f"target: {field}"],
                next_step="Verify with the target that was calibrated with, as it was described "
                "then.",
            )


def check_robot(session: Session, stated: Robot, known: Robot) -> None:
    """Refuses another robot than a calibration's; the same model written otherwise passes.

    Raises:
        DataError: They differ.
    """
    culprit = ["session.toml: robot.model"]
    if stated.joint_count != known.joint_count:
        raise DataError(
            f"session {session.name!r} names robot {stated.name} with {stated.joint_count} joints, "
            f"and the calibration is of {known.name} with {known.joint_count}.",
            culprits=culprit,
            next_step="Name the calibration of this robot.",
        )
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (_POSTURES, known.joint_count))
    # The calibrated one's base may have been placed by the poses: motions are compared.
    ours, theirs = (robot.base_from_flange(q) for robot in (known, stated))
    between = [invert(array[0]) @ array for array in (ours, theirs)]
    off = np.max([pose_difference(a, b) for a, b in zip(*between, strict=True)], axis=0)
    if off[0] > _ONE_ROBOT_MM or off[1] > _ONE_ROBOT_DEG:
        raise DataError(
            f"session {session.name!r} names robot {stated.name}, whose flange is up to "
            f"{off[0]:.3g} mm and {figure(off[1])} deg off from the calibrated {known.name}'s: "
            "it is another robot, or another tip.",
            culprits=culprit,
            next_step="Name the robot and tip as in the calibration's session.",
        )


def _warnings(known: ObservedPoses, prior_calibration: CalibrationPrior) -> Iterator[str]:
    """What is odd about the session."""
    yield from dict.fromkeys(warning.reason for warning in known.warnings)
    if prior_calibration.calibration.thermal is not None:
        cold_c = float(prior_calibration.calibration.drift.reference_c.mean())
        yield (
            "The calibrated arm drifts with its temperature, and a check takes it for as warm as "
            f"it was at the start (about {cold_c:.0f} deg C): one at work looks longer, or as if "
            "its joints had slipped. Verify with the arm as warm as then."
        )
    before, now = prior_calibration.calibration.noise.get("pixel_px"), known.pixel_px
    if before is not None and now is not None and now > _MENTIONED * max(before, 1e-3):
        yield (
            f"The corners scatter by {figure(now)} px around the target's poses, and by "
            f"{figure(before)} "
            "px when it was calibrated: look whether the lens is clean, sharp and as it was."
        )
