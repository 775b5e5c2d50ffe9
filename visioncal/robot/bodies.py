"""What takes up room in a cell: convex bodies that hang on an arm's links or stand in its base."""

import itertools
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable
from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray
from visioncal.robot.model import BODY_KEYS, Robot

Shape: TypeAlias = Literal["capsule", "cylinder", "box"]

# Radius of the links over the length of all links: 0.065 m for a UR5e, 0.09 m for a UR10e. Small
# arms are not thinner than the motors in them [m].
_THICKNESS, _THINNEST_M = 0.05, 0.045
# Links that are shorter lie inside their neighbours [m].
_SHORTEST_M = 0.01


@dataclass(frozen=True, eq=False)
class Body:
    """A convex body.

    Attributes:
        name: What it is, for messages.
        link: The joint with which it moves, counted from 1; 0 for what stands in the base.
        shape: Its form.
        size_m: (2,) radius and length of the axis (capsule and cylinder, along z) or (3,) full
            lengths (box) [m]. A capsule's caps come on top of its length.
        link_from_body: (4, 4) the body's centre in the joint's frame after its motion, or in the
            base [m].
        of_arm: Whether it is a part of the arm itself.
        unsure_m: How much farther than others it stays from what is not of the arm: where it is,
            is only guessed [m].
    """

    name: str
    link: int
    shape: Shape
    size_m: FloatArray
    link_from_body: FloatArray
    of_arm: bool = False
    unsure_m: float = 0.0

    @property
    def extent_m(self) -> float:
        """Greatest distance of its points from the frame that it hangs on [m]."""
        if self.shape == "box":
            half = 0.5 * float(np.linalg.norm(self.size_m))
        else:
            half = float(self.size_m[0] + 0.5 * self.size_m[1])
        return half + float(np.linalg.norm(self.link_from_body[:3, 3]))


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
    """A capsule about the line between two points of a link's frame [m]."""
    between = end - start
    length = float(np.linalg.norm(between))
    along_z = _turned_to(between / length) if length > 0.0 else np.eye(3)
    pose = compose(along_z, 0.5 * (start + end))
    return Body(name, link, "capsule", np.array([radius_m, length]), pose, of_arm, unsure_m)


def body_name(robot: Robot, link: int) -> str:
    """What the bodies of a link are called; a link has the name of its joint."""
    return f"link {robot.joint_names[link - 1]}" if link else "base"


def arm_bodies(robot: Robot) -> tuple[Body, ...]:
    """The bodies of an arm's links.

    Each link is a capsule from its joint to the next one. A joint's table may say how thick its
    link is, `body_radius_m`, and that it runs aside, `body_offset_m` along the joint's axis: many
    arms have their upper arm beside the shoulder. Else the radius follows from the arm's length.
    The way on which a prismatic joint slides is left out. A URDF's boxes, cylinders, capsules and
    spheres are taken as they are, for the links that have some; its meshes are files elsewhere.

    Returns:
        The bodies, from the base to the flange.

    Raises:
        DataError: A radius or an offset is not a number, or out of range.
    """
    from visioncal.robot.collision import urdf_bodies

    own, undrawn = urdf_bodies(robot) if "urdf" in robot.document else ((), frozenset[int]())
    drawn = {body.link for body in own} - undrawn
    lengths = np.linalg.norm(robot.chain.placements[1:, :3, 3], axis=1)
    usual = max(_THINNEST_M, _THICKNESS * float(lengths.sum()))
    bodies = list(own)
    for link, (radius, offset) in enumerate(_thickness(robot, usual)):
        if link not in drawn:
            bodies += _link(robot, link, radius, offset)
    return tuple(sorted(bodies, key=lambda body: body.link))


def _link(robot: Robot, link: int, radius_m: float, offset_m: float) -> list[Body]:
    """The capsules of one link, 0 for what stands before the first joint."""
    end = robot.chain.placements[link][:3, 3]
    aside = offset_m * robot.chain.axes[link - 1] if link else np.zeros(3)
    knots = [np.zeros(3), aside, end + aside, end] if offset_m else [np.zeros(3), end]
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
    found = [(usual_m, 0.0)]
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
        found.append((radius, offset))
    return found


def _turned_to(direction: FloatArray) -> FloatArray:
    """A rotation (3, 3) that takes z to a unit vector."""
    aside = np.eye(3)[int(np.argmin(np.abs(direction)))]
    x = np.cross(aside, direction)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(direction, x), direction], axis=1)
