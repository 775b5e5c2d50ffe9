"""One arm looks at a board in the hand of another: how the bases lie, else unknown.

Views say `u * first * v * second * w = seen`, with both arms' poses for first and second, and three
transforms unknown. Were one of them known, the two others would be a hand-eye calibration: each is
solved with the others as they were, in turn (as Wu, Wang, Qi and Ren 2016 iterate), from turns of
the bases all around.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.calibration.stages.pairwise import Candidates
from visioncal.core.transforms import compose, invert, rotation_angle
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.closed_form import SOLVERS

_FEWEST = 5
# Rounds of a start, how many starts are followed, and for how long.
_ROUNDS, _FOLLOWED, _LONG = 6, 4, 40
# A start is one where views lie within so much of what is predicted, rotations on a lever [m].
_NEAR_M = 0.02


def between_arms(
    first: FloatArray, second: FloatArray, candidates: Candidates
) -> tuple[FloatArray, float] | None:
    """Finds the transform in the middle.

    Args:
        first: (m, 4, 4) the arm's poses before it.
        second: (m, 4, 4) the other arm's, behind it.
        candidates: What each view allows of what was seen.

    Returns:
        (4, 4) v, and how far views are from it [m]; None where they are far.
    """
    if len(first) < _FEWEST or candidates.turns.max(initial=0) > 0:
        return None
    seen = candidates.poses[:, 0]
    starts = Rotation.create_group("O").as_matrix()
    found = []
    for turn in starts:
        middle, away = _alternated(first, second, seen, compose(turn, np.zeros(3)), _ROUNDS)
        found.append((away, middle))
    found.sort(key=lambda it: it[0])
    followed = [_alternated(first, second, seen, it, _LONG) for _, it in found[:_FOLLOWED]]
    middle, away = min(followed, key=lambda it: it[1])
    return (middle, away) if away < _NEAR_M else None


def _alternated(
    first: FloatArray, second: FloatArray, seen: FloatArray, middle: FloatArray, rounds: int
) -> tuple[FloatArray, float]:
    """Solves for two of the three in turn; returns the middle, and the views' median distance."""
    away = np.inf
    for _ in range(rounds):
        # u and w with v as it is; then v and w with u; then u and v with w.
        u_inverse, w = _park(invert(first @ middle @ second), seen)
        _, w = _park(invert(second), invert(first) @ u_inverse @ seen)
        u_inverse, middle = _park(invert(first), seen @ invert(w) @ invert(second))
        between = invert(invert(u_inverse) @ first @ middle @ second @ w) @ seen
        apart = np.linalg.norm(between[:, :3, 3], axis=1) + LEVER_M * rotation_angle(between)
        away = float(np.median(apart))
    return middle, away


def _park(robot: FloatArray, camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    solution = SOLVERS["park"](robot, camera)
    return solution.x, solution.z
