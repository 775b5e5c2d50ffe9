"""Errors that grow with time, reach or gravity, in the fit of a cell; see `RANDOM_EFFECTS`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.arms import RobotArm
from visioncal.calibration.stages.error_sizes import Growth
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.arm import LEVER_M, stops_of
from visioncal.estimation.effects import RANDOM_EFFECTS
from visioncal.estimation.effects.lenses import LinearisedCorners
from visioncal.estimation.effects.random_effect import (
    RandomEffect,
    Stops,
    effect_of,
    find_random_effects,
)
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.outliers import InlierFit
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, State

# With fewer stops, no such error is distinguished from noise.
_FEWEST_STOPS = 12
_KINDS = {kind.kind: kind for kind in RANDOM_EFFECTS}


def of_random_effects(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Those of some effects that are random effects."""
    return tuple(effect for effect in effects if effect.name.partition(" of ")[0] in _KINDS)


def random_effects(
    inliers: InlierFit,
    arms: Mapping[str, RobotArm],
    corners: LinearisedCorners | None,
    rows: IntArray | None,
    growth: Mapping[str, Growth],
) -> tuple[Effect, ...]:
    """The random effects that the residuals of the inliers show, for all observations.

    `rows` are the (n,) views of the observations, -1 for none, among the cameras' corners, if any;
    `growth` that of lenses which grow, see `ErrorSizes`.
    """
    problem, found = inliers.problem, list[Effect]()
    for robot, arm in arms.items():
        stops = stops_of(inliers.part, robot)
        if len(stops) < _FEWEST_STOPS or f"arm of {robot}" in problem.effect_columns:
            continue
        candidates = [*_of_flange(problem, robot, stops)]
        flat = PriorInformation.flat(arm.basis.shape[2])
        nuisance = Effect.free(f"postures of {robot}", flat, None, {robot: arm.basis})
        found += find_random_effects(inliers, candidates, [nuisance])
        if growth and corners is not None and rows is not None and len(arms) == 1:
            for _, effect in _of_sensors(inliers, robot, stops, corners, rows):
                known = growth.get(effect.name.partition(" of ")[2])
                if known is not None:
                    information = np.eye(1) / known.sigma**2
                    prior = PriorInformation(information, -information[0] * known.share)
                    found.append(replace(effect, prior=prior))
    return tuple(found)


def _time(stops: IntArray, count: int) -> FloatArray:
    """(s,) share of the observed stops that are over, of all stops."""
    return np.asarray(np.searchsorted(stops, np.arange(count)) / max(len(stops) - 1, 1))


def _of_flange(
    problem: Problem, robot: str, stops: IntArray
) -> Iterator[tuple[RandomEffect, Effect]]:
    poses = np.where(np.isfinite(problem.poses[robot]), problem.poses[robot], np.eye(4))
    seen = Stops(poses, _time(stops, len(poses)), np.zeros((0, 6)))
    for kind in RANDOM_EFFECTS:
        if not kind.is_of_sensor:
            effect = effect_of(kind, robot, seen)
            columns = _without_constants(effect.flange_jacobian[robot], poses, stops)
            yield kind, replace(effect, flange_jacobian={robot: columns})


def _without_constants(columns: FloatArray, poses: FloatArray, stops: IntArray) -> FloatArray:
    """Columns (s, 6, k) less what one twist of base and of flange explains at the observed stops.

    Base and flange are those of which the robot reports: what is the same at all stops is theirs
    (Hodges and Reich 2010, on random effects beside fixed ones).
    """
    flange = np.broadcast_to(np.eye(6), (len(poses), 6, 6))
    constant = np.concatenate([flange, adjoint(invert(poses))], axis=2)
    weights = np.repeat([LEVER_M, 1.0], 3)[:, None]
    among, target = (
        (weights * array[stops]).reshape(6 * len(stops), -1) for array in (constant, columns)
    )
    return np.asarray(columns - constant @ np.linalg.lstsq(among, target, rcond=None)[0])


def _of_sensors(
    inliers: InlierFit, robot: str, stops: IntArray, corners: LinearisedCorners, rows: IntArray
) -> Iterator[tuple[RandomEffect, Effect]]:
    problem = inliers.problem
    time = _time(stops, len(problem.poses[robot]))[problem.observations.stops]
    optics = corners.camera_parameters
    for name, compressed in zip(optics.problems, corners.compressed, strict=True):
        views, by_focal = optics.rows(name), np.zeros((len(rows), 6))
        is_mine = (rows >= views.start) & (rows < views.stop)
        by_shared = compressed.by_shared[rows[is_mine] - views.start, :, :2]
        by_focal[is_mine] = by_shared @ optics.camera(name).matrix[:2]
        seen = Stops(np.zeros((0, 4, 4)), time, by_focal)
        for kind in RANDOM_EFFECTS:
            if kind.is_of_sensor and (is_mine & inliers.used).any():
                yield kind, effect_of(kind, name, seen)


def random_effect_rms(problem: Problem, state: State, robot: str) -> FloatArray:
    """(2,) rms of a robot's flange errors by random effects, of rotation [rad] and position [m]."""
    error = np.zeros((len(problem.poses[robot]), 6))
    for effect in of_random_effects(problem.effects):
        if robot in effect.flange_jacobian:
            error += effect.flange_jacobian[robot] @ problem.values_of(effect.name, state)
    squares = error[stops_of(problem, robot)].reshape(-1, 2, 3) ** 2
    return np.asarray(np.sqrt(squares.mean(axis=(0, 2))))
