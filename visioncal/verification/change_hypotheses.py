"""Hypotheses on what changed in a cell since its calibration, which a check compares."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.transforms import adjoint, invert, log, mean_transform
from visioncal.core.types import FloatArray
from visioncal.robot.arm_model import ArmModel
from visioncal.robot.errors import TURN_PER_M
from visioncal.verification.calibration_prior import CalibrationPrior
from visioncal.verification.model_evidence import ChangeHypothesis
from visioncal.verification.prediction import PredictedStops, board_changes
from visioncal.vision.corners import CornerStack
from visioncal.vision.poses import fit_poses

CAMERA, LENS, BOARD, BOTH, SIZE, REPLACED, JOINT, LOAD, LENGTH, NOISE, VIEW, PAIRING = (
    "camera",
    "lens",
    "board",
    "camera_and_board",
    "board_size",
    "board_replaced",
    "joint",
    "load",
    "arm_length",
    "robot_noise",
    "view",
    "pairing",
)
# Prior chances of kinds, relative to a camera or board that is knocked: a lens is focused again, or
# a board printed anew, on purpose. Two changes at once are rarer, and so is an arm that is warmer
# by as much as stops show.
_CHANCES = {LENS: 0.1, SIZE: 0.3, REPLACED: 0.3, BOTH: 0.1, LENGTH: 0.03}
# Shares by which a lens that is focused again, and an arm that is warmer by up to 50 K, grow.
_FOCUS_SHARES, _WARMTH_SHARES = (1e-3, 1e-2, 1e-1), (1e-4, 3e-4, 1e-3)
# A mount that is knocked turns with its shift, or slides and turns a tenth as far.
_KNOCKS = (np.ones(6), np.repeat([0.1, 1.0], 3))
# Two simultaneous changes.
PAIRS = (BOTH, REPLACED)
# Share by which a lens grows whose motions are proportional.
_SMALL_SHARE = 1e-3
# Displacement from which on a board is not in place, as by a millimetre and 4 mrad for each of
# these [m].
_FAR_M = 5e-3
# Units of a twist, for a change of one metre.
MOTION_UNITS: FloatArray = np.repeat([TURN_PER_M, 1.0], 3)


def causes_of(
    predicted: PredictedStops, prior: CalibrationPrior, *, board_placed_anew: bool
) -> tuple[ChangeHypothesis, ...]:
    """The changes that a check of these stops compares.

    Args:
        predicted: The stops.
        prior: The calibration as a prior.
        board_placed_anew: Whether the board was moved on purpose, so that its pose is not checked.
    """
    measured, away = predicted.problem.observations.measured, predicted.away(prior)
    changes = log(away)
    # The camera's edge: a twist on its right, transformed to the target's side.
    moved = adjoint(invert(measured))
    # Steps from zero do not reach half a turn, and logarithms near it have no mean.
    undoing = log(mean_transform(measured @ invert(away) @ invert(measured)))
    camera = ChangeHypothesis(CAMERA, MOTION_UNITS, moved, start=undoing, shapes=_KNOCKS)
    # A board that is larger by a share is seen nearer by the same share.
    nearer = np.zeros((len(measured), 6, 1))
    nearer[:, 3:, 0] = np.einsum("nji,nj->ni", measured[:, :3, :3], measured[:, :3, 3])
    causes, names = [camera, *_focal_length(predicted, changes)], tuple(prior.targets) or ("",)
    for at, index in enumerate(prior.boards):
        shown = predicted.boards == at
        if not shown.any():
            continue
        by_size = np.where(shown[:, None, None], nearer, 0.0)
        size = ChangeHypothesis(SIZE, np.ones(1), by_size, at=at, of=names[index])
        causes.append(size)
        if board_placed_anew:
            continue
        # The board's edge: a twist on its right.
        by_place = np.where(shown[:, None, None], -np.eye(6), 0.0)
        start = log(mean_transform(away[shown]))
        place = ChangeHypothesis(BOARD, MOTION_UNITS, by_place, start=start, at=at, shapes=_KNOCKS)
        place = replace(place, of=names[index])
        # Prior scale of an exchanged board: one that is displaced by 1 mm differs by 1 % in size.
        other = replace(size, units=np.array([10.0]))
        causes += [place, _simultaneous(REPLACED, place, other)]
        # Camera and board together fit any two stops.
        if len(prior.boards) == 1 and predicted.stops >= FEWEST_VIEWS:
            causes.append(_simultaneous(BOTH, camera, place))
    # All lengths of an arm by a share place its flange farther from the base by the same share.
    ((_, poses),) = predicted.problem.poses.items()
    farther = np.zeros((len(poses), 6, 1))
    farther[:, 3:, 0] = np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    causes.append(
        ChangeHypothesis(LENGTH, np.ones(1), flange_jacobian=farther, sizes_m=_WARMTH_SHARES)
    )
    causes += _joints(predicted, prior)
    if predicted.stops > 1:
        # The robot's noise may have grown by 2 to 32 times.
        factors = tuple((2.0 ** np.arange(1, 6)).tolist())
        causes.append(ChangeHypothesis(NOISE, np.zeros(0), noise_factors=factors))
        causes += [*_views(predicted, prior, changes), *_pairing(predicted, prior, changes)]
    return tuple(causes)


def prior_chances(causes: Sequence[ChangeHypothesis]) -> FloatArray:
    """(c,) prior probabilities of changes; those of one kind share its chance."""
    kinds = [cause.kind for cause in causes]
    chances = np.array([_CHANCES.get(kind, 1.0) / kinds.count(kind) for kind in kinds])
    return np.asarray(chances / chances.sum())


def _focal_length(predicted: PredictedStops, changes: FloatArray) -> Iterator[ChangeHypothesis]:
    """Another focal length, as of a lens that was focused again, where corners are seen."""
    observed = predicted.observed
    corners = [observed.poses[view].corners for view in predicted.views]
    seen = {view: each for view, each in zip(predicted.views, corners, strict=True) if each}
    if (free := observed.free) is None or len(seen) < len(corners):
        return
    stack = CornerStack.of(seen, free.positions + free.basis @ free.appearance.board)
    camera, measured = free.appearance.camera, predicted.problem.observations.measured

    def undoing(share: float) -> FloatArray:
        """(n, 6, 1) motion of each board that shows the same corners by a longer lens."""
        grown = camera.matrix * [1.0 + share, 1.0 + share, 1.0, 1.0]
        poses = fit_poses(stack, replace(camera, matrix=grown), measured).cam_from_target
        return log(invert(measured) @ poses)[:, :, None] / share

    small = undoing(_SMALL_SHARE)
    share = -float(np.sum(small[:, :, 0] * changes) / np.sum(small**2))
    # From the larger share on it is another lens.
    is_small = not _SMALL_SHARE < abs(share) < 0.5
    # Large ones bend.
    by_share, share = (small, 0.0) if is_small else (undoing(share), share)
    yield ChangeHypothesis(
        LENS, np.ones(1), by_share, start=np.array([share]), sizes_m=_FOCUS_SHARES
    )


def _simultaneous(kind: str, one: ChangeHypothesis, other: ChangeHypothesis) -> ChangeHypothesis:
    """Two simultaneous changes of the sensor's side."""
    start = np.zeros(len(one.units)) if one.start is None else one.start
    parts = [part.by_sensor for part in (one, other) if part.by_sensor is not None]
    return replace(
        other,
        kind=kind,
        units=np.concatenate([one.units, other.units]),
        by_sensor=np.concatenate(parts, axis=2),
        start=np.concatenate([start, np.zeros(len(other.units))]),
        shapes=(),
    )


