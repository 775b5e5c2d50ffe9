"""Changes from some stop on: of a frame, a joint, a lens or a board's size; and a base's drift.

Each is a few columns of the residuals, and all stops are tried at once by running sums (Rao's score
test of a change point, Page 1955). The evidence of a fit with the change decides; `moves` finds
frames that moved by more than the noise of single observations.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from visioncal.core.limits import CLEAR_RATIO, FEWEST_VIEWS
from visioncal.core.linalg import ROUNDING, covariance_from
from visioncal.core.procrustes import align
from visioncal.core.quantiles import FALSE_ALARM, f_limit
from visioncal.core.transforms import adjoint, apply, compose, invert, log, mean_transform
from visioncal.core.types import FloatArray, IntArray, Mask, evenly
from visioncal.estimation.arm import rows_of, stops_of
from visioncal.estimation.moves import CREEP, Creep, fitted_change, moved
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, State, by_size
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.solve import (
    Solution,
    by_noise_alone,
    equations_from,
    fit_problem,
    fitted_covariance,
)
from visioncal.robot.errors import SIZES_M, TURN_PER_M, TWIST_UNITS

FRAME, JOINT, SIZE, LENS, DRIFT = "frame", "joint", "size", "lens", "drift"
# Sizes of changes with equal prior probability, and the unit of each value.
_MOTION = SIZES_M, np.repeat([TURN_PER_M, 1.0], 3)
_PRIOR: Mapping[str, tuple[tuple[float, ...], FloatArray]] = {
    FRAME: _MOTION,
    DRIFT: _MOTION,
    JOINT: ((1e-4, 1e-3, 1e-2, 1e-1), np.ones(1)),
    SIZE: ((1e-3, 1e-2, 1e-1), np.ones(1)),
    LENS: ((1e-3, 1e-2, 1e-1), np.ones(3)),
}
# Largest share of the residuals that a change explains.
_MOST_EXPLAINED = 0.99


@dataclass(frozen=True, eq=False)
class Candidate:
    """A possible change during the session."""

    kind: str  # One of the above, or `CREEP` of another frame than a base.
    of: str  # The frame; of a joint or a drift the robot, as the problem names it.
    stops: IntArray  # The stops from which on it may have changed.
    effect: Effect | None = None  # The change as an effect on all stops; None for a frame's pose.
    joint: int = -1  # Index of the joint.


@dataclass(frozen=True, eq=False)
class Step:
    """A change from some stop on."""

    candidate: Candidate  # The change.
    stop: int  # The first stop after it.
    # (c,) change: twist of a frame in its own old pose, or of a base over the session [rad, m];
    # actual minus reported angle [rad]; relative size; of a lens see `lenses_of`.
    value: FloatArray
    covariance: FloatArray  # (c, c) of the change.
    gain: float  # Twice the gain in log-likelihood, or the log Bayes factor of `evidence`.
    # (p, p) covariance added for it where a fit does not model it: the solution lies between the
    # states before and after, which are equally likely to be needed.
    spread: FloatArray
    earlier: tuple["Step", ...] = ()  # Of the same frame, beside which it is.

    @property
    def kind(self) -> str:
        """Kind of the change, as of its candidate."""
        return self.candidate.kind

    @property
    def of(self) -> str:
        """The frame or robot that changed."""
        return self.candidate.of


def frames_of(problem: Problem, frames: Sequence[str]) -> list[Candidate]:
    """Poses of frames that may have changed."""
    return [
        Candidate(FRAME, frame, _between(problem, problem.observations.involves(frame)))
        for frame in frames
    ]


def candidates_of(
    problem: Problem, frames: Sequence[str], creeps: Sequence[Creep]
) -> list[Candidate]:
    """Frames that may have moved at once, and effects of those that may have crept."""
    first = np.array([int(problem.observations.stops.min())])
    crept = [Candidate(CREEP, at.frame, first, at) for at in creeps]
    return [*frames_of(problem, frames), *crept]


def joints_of(problem: Problem, offsets: Mapping[str, FloatArray]) -> list[Candidate]:
    """Joints whose offsets may have changed.

    `offsets` are (s, 6, n) by robot: Jacobians of its flange at each stop by its n joint offsets.
    """
    return [
        Candidate(
            JOINT,
            robot,
            _between(problem, rows_of(problem, robot)),
            Effect.free(
                f"offset {joint} of {robot}", flange_jacobian={robot: offset[:, :, [joint]]}
            ),
            joint,
        )
        for robot, offset in offsets.items()
        for joint in range(offset.shape[2])
    ]


def sizes_of(problem: Problem, fit: Solution) -> list[Candidate]:
    """Boards that may have been exchanged for one of another size, in proportion to distance."""
    by_sizes, candidates = by_size(problem.measured(fit.state)), []
    for frame in (name for name in problem.unknown if name.startswith("target")):
        rows = np.array([name == frame for name in problem.observations.observed])
        jacobian = np.where(rows[:, None], by_sizes, 0.0)[:, :, None]
        effect = Effect.free(f"size of {frame}", by_sensor=jacobian)
        candidates.append(Candidate(SIZE, frame, _between(problem, rows), effect))
    return candidates


def lenses_of(problem: Problem, moves: Mapping[str, FloatArray]) -> list[Candidate]:
    """Cameras whose focal length and centre may have changed.

    `moves` are (n, 6, 3) by camera: Jacobians of the measured poses by these, as shares of the
    focal length.
    """
    return [
        Candidate(
            LENS,
            camera,
            _between(problem, np.asarray(by_lens.any(axis=(1, 2)))),
            Effect.free(f"lens of {camera}", by_sensor=by_lens),
        )
        for camera, by_lens in moves.items()
    ]


def drift_of(problem: Problem, robot: str) -> Candidate:
    """Motion of a robot's base in proportion to the number of the stop."""
    stops, poses = stops_of(problem, robot), problem.poses[robot]
    jacobian = np.zeros((len(poses), 6, 6))
    time = np.linspace(-0.5, 0.5, len(stops))[:, None, None]
    jacobian[stops] = adjoint(invert(poses[stops])) * time
    effect = Effect.free(f"drift of {robot}", flange_jacobian={robot: jacobian})
    first = int(problem.observations.stops.min())
    return Candidate(DRIFT, robot, np.array([first]), effect)


