"""Scale error of poses that another program measured, by the robot's motion."""

import numpy as np

from visioncal.calibration.guess.fit import distance_rows
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Option, Remedy, mending


def distance_scale(
    parent_from_flange: FloatArray, cam_from_target: FloatArray, flange_from_seer: FloatArray
) -> Finding | None:
    """Estimates the scale error of measured distances.

    Args:
        parent_from_flange: (m, 4, 4) the robot's poses; their inverses for a static camera.
        cam_from_target: (m, 4, 4) measured poses.
        flange_from_seer: (4, 4) the camera's transform, of which the rotation is used.

    Returns:
        The finding; None where another scale does not explain nearly all of the misfit, as an
        arm's own errors leave more.
    """
    count = len(cam_from_target)
    if 3 * count < 14:
        return None
    rows, places = distance_rows(parent_from_flange, cam_from_target, flange_from_seer)
    a, seen = rows.reshape(-1, 7), places.reshape(-1)
    solution, _, rank, _ = np.linalg.lstsq(a, -seen)
    misfit = float(np.sum((seen + a @ solution) ** 2))
    unscaled, *_ = np.linalg.lstsq(a[:, :6], -seen - a[:, 6])
    unscaled_misfit = float(np.sum((seen + a[:, 6] + a[:, :6] @ unscaled) ** 2))
    is_determined = rank == 7 and solution[6] > 0.0
    if not is_determined or CLEAR_RATIO**2 * misfit > unscaled_misfit:
        return None
    scale = 1.0 / float(solution[6])
    variance = scale**4 * misfit / (3 * count - 7) * np.linalg.pinv(a.T @ a)[6, 6]
    return other_size(scale - 1.0, variance)


def scaling(first: str, factor: float, board: str = "") -> Remedy:
    """Advice to scale a board, of several by its name, after a measurement that comes first."""
    option = Option("board-scale", f"{f'{board}:' * bool(board)}{factor:.5g}")
    words = f"the board is {factor:.5g} times as large"
    return mending(words, option, f"{first}write", "; else check the arm.")


def other_size(share: float, variance: float, further: str = "") -> Finding:
    """The finding on a board that is larger by a share of some variance, with words beside it."""
    short, size = ("short", "larger") if share > 0.0 else ("long", "smaller")
    percent = f"{figure(100 * abs(share))} % (sigma {figure(100 * variance**0.5)} %)"
    return Finding(
        "board_size",
        f"By the robot's motion the board is {percent} {size} than the size by which a program "
        f"measured its poses: all distances in them (cft_) are too {short}.{further}",
        scaling("Measure the board with a caliper. If the robot is right, ", 1.0 + share),
        mahalanobis_sq=share**2 / max(variance, np.finfo(float).tiny),
    )
