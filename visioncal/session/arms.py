"""The robots of a session: the models of one, or of several by their names."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from visioncal.core.errors import DataError
from visioncal.robot import Robot, read_robot_document
from visioncal.session.document import Declaration
from visioncal.session.outside import outside_file, without_content
from visioncal.session.tables import RobotTable


def read_robots(
    declaration: Declaration, folder: Path | None, document: Mapping[str, Any] | None
) -> tuple[Mapping[str, Any] | None, list[str]]:
    """Reads the models of the robots that a session declares.

    Args:
        declaration: What it declares.
        folder: Relative paths start here; the working directory where None.
        document: The content of the robot's file, where that is known already; of several robots,
            the contents by their names.

    Returns:
        The model, of several the models by name, None where none is known; and in words, why a
        model is not known.
    """
    several = len(declaration.robots) > 1
    if document is not None:
        return document, []
    found, problems = {}, []
    for name, table in declaration.named("robot").items():
        if not isinstance(table, RobotTable) or table.model is None:
            continue
        try:
            found[name] = _read(table, table.model, folder)
        except DataError as error:
            path = f"robots.{name}" if name else "robot"
            problems.append(f"session.toml: {path}.model: {error}")
    if several:
        return found or None, problems
    return next(iter(found.values()), None), problems


def _read(table: RobotTable, model: str, folder: Path | None) -> dict[str, Any]:
    with without_content(model, "model", folder):
        document = read_robot_document(model, tip=table.tip, folder=folder)
        if outside_file(model, "model", folder) is not None:
            # What is no robot is not taken into recordings.
            Robot.from_document(document)
    if table.gravity_m_s2 is not None:
        document |= {"gravity_m_s2": table.gravity_m_s2}
    return document
