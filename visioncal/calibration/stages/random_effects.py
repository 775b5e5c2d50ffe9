"""Errors that grow with time, reach or gravity, in the fit of a cell; see `model.effects.NAMED`.

The one likelihood of all sightings finds them, and their sizes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.error_sizes import ErrorSizes, FoundEffect, OpenedEffect
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.arm import stops_of
from visioncal.estimation.effects.lenses import LinearisedCorners
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.outliers import InlierFit
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, State
from visioncal.model.effects import NAMED, Named
from visioncal.session.frames import object_name

# Of their findings, and their names in the budget.
KINDS: Mapping[str, type[Named]] = {effect.kind.replace(" ", "_"): effect for effect in NAMED}


def of_random_effects(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The random effects among some effects."""
    return tuple(effect for effect in effects if effect.name.partition(" of ")[0] in KINDS)


def random_effects(
    inliers: InlierFit,
    arms: Mapping[str, Arm],
    sizes: ErrorSizes,
    corners: LinearisedCorners | None,
    rows: IntArray | None,
) -> dict[Effect, float]:
    """The random effects that the one likelihood found, for all observations.

    Each comes with twice its gain in log-likelihood.

    Args:
        inliers: The fit.
        arms: Its arms.
        sizes: By the one likelihood of all sightings.
        corners: The cameras' corners, if any.
        rows: (n,) views of the observations among these, -1 for none.
    """
    problem, found = inliers.problem, dict[Effect, float]()
    for at in sizes.opened:
        robot = object_name(at.effect.frame, "robot")
        if robot in arms:
            found[_of_flange(at, problem, arms[robot])] = at.gain
    if corners is not None and rows is not None:
        found |= {_of_lens(lens, problem, corners, rows): lens.gain for lens in sizes.grown}
    return found


def _of_flange(at: OpenedEffect, problem: Problem, arm: Arm) -> Effect:
    """An effect on a flange, as it moves the poses of its robot."""
    robot = arm.robot
    poses = np.where(np.isfinite(problem.poses[robot]), problem.poses[robot], np.eye(4))
    effect, moments = replace(at.effect, frame=robot), replace(arm.moments, poses={robot: poses})
    seen, unseen = effect.columns(moments, np.ones(len(poses))), effect.unseen(moments)
    columns = np.append(seen, unseen, axis=2)
    size = columns.shape[2]
    prior = PriorInformation(np.eye(size) / at.size**2, np.zeros(size))
    name = f"{effect.kind.replace(' ', '_')} of {robot}"
    free = Effect.free(name, prior, None, {robot: columns})
    return replace(free, held=np.arange(size) >= effect.count)


def _of_lens(
    found: FoundEffect, problem: Problem, corners: LinearisedCorners, rows: IntArray
) -> Effect:
    """A lens that grows, as it moves measured poses."""
    optics, moved = corners.camera_parameters, np.zeros((len(rows), 6, len(found.values)))
    for name, compressed in zip(optics.problems, corners.compressed, strict=True):
        views = optics.rows(name)
        if name == found.effect.frame:
            is_of_lens = (rows >= views.start) & (rows < views.stop)
            lens = found.columns[problem.observations.stops[is_of_lens]]
            by_lens = compressed.by_shared[rows[is_of_lens] - views.start, :, : lens.shape[1]]
            moved[is_of_lens] = by_lens @ lens
    # The corners were corrected by the estimated growth: its covariance is that of the rest.
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
