"""Errors that grow with time, reach or gravity, in the fit of a cell; see `model.effects.NAMED`.

Those of a flange have their sizes by the restricted likelihood of the robots' noise, all together
and beside errors of the arm by its posture; a lens that grows has its own by its corners.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.arms import RobotArm
from visioncal.calibration.stages.error_sizes import ErrorSizes, FoundEffect
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.arm import stops_of
from visioncal.estimation.effects.lenses import LinearisedCorners
from visioncal.estimation.mixed import (
    LEAST_SIGMA,
    MOST_SIGMA,
    MixedEstimate,
    PriorInformation,
)
from visioncal.estimation.outliers import InlierFit
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, State
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.model import Moments
from visioncal.model.arm import even_progress
from visioncal.model.effects import (
    NAMED,
    BaseSteps,
    Creeps,
    MountSteps,
    Named,
    SightSteps,
    Stood,
)
from visioncal.model.effects import Effect as GrowingEffect
from visioncal.session.frames import object_name

# Of their findings, and their names in the budget.
KINDS: Mapping[str, type[Named]] = {effect.kind.replace(" ", "_"): effect for effect in NAMED}
# With fewer stops, no such error is distinguished from noise.
_FEWEST_STOPS = 12
# Share of sessions that have one such error, and typical size of an arm's errors by its posture
# [rad].
_RARE, _ARM = 0.01, 3e-4
# Log-likelihood that six values gain by chance at one of a dozen stops, of one of two frames.
_BY_CHANCE = 0.5 * float(chi2_limit(FALSE_ALARM / 24.0, 6))


def of_random_effects(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The random effects among some effects."""
    return tuple(effect for effect in effects if effect.name.partition(" of ")[0] in KINDS)


def random_effects(
    inliers: InlierFit,
    arms: Mapping[str, RobotArm],
    sizes: ErrorSizes,
    corners: LinearisedCorners | None,
    rows: IntArray | None,
) -> dict[Effect, float]:
    """The random effects that the residuals of the inliers show, for all observations.

    Each comes with twice its gain in log-likelihood.

    Args:
        inliers: The fit.
        arms: Its arms.
        sizes: By the one likelihood of all corners: lenses that grow, frames moved at once.
        corners: The cameras' corners, if any.
        rows: (n,) views of the observations among these, -1 for none.
    """
    problem, found = inliers.problem, dict[Effect, float]()
    for robot, arm in arms.items():
        stops = stops_of(inliers.part, robot)
        if len(stops) < _FEWEST_STOPS or f"arm of {robot}" in problem.effect_columns:
            continue
        flat = PriorInformation.flat(arm.basis.shape[2])
        nuisance = Effect.free(f"postures of {robot}", flat, None, {robot: arm.basis})
        opened = [at for at in sizes.opened if object_name(at.frame, "robot") == robot]
        kinds = [
            kind
            for kind in NAMED
            if not kind.is_imitated or any(isinstance(at, kind) for at in opened)
        ]
        if any(isinstance(at, SightSteps) for at in sizes.opened):
            kinds = [kind for kind in kinds if not issubclass(kind, Creeps)]
        creeps = [at for at in opened if not isinstance(at, BaseSteps | MountSteps)]
        tried = _of_flange(problem, robot, stops, kinds, creeps)
        chosen, value = _with_sizes(inliers, tried, nuisance)
        step = next((at for at in opened if isinstance(at, BaseSteps | MountSteps)), None)
        if step is not None:
            # A frame that moved at once looks as if it crept; the search for steps comes later.
            kinds = [kind for kind in kinds if not issubclass(kind, Creeps)]
            others = _of_flange(problem, robot, stops, kinds, [step])
            instead, least = _with_sizes(inliers, others, nuisance)
            if value - least > _BY_CHANCE:
                chosen = {at: instead[at] for at in of_random_effects([*instead])}
        found |= chosen
    if corners is not None and rows is not None:
        found |= {_of_lens(lens, problem, corners, rows): lens.gain for lens in sizes.grown}
    return found


def _of_flange(
    problem: Problem,
    robot: str,
    stops: IntArray,
    kinds: Sequence[type[Named]],
    opened: Sequence[GrowingEffect],
) -> dict[Effect, float]:
    """Effects that may act on a flange, each with its largest size: steps, if opened, and kinds."""
    poses = np.where(np.isfinite(problem.poses[robot]), problem.poses[robot], np.eye(4))
    stood, count = Stood(poses, stops, is_swept=False), len(poses)
    moments = Moments({robot: poses}, {}, even_progress(count), np.arange(count))
    steps = (at for at in opened if isinstance(at, BaseSteps | MountSteps))
    tried = list[tuple[GrowingEffect, float]]()
    tried += [(replace(step, frame=robot), np.inf) for step in steps]
    for kind in kinds:
        # Creeps that fade otherwise are too much alike: one is tried as the one likelihood has it.
        own = (replace(effect, frame=robot) for effect in opened if isinstance(effect, kind))
        tried += [(next(own, effect), kind.most) for effect in kind.of_flange(robot, stood)][:1]
    found = dict[Effect, float]()
    for effect, most in tried:
        name, unseen = effect.kind.replace(" ", "_"), effect.unseen(moments)
        columns = np.append(effect.columns(moments, np.ones(count)), unseen, axis=2)
        flat = PriorInformation.flat(columns.shape[2])
        free = Effect.free(f"{name} of {robot}", flat, None, {robot: columns})
        found[replace(free, held=np.arange(len(free)) >= effect.count)] = most
    return found