def _between(problem: Problem, rows: Mask) -> IntArray:
    """Stops with enough stops of (n,) some observations before and after."""
    return np.asarray(np.unique(problem.observations.stops[rows])[FEWEST_VIEWS : 1 - FEWEST_VIEWS])


def find_steps(
    problem: Problem, fit: Solution, candidates: Sequence[Candidate], kinds: int = 1
) -> list[Step]:
    """The step of each candidate that noise does not explain, greatest gain first.

    Args:
        problem: The inlier observations.
        fit: The converged fit of the problem.
        candidates: Frames, joints or others that may have changed.
        kinds: Number of kinds of residuals, rotations and positions, if a frame's step may be in
            one alone: it then has to explain a half as much, and noise explains it more often. No
            `evidence` follows for a drift, whose test is of both.
    """
    size, fitted = problem.size, fitted_covariance(problem, fit.state, fit.noise)
    effects = [candidate.effect for candidate in candidates if candidate.effect is not None]
    widened = problem.with_effects([*problem.effects, *effects])
    values = np.append(fit.state.values, np.zeros(widened.size - size))
    start = replace(fit, state=State(fit.state.edges, values))
    columns = [
        np.r_[
            widened.edge_columns(candidate.of)
            if candidate.effect is None
            else widened.effect_columns[candidate.effect.name]
        ]
        for candidate in candidates
    ]
    every = np.concatenate([np.zeros(0, dtype=np.int64), *columns])
    ends = np.cumsum([0, *map(len, columns)])
    equations = [*equations_from(widened, start, every)]
    stops = np.array([stop for stop, *_ in equations])
    # Unknowns with a prior take less than one degree of freedom each.
    determined = float(np.sum(problem.moving))
    determined -= float(np.sum(fitted * problem.prior_information(fit.state).information))
    freedom = max(float(problem.observations.directions.sum()) - determined, 6.0)
    tried = Counter[str]()
    for candidate in candidates:
        tried[candidate.kind] += len(candidate.stops)
    steps = []
    for at, candidate in enumerate(candidates):
        part, among = slice(ends[at], ends[at + 1]), np.isin(stops, candidate.stops)
        if not among.any():
            continue
        some = [equations[index] for index in np.flatnonzero(among)]
        slopes = np.array([gradient[part] for *_, gradient in some])
        information = np.array([rows[part] for _, rows, _ in some])
        across, unadjusted = information[:, :, :size], information[:, :, columns[at]]
        left = unadjusted - (across @ fitted) @ np.swapaxes(across, 1, 2)
        blocks = np.stack([unadjusted, left], axis=1)
        scale = np.sqrt(
            np.maximum(np.diagonal(blocks[:, 0], axis1=1, axis2=2), np.finfo(float).tiny)
        )
        scaled = blocks / (scale[:, :, None] * scale[:, None, :])[:, None]
        sound = np.linalg.eigvalsh(scaled).min(axis=(1, 2)) >= ROUNDING
        covariances = covariance_from(blocks[sound, 1])
        values = -(covariances @ slopes[sound][:, :, None])[:, :, 0]
        squares, count = -np.sum(slopes[sound] * values, axis=1), slopes.shape[1]
        many = freedom / (kinds if candidate.kind == FRAME else 1)
        chance = FALSE_ALARM / tried[candidate.kind]
        limit = count * float(f_limit(chance, count, max(0.5 * many, 6.0)))
        # An F test: the noise of a score includes the tested change, which bounds the score.
        remaining = np.maximum(many - squares, (1.0 - _MOST_EXPLAINED) * many)
        tested = squares * max(many - count, 1.0) / remaining
        shown = np.where(tested < limit, 0.0, squares)
        if shown.max(initial=0.0) > 0.0:
            best = int(np.argmax(shown))
            share = min(float(shown[best]) / freedom, _MOST_EXPLAINED)
            stop, value = int(stops[among][sound][best]), values[best]
            before = -fitted @ across[sound][best].T @ value
            after = before.copy()
            if candidate.effect is None:
                after[columns[at]] += value
            spread = (np.outer(before, before) + np.outer(after, after)) / 2.0
            gain = -freedom * float(np.log1p(-share))
            steps.append(Step(candidate, stop, value, covariances[best], gain, spread))
    return sorted(steps, key=lambda step: -step.gain)


