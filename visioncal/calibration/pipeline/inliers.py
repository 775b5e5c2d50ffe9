"""The views that agree, and the priors that these do not contradict."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.starting import Start, sensors_of
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.error_sizes import scales_of
from visioncal.calibration.stages.priors import with_loose_positions, without_most_contradicted
from visioncal.calibration.stages.refine import PRINTED_SCALE
from visioncal.core.transforms import LEVER_M
from visioncal.estimation.fit import Fit
from visioncal.estimation.joint import target_sizes
from visioncal.estimation.moves import Creep, creep_effects
from visioncal.estimation.outliers import (
    InlierFit,
    inliers_and_moves,
    presumed_inliers,
    refine_inliers,
)
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State
from visioncal.estimation.solve import Solution, solve_problem
from visioncal.model.effects import FrameCreeps
from visioncal.vision.pnp import ViewPoses


def initial_inliers(start: Start) -> InlierFit:
    """Finds the inliers, and the priors that they do not contradict.

    Of one robot and one camera, they are those of the one likelihood, if it comes to rest.
    """
    cell, problem, agreeing = start.cell, start.problem, start.agreeing
    movable, observations = _movable_frames(cell, problem), problem.observations
    # Cameras may disagree about one stop by more than their corners say, and not before the lenses
    # are fitted alone: a board shrunk to nothing would reconcile them, or a robot's noise of
    # decimetres, and all stops would be explained.
    problem = _with_camera_levels(cell, start.poses, problem)
    problem, state = _with_creeps(start, problem)
    # Targets whose corners were seen: other poses have no known covariance.
    pairs = zip(observations.observed, observations.sensors.tolist(), strict=True)
    printed = [target for target, sensor in pairs if sensor < 0 and movable]
    if printed:
        # Otherwise all observations of a board of another size would be outliers.
        off = scales_of(start.solved) if agreeing is not None else {}
        known = {target: off.get(target, 0.0) for target in printed}
        sigmas = {target: max(PRINTED_SCALE, abs(share)) for target, share in known.items()}
        sizes = target_sizes(problem, sigmas)
        problem = problem.with_effects([*problem.effects, sizes])
        state = State(state.edges, np.append(state.values, [*known.values()]))
    loose = replace(problem, priors=with_loose_positions(cell.priors))
    if agreeing is None or not cell.session.has_one_pair:
        inliers = inliers_and_moves(loose, state, movable, agreeing)
    else:
        inliers = presumed_inliers(loose, state, agreeing)
    if cell.priors:
        inliers = _with_priors(cell, inliers).refitted()
    # Sizes are estimated from the corners, with the lenses.
    problem, state = inliers.problem, inliers.fit.state
    moved = {move.frame for move in inliers.moves}
    creeps = [effect for effect in creep_effects(problem) if effect.frame not in moved]
    values = [np.zeros(0), *(problem.values_of(effect.name, state) for effect in creeps)]
    fit = replace(inliers.fit, state=State(state.edges, np.concatenate(values)))
    return replace(inliers, problem=problem.with_effects(creeps), fit=fit)


def _with_creeps(start: Start, problem: Problem) -> tuple[Problem, State]:
    """The problem at its start with the frames that creep, by the one likelihood."""
    state = start.state
    if start.solved is None or start.cell.session.has_one_pair:
        return problem, state
    fit = start.solved.fit
    for effect in fit.unknowns.opened:
        if isinstance(effect, FrameCreeps) and effect.frame in problem.unknown:
            edges, frame = state.edges.copy(), effect.frame
            edges[problem.unknown[frame]] = fit.edge(frame)
            state = State(edges, state.values)
            creep = Creep.at(problem, state, frame, effect.rate)
            values = fit.state.values["effect", effect.name] / np.repeat([LEVER_M, 1.0], 3)
            problem = problem.with_effects([*problem.effects, creep])
            state = State(edges, np.append(state.values, values))
    return problem, state


def updated_inliers(cell: Cell, inliers: InlierFit) -> InlierFit:
    """Refits inliers and priors until neither set changes."""
    if cell.priors:
        loose = replace(inliers.problem, priors=with_loose_positions(cell.priors))
        inliers = refine_inliers(replace(inliers, problem=loose), _movable_frames(cell, loose))
        inliers = _with_priors(cell, inliers)
    return refine_inliers(inliers, _movable_frames(cell, inliers.problem))


def _with_camera_levels(cell: Cell, poses: Sequence[ViewPoses], problem: Problem) -> Problem:
    """The problem with a noise level of each camera; itself where they cannot be separated."""
    # Corners of one image may have a common error, as those of small squares do: poses then
    # scatter by more than the corners indicate, but never by less. Where one camera sees one robot
    # once a stop, that is part of the robot's noise.
    is_single = cell.session.has_one_pair and len(problem.units[1]) == len(problem)
    if is_single or problem.is_combined:
        return problem
    sensors = sensors_of(cell, poses)
    frames = tuple(dict.fromkeys((*sensors, *(row.seer for row in cell.rows))))
    indices = {frame: at for at, frame in enumerate(frames)}
    seers = np.array([indices[row.seer] for row in cell.rows], dtype=np.int64)
    return replace(
        problem,
        observations=replace(problem.observations, sensors=seers),
        least_levels=np.repeat([0.0, 1.0], [len(sensors), len(frames) - len(sensors)]),
    )


def with_repeats(inliers: InlierFit) -> InlierFit:
    """Fits with a shared error of repeated views of a fixed board by a fixed camera."""
    # Moved frames were searched without it: differences of such views do not contain it.
    return replace(inliers, problem=replace(inliers.problem, with_repeats=True)).refitted()


def _with_priors(cell: Cell, inliers: InlierFit) -> InlierFit:
    """Adds the components of priors that the observations do not contradict."""
    # The most contradicted is dropped first, as it biases the rest. The noise is that of a fit with
    # loose priors: estimated together with a wrong prior, it would grow until it explains it.
    problem, noise = replace(inliers.problem, priors=cell.priors), inliers.fit.noise
    while True:
        part = problem.subset(inliers.used)
        fit = Solution(solve_problem(part, inliers.fit.state, noise)[0], noise)
        kept = without_most_contradicted(Fit(part, fit))
        if kept is None:
            return replace(inliers, problem=problem, fit=fit)
        problem = replace(problem, priors=kept)


def _movable_frames(cell: Cell, problem: Problem) -> tuple[str, ...]:
    """Frames that may have moved during the session: all unknown ones but bases."""
    # One camera that sees one robot move cannot distinguish what slipped from a wrong pose.
    if cell.session.has_one_pair:
        return ()
    bases = problem.tree.bases.values()
    return tuple(name for name in problem.tree.unknown if name not in bases)
