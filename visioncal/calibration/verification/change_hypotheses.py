"""Hypotheses on what changed in a cell since its calibration, which a check compares."""

from collections.abc import Iterator
from dataclasses import replace

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
# Factors by which the robot's noise may have grown.
_FACTORS = (2.0, 4.0, 8.0, 16.0, 32.0)
# Prior scale of an exchanged board: one that is displaced by 1 mm differs by 1 % in size.
_OTHER_SIZE_PER_M = 10.0
_MOTION_UNITS = np.repeat([TURN_PER_M, 1.0], 3)


def causes_of(
    predicted: PredictedStops, prior: CalibrationPrior, *, board_placed_anew: bool
) -> tuple[ChangeHypothesis, ...]:
    """The causes that a check of these stops compares.

    Args:
        predicted: The stops.
        prior: The calibration as a prior.
        board_placed_anew: Whether the board was moved on purpose, so that its pose is not checked.
    """
    # The camera's edge: a twist on its right, transformed to the target's side.
    moved = adjoint(invert(predicted.problem.observations.measured))
    camera = _cause(CAMERA, predicted, _MOTION_UNITS, by_sensor=moved)
    boards = () if board_placed_anew else tuple(_boards(predicted, prior))
    sizes = tuple(_sizes(predicted, prior))
    noise = (replace(_cause(NOISE, predicted, np.zeros(0)), noise_factors=_FACTORS),)
    return (
        camera,
        *boards,
        *sizes,
        *(
            _simultaneous(REPLACED, moved, replace(size, units=np.array([_OTHER_SIZE_PER_M])))
            for moved, size in zip(boards, sizes, strict=False)
        ),
        # Camera and board together fit any two stops.
        *(
            _simultaneous(BOTH, camera, board)
            for board in boards
            if len(prior.boards) == 1 and len(predicted.problem) >= FEWEST_VIEWS
        ),
        *_joints(predicted, prior),
        *(noise if predicted.stops > 1 else ()),
        *_views(predicted, prior),
    )


def kind_of(cause: str) -> str:
    """The kind of a cause: `joint` of `joint 3`."""
    return cause.partition(" ")[0]


def _boards(predicted: PredictedStops, prior: CalibrationPrior) -> Iterator[ChangeHypothesis]:
    """Each board's edge: a twist on its right."""
    names, changes = tuple(prior.targets) or ("",), log(predicted.away(prior))
    for at, board in enumerate(prior.boards):
        of_board = predicted.boards == at
        if not of_board.any():
            continue
        by_sensor, start = (
            np.where(of_board[:, None, None], -np.eye(6), 0.0),
            changes[of_board].mean(axis=0),
        )
        yield _cause(
            f"{BOARD} {names[board]}".strip(), predicted, _MOTION_UNITS, by_sensor, start=start
        )


def _simultaneous(kind: str, first: ChangeHypothesis, second: ChangeHypothesis) -> ChangeHypothesis:
    """Two simultaneous changes."""
    # If both camera and board moved, only the arm is left of the calibration; a board of another
    # size at another place is another board.
    return ChangeHypothesis(
        f"{kind} {second.name.partition(' ')[2]}".strip(),
        np.concatenate([first.by_sensor, second.by_sensor], axis=2),
        np.concatenate([first.flange_jacobian, second.flange_jacobian], axis=2),
        np.concatenate([first.units, second.units]),
        np.concatenate([first.start, np.zeros(len(second.units))]),
    )


def _sizes(predicted: PredictedStops, prior: CalibrationPrior) -> Iterator[ChangeHypothesis]:
    """Each board's size, as a share: a larger board is seen nearer by the same share."""
    if prior.calibration.mount == "instrument":
        return
    names, measured = tuple(prior.targets) or ("",), predicted.problem.observations.measured
    nearer = np.zeros((len(measured), 6, 1))
    nearer[:, 3:, 0] = np.einsum("nji,nj->ni", measured[:, :3, :3], measured[:, :3, 3])
    for at, board in enumerate(prior.boards):
        if (of_board := predicted.boards == at).any():
            by_sensor = np.where(of_board[:, None, None], nearer, 0.0)
            yield _cause(f"{SIZE} {names[board]}".strip(), predicted, np.ones(1), by_sensor)


def _joints(predicted: PredictedStops, prior: CalibrationPrior) -> Iterator[ChangeHypothesis]:
    """An offset of each joint, and a common scale of all lengths."""
    model, q = _arm(predicted, prior), predicted.joints_rad
    if model is None or q is None:
        return
    offsets, robot = model.columns("offsets", q), model.robot
    for joint in range(robot.joint_count):
        unit = 1.0 if robot.chain.prismatic[joint] else TURN_PER_M
        column = offsets[:, :, joint : joint + 1]
        yield _cause(f"{JOINT} {joint + 1}", predicted, np.array([unit]), flange_jacobian=column)
    yield _cause(LENGTH, predicted, np.ones(1), flange_jacobian=_stretch(robot, q)[:, :, None])


def _arm(predicted: PredictedStops, prior: CalibrationPrior) -> ArmModel | None:
    """The arm for joint offsets; the nominal one where none was calibrated."""
    robot, matched = prior.calibration.calibrated_robot, predicted.observed.reported.matched
    if prior.model is not None or robot is None:
        return prior.model
    reported = np.eye(4) if matched is None else matched.flange_from_reported
    return ArmModel(robot, reported, {}, np.zeros(0))


def _stretch(robot: Robot, q: FloatArray) -> FloatArray:
    """(m, 6) derivative of the flange with respect to a common scale of all lengths."""
    placements = robot.chain.placements
    # A placement's offset is in the frame before it; its twist is in the frame after it.
    twists = np.zeros((len(placements), 6))
    twists[:, 3:] = np.einsum("nji,nj->ni", placements[:, :3, :3], placements[:, :3, 3])
    return np.asarray(robot.placement_jacobian(q) @ twists.reshape(-1))


def _views(predicted: PredictedStops, prior: CalibrationPrior) -> Iterator[ChangeHypothesis]:
    """Each stop alone: its image belongs to another pose, or something slipped meanwhile."""
    if predicted.stops < 2:
        return
    changes, boards = log(predicted.away(prior)), prior.state.edges[1:][predicted.boards]
    for stop in range(predicted.stops):
        at_stop = predicted.problem.observations.stops == stop
        first = int(np.argmax(at_stop))
        # All boards of a stop move together.
        transform = adjoint(invert(boards) @ boards[first])
        by_sensor = np.where(at_stop[:, None, None], -transform, 0.0)
        yield _cause(
            f"{VIEW} {predicted.views[first][0]}",
            predicted,
            _MOTION_UNITS,
            by_sensor,
            start=changes[first],
        )


def _cause(
    name: str,
    predicted: PredictedStops,
    units: FloatArray,
    by_sensor: FloatArray | None = None,
    flange_jacobian: FloatArray | None = None,
    start: FloatArray | None = None,
) -> ChangeHypothesis:
    size = len(units)
    return ChangeHypothesis(
        name,
        np.zeros((len(predicted.problem), 6, size)) if by_sensor is None else by_sensor,
        np.zeros((predicted.stops, 6, size)) if flange_jacobian is None else flange_jacobian,
        units,
        np.zeros(size) if start is None else start,
    )