def with_step(problem: Problem, fit: Solution, step: Step) -> tuple[Problem, Solution]:
    """The problem with a step from its stop on, and with those before it, and its fit."""
    effect, frame = step.candidate.effect, step.of
    for one in step.earlier:
        problem, fit = with_step(problem, fit, one)
        frame = [*problem.unknown][-1]
    if effect is None:
        widened, start, _ = moved(problem, fit, frame, step.stop, step.value)
    else:
        by_sensor, after = effect.by_sensor, problem.observations.stops >= step.stop
        flanges = {name: array.copy() for name, array in effect.flange_jacobian.items()}
        for array in flanges.values():
            array[: step.stop] = 0.0
        effect = replace(
            effect,
            by_sensor=None if by_sensor is None else by_sensor * after[:, None, None],
            flange_jacobian=flanges,
        )
        widened = problem.with_effects([*problem.effects, effect])
        values = np.append(fit.state.values, step.value)
        start = replace(fit, state=State(fit.state.edges, values))
    return widened, fit_problem(widened, start.state, start.noise)


def evidence(problem: Problem, fit: Solution, step: Step) -> tuple[float, Problem, Solution]:
    """Twice the log Bayes factor of a step, by a fit with it and with its own noise.

    The score has one noise level for rotations and positions. A pushed camera shows in positions
    alone, which are only half of the score. Noise may be uneven from stop to stop: where a Student
    distribution leaves less of the factor, it counts (Lange, Little and Taylor 1989).

    Returns:
        The factor, and the problem with the step and its fit.
    """
    widened, step_fit = with_step(problem, fit, step)
    # The sensors' levels are held, the same for both.
    before, after = (
        robot_likelihood(part, state, step_fit.noise).negative_log_likelihood
        for part, state in ((problem, fit.state), (widened, step_fit.state))
    )
    known = fitted_covariance(widened, step_fit.state, step_fit.noise)
    # Restricted likelihood has a flat prior on the change; actual changes come in all orders of
    # magnitude.
    if step.candidate.effect is None:
        twin = [*widened.unknown][-1]
        change, covariance = fitted_change(widened, step_fit, known, step.of, twin)
    else:
        count = len(step.value)
        change, covariance = step_fit.state.values[-count:], known[-count:, -count:]
    sizes, units = _PRIOR[step.kind]
    logs = []
    for size in sizes:
        total = covariance + np.diag((size * units) ** 2)
        square = float(change @ np.linalg.solve(total, change))
        logs.append(-0.5 * (float(np.linalg.slogdet(total)[1]) + square))
    prior = float(np.logaddexp.reduce(logs) - np.log(len(logs)))
    even, uneven = (
        _log_likelihoods(by_noise_alone(part, Solution(state, step_fit.noise)))
        for part, state in ((widened, step_fit.state), (problem, fit.state))
    )
    less = max(float(np.subtract(*(even - uneven))), 0.0)
    return 2.0 * (before - after + prior - less), widened, step_fit


