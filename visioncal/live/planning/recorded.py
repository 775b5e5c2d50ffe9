"""The start of a plan that adds to a session: what the session determines so far."""

from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.calibration.pipeline.observed_poses import ObservedPoses
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.solved import Solved
from visioncal.calibration.pipeline.steps import STAGES
from visioncal.calibration.stages.arms import RobotArm
from visioncal.calibration.stages.pose_ambiguity import choose_by
from visioncal.calibration.stages.refine import free_of
from visioncal.calibration.stages.side import FramesSide
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import counted
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray, Mount, Progress
from visioncal.estimation.appearance import LensBoardParameters
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.chain import robot_part
from visioncal.estimation.linalg import covariance_among
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import fisher_information, normal_equations
from visioncal.live.planning.cell import Box, Limits, PlanCell
from visioncal.live.planning.information import RecordedStops
from visioncal.robot import Robot
from visioncal.session import Session, frame_name
from visioncal.vision.targets import extent_m, first_corners

# Without a guess, what is mounted on the flange is about so far from it, per axis [m].
_MOUNTED_M = 0.1
# Stops cannot be found for edges that are known no better [rad and m].
_TOO_VAGUE_RAD, _TOO_VAGUE_M = 0.5, 0.5
# No arm repeats better; a few stops may show less by chance [rad and m].
_LEAST_NOISE = Noise.of_robot(2e-5, 1e-5)
# What well-kept arms repeat to, where nothing has been seen of it [rad and m].
_TYPICAL = Noise.of_robot(5e-5, 3e-5)
# Newton's steps to the nearest edges; the problem is as good as linear.
_STEPS = 20