def nominal_model(predicted: PredictedStops, prior: CalibrationPrior) -> ArmModel | None:
    """The nominal arm, where none was calibrated; None where the robot is unknown."""
    robot, matched = prior.calibration.calibrated_robot, predicted.observed.reported.matched
    reported = np.eye(4) if matched is None else matched.flange_from_reported
    return None if robot is None else ArmModel(robot, reported, {}, np.zeros(0))


def _joints(predicted: PredictedStops, prior: CalibrationPrior) -> Iterator[ChangeHypothesis]:
    """An offset of each joint, and how far stated loads bend them."""
    model = prior.model or nominal_model(predicted, prior)
    observed = predicted.observed
    q = observed.arm_at(observed.first_of_stops(observed.used)).joints_rad
    if model is None or q is None:
        return
    offsets, arm = model.columns("offsets", q), model.robot
    for joint in range(arm.joint_count):
        unit = np.array([1.0 if arm.chain.prismatic[joint] else TURN_PER_M])
        by_flange = offsets[:, :, joint : joint + 1]
        of = f"{joint + 1}"
        yield ChangeHypothesis(JOINT, unit, flange_jacobian=by_flange, at=joint, of=of)
    yield from _load(predicted, prior, model, offsets)


def _load(
    predicted: PredictedStops, prior: CalibrationPrior, model: ArmModel, offsets: FloatArray
) -> Iterator[ChangeHypothesis]:
    """Bending of each joint by stated loads that a calibration without stiffness has not seen."""
    observed, calibrated = predicted.observed, prior.calibration
    arm = observed.arm_at(observed.first_of_stops(observed.used))
    more_kg = arm.loads.payload_kg - calibrated.means.get("payload_kg", 0.0)
    loads = replace(arm.loads, payload_kg=more_kg)
    if calibrated.elastic is not None or arm.joints_rad is None or not loads.any:
        return
    robot, q = model.robot, arm.joints_rad
    torques = robot.load_torques(q, loads) - robot.load_torques(q)
    greatest = np.abs(torques).max(axis=0)
    if not greatest.any():
        return
    # Joints that a load reaches by a smaller share of its greatest torque do not bend.
    bent = greatest > 0.01 * greatest.max()
    # Joints of about equal stiffness.
    by_flange = (offsets * (torques / greatest.max())[:, None, :])[:, :, bent]
    units = np.full(int(bent.sum()), TURN_PER_M)
    yield ChangeHypothesis(LOAD, units, flange_jacobian=by_flange)


