"""The same arm with other inertias of its links."""

from typing import Any

import numpy as np

from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.robot.chain import chain_document
from visioncal.robot.inertia import Inertias
from visioncal.robot.model import Robot
from visioncal.robot.tables import row_frames, table_from_document


def with_inertias(robot: Robot, inertias: Inertias) -> Robot:
    """Builds an arm whose links weigh otherwise.

    Args:
        robot: The arm. A table or a chain stays one; a URDF becomes a chain.
        inertias: Of its links, in the joints' frames.

    Returns:
        The arm, whose document states the masses, their centres and the inertias.
    """
    if "convention" in robot.document:
        document = dict(robot.document)
        joint_from_row = row_frames(table_from_document(document))
    else:
        document = robot.weighted(chain_document(robot.name, robot.tip, robot.chain))
        joint_from_row = np.broadcast_to(np.eye(4), (robot.joint_count, 4, 4))
    rows = zip(document["joint"], _seen_from(inertias, joint_from_row).rows(), strict=True)
    joints: list[dict[str, Any]] = [{**row, **own} for row, own in rows]
    return Robot.from_document(document | {"joint": joints})


def _seen_from(inertias: Inertias, joint_from_row: FloatArray) -> Inertias:
    """The inertias in other frames of the same links."""
    row_from_joint = invert(joint_from_row)
    rotation, place = row_from_joint[:, :3, :3], row_from_joint[:, :3, 3]
    masses = inertias.masses
    centres = (rotation @ masses.centres_m[:, :, None])[:, :, 0] + place
    about = rotation @ inertias.about_centres @ np.swapaxes(rotation, 1, 2)
    return Inertias.of_bodies(masses.kg, centres, about)
