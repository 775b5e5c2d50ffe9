"""Hypotheses on what changed in a cell since its calibration, which a check compares."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.verification.calibration_prior import CalibrationPrior
from visioncal.calibration.verification.prediction import PredictedStops
from visioncal.core.transforms import adjoint, invert, log
from visioncal.core.types import FloatArray
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.model_evidence import TURN_PER_M, ChangeHypothesis
from visioncal.estimation.observability import FEWEST_VIEWS
from visioncal.robot import Robot

CAMERA, BOARD, BOTH, SIZE, REPLACED, JOINT, LENGTH, NOISE, VIEW = (
    "camera",
    "board",
    "camera_and_board",
    "board_size",
    "board_replaced",
    "joint",
    "arm_length",
    "robot_noise",
    "view",
)
# Two simultaneous changes.
PAIRS = (BOTH, REPLACED)
# Factors by which the robot's noise may have grown.
_FACTORS = (2.0, 4.0, 8.0, 16.0, 32.0)
# Prior scale of an exchanged board: one that is displaced by 1 mm differs by 1 % in size.
_OTHER_SIZE_PER_M = 10.0
_MOTION_UNITS = np.repeat([TURN_PER_M, 1.0], 3)


@dataclass(frozen=True, eq=False)
class Cause:
    """A change that may have happened."""

    kind: str
    columns: ChangeHypothesis  # How it moves the stops; its name has board, joint or view.
    at: int = 0  # Index of the board that moved, among the calibration's, or of the joint.

    @property
    def name(self) -> str:
        """Its kind and what it is of, as `joint 3`."""
        return self.columns.name


def causes_of(
    predicted: PredictedStops, prior: CalibrationPrior, *, board_placed_anew: bool
) -> tuple[Cause, ...]:
    """The causes that a check of these stops compares.

    Args:
        predicted: The stops.
        prior: The calibration as a prior.
        board_placed_anew: Whether the board was moved on purpose, so that its pose is not checked.
    """
    # The camera's edge: a twist on its right, transformed to the target's side.
    moved = adjoint(invert(predicted.problem.observations.measured))
    camera = Cause(CAMERA, ChangeHypothesis(CAMERA, _MOTION_UNITS, moved))
    boards: list[Cause] = [] if board_placed_anew else [*_boards(predicted, prior)]
    sizes = [*_sizes(predicted, prior)]
    causes = [camera, *boards, *sizes]
    for board, size in zip(boards, sizes, strict=False):
        units = np.array([_OTHER_SIZE_PER_M])
        other = replace(size, columns=replace(size.columns, units=units))
        causes.append(_simultaneous(REPLACED, board, other))
    # Camera and board together fit any two stops.
    if len(prior.boards) == 1 and predicted.stops >= FEWEST_VIEWS:
        causes += [_simultaneous(BOTH, camera, board) for board in boards]
    causes += _joints(predicted, prior)
    if predicted.stops > 1:
        noise = ChangeHypothesis(NOISE, np.zeros(0), noise_factors=_FACTORS)
        causes += [Cause(NOISE, noise), *_views(predicted, prior)]
    return tuple(causes)


def _boards(predicted: PredictedStops, prior: CalibrationPrior) -> Iterator[Cause]:
    """Each board's edge: a twist on its right."""
    changes = log(predicted.away(prior))
    for at, name, of_board in _shown(predicted, prior):
        start = changes[of_board].mean(axis=0)
        by_sensor = np.where(of_board[:, None, None], -np.eye(6), 0.0)
        named = f"{BOARD} {name}".strip()
        columns = ChangeHypothesis(named, _MOTION_UNITS, by_sensor, start=start)
        yield Cause(BOARD, columns, at)