@dataclass(frozen=True, eq=False)
class RoughEdges:
    """Rough guesses of both edges (4, 4), and how well they are known, per axis [rad and m]."""

    x: FloatArray
    z: FloatArray
    sigma_rad: float
    sigma_m: float

    def __post_init__(self) -> None:
        for name in ("sigma_rad", "sigma_m"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise DataError(
                    f"the guesses: {name} is {getattr(self, name)}; a number above zero is needed.",
                    culprits=[name],
                )


@dataclass(frozen=True, eq=False)
class Begun:
    """A session to which stops are added.

    Attributes:
        cell: The cell as far as the session determines it.
        recorded: The session's information.
        refusal: Why the session alone gives no result; empty where it does.
        views: The number of the first view of each stop.
    """

    cell: PlanCell
    recorded: RecordedStops
    refusal: str
    views: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SoFar:
    """What is known of a session, and why no more."""

    known: RunState
    refusal: str = field(default="")


def so_far(session: Session, *, progress: Progress | None = None) -> SoFar:
    """Calibrates the hand-eye level of a session as far as it goes.

    Raises:
        DataError: The input is wrong or shows no target.
    """
    known = RunState(session, progress, level="hand-eye")
    for at, stage in enumerate(STAGES):
        if progress is not None:
            progress(stage.name, at, len(STAGES))
        try:
            known = stage.run(known)
        except DegenerateError as error:
            return SoFar(known, error.message)
    return SoFar(known)


def begin(
    found: SoFar,
    *,
    guess: RoughEdges | None = None,
    limits: Limits | None = None,
    boxes: tuple[Box, ...] = (),
) -> Begun:
    """Puts a session as the start of a plan.

    Where the stops leave a direction open, the edges are those nearest to the guess among all that
    the stops allow; without a guess, those by which what is mounted is nearest to the flange.

    Args:
        found: What is known of the session.
        guess: What is known of the edges besides.
        limits: What the added stops must keep.
        boxes: What else stands in the cell.

    Raises:
        DataError: The session lacks a robot's model, a camera or a board, or has too few
            views to begin without a guess.
    """
    known = found.known
    robot, targets = known.robot, tuple(known.session.boards.values())
    if robot is None or not targets or known.pixel_px is None or not known.scenes:
        raise _missing(known)
    with one_blas_thread():
        begun = _guessed(known, guess) if known.fit is None else _fitted(known, known.fit)
        edges, covariance = _nearest(
            begun.problem, begun.state, begun.noise, known.session.mount, guess
        )
    sigmas = np.sqrt(np.diag(covariance).reshape(2, 2, 3).mean(axis=(0, 2)))
    if sigmas[0] > _TOO_VAGUE_RAD or sigmas[1] > _TOO_VAGUE_M:
        raise _too_vague(known, len(begun.views))
    cell = PlanCell(
        known.session.mount,
        _arm(begun.arm, robot),
        begun.free.appearance.camera,
        targets[begun.board],
        edges[0],
        edges[1],
        float(sigmas[0]),
        float(sigmas[1]),
        begun.noise,
        known.pixel_px,
        limits or Limits(),
        boxes,
        covariance,
    )
    cell = replace(cell, shown_m=_shown_m(cell, begun.problem))
    first_corner = int(first_corners(targets)[begun.board])
    recorded = _recorded(known, begun, edges, first_corner)
    return Begun(cell, recorded, found.refusal, begun.views)


def _shown_m(cell: PlanCell, problem: Problem) -> tuple[float, float]:
    """The least and the greatest distance at which stops show the board that is planned for."""
    _, board, *_ = problem.unknown
    shows = np.array(problem.observations.observed) == board
    flange = problem.poses[problem.robots[0]][problem.observations.stops[shows]]
    low, high = extent_m(cell.target)
    seen, centre = cell.seen_from(flange), np.append(0.5 * (low + high), 0.0)
    away = np.linalg.norm(seen[:, :3, :3] @ centre + seen[:, :3, 3], axis=1)
    return float(away.min()), float(away.max())


def _recorded(
    known: RunState, begun: "_RecordedStart", edges: FloatArray, first_corner: int
) -> RecordedStops:
    """The session's information, at the edges where the plan takes them to be."""
    arm, misfits = begun.arm, () if known.answer is None else known.answer.misfits.values()
    alike = [misfit.alike for misfit in misfits if misfit.alike is not None]
    factors = (neighbours.factor for neighbours in alike if neighbours.is_significant)
    return RecordedStops(
        begun.problem,
        edges,
        begun.free,
        arm.joints_rad,
        begun.noise,
        first_corner,
        # Of few stops, sizes of errors that noise alone explains are mostly chance.
        arm.errors if arm.is_modelled and arm.errors and arm.errors.is_likely else None,
        max(factors, default=1.0),
        _beside_noise(known, begun),
        _held_pull(known, begun.problem),
    )


@dataclass(frozen=True, eq=False)
class _RecordedStart:
    """What a session determines.

    Attributes:
        problem: Its s stops, without errors of the arm; the board that is planned for comes first.
        state: Where to begin.
        noise: Of the robot at the stops.
        free: Lens and boards as the views see them.
        arm: The robot's arm at the stops.
        board: Which of the session's boards is planned for: the one in the most views.
        views: (s,) the first view of each stop.
    """

    problem: Problem
    state: State
    noise: Noise
    free: LensBoardParameters
    arm: RobotArm
    board: int
    views: tuple[int, ...]


def _fitted(known: RunState, solved: Solved) -> _RecordedStart:
    """What the fit of a session determines, even where that leaves a direction open."""
    if solved.seen is None:
        raise _missing(known)
    part, arm = solved.part, known.robot_arm
    observed = part.observations.observed
    most = max(dict.fromkeys(observed), key=observed.count)
    stops, first, of = np.unique(part.observations.stops, return_index=True, return_inverse=True)
    frames = part.frames(solved.agreed.fit.state)
    # The arm's own errors are the purpose's business: they are put in again with its priors.
    bare = part.with_effects(
        [effect for effect in part.effects if effect.name != f"arm of {arm.robot}"]
    )
    seen_at = np.isin(np.arange(len(arm.stood)), stops)
    camera, *boards = part.unknown
    order = [branch for branch in part.tree.branches if branch not in part.unknown]
    order += [camera, most, *(board for board in boards if board != most)]
    problem = replace(
        bare,
        tree=replace(part.tree, branches={name: part.tree.branches[name] for name in order}),
        poses={name: pose[stops] for name, pose in part.poses.items()},
        observations=replace(part.observations, stops=of),
        effects=tuple(effect.of_stops(seen_at) for effect in bare.effects),
    ).merged()
    noise = solved.agreed.fit.noise
    return _RecordedStart(
        problem,
        problem.start(frames),
        replace(noise, robots=np.maximum(noise.robots, _LEAST_NOISE.robots)),
        free_of(solved.seen),
        arm.at(stops),
        tuple(frame_name("target", board) for board in known.session.boards).index(most),
        tuple(known.used[index] for index in first.tolist()),
    )


def _guessed(known: RunState, guess: RoughEdges | None) -> _RecordedStart:
    """What stops too few for a fit determine, beside a guess."""
    looked = ObservedPoses.of(known)
    views = [
        pose
        for pose in known.poses
        if pose in known.base_from_flange and pose not in known.held_back
    ]
    if guess is None or not views:
        raise _too_vague(known, len(views))
    shown = [known.poses[view].board for view in views]
    board = max(dict.fromkeys(shown), key=shown.count)
    mine = [view for view in sorted(views) if known.poses[view].board == board]
    looked = replace(looked, boards=(board,), used=tuple(mine))
    looked = replace(looked, frames=looked.framed(np.stack([guess.x, guess.z])))
    robot = robot_part(looked.arm_at(mine).poses, known.session.mount)
    target = tuple(known.session.boards.values())[board]
    poses = [
        choose_by(known.poses[index], pose, target)
        for index, pose in zip(mine, invert(robot @ guess.x) @ guess.z, strict=True)
    ]
    ((frame, scene),) = known.scenes.items()
    problem, alone = looked.posed(poses).problem(mine), np.ones(len(mine), dtype=bool)
    looks = FramesSide(problem, alone, mine, {}).looks({frame: scene}, {frame: poses})
    looked = replace(looked, free=free_of(looks.seen(looks.first))).posed(poses)
    problem = looked.problem(mine).merged()
    return _RecordedStart(
        problem,
        problem.start(looked.frames),
        _TYPICAL,
        looked.free or free_of(looks.seen(looks.first)),
        looked.arm_at_stops,
        board,
        tuple(looked.first_of_stops(mine)),
    )


def _held_pull(known: RunState, problem: Problem) -> FloatArray:
    """(k, 1) how the stops pull at what is held of lens and boards, as their gradient, if it is."""
    if known.answer is None:
        return np.zeros((0, 0))
    fitted, state, noise = known.answer.problem, known.answer.state, known.answer.noise
    pull = normal_equations(fitted, state, noise)[1] * (fitted.counted & ~fitted.moving)
    columns = [fitted.effect_columns[effect.name] for effect in problem.effects]
    return np.concatenate([np.zeros(0), *(pull[column.start : column.stop] for column in columns)])[
        :, None
    ]


def _beside_noise(known: RunState, begun: "_RecordedStart") -> FloatArray:
    """(12, c) how the edges err by what an arm does wrong whose joints are not known, if any."""
    if known.answer is None or begun.arm.is_modelled or "arm" not in known.answer.beside:
        return np.zeros((12, 0))
    names = tuple(begun.problem.unknown)[:2]
    columns = [
        np.arange(item.start, item.stop) for item in map(known.solved.problem.edge_columns, names)
    ]
    at = np.concatenate(columns)
    values, vectors = np.linalg.eigh(known.answer.beside["arm"][np.ix_(at, at)])
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0)))[:, values > 0.0])


