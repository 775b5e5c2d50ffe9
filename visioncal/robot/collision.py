"""Convex bodies of an arm and its cell, and distances between them, by Pinocchio and coal.

Only this module uses coal, which it imports when a cell is built.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias
from xml.etree import ElementTree

import numpy as np

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray, IntArray
from visioncal.robot.conversion import swing
from visioncal.robot.model import BODY_KEYS, Robot

if TYPE_CHECKING:
    import pinocchio as pin

Shape: TypeAlias = Literal["capsule", "cylinder", "box"]

# Box around a camera with its lens and plug, and how far its centre is behind the lens [m].
_CAMERA_M, _CAMERA_BEHIND_M = np.array([0.1, 0.1, 0.1]), 0.03
# Additional clearance of stops, so that paths between them can depart and arrive [m].
SLACK_M = 0.004
# Range of joints without limits, to either side [rad], [m].
_TURN_RAD, _TRAVEL_M = np.pi, 5.0


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
    described, incomplete = (
        urdf_bodies(robot) if "urdf" in robot.document else ((), frozenset[int]())
    )
    complete = {body.link for body in described} - incomplete
    lengths = np.linalg.norm(robot.chain.placements[1:, :3, 3], axis=1)
    # A link is 5 % of the arm's length thick, and at least as its motor [m].
    usual = max(0.045, 0.05 * float(lengths.sum()))
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
    # Shorter links are inside their neighbours [m].
    if np.abs(np.diff(knots, axis=0)).sum() < 0.01:
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
                f"{row.label}: body_radius_m = {radius!r} and body_offset_m = {offset!r}, but "
                f"must be in metres, and less than the arm's {length:.3g} m.",
                culprits=[row.label],
            )
        sizes.append((radius, offset))
    return sizes


@dataclass(frozen=True)
class LeftOut:
    """Two bodies whose distance is not checked, and why."""

    first: str
    second: str
    reason: str


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of bodies whose distances are checked."""

    # (k, 2) indices of the bodies, the one on the later link second; the index after the last body
    # is the floor.
    bodies: IntArray
    needed_m: FloatArray  # (k,) required distance [m].
    # (k, n) greatest motion of a point of one, seen from the other, for a unit of each joint's
    # effective position [m].
    levers: FloatArray


