"""Conventions and input checks of all closed-form hand-eye solvers.

A view i pairs a robot pose `R_i` with a camera pose `C_i = cam_from_target`. Two transforms are
unknown and obey `R_i @ X @ C_i = Z`:

- eye-in-hand: `R_i = base_from_flange`, `X = flange_from_cam`, `Z = base_from_target`;
- eye-to-hand: `R_i = flange_from_base`, `X = base_from_cam`, `Z = flange_from_target`.

Two views i and j eliminate Z: `A @ X = X @ B` with `A = inv(R_j) @ R_i`, `B = C_j @ inv(C_i)`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import TypeAlias

import numpy as np

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import counted
from visioncal.core.types import FloatArray

FEWEST_VIEWS = 2


@dataclass(frozen=True, eq=False)
class HandEye:
    """Both unknown transforms."""

    # (..., 4, 4) X: `flange_from_cam` (eye-in-hand) or `base_from_cam` (eye-to-hand) [m].
    x: FloatArray
    z: FloatArray  # (..., 4, 4) Z: `base_from_target` or `flange_from_target` [m].


Solver: TypeAlias = Callable[[FloatArray, FloatArray], HandEye]


def solver(solve: Solver) -> Solver:
    """Decorates a closed form with checks of its input.

    Args:
        solve: The closed form, of (..., m, 4, 4) robot poses `R_i` and `cam_from_target` of the
            same views [m]; it returns X and Z.

    Returns:
        The checked solver. It raises a DataError where shapes do not match or a pose has an entry
        that is not finite, and a DegenerateError for fewer than two views.
    """

    @wraps(solve)
    def checking(robot: FloatArray, camera: FloatArray) -> HandEye:
        return solve(*_checked(robot, camera))

    return checking


def _checked(robot: FloatArray, camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    robot, camera = np.asarray(robot, dtype=float), np.asarray(camera, dtype=float)
    if robot.shape != camera.shape or robot.ndim < 3 or robot.shape[-2:] != (4, 4):
        raise DataError(
            f"hand-eye: robot poses of shape {robot.shape} and camera poses of shape "
            f"{camera.shape} cannot be paired; both must be (views, 4, 4)."
        )
    if robot.shape[-3] < FEWEST_VIEWS:
        raise DegenerateError(
            f"hand-eye: {counted(robot.shape[-3], 'view', ('was', 'were'))} given; a relative "
            f"motion needs at least {FEWEST_VIEWS}, and a full solution 3 with two different "
            "rotation axes.",
            next_step="Add views that are tilted about different axes.",
        )
    if not (np.isfinite(robot).all() and np.isfinite(camera).all()):
        finite = (
            np.isfinite(robot + camera).all(axis=(-2, -1)).reshape(-1, robot.shape[-3]).all(axis=0)
        )
        rows = ", ".join(str(row) for row in np.flatnonzero(~finite))
        raise DataError(
            f"hand-eye: the poses in rows {rows} (counted from 0) are not finite numbers.",
            culprits=[f"row {row}" for row in np.flatnonzero(~finite)],
            next_step="Leave these views out, or mend their poses.",
        )
    return robot, camera
