"""What may have happened to a cell since it was calibrated: the causes that a check compares."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visioncal.calibration.verification.calibration_prior import CalibrationPrior
from visioncal.calibration.verification.prediction import PredictedStops
from visioncal.core.transforms import adjoint, invert, log
from visioncal.core.types import FloatArray
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.model_evidence import TURN_PER_M, Cause
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
# What a robot's scatter may have grown by.
_FACTORS = (2.0, 4.0, 8.0, 16.0, 32.0)
# A board that lies a millimetre elsewhere differs by a percent where it is another one.
_OTHER_SIZE_PER_M = 10.0
_KNOCK = np.repeat([TURN_PER_M, 1.0], 3)


def causes_of(
    seen: PredictedStops, prior_calibration: CalibrationPrior, *, board_placed_anew: bool
) -> tuple[Cause, ...]:
    """The single causes that a check of these stops compares.

    Args:
        seen: The stops.
        prior_calibration: What the calibration rests on.
        board_placed_anew: Whether the board's place is nothing to be checked.
    """
    camera = _camera(seen)
    boards = () if board_placed_anew else tuple(_boards(seen, prior_calibration))
    sizes = tuple(_sizes(seen, prior_calibration))
    return (
        camera,
        *boards,
        *sizes,
        *(
            _jointly(REPLACED, moved, replace(size, units=np.array([_OTHER_SIZE_PER_M])))
            for moved, size in zip(boards, sizes, strict=False)
        ),
        *(
            _jointly(BOTH, camera, board)
            for board in boards
            if _both_possible(seen, prior_calibration)
        ),
        *_joints(seen, prior_calibration),
        *_noise(seen),
        *_views(seen, prior_calibration),
    )


def kind_of(cause: str) -> str:
    """The kind of a cause: `joint` of `joint 3`."""
    return cause.partition(" ")[0]


def _camera(seen: PredictedStops) -> Cause:
    """The camera's edge: a twist on its right, seen from the target's side."""
    moved = adjoint(invert(seen.problem.observations.measured))
    return _cause(CAMERA, seen, _KNOCK, by_sensor=moved)


def _boards(seen: PredictedStops, prior_calibration: CalibrationPrior) -> Iterator[Cause]:
    """Each board's edge: a twist on its right."""
    names, away = tuple(prior_calibration.targets) or ("",), log(seen.away(prior_calibration))
    for at, board in enumerate(prior_calibration.boards):
        mine = seen.boards == at
        if not mine.any():
            continue
        by_sensor, start = np.where(mine[:, None, None], -np.eye(6), 0.0), away[mine].mean(axis=0)
        yield _cause(f"{BOARD} {names[board]}".strip(), seen, _KNOCK, by_sensor, start=start)


def _both_possible(seen: PredictedStops, prior_calibration: CalibrationPrior) -> bool:
    """Whether camera and board at once are tried: they fit any two stops."""
    return len(prior_calibration.boards) == 1 and len(seen.problem) >= FEWEST_VIEWS


def _jointly(kind: str, first: Cause, second: Cause) -> Cause:
    """Two changes at once."""
    # Of camera and board nothing is left of the old hand-eye calibration but the arm; a board of
    # another size that lies elsewhere is another board.
    return Cause(
        f"{kind} {second.name.partition(' ')[2]}".strip(),
        np.concatenate([first.by_sensor, second.by_sensor], axis=2),
        np.concatenate([first.flange_jacobian, second.flange_jacobian], axis=2),
        np.concatenate([first.units, second.units]),
        np.concatenate([first.start, np.zeros(len(second.units))]),
    )


def _sizes(seen: PredictedStops, prior_calibration: CalibrationPrior) -> Iterator[Cause]:
    """Each board's size, as a share: one that is larger is seen nearer by as much."""
    if prior_calibration.calibration.mount == "instrument":
        return
    names, measured = tuple(prior_calibration.targets) or ("",), seen.problem.observations.measured
    nearer = np.zeros((len(measured), 6, 1))
    nearer[:, 3:, 0] = np.einsum("nji,nj->ni", measured[:, :3, :3], measured[:, :3, 3])
    for at, board in enumerate(prior_calibration.boards):
        if (mine := seen.boards == at).any():
            by_sensor = np.where(mine[:, None, None], nearer, 0.0)
            yield _cause(f"{SIZE} {names[board]}".strip(), seen, np.ones(1), by_sensor)


def _joints(seen: PredictedStops, prior_calibration: CalibrationPrior) -> Iterator[Cause]:
    """One offset a joint, and one stretch of all lengths."""
    model, q = _arm(seen, prior_calibration), seen.joints_rad
    if model is None or q is None:
        return
    offsets, robot = model.columns("offsets", q), model.robot
    for joint in range(robot.joint_count):
        unit = 1.0 if robot.chain.prismatic[joint] else TURN_PER_M
        column = offsets[:, :, joint : joint + 1]
        yield _cause(f"{JOINT} {joint + 1}", seen, np.array([unit]), flange_jacobian=column)
    yield _cause(LENGTH, seen, np.ones(1), flange_jacobian=_stretch(robot, q)[:, :, None])


def _arm(seen: PredictedStops, prior_calibration: CalibrationPrior) -> ArmModel | None:
    """The arm that offsets are of; the nominal one where none was calibrated."""
    robot, matched = prior_calibration.calibration.calibrated_robot, seen.known.reported.matched
    if prior_calibration.model is not None or robot is None:
        return prior_calibration.model
    reported = np.eye(4) if matched is None else matched.flange_from_reported
    return ArmModel(robot, reported, {}, np.zeros(0))


def _stretch(robot: Robot, q: FloatArray) -> FloatArray:
    """(m, 6) how the flange moves when all of an arm's lengths grow by as much as they are."""
    placements = robot.chain.placements
    # A placement's offset lies in the frame before it; its twist acts behind it.
    twists = np.zeros((len(placements), 6))
    twists[:, 3:] = np.einsum("nji,nj->ni", placements[:, :3, :3], placements[:, :3, 3])
    return np.asarray(robot.placement_jacobian(q) @ twists.reshape(-1))


def _noise(seen: PredictedStops) -> Iterator[Cause]:
    """The robot's: one stop alone scatters from no other."""
    if seen.stops > 1:
        yield replace(_cause(NOISE, seen, np.zeros(0)), noise_factors=_FACTORS)


def _views(seen: PredictedStops, prior_calibration: CalibrationPrior) -> Iterator[Cause]:
    """Each stop by itself: its image belongs to another pose, or something slipped meanwhile."""
    if seen.stops < 2:
        return
    away, placed = log(seen.away(prior_calibration)), prior_calibration.state.edges[1:][seen.boards]
    for stop in range(seen.stops):
        mine = seen.problem.observations.stops == stop
        first = int(np.argmax(mine))
        # All boards of a stop move together.
        carried = adjoint(invert(placed) @ placed[first])
        by_sensor = np.where(mine[:, None, None], -carried, 0.0)
        yield _cause(f"{VIEW} {seen.views[first][0]}", seen, _KNOCK, by_sensor, start=away[first])


def _cause(
    name: str,
    seen: PredictedStops,
    units: FloatArray,
    by_sensor: FloatArray | None = None,
    flange_jacobian: FloatArray | None = None,
    start: FloatArray | None = None,
) -> Cause:
    still = np.zeros((len(seen.problem), 6, len(units)))
    resting = np.zeros((seen.stops, 6, len(units)))
    return Cause(
        name,
        still if by_sensor is None else by_sensor,
        resting if flange_jacobian is None else flange_jacobian,
        units,
        np.zeros(len(units)) if start is None else start,
    )