def _with_sizes(
    inliers: InlierFit, candidates: Mapping[Effect, float], nuisance: Effect
) -> tuple[dict[Effect, float], float]:
    """Candidates that the residuals show, with sizes as priors, and the likelihood with these.

    Args:
        inliers: The fit.
        candidates: What may act, each with its largest size.
        nuisance: Errors of the arm by posture, of any size.
    """
    effects, most = [*candidates, nuisance], np.array([*candidates.values()])
    problem, fit = inliers.problem, inliers.fit
    wide = problem.with_effects([*problem.effects, *effects]).subset(inliers.used)
    values = np.append(fit.state.values, np.zeros(sum(map(len, effects))))
    likelihood = robot_likelihood(wide, State(fit.state.edges, values), fit.noise)
    columns = np.full(wide.size, -1)
    for index, effect in enumerate(effects):
        columns[wide.effect_columns[effect.name]] = index
    of_size = columns[likelihood.moving]
    shares = (of_size[:, None] == np.arange(len(effects))).astype(float)
    first, prior = likelihood.model.shares.shape[1], likelihood.model.prior
    model = replace(
        likelihood.model,
        shares=np.concatenate([likelihood.model.shares, shares], axis=1),
        prior=None if prior is None else prior.beside(np.zeros(len(effects)), np.inf),
    )
    levels = np.maximum(fit.noise.robots.ravel(), LEAST_SIGMA)
    low = np.full(first + len(effects), np.log(LEAST_SIGMA))
    # The search starts above what is typical.
    logs = np.log(np.concatenate([levels, np.minimum(most / 5.0, 1e-3), [3.0 * _ARM]]))

    def without(closed: Sequence[int], start: FloatArray) -> MixedEstimate:
        high = np.full(len(low), np.log(MOST_SIGMA))
        high[first + np.array(closed, dtype=int)] = np.log(LEAST_SIGMA)
        return model.maximised(np.minimum(start, high), low, high)

    # Of some that look alike, the weakest goes first.
    closed, found, chosen = list[int](), without([], logs), dict[Effect, float]()
    while len(closed) < len(candidates):
        sizes = np.exp(found.logs[first : first + len(candidates)])
        left = [index for index in range(len(candidates)) if index not in closed]
        out = [index for index in left if sizes[index] <= 10.0 * LEAST_SIGMA]
        if not out:
            # Two that compensate may both be larger than they can.
            is_possible = (sizes[left] <= most[left]).all()
            others = [without([*closed, index], found.logs).value for index in left]
            weakest = int(np.argmin(others))
            # Each size costs one in log-likelihood (Akaike 1974).
            is_clear = others[weakest] - found.value > 1.0 - np.log(_RARE / (1.0 - _RARE))
            if is_clear and is_possible:
                for index, other in zip(left, others, strict=True):
                    effect, size = effects[index], float(np.exp(found.logs[first + index]))
                    known = PriorInformation(np.eye(len(effect)) / size**2, np.zeros(len(effect)))
                    chosen[replace(effect, prior=known)] = 2.0 * (other - found.value)
                break
            out = [left[weakest]]
        closed += out
        found = without(closed, found.logs)
    return chosen, found.value


def _of_lens(
    found: FoundEffect, problem: Problem, corners: LinearisedCorners, rows: IntArray
) -> Effect:
    """A lens that grows, as it moves measured poses."""
    optics, moved = corners.camera_parameters, np.zeros((len(rows), 6, len(found.values)))
    for name, compressed in zip(optics.problems, corners.compressed, strict=True):
        views = optics.rows(name)
        if name == found.effect.frame:
            own = (rows >= views.start) & (rows < views.stop)
            lens = found.columns[problem.observations.stops[own]]
            by_lens = compressed.by_shared[rows[own] - views.start, :, : lens.shape[1]]
            moved[own] = by_lens @ lens
    # Of what the corners were not steadied by.
    information = np.asarray(np.linalg.inv(found.covariance), dtype=float)
    prior = PriorInformation(information, np.zeros(len(found.values)))
    kind = found.effect.kind.replace(" ", "_")
    return Effect.free(f"{kind} of {found.effect.frame}", prior, moved)


def random_effect_rms(problem: Problem, state: State, robot: str) -> FloatArray:
    """(2,) rms of a robot's flange errors by random effects, of rotation [rad] and position [m]."""
    error = np.zeros((len(problem.poses[robot]), 6))
    for effect in of_random_effects(problem.effects):
        if robot in effect.flange_jacobian:
            error += effect.flange_jacobian[robot] @ problem.values_of(effect.name, state)
    squares = error[stops_of(problem, robot)].reshape(-1, 2, 3) ** 2
    return np.asarray(np.sqrt(squares.mean(axis=(0, 2))))
