"""Convex collision bodies of an arm's links and of its cell."""

import itertools
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable
from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray
from visioncal.robot.conversion import swing
from visioncal.robot.model import BODY_KEYS, Robot

Shape: TypeAlias = Literal["capsule", "cylinder", "box"]

# Default radius of links over the length of all links: 0.065 m for a UR5e, 0.09 m for a UR10e; its
# least is that of the motors [m].
_THICKNESS, _THINNEST_M = 0.05, 0.045
# Box around a camera with its lens and plug, and how far its centre is behind the lens [m].
_CAMERA_M, _CAMERA_BEHIND_M = np.array([0.1, 0.1, 0.1]), 0.03
# Shorter links are inside their neighbours, and get no body [m].
_SHORTEST_M = 0.01


@dataclass(frozen=True, eq=False)
class Body:
    """A convex body."""

    name: str  # Name for messages.
    link: int  # The joint with which it moves, from 1; 0 for one fixed to the base.
    shape: Shape  # Its shape.
    # (2,) radius and length of the axis (capsule and cylinder, along z) or (3,) full lengths (box)
    # [m]. A capsule's caps come on top of its length.
    size_m: FloatArray
    # (4, 4) pose of the body in the joint's frame after its motion, or in the base [m].
    link_from_body: FloatArray
    of_arm: bool = False  # Whether it is a part of the arm itself.
    # Additional distance to bodies that are not of the arm, for an uncertain pose [m].
    uncertainty_m: float = 0.0

    @property
    def extent_m(self) -> float:
        """Greatest distance of its points from its link's frame [m]."""
        if self.shape == "box":
            half = 0.5 * float(np.linalg.norm(self.size_m))
        else:
            half = float(self.size_m[0] + 0.5 * self.size_m[1])
        return half + float(np.linalg.norm(self.link_from_body[:3, 3]))

    def corners(self) -> FloatArray:
        """(8, 3) corners of a box, in the frame of its link [m]."""
        signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
        pose = self.link_from_body
        return np.asarray((signs * self.size_m) @ pose[:3, :3].T + pose[:3, 3])


def camera_body(link: int, link_from_cam: FloatArray, unsure_m: float = 0.0) -> Body:
    """Builds the box that a camera with its lens and plug fits into."""
    behind = compose(np.eye(3), np.array([0.0, 0.0, -_CAMERA_BEHIND_M]))
    return Body("camera", link, "box", _CAMERA_M, link_from_cam @ behind, uncertainty_m=unsure_m)


def capsule(
    name: str,
    link: int,
    start: FloatArray,
    end: FloatArray,
    radius_m: float,
    *,
    of_arm: bool = False,
    unsure_m: float = 0.0,
) -> Body:
    """Builds a capsule about the line between two points of a link's frame [m]."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    pose = swing(axis / length) if length > 0.0 else np.eye(4)
    pose[:3, 3] = 0.5 * (start + end)
    return Body(name, link, "capsule", np.array([radius_m, length]), pose, of_arm, unsure_m)


def body_name(robot: Robot, link: int) -> str:
    """Name of a link's bodies, from its joint."""
    return f"link {robot.joint_names[link - 1]}" if link else "base"


def arm_bodies(robot: Robot) -> tuple[Body, ...]:
    """The bodies of an arm's links.

    Each link is a capsule from its joint to the next one. A joint's table may state its link's
    `body_radius_m`, and an offset `body_offset_m` along the joint's axis: many arms have their
    upper arm beside the shoulder. By default the radius follows from the arm's length. The travel
    of a prismatic joint has no body. Links with boxes, cylinders, capsules or spheres in a URDF
    have these instead; meshes are not read.

    Returns:
        The bodies, from the base to the flange.

    Raises:
        DataError: A radius or an offset is not a number, or out of range.
    """
    from visioncal.robot.collision import urdf_bodies

    described, incomplete = (
        urdf_bodies(robot) if "urdf" in robot.document else ((), frozenset[int]())
    )
    complete = {body.link for body in described} - incomplete
    lengths = np.linalg.norm(robot.chain.placements[1:, :3, 3], axis=1)
    usual = max(_THINNEST_M, _THICKNESS * float(lengths.sum()))
    bodies = list(described)
    for link, (radius, offset) in enumerate(_thickness(robot, usual)):
        if link not in complete:
            bodies += _link(robot, link, radius, offset)
    return tuple(sorted(bodies, key=lambda body: body.link))


def _link(robot: Robot, link: int, radius_m: float, offset_m: float) -> list[Body]:
    """Capsules of one link; link 0 is before the first joint."""
    end = robot.chain.placements[link][:3, 3]
    offset = offset_m * robot.chain.axes[link - 1] if link else np.zeros(3)
    knots = [np.zeros(3), offset, end + offset, end] if offset_m else [np.zeros(3), end]
    name = body_name(robot, link)
    if np.abs(np.diff(knots, axis=0)).sum() < _SHORTEST_M:
        return []
    return [
        capsule(name, link, start, stop, radius_m, of_arm=True)
        for start, stop in itertools.pairwise(knots)
        if np.any(start != stop)
    ]


def _thickness(robot: Robot, usual_m: float) -> list[tuple[float, float]]:
    """Radius and offset of each link, the base first [m]."""
    rows = robot.document.get("joint", ())
    sizes = [(usual_m, 0.0)]
    for place, name in enumerate(robot.joint_names):
        content = rows[place] if place < len(rows) else {}
        row = DocumentTable(content, f"robot {robot.name}, joint {name}")
        radius = row.number(BODY_KEYS[0], usual_m, positive=True)
        offset = row.number(BODY_KEYS[1], 0.0)
        length = float(np.abs(robot.chain.placements[:, :3, 3]).sum())
        if max(radius, abs(offset)) > length:
            raise DataError(
                f"{row.label}: body_radius_m = {radius!r} and body_offset_m = {offset!r}; lengths "
                f"in metres, less than the arm's {length:.3g} m, are needed.",
                culprits=[row.label],
            )
        sizes.append((radius, offset))
    return sizes
