"""Where a plan begins that adds to a session: what the session tells, be it ever so little."""

from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.errors import DataError, DegenerateError
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.linalg import covariance_among
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import fisher_information, fit_problem, normal_equations
from visioncal.pipeline.known import Known
from visioncal.pipeline.steps import STAGES
from visioncal.planning.cell import Box, Limits, PlanCell
from visioncal.planning.information import Recorded
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.targets import first_corners
from visioncal.threads import one_blas_thread
from visioncal.transforms import invert, log
from visioncal.types import FloatArray, Mount, Progress

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
class Guess:
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
        cell: The cell as far as the session tells it.
        recorded: What the session tells.
        refusal: Why the session alone gives no result; empty where it does.
        views: The number of the first view of each stop.
    """

    cell: PlanCell
    recorded: Recorded
    refusal: str
    views: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SoFar:
    """What is known of a session, and why no more."""

    known: Known
    refusal: str = field(default="")


def so_far(session: Session, *, level: str = "hand-eye", progress: Progress | None = None) -> SoFar:
    """Calibrates a session as far as it goes.

    Args:
        session: What was recorded.
        level: How far to go, as `visioncal.calibrate` takes it.
        progress: Told of long work.

    Raises:
        DataError: The input is wrong or shows no target.
    """
    known = Known(session, progress, level=level)
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
    guess: Guess | None = None,
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
        DataError: The session lacks a robot's model, a camera or a board, or it tells too little to
            begin without a guess.
    """
    known = found.known
    robot, free, targets = known.robot, known.free, tuple(known.session.boards.values())
    if robot is None or free is None or not targets or known.pixel_px is None:
        raise _lacking(known)
    first, arm = known.first_of_stops(known.used), known.arm_at_stops
    # The arm's own errors are the purpose's business: they are put in again with its priors.
    bare = replace(known, calibrated=replace(known.robot_arm, errors=None))
    problem = bare.problem(known.used).merged()
    with one_blas_thread():
        state, noise = _start(known, problem, guess)
        edges, spread = _nearest(problem, state, noise, known.session.mount, guess)
    sigmas = np.sqrt(np.diag(spread).reshape(2, 2, 3).mean(axis=(0, 2)))
    if sigmas[0] > _TOO_VAGUE_RAD or sigmas[1] > _TOO_VAGUE_M:
        raise _too_vague(known)
    cell = PlanCell(
        known.session.mount,
        _arm(known, robot),
        free.appearance.camera,
        targets[known.boards[0]],
        edges[0],
        edges[1],
        float(sigmas[0]),
        float(sigmas[1]),
        noise,
        known.pixel_px,
        limits or Limits(),
        boxes,
        spread,
    )
    corner = int(first_corners(targets)[known.boards[0]])
    recorded = Recorded(
        problem,
        edges,
        free,
        arm.joints_rad,
        noise,
        corner,
        arm.errors,
        1.0 if known.diagnosis is None else known.diagnosis.inflation,
    )
    return Begun(cell, recorded, found.refusal, tuple(first))


def _arm(known: Known, robot: Robot) -> Robot:
    """The arm up to the frame of the reported poses, as far as it is calibrated."""
    arm = known.arm_at(known.used)
    if arm.model is not None:
        return arm.model.robot
    return robot if arm.joints_rad is None else ArmModel.of(robot, arm.joints_rad, arm.poses).robot


def _start(known: Known, problem: Problem, guess: Guess | None) -> tuple[State, Noise]:
    if known.agreed is None and guess is None:
        raise _too_vague(known)
    frames = known.frames
    if guess is not None and not frames:
        frames = known.framed(np.stack([guess.x, guess.z]))
    state = problem.start(frames)
    if known.agreed is None:
        return state, _TYPICAL
    if known.hand_eye is not None:
        noise = known.hand_eye.noise
    else:
        fit = fit_problem(problem, state)
        state, noise = State(fit.state.edges, state.values), fit.noise
    return state, replace(noise, robots=np.maximum(noise.robots, _LEAST_NOISE.robots))


def _nearest(
    problem: Problem, state: State, noise: Noise, mount: Mount, guess: Guess | None
) -> tuple[FloatArray, FloatArray]:
    """The likeliest edges with what is known beforehand, and the covariance (12, 12) of two.

    These are the camera's and that of the board that is planned for.
    """
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
    spread = covariance_among(fisher_information(problem, state, noise) + weights, problem.counted)
    return state.edges, spread[:12, :12]


def _weights(mount: Mount, guess: Guess | None) -> FloatArray:
    if guess is not None:
        return np.tile(np.repeat([guess.sigma_rad**-2.0, guess.sigma_m**-2.0], 3), 2)
    weights = np.full((2, 2, 3), 1e-6)
    weights[0 if mount == "eye-in-hand" else 1, 1] = _MOUNTED_M**-2.0
    return weights.ravel()


def _away(edges: FloatArray, guess: Guess | None) -> FloatArray:
    """(12,) steps from what is known beforehand to the edges (2, 4, 4)."""
    if guess is not None:
        return np.asarray(log(invert(np.stack([guess.x, guess.z])) @ edges).ravel())
    local = [it[:3, :3].T @ it[:3, 3] for it in edges]
    return np.concatenate([np.zeros(3), local[0], np.zeros(3), local[1]])


def _lacking(known: Known) -> DataError:
    session, missing = known.session, []
    if known.robot is None:
        missing.append("a model of its robot ([robot] model)")
    if not session.boards:
        missing.append("a board (target)")
    if known.free is None or known.pixel_px is None:
        missing.append("images of the board")
    return DataError(
        f"session {session.name!r}: stops cannot be added to it without {' and '.join(missing)}.",
        culprits=[f"session {session.name!r}"],
        next_step="Name the arm in session.toml ([robot] model), or by --robot."
        if known.robot is None
        else "",
    )


def _too_vague(known: Known) -> DataError:
    stops = len(known.first_of_stops(known.used))
    return DataError(
        f"session {known.session.name!r}: its {stops} usable stop{'s' if stops != 1 else ''} "
        "of the robot do not tell where camera and board are, not even roughly.",
        culprits=[f"session {known.session.name!r}"],
        next_step="Give rough guesses of both transforms.",
    )