class Collisions:
    """Distances and contacts of an arm, its tool, and the bodies of its cell.

    Not checked are adjacent links, parts of the arm that are near one another by design, the first
    link against the arm's pedestal, and a tool against links that it is always near to.

    It holds Pinocchio's working memory, so each thread needs its own.

    Attributes:
        names: Names of both bodies of each checked pair.
        left_out: The pairs that are not checked, and why.
    """

    def __init__(
        self, robot: Robot, bodies: Sequence[Body], clearance_m: float, floor_m: float | None
    ) -> None:
        """Prepares the distances of a cell.

        Args:
            robot: The arm.
            bodies: Bodies of the arm, its tool and the cell.
            clearance_m: The required distance of all pairs [m].
            floor_m: Height of the floor in the base frame [m]; None for a cell without one.
        """
        import pinocchio as pin

        self._robot, self._model = robot, robot.pinocchio_model
        self._data: pin.Data = self._model.createData()
        self._geometry = _geometry(bodies, floor_m)
        names = [*(body.name for body in bodies), "floor"]
        pairs = _all_pairs(robot, bodies, clearance_m, floor_m is not None)
        self._set_pairs(pairs)
        self._pairs, self.left_out = self._checked_pairs(pairs, bodies, names)
        self._set_pairs(self._pairs)
        self.names = tuple((names[a], names[b]) for a, b in self._pairs.bodies)

    def first_contact(self, q: FloatArray) -> IntArray:
        """Finds the nearest pair of bodies that are too near at each of (m, n) joint angles [rad].

        Returns:
            (m,) index in `names`, by the clearance and the slack for paths to and from the posture;
            -1 where no pair is too near.
        """
        import pinocchio as pin

        contacts = np.full(len(q), -1, dtype=np.int64)
        for row, positions in enumerate(self._robot.chain.effective(np.asarray(q, dtype=float))):
            touching = pin.computeCollisions(
                self._model, self._data, self._geometry, self._memory, positions, True
            )
            if touching:
                margin_m = self._distances(positions) - self._pairs.needed_m
                contacts[row] = int(margin_m.argmin())
        return contacts

    def distances(self, q: FloatArray) -> FloatArray:
        """Distances (k,) of the pairs in `names` at (n,) joint angles; negative inside [m]."""
        return self._distances(self._robot.chain.effective(np.asarray(q, dtype=float)[None])[0])

    def needed_m(self) -> FloatArray:
        """Required distances (k,) of the pairs in `names` [m]."""
        return self._pairs.needed_m.copy()

    def path_contact(self, start: FloatArray, end: FloatArray) -> int:
        """Finds a pair of bodies that come too near while all joints move linearly.

        Conservative advancement (Mirtich 1996): the step from each posture to the next is bounded
        so that no pair can use up its margin in between. So the clearance is kept everywhere, not
        only at samples.

        Returns:
            Index in `names` of the first pair that comes too near; -1 for a clear path.
        """
        begin, stop = self._robot.chain.effective(np.array([start, end], dtype=float))
        needed = self._pairs.needed_m
        # A joint's eccentricity makes it faster than its encoder by so much at most.
        speeds = 1.02 * self._pairs.levers @ np.abs(stop - begin)
        fraction = 0.0
        while True:
            margin_m = self._distances(begin + fraction * (stop - begin)) - needed
            worst = int(margin_m.argmin()) if len(margin_m) else -1
            if worst >= 0 and margin_m[worst] < 0.5 * SLACK_M:
                return worst
            if fraction == 1.0:
                return -1
            moving = speeds > 0.0
            fraction = min(
                1.0, fraction + float(np.min(margin_m[moving] / speeds[moving], initial=1.0))
            )

    def _distances(self, positions: FloatArray) -> FloatArray:
        import pinocchio as pin

        pin.computeDistances(self._model, self._data, self._geometry, self._memory, positions)
        return np.array([result.min_distance for result in self._memory.distanceResults])

    def _set_pairs(self, pairs: _Pairs) -> None:
        """Sets the pairs that Pinocchio checks."""
        import pinocchio as pin

        self._geometry.removeAllCollisionPairs()
        for first, second in pairs.bodies.tolist():
            self._geometry.addCollisionPair(pin.CollisionPair(first, second))
        self._memory: pin.GeometryData = self._geometry.createData()
        for place, needed in enumerate(pairs.needed_m.tolist()):
            self._memory.collisionRequests[place].security_margin = needed + SLACK_M

    def _checked_pairs(
        self, pairs: _Pairs, bodies: Sequence[Body], names: Sequence[str]
    ) -> tuple[_Pairs, tuple[LeftOut, ...]]:
        """The pairs to check, and those to leave out."""
        rng = np.random.default_rng(0)
        chain = self._robot.chain
        range_ = np.where(chain.prismatic, _TRAVEL_M, _TURN_RAD)
        lower, upper = np.maximum(chain.lower, -range_), np.minimum(chain.upper, range_)
        postures = chain.effective(rng.uniform(lower, upper, (300, len(chain))))
        margin_m = np.array([self._distances(posture) for posture in postures]) - pairs.needed_m
        near_share = (margin_m < SLACK_M).mean(axis=0)
        kinds = [(body.of_arm, body.link > 0, body.link == 1) for body in bodies]
        pair_kinds = np.array([*kinds, (False, False, False)])[pairs.bodies]
        of_arm, moving, _ = np.asarray(pair_kinds.all(axis=1)).T
        on_first_link = pair_kinds[..., 2].any(axis=1)
        # A cell body that a later link touches in every posture is an error, and must be reported.
        always_near = (near_share == 1.0) & (of_arm | moving | on_first_link)
        # Parts that are near in a larger share of postures are so by design: the joints' limits
        # keep them apart, which the coarse capsules do not show.
        excluded = always_near | (of_arm & (near_share > 0.2))
        left_out = tuple(
            LeftOut(names[a], names[b], f"too near in {100 * share:.0f} % of all postures")
            for (a, b), share in zip(
                pairs.bodies[excluded].tolist(), near_share[excluded].tolist(), strict=True
            )
        )
        kept = _Pairs(pairs.bodies[~excluded], pairs.needed_m[~excluded], pairs.levers[~excluded])
        return kept, left_out


