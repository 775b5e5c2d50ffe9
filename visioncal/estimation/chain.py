"""The problem of one robot and one camera: a chain of frames with a robot in it.

    eye-in-hand   base -> flange -> cam,  base -> target
    eye-to-hand   base -> flange -> target,  base -> cam

A measuring instrument that reads a probe on the flange is a camera that stands still, and the probe
its target.
"""

from collections.abc import Sequence

import numpy as np

from visioncal.core.transforms import distances, invert, mean_transform
from visioncal.core.types import FloatArray, IntArray, Mount
from visioncal.estimation.parts import ROBOT, Effect, Observations, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.tree import Branch, Tree

BASE, FLANGE = "base", "flange"


def edge_names(mount: Mount) -> tuple[str, str]:
    """Names of the edges that place the camera and an only target."""
    if mount == "instrument":
        return "base_from_instrument", "flange_from_probe"
    if mount == "eye-in-hand":
        return "flange_from_cam", "base_from_target"
    return "base_from_cam", "flange_from_target"


def robot_part(base_from_flange: FloatArray, mount: Mount) -> FloatArray:
    """The robot's part (m, 4, 4) of the chain `robot * x * camera = z`."""
    return base_from_flange if mount == "eye-in-hand" else invert(base_from_flange)


def scatter(problem: Problem, others: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """How far observations place their targets from where others do on average.

    Args:
        problem: The n observations.
        others: Those that they are compared with, of the same targets.
        state: The unknowns of both.

    Returns:
        (n,) distances [m], and (n,) [rad].
    """
    placed, among = _placed(others, state), np.array(others.observations.observed)
    mean = {
        value: mean_transform(placed[among == value]) for value in dict.fromkeys(among.tolist())
    }
    return distances(
        _placed(problem, state), np.array([mean[name] for name in problem.observations.observed])
    )


def _placed(problem: Problem, state: State) -> FloatArray:
    """(n, 4, 4) where each observation places its target, in the frame that this hangs on."""
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
    """Puts the problem of one robot and one camera.

    Args:
        mount: Where the camera is.
        base_from_flange: (s, 4, 4) where the robot was, at each stop.
        cam_from_target: (m, 4, 4) what the views measured.
        covariance: (m, 6, 6) of its right perturbations; None where nothing is known of it.
        stops: (m,) the stop of each view, numbered from 0; None where each has its own.
        targets: (m,) the frame of the target that each view shows; empty for an only one.
        order: The targets in the order of the unknowns; empty for that of their first views.
        effects: What moves views together.
    """
    count = len(cam_from_target)
    (camera, observer), (target, only) = (name.split("_from_") for name in edge_names(mount))
    observed = tuple(targets) or (only,) * count
    targets = order or observed or (only,)
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