def _views(
    predicted: PredictedStops, prior: CalibrationPrior, changes: FloatArray
) -> Iterator[ChangeHypothesis]:
    """Each stop alone: its image belongs to another pose, or something slipped meanwhile."""
    boards = prior.state.edges[1:][predicted.boards]
    for stop in range(predicted.stops):
        at_stop = predicted.problem.observations.stops == stop
        first = int(np.argmax(at_stop))
        # All boards of a stop move together.
        transform = adjoint(invert(boards) @ boards[first])
        yield ChangeHypothesis(
            VIEW,
            MOTION_UNITS,
            np.where(at_stop[:, None, None], -transform, 0.0),
            start=changes[first],
            at=int(predicted.boards[first]),
            of=str(predicted.views[first]),
        )


def _pairing(
    predicted: PredictedStops, prior: CalibrationPrior, changes: FloatArray
) -> Iterator[ChangeHypothesis]:
    """Images that belong to the poses of other stops: of exchanged, shifted or repeated rows.

    Such an image shows its board in place from another stop than its own. One image may do so from
    none, as the first of shifted rows; its board then moves by itself.
    """
    problem = predicted.problem
    ((robot, poses),) = problem.poses.items()
    stops, at = problem.observations.stops, np.arange(len(problem))
    away = np.zeros((len(poses), len(problem), 4, 4))
    for shift in range(len(poses)):
        others = np.roll(poses, -shift, axis=0)
        by_others = board_changes(replace(problem, poses={robot: others}), prior.state)
        away[(stops + shift) % len(poses), at] = by_others
    off_m = np.linalg.norm(log(away) / MOTION_UNITS, axis=2)
    nearest = np.argmin(off_m, axis=0)
    is_off, is_placed = off_m[stops, at] > _FAR_M, off_m[nearest, at] < _FAR_M
    moved, lost = np.flatnonzero(is_off & is_placed), np.flatnonzero(is_off & ~is_placed)
    if not len(moved) or len(lost) > 1:
        return
    by_sensor = np.zeros((len(problem), 6, 1 + 6 * len(lost)))
    undone = invert(away[stops[moved], moved]) @ away[nearest[moved], moved]
    by_sensor[moved, :, 0] = log(undone)
    # Unit of a change that is one or none.
    start, units = np.ones(1), np.full(1, 10.0)
    if len(lost):
        by_sensor[lost[0], :, 1:] = -np.eye(6)
        start = np.append(start, changes[lost[0]])
        units = np.append(units, MOTION_UNITS)
    views = np.array(predicted.views)
    pairs = zip(
        views[moved].tolist(),
        views[np.unique(stops, return_index=True)[1][nearest[moved]]].tolist(),
        strict=True,
    )
    yield ChangeHypothesis(PAIRING, units, by_sensor, start=start, pairs=tuple(pairs))