def twice(
    problem: Problem, fit: Solution, step: Step, stepped: tuple[Problem, Solution]
) -> tuple[Step, Problem, Solution] | None:
    """A frame's step beside another, of both the later, with the log Bayes factor of both, doubled.

    Each is the likeliest beside the other; None where the rest shows no other.

    Args:
        problem: The inlier observations.
        fit: The converged fit of the problem.
        step: A step of a frame.
        stepped: The problem with it, and its fit.

    Returns:
        The step, and the problem with both and its fit.
    """
    other = _other(*stepped, step)
    if other is None:
        return None
    again = _other(*with_step(problem, fit, other), step) or step
    first, last = sorted((again, other), key=lambda one: one.stop)
    gain, apart, solution = evidence(problem, fit, first)
    frames = [step.of, [*apart.unknown][-1]]
    later = replace(last, candidate=replace(last.candidate, of=frames[-1]))
    more, apart, solution = evidence(apart, solution, later)
    frames.append([*apart.unknown][-1])
    edges = [solution.state.edges[apart.unknown[frame]] for frame in frames]
    # The fit without steps is of one of three states, which are equally likely to be needed.
    away = np.zeros((3, problem.size))
    edge_indices, all_of = (
        np.array([apart.unknown[name] for name in problem.unknown]),
        problem.unknown,
    )
    for shift, edge in zip(away, edges, strict=True):
        now = solution.state.edges[edge_indices].copy()
        now[all_of[step.of]] = edge
        shift[: now.shape[0] * 6] = log(invert(fit.state.edges) @ now).ravel()
        shift[now.shape[0] * 6 :] = solution.state.values - fit.state.values
    changes = [log(invert(before) @ after) for before, after in pairwise(edges)]
    joint_step = replace(
        last,
        value=changes[1],
        gain=gain + more,
        spread=away.T @ away / 3.0,
        earlier=(replace(first, value=changes[0]),),
    )
    return joint_step, apart, solution


def _other(apart: Problem, solution: Solution, step: Step) -> Step | None:
    """The likeliest step of the same frame, of which a problem has another, as one of its own."""
    frames = frames_of(apart, [step.of, [*apart.unknown][-1]])
    found = find_steps(apart, solution, frames, kinds=2)
    return replace(found[0], candidate=step.candidate) if found else None


def _log_likelihoods(squares: FloatArray) -> FloatArray:
    """Log-likelihoods (2,) of poses by their (n,) squared residuals, each at its likeliest scale.

    Of even noise, and of one that is uneven from pose to pose: a Student distribution with four
    degrees of freedom, under which one pose in fifty is off by thrice the typical noise.
    """
    half, scale = 3.0 * len(squares), float(np.mean(squares)) / 6.0
    even = -half * (np.log(scale) + 1.0)
    for _ in range(30):
        scale = float(np.mean(10.0 * squares / (4.0 + squares / scale))) / 6.0
    tails = 5.0 * np.log1p(squares / (4.0 * scale))
    return np.array([even, -half * np.log(scale) - float(tails.sum())])


def step_of(
    part: Problem, frame: str, state: State, step: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """The step of a frame that explains observations, or a given one, and what it leaves (n,).

    Of places, a step of the instrument is rigid, and one of the point a shift.
    """
    if part.observations.has_rotation.all():
        changes = part.change_of(frame, state)
        if step is None:
            # Observations among which a common step is sought: of more, all would take memory by
            # their square.
            some = changes[evenly(len(changes), 200)]
            apart = np.linalg.norm(log(invert(some)[:, None] @ changes) / TWIST_UNITS, axis=-1)
            nearest = apart[int(np.median(apart, axis=1).argmin())]
            # One wrong pose among few would put their mean off.
            step = mean_transform(changes[nearest <= CLEAR_RATIO * np.median(nearest)])
        return step, np.linalg.norm(log(invert(step) @ changes) / TWIST_UNITS, axis=-1)
    measured, predicted = part.measured(state), part.predicted(state)
    if frame.startswith("instrument"):
        if step is None:
            step = align(predicted[:, :3, 3], measured[:, :3, 3])
        left = predicted[:, :3, 3] - apply(step, measured[:, :3, 3])
    else:
        left = (invert(predicted) @ measured)[:, :3, 3]
        if step is None:
            step = compose(np.eye(3), np.median(left, axis=0))
        left = left - step[:3, 3]
    return step, np.linalg.norm(left / TWIST_UNITS[3:], axis=-1)
