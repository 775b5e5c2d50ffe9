"""Jacobians of a joint table's numbers over the geometry, and of the arm over the numbers.

Both follow from the 6 x 5 Jacobian of each row's `Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)` over
its five numbers. Four of them and a screw about the next axis, which goes into the next row, span
all motions; so each row takes its part of a link's motion and passes on the screw, as `table_of`
does with finite motions.
"""

import numpy as np

from visioncal.core.transforms import adjoint, exp, invert
from visioncal.core.types import FloatArray
from visioncal.robot.chain import Chain
from visioncal.robot.conversion import EXACTLY, chain_about_z, swing
from visioncal.robot.model import Robot
from visioncal.robot.tables import DHTable, about_x

# The numbers of a row, in the order of the Jacobians' last axis.
ROW_NAMES = ("theta", "d", "a", "alpha", "beta")
_THETA, _D, _A, _ALPHA, _BETA = range(5)
# Rotation about and translation along z in a twist.
_Z = [2, 5]


def table_jacobian(
    robot: Robot, table: DHTable, placements: FloatArray, functions: FloatArray
) -> FloatArray:
    """Derivatives of a robot's table over its geometry.

    Args:
        robot: The robot.
        table: `table_of(robot, ..., like=...)`.
        placements: (p, n + 1, 6) twists of the placements, as `Robot.corrected` takes them.
        functions: (p, n, 4) changes of the joints' functions that go with them.

    Returns:
        (p, n, 5) derivatives of theta, d, a, alpha and beta of each Z_i X_i [rad and m]. Numbers
        that the convention fixes have zeros: beta or d, and a and alpha after the last axis, where
        the flange takes all but the screw about it.
    """
    count, chain = len(table), robot.chain
    twists = _twists_about_z(chain, placements, functions)
    derivatives = np.zeros((len(placements), count, 5))
    frames = chain_about_z(chain.with_offsets_placed()).placements
    along = table.along_z @ table.along_x[1:]
    # (4, 4) the screw that each row, the first of the base, leaves to the next axis.
    rest = invert(table.base @ table.along_x[0]) @ frames[0]
    # The screw about the next axis that a row passes on, (p, 2).
    screw = (twists[:, 0] @ adjoint(rest).T)[:, _Z]
    for row in range(count - 1):
        link = twists[:, row + 1] + screw @ adjoint(invert(frames[row + 1]))[:, _Z].T
        rest = invert(along[row]) @ rest @ frames[row + 1]
        free = _free_columns(table, row)
        basis = np.concatenate([_row_jacobian(table, row)[:, free], np.eye(6)[:, _Z]], axis=1)
        motion = link @ adjoint(rest).T
        solution = np.linalg.lstsq(basis, motion.T, rcond=None)[0].T
        derivatives[:, row, free], screw = solution[:, :-2], solution[:, -2:]
    last = twists[:, count] + screw @ adjoint(invert(frames[-1]))[:, _Z].T
    across = about_x(table.a_m[-1], table.alpha_rad[-1], table.beta_rad[-1])
    derivatives[:, -1, [_THETA, _D]] = (last @ adjoint(across @ table.flange).T)[:, _Z]
    return derivatives


def _twists_about_z(chain: Chain, placements: FloatArray, functions: FloatArray) -> FloatArray:
    """Twists (p, n + 1, 6) including function offsets, in frames with z along the axes."""
    twists = np.array(placements)
    # A joint's offset comes after the twist of its frame.
    placed = exp(chain.twists * chain.functions[:, :1])
    twists[:, :-1] = np.einsum("nij,pnj->pni", adjoint(invert(placed)), twists[:, :-1])
    twists[:, :-1] += functions[:, :, :1] * chain.twists
    turns = np.array([*map(swing, chain.axes), np.eye(4)])
    return np.asarray(np.einsum("nij,pnj->pni", adjoint(invert(turns)), twists))


def _row_jacobian(table: DHTable, row: int) -> FloatArray:
    """Jacobian (6, 5) of Z_i X_i over theta, d, a, alpha and beta."""
    a, alpha, beta = table.a_m[row + 1], table.alpha_rad[row + 1], table.beta_rad[row + 1]
    zero = np.zeros(())
    behind_z, behind_a = about_x(a, alpha, beta), about_x(zero, alpha, beta)
    about_y = about_x(zero, zero, beta)
    along_z, along_x = adjoint(invert(behind_z)), adjoint(invert(behind_a))
    columns = [
        along_z[:, 2],
        along_z[:, 5],
        along_x[:, 3],
        adjoint(invert(about_y))[:, 0],
        np.eye(6)[:, 1],
    ]
    return np.stack(columns, axis=1)


def _free_columns(table: DHTable, row: int) -> list[int]:
    """Numbers of a row that are free; the convention fixes others, or they are unidentifiable."""
    # Between exactly parallel axes d is fixed, and theta too where the axes coincide.
    has_beta = bool(table.parallel[row + 1])
    alpha, beta = table.alpha_rad[row + 1], table.beta_rad[row + 1]
    next_axis = about_x(np.zeros(()), alpha, beta)[:3, 2]
    if not has_beta and np.hypot(next_axis[0], next_axis[1]) >= EXACTLY:
        return [_THETA, _D, _A, _ALPHA]
    turning = [] if abs(float(table.a_m[row + 1])) < EXACTLY else [_THETA]
    return [*turning, _A, *([_ALPHA, _BETA] if has_beta else [])]