def _arm(arm: RobotArm, robot: Robot) -> Robot:
    """The arm up to the frame of the reported poses, as far as it is calibrated."""
    if arm.model is not None:
        return arm.model.robot
    return robot if arm.joints_rad is None else ArmModel.of(robot, arm.joints_rad, arm.poses).robot


def _nearest(
    problem: Problem, state: State, noise: Noise, mount: Mount, guess: RoughEdges | None
) -> tuple[FloatArray, FloatArray]:
    """The likeliest edges with what is known beforehand, and the covariance (12, 12) of two."""
    # These are the camera's and that of the board that is planned for.
    weights = np.zeros((problem.size, problem.size))
    weights[:12, :12] = np.diag(_weights(mount, guess))
    for _ in range(_STEPS):
        information, gradient = normal_equations(problem, state, noise)
        away = np.zeros(problem.size)
        away[:12] = _away(state.edges[:2], guess)
        step = -covariance_among(information + weights, problem.moving) @ (
            gradient + weights @ away
        )
        # What is shared has settled before; it may follow, but it does not move.
        step[6 * len(state.edges) :] = 0.0
        state = state.moved(step)
    covariance = covariance_among(
        fisher_information(problem, state, noise) + weights, problem.counted
    )
    return state.edges, covariance[:12, :12]


def _weights(mount: Mount, guess: RoughEdges | None) -> FloatArray:
    if guess is not None:
        return np.tile(np.repeat([guess.sigma_rad**-2.0, guess.sigma_m**-2.0], 3), 2)
    weights = np.full((2, 2, 3), 1e-6)
    weights[0 if mount == "eye-in-hand" else 1, 1] = _MOUNTED_M**-2.0
    return weights.ravel()


def _away(edges: FloatArray, guess: RoughEdges | None) -> FloatArray:
    """(12,) steps from what is known beforehand to the edges (2, 4, 4)."""
    if guess is not None:
        return np.asarray(log(invert(np.stack([guess.x, guess.z])) @ edges).ravel())
    local = [edge[:3, :3].T @ edge[:3, 3] for edge in edges]
    return np.concatenate([np.zeros(3), local[0], np.zeros(3), local[1]])


def _missing(known: RunState) -> DataError:
    session, missing = known.session, []
    if session.mount == "instrument":
        return DataError(
            f"session {session.name!r} is of an instrument; stops are planned for cameras that see "
            "a board.",
            culprits=[session.name],
            next_step="Choose stops that turn the flange by 30 degrees or more about two axes, all "
            "over the workspace.",
        )
    if known.robot is None:
        missing.append("a model of its robot, which says where the arm reaches")
    if not session.boards:
        missing.append("a board (target)")
    if known.pixel_px is None or not known.scenes:
        missing.append("images of the board")
    return DataError(
        f"session {session.name!r}: stops cannot be added to it without {' and '.join(missing)}.",
        culprits=[f"session {session.name!r}"],
        next_step="Name the arm in session.toml ([robot] model), or by --robot; that of a whole "
        "cell in its own table, as model in [robots.a]."
        if known.robot is None
        else "",
    )


def _too_vague(known: RunState, stops: int) -> DataError:
    return DataError(
        f"session {known.session.name!r}: its {counted(stops, 'usable stop')} of "
        "the robot do not show where camera and board are, not even roughly.",
        culprits=[f"session {known.session.name!r}"],
        next_step="Give rough guesses of both, in mm and degrees: --cam 'X Y Z RX RY RZ' --board "
        "'X Y Z RX RY RZ'.",
    )
