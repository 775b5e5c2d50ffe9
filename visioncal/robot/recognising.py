"""Which convention a table of joints was written in, by the poses that a controller reports."""

from dataclasses import replace

import numpy as np

from visioncal.core.choices import Convention
from visioncal.core.types import FloatArray
from visioncal.robot.chain import IDENTITY_FUNCTION, chain_document
from visioncal.robot.model import Robot
from visioncal.robot.tables import DHTable, chain_of_table, table_from_document


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