def _sizes(predicted: PredictedStops, prior: CalibrationPrior) -> Iterator[Cause]:
    """Each board's size, as a share: a larger board is seen nearer by the same share."""
    measured = predicted.problem.observations.measured
    nearer = np.zeros((len(measured), 6, 1))
    nearer[:, 3:, 0] = np.einsum("nji,nj->ni", measured[:, :3, :3], measured[:, :3, 3])
    for at, name, of_board in _shown(predicted, prior):
        by_sensor = np.where(of_board[:, None, None], nearer, 0.0)
        yield Cause(SIZE, ChangeHypothesis(f"{SIZE} {name}".strip(), np.ones(1), by_sensor), at)


def _shown(
    predicted: PredictedStops, prior: CalibrationPrior
) -> Iterator[tuple[int, str, FloatArray]]:
    """Index, name and (m,) mask of the observations of each board that is shown."""
    names = tuple(prior.targets) or ("",)
    for at, board in enumerate(prior.boards):
        of_board = predicted.boards == at
        if of_board.any():
            yield at, names[board], of_board


def _simultaneous(kind: str, first: Cause, second: Cause) -> Cause:
    """Two simultaneous changes of the sensor's side."""
    # If both camera and board moved, only the arm is left of the calibration; a board of another
    # size at another place is another board.
    one, other = first.columns, second.columns
    start = np.zeros(len(one.units)) if one.start is None else one.start
    parts = [part.by_sensor for part in (one, other) if part.by_sensor is not None]
    columns = ChangeHypothesis(
        f"{kind} {other.name.partition(' ')[2]}".strip(),
        np.concatenate([one.units, other.units]),
        np.concatenate(parts, axis=2),
        start=np.concatenate([start, np.zeros(len(other.units))]),
    )
    return Cause(kind, columns, second.at)


def _joints(predicted: PredictedStops, prior: CalibrationPrior) -> Iterator[Cause]:
    """An offset of each joint, and a common scale of all lengths."""
    model, q, robot = prior.model, predicted.joints_rad, prior.calibration.calibrated_robot
    if model is None and robot is not None:
        # The nominal arm, where none was calibrated.
        matched = predicted.observed.reported.matched
        reported = np.eye(4) if matched is None else matched.flange_from_reported
        model = ArmModel(robot, reported, {}, np.zeros(0))
    if model is None or q is None:
        return
    offsets, arm = model.columns("offsets", q), model.robot
    for joint in range(arm.joint_count):
        unit = np.array([1.0 if arm.chain.prismatic[joint] else TURN_PER_M])
        by_flange = offsets[:, :, joint : joint + 1]
        columns = ChangeHypothesis(f"{JOINT} {joint + 1}", unit, flange_jacobian=by_flange)
        yield Cause(JOINT, columns, joint)
    stretch = _stretch(arm, q)[:, :, None]
    yield Cause(LENGTH, ChangeHypothesis(LENGTH, np.ones(1), flange_jacobian=stretch))


def _stretch(robot: Robot, q: FloatArray) -> FloatArray:
    """(m, 6) derivative of the flange with respect to a common scale of all lengths."""
    placements = robot.chain.placements
    # A placement's offset is in the frame before it; its twist is in the frame after it.
    twists = np.zeros((len(placements), 6))
    twists[:, 3:] = np.einsum("nji,nj->ni", placements[:, :3, :3], placements[:, :3, 3])
    return np.asarray(robot.placement_jacobian(q) @ twists.reshape(-1))


def _views(predicted: PredictedStops, prior: CalibrationPrior) -> Iterator[Cause]:
    """Each stop alone: its image belongs to another pose, or something slipped meanwhile."""
    changes, boards = log(predicted.away(prior)), prior.state.edges[1:][predicted.boards]
    for stop in range(predicted.stops):
        at_stop = predicted.problem.observations.stops == stop
        first = int(np.argmax(at_stop))
        # All boards of a stop move together.
        transform = adjoint(invert(boards) @ boards[first])
        columns = ChangeHypothesis(
            f"{VIEW} {predicted.views[first]}",
            _MOTION_UNITS,
            np.where(at_stop[:, None, None], -transform, 0.0),
            start=changes[first],
        )
        yield Cause(VIEW, columns, int(predicted.boards[first]))
