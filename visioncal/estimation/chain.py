"""Problem of one robot and one camera: a chain of frames with a robot in it.

    eye-in-hand   base -> flange -> cam,  base -> target
    eye-to-hand   base -> flange -> target,  base -> cam

A measuring instrument that reads a probe on the flange is modelled as a stationary camera, with the
probe as its target.
"""

from collections.abc import Sequence

import numpy as np

from visioncal.core.transforms import distances, invert, mean_transform
from visioncal.core.types import FloatArray, IntArray, Mount
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import ROBOT, Effect, Observations, State
from visioncal.session.frames import edge_names
from visioncal.session.tree import Branch, Tree

BASE, FLANGE = "base", "flange"


def scatter(problem: Problem, others: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """Distances (n,) [m] and (n,) [rad] of observed targets from their means in `others`.

    The state is that of both problems, which are of the same targets.
    """
    poses, targets = _target_poses(others, state), np.array(others.observations.observed)
    mean = {
        value: mean_transform(poses[targets == value]) for value in dict.fromkeys(targets.tolist())
    }
    return distances(
        _target_poses(problem, state),
        np.array([mean[name] for name in problem.observations.observed]),
    )


def _target_poses(problem: Problem, state: State) -> FloatArray:
    """(n, 4, 4) pose of each observation's target, in the target's parent frame."""
    edges = state.edges[[problem.unknown[name] for name in problem.observations.observed]]
    return np.asarray(edges @ invert(problem.predicted(state)) @ problem.measured(state))


def chain(
    mount: Mount,
    base_from_flange: FloatArray,
    cam_from_target: FloatArray,
    covariance: FloatArray | None = None,
    *,
    stops: IntArray | None = None,
    targets: Sequence[str] = (),
    order: Sequence[str] = (),
    effects: Sequence[Effect] = (),
) -> Problem:
    """Builds the problem of one robot and one camera.

    Args:
        mount: Mounting of the camera.
        base_from_flange: (s, 4, 4) robot poses, by stop.
        cam_from_target: (m, 4, 4) poses that the views measured.
        covariance: (m, 6, 6) of their right perturbations; None where unknown.
        stops: (m,) the stop of each view, numbered from 0; None where each has its own.
        targets: (m,) the frame of the target in each view; empty for a single one.
        order: The targets in the order of the unknowns; empty for that of their first views.
        effects: Effects common to many views.
    """
    count = len(cam_from_target)
    (camera, observer), (target, single) = (name.split("_from_") for name in edge_names(mount))
    observed = tuple(targets) or (single,) * count
    targets = order or observed or (single,)
    unknown = {observer: Branch(camera), **{name: Branch(target) for name in targets}}
    return Problem(
        Tree(BASE, {FLANGE: Branch(BASE, robot=ROBOT), **unknown}),
        {ROBOT: base_from_flange},
        Observations(
            (observer,) * count,
            observed,
            np.arange(count) if stops is None else stops,
            np.full(count, -1),
            cam_from_target,
            np.zeros((count, 6, 6)) if covariance is None else covariance,
            np.ones(count, dtype=bool),
            np.full(count, covariance is None),
        ),
        tuple(effect for effect in effects if len(effect)),
        is_combined=covariance is None,
    )