def _all_pairs(robot: Robot, bodies: Sequence[Body], clearance_m: float, floor: bool) -> _Pairs:
    """All pairs of bodies that move relative to one another, without adjacent links."""
    found_pairs: list[tuple[int, int]] = []
    needed: list[float] = []
    order = sorted(range(len(bodies)), key=lambda index: bodies[index].link)
    for at, a in enumerate(order):
        for b in order[at + 1 :]:
            links_between = bodies[b].link - bodies[a].link
            if links_between == 0 or (links_between == 1 and bodies[a].of_arm and bodies[b].of_arm):
                continue
            uncertainty_m = np.hypot(bodies[a].uncertainty_m, bodies[b].uncertainty_m)
            found_pairs.append((a, b))
            needed.append(clearance_m + (uncertainty_m if bodies[a].link == 0 else 0.0))
    if floor:
        moving = [index for index in order if bodies[index].link > 0]
        found_pairs += [(len(bodies), index) for index in moving]
        needed += [clearance_m + bodies[index].uncertainty_m for index in moving]
    links = np.array([*(body.link for body in bodies), 0])
    pairs = np.array(found_pairs, dtype=np.int64).reshape(-1, 2)
    levers = [_levers(robot, links[a], bodies[b]) for a, b in pairs.tolist()]
    return _Pairs(pairs, np.array(needed), np.array(levers).reshape(-1, len(robot.chain)))


def _levers(robot: Robot, before: int, body: Body) -> FloatArray:
    """Greatest motion (n,) of a body's points, seen from an earlier link, per joint [m]."""
    chain = robot.chain
    lengths = np.linalg.norm(chain.placements[:-1, :3, 3], axis=1)
    travel = np.maximum(np.abs(chain.lower), np.abs(chain.upper))
    lengths += np.where(chain.prismatic, np.where(np.isfinite(travel), travel, _TRAVEL_M), 0.0)
    levers = np.zeros(len(chain))
    lever = body.extent_m
    for joint in range(body.link - 1, before - 1, -1):
        levers[joint] = 1.0 if chain.prismatic[joint] else lever
        lever += float(lengths[joint])
    return levers


def _geometry(bodies: Sequence[Body], floor_m: float | None) -> "pin.GeometryModel":
    """Pinocchio's geometry model of the bodies, the floor last."""
    import coal
    import pinocchio as pin

    shapes = {"box": coal.Box, "capsule": coal.Capsule, "cylinder": coal.Cylinder}
    model = pin.GeometryModel()
    for index, body in enumerate(bodies):
        pose, shape = pin.SE3(body.link_from_body), shapes[body.shape](*body.size_m.tolist())
        item = pin.GeometryObject(f"{index} {body.name}", body.link, pose, shape)
        model.addGeometryObject(item)
    if floor_m is not None:
        below = coal.Halfspace(np.array([0.0, 0.0, 1.0]), floor_m)
        model.addGeometryObject(pin.GeometryObject("floor", 0, pin.SE3.Identity(), below))
    return model


def urdf_bodies(robot: Robot) -> tuple[tuple[Body, ...], frozenset[int]]:
    """Collision boxes, cylinders and spheres of a URDF.

    Returns:
        The bodies, and the links that have meshes, which are not read.
    """
    import pinocchio as pin

    root = ElementTree.fromstring(robot.document["urdf"])
    with_meshes = set()
    for link in root.findall("link"):
        for collision in link.findall("collision"):
            shape = collision.find("geometry")
            if shape is None or all(
                shape.find(name) is None for name in ("box", "cylinder", "sphere")
            ):
                link.remove(collision)
                with_meshes.add(link.get("name"))
    text = ElementTree.tostring(root, encoding="unicode")
    model = pin.buildModelFromXML(text)
    geometry = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    numbers = {name: number for number, name in enumerate(robot.joint_names, start=1)}
    others = [joint for joint in range(1, model.njoints) if model.names[joint] not in numbers]
    model, reduced = pin.buildReducedModel(model, [geometry], others, pin.neutral(model))
    bodies = [
        _body(item, numbers.get(model.names[item.parentJoint], 0), robot)
        for item in reduced[0].geometryObjects
    ]
    incomplete = {
        numbers.get(model.names[frame.parentJoint], 0)
        for frame in model.frames
        if frame.name in with_meshes
    }
    return tuple(bodies), frozenset(incomplete)


def _body(item: "pin.GeometryObject", link: int, robot: Robot) -> Body:
    name, pose, form = body_name(robot, link), item.placement.homogeneous, item.geometry
    if type(form).__name__ == "Box":
        return Body(name, link, "box", 2.0 * np.asarray(form.halfSide), pose, of_arm=True)
    if type(form).__name__ == "Cylinder":
        size = np.array([form.radius, 2.0 * form.halfLength])
        return Body(name, link, "cylinder", size, pose, of_arm=True)
    return Body(name, link, "capsule", np.array([form.radius, 0.0]), pose, of_arm=True)
