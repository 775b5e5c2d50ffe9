"""Which convention a table of joints was written in, by the poses that a controller reports."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.choices import Convention
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, invert, nearest_rotation, rotation_angle
from visioncal.core.types import FloatArray
from visioncal.robot.chain import IDENTITY_FUNCTION, chain_document
from visioncal.robot.kinematics import build_model, flange_poses
from visioncal.robot.model import Robot
from visioncal.robot.tables import DHTable, chain_of_table, table_from_document

# Two constant transforms have twelve unknowns; fewer rows fit anything.
_FEWEST_ROWS = 5
# The right convention misses by the arm's own errors, millimetres; a wrong one by link lengths.
_CLEARLY, _FITS = 3.0, 0.03
# Nobody reports poses any better [m].
_FINEST_M = 1e-6
_ROUNDS = 20


@dataclass(frozen=True)
class Recognised:
    """How well the conventions explain reported poses.

    Attributes:
        convention: The one that does; None where several do, or none.
        misfit_m: What each leaves, root mean square over the rows [m]; a rotation counts with a
            third of the arm's length.
    """

    convention: Convention | None
    misfit_m: Mapping[Convention, float]


def recognised_convention(
    table: DHTable, q: FloatArray, base_from_flange: FloatArray
) -> Recognised:
    """Says in which convention the numbers of a table explain reported poses.

    The same rows are read as standard and as modified; base and flange of the poses may be any
    constants, so the table's own play no part. With beta, the standard reading is Hayati's.

    Args:
        table: The table as declared.
        q: (m, n) joint angles [rad].
        base_from_flange: (m, 4, 4) the poses that the controller reported with them [m].

    Returns:
        The convention and each one's misfit. It is undecided where less than two parts in three of
        the misfit go away with the better one, as with too few or too similar poses.

    Raises:
        DataError: Rows are fewer than five, or do not belong together.
    """
    if q.shape != (len(base_from_flange), len(table)) or len(q) < _FEWEST_ROWS:
        raise DataError(
            f"robot {table.name}: at least {_FEWEST_ROWS} rows with {len(table)} joint angles and "
            f"a pose are needed, not {q.shape} angles and {len(base_from_flange)} poses.",
            culprits=[table.name],
        )
    length = float(np.abs(table.a_m).sum() + np.abs(table.d_m).sum())
    misfit = {
        reading.convention: _misfit(_poses(reading, q), base_from_flange, length / 3.0)
        for reading in _readings(table)
    }
    best, other = sorted(misfit, key=lambda it: misfit[it])
    distinct = misfit[other] > _CLEARLY * max(misfit[best], _FINEST_M)
    fits = misfit[best] < _FITS * length
    return Recognised(best if distinct and fits else None, misfit)


def other_convention(robot: Robot) -> tuple[Robot, Convention] | None:
    """The arm that the numbers of a robot's table are in the convention that was not declared.

    Its base and flange may be other constants than the table's.

    Returns:
        The arm and its convention; None where the robot is not described by a table.
    """
    if "convention" not in robot.document:
        return None
    declared = table_from_document(robot.document)
    standard, modified = _readings(declared)
    other = standard if declared.convention == "modified" else modified
    document = chain_document(robot.name, robot.tip, chain_of_table(other))
    return Robot.from_document(document), other.convention


def _readings(table: DHTable) -> tuple[DHTable, DHTable]:
    """The printed rows as both orders read them."""
    rows = slice(None, -1) if table.convention == "modified" else slice(1, None)
    columns = np.array([table.a_m, table.alpha_rad, table.beta_rad])[:, rows]
    bare = replace(
        table,
        base=np.eye(4),
        flange=np.eye(4),
        functions=np.tile(IDENTITY_FUNCTION, (len(table), 1)),
    )
    standard: Convention = "hayati" if table.convention == "hayati" else "standard"
    return (
        _with_across(replace(bare, convention=standard), np.pad(columns, ((0, 0), (1, 0)))),
        _with_across(replace(bare, convention="modified"), np.pad(columns, ((0, 0), (0, 1)))),
    )


def _with_across(table: DHTable, columns: FloatArray) -> DHTable:
    return replace(table, a_m=columns[0], alpha_rad=columns[1], beta_rad=columns[2])


def _poses(table: DHTable, q: FloatArray) -> FloatArray:
    chain = chain_of_table(table)
    return flange_poses(build_model(table.name, table.tip, chain), table.tip, q)


def _misfit(model: FloatArray, reported: FloatArray, lever_m: float) -> float:
    """What is left [m] of `reported = x @ model @ y` with the best constants x and y."""
    x, y = _constants(model, reported)
    away = invert(x @ model @ y) @ reported
    moved = np.sum(away[:, :3, 3] ** 2, axis=1) + (lever_m * rotation_angle(away)) ** 2
    return float(np.sqrt(np.mean(moved)))


def _constants(model: FloatArray, reported: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The x and y of `reported = x @ model @ y`, rotations first.

    The rotations solve `R S = X M` with S the inverse of y's, linear in the 18 entries of S and X
    (Zhuang, Roth and Sudhakar 1994, there in quaternions), and are then fitted in turns as
    orthogonal Procrustes problems; the positions are linear in what is left.
    """
    turned, rotations = reported[:, :3, :3], model[:, :3, :3]
    eye = np.broadcast_to(np.eye(3), rotations.shape)
    left = np.einsum("mij,mkl->mikjl", turned, eye).reshape(-1, 9)
    right = np.einsum("mij,mlk->mikjl", eye, rotations).reshape(-1, 9)
    both = np.hstack([left, -right])
    null = np.linalg.eigh(both.T @ both)[1][:, 0].reshape(2, 3, 3)
    null *= np.sign(np.linalg.det(null[1])) or 1.0
    s, x = nearest_rotation(null)
    for _ in range(_ROUNDS):
        x = nearest_rotation(np.sum(turned @ s @ np.swapaxes(rotations, 1, 2), axis=0))
        s = nearest_rotation(np.sum(np.swapaxes(turned, 1, 2) @ x @ rotations, axis=0))
    position = reported[:, :3, 3] - model[:, :3, 3] @ x.T
    design = np.concatenate([eye, x @ rotations], axis=2).reshape(-1, 6)
    solved = np.linalg.lstsq(design, position.ravel(), rcond=None)[0]
    return compose(x, solved[:3]), compose(s.T, solved[3:])
