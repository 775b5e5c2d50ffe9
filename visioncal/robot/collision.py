"""Distances between the bodies of an arm and what stands around it: Pinocchio's, with coal.

This is the only module that knows coal, and it imports it when a cell is built.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from visioncal.core.types import FloatArray, IntArray
from visioncal.robot.bodies import Body, body_name
from visioncal.robot.model import Robot

if TYPE_CHECKING:
    import coal
    import pinocchio as pin

# Stops keep so much more than the clearance, so that ways between them can leave and arrive [m].
SLACK_M = 0.004
# Postures by which parts that are always near one another are separated from those that may meet.
_SAMPLES = 300
# Parts of an arm that are near one another in a larger share of all postures are so by design;
# joint limits keep them apart, and thick capsules do not show it.
_OFTEN = 0.2
# What counts as a joint's range where it has no limits [rad], [m].
_TURN_RAD, _TRAVEL_M = np.pi, 5.0
# What a joint's eccentricity may add to its speed.
_FASTER = 1.02


@dataclass(frozen=True)
class LeftOut:
    """Two bodies whose distance is not looked at, and why."""

    first: str
    second: str
    reason: str


@dataclass(frozen=True, eq=False)
class _Pairs:
    """What is kept apart: pairs of bodies, by their places in the list of bodies.

    Attributes:
        bodies: (k, 2) places, the one on the later link second; one more than the last place is
            the floor.
        needed_m: (k,) distance that they keep [m].
        levers: (k, n) how far a point of one moves, seen from the other, for a unit of each
            joint's effective position, at most [m].
    """

    bodies: IntArray
    needed_m: FloatArray
    levers: FloatArray


class Collisions:
    """An arm with what it carries, and what stands around it.

    Links that follow one another are not kept apart, nor parts of the arm that are near one another
    by design, nor the first link from what the arm stands on, nor what it carries from the link
    that it is always near to.

    It holds Pinocchio's working memory: one object a thread.

    Attributes:
        names: For each pair that is kept apart, the names of both.
        left_out: The pairs that are not, and why.
    """

    def __init__(
        self, robot: Robot, bodies: Sequence[Body], clearance_m: float, floor_m: float | None
    ) -> None:
        """Prepares the distances of a cell.

        Args:
            robot: The arm.
            bodies: All bodies: those of the arm, what it carries, and what stands in the cell.
            clearance_m: The distance that all keep [m].
            floor_m: Height of the floor in the base frame [m]; None for a cell without one.
        """
        import pinocchio as pin

        self._robot, self._model = robot, robot.pinocchio_model
        self._data: pin.Data = self._model.createData()
        self._geometry = _geometry(bodies, floor_m)
        names = [*(body.name for body in bodies), "floor"]
        pairs = _all_pairs(robot, bodies, clearance_m, floor_m is not None)
        self._watch(pairs)
        self._pairs, self.left_out = self._sifted(pairs, bodies, names)
        self._watch(self._pairs)
        self.names = tuple((names[a], names[b]) for a, b in self._pairs.bodies)

    def first_contact(self, q: FloatArray) -> IntArray:
        """Looks for bodies that are too near one another.

        Args:
            q: (m, n) joint angles [rad].

        Returns:
            (m,) the place in `names` of a pair that is nearer than the clearance, with a little
            more for the ways to and from the posture; -1 where there is none.
        """
        import pinocchio as pin

        found = np.full(len(q), -1, dtype=np.int64)
        for row, positions in enumerate(self._robot.chain.effective(np.asarray(q, dtype=float))):
            touching = pin.computeCollisions(
                self._model, self._data, self._geometry, self._memory, positions, True
            )
            if touching:
                margin_m = self._distances(positions) - self._pairs.needed_m
                found[row] = int(margin_m.argmin())
        return found

    def distances(self, q: FloatArray) -> FloatArray:
        """Distances (k,) of the pairs in `names` at (n,) joint angles, below zero inside [m]."""
        return self._distances(self._robot.chain.effective(np.asarray(q, dtype=float)[None])[0])

    def needed_m(self) -> FloatArray:
        """Distances (k,) that the pairs in `names` keep [m]."""
        return self._pairs.needed_m.copy()

    def on_the_way(self, start: FloatArray, end: FloatArray) -> int:
        """Looks for bodies that come too near one another while all joints move evenly.

        Conservative advancement (Mirtich 1996): from each posture the next one that is looked at
        is so near that no pair can use up, in between, what it has left. So the clearance is kept
        everywhere, not only at samples.

        Args:
            start: (n,) joint angles [rad].
            end: (n,) joint angles [rad].

        Returns:
            The place in `names` of the first pair in the way; -1 for a clear way.
        """
        begin, stop = self._robot.chain.effective(np.array([start, end], dtype=float))
        needed = self._pairs.needed_m
        speeds = _FASTER * self._pairs.levers @ np.abs(stop - begin)
        at = 0.0
        while True:
            left = self._distances(begin + at * (stop - begin)) - needed
            worst = int(left.argmin()) if len(left) else -1
            if worst >= 0 and left[worst] < 0.5 * SLACK_M:
                return worst
            if at == 1.0:
                return -1
            moving = speeds > 0.0
            at = min(1.0, at + float(np.min(left[moving] / speeds[moving], initial=1.0)))

    def _distances(self, positions: FloatArray) -> FloatArray:
        import pinocchio as pin

        pin.computeDistances(self._model, self._data, self._geometry, self._memory, positions)
        return np.array(
            [distanceresult.min_distance for distanceresult in self._memory.distanceResults]
        )

    def _watch(self, pairs: _Pairs) -> None:
        """Makes these the pairs that are looked at."""
        import pinocchio as pin

        self._geometry.removeAllCollisionPairs()
        for first, second in pairs.bodies.tolist():
            self._geometry.addCollisionPair(pin.CollisionPair(first, second))
        self._memory: pin.GeometryData = self._geometry.createData()
        for place, needed in enumerate(pairs.needed_m.tolist()):
            self._memory.collisionRequests[place].security_margin = needed + SLACK_M

    def _sifted(
        self, pairs: _Pairs, bodies: Sequence[Body], names: Sequence[str]
    ) -> tuple[_Pairs, tuple[LeftOut, ...]]:
        """The pairs that can be kept apart, and the others."""
        rng = np.random.default_rng(0)
        chain = self._robot.chain
        most = np.where(chain.prismatic, _TRAVEL_M, _TURN_RAD)
        lower, upper = np.maximum(chain.lower, -most), np.minimum(chain.upper, most)
        postures = chain.effective(rng.uniform(lower, upper, (_SAMPLES, len(chain))))
        margin_m = np.array([self._distances(posture) for posture in postures]) - pairs.needed_m
        often = (margin_m < SLACK_M).mean(axis=0)
        parts = np.array([*(body.of_arm for body in bodies), False])[pairs.bodies].all(axis=1)
        carried = np.array([*(body.link > 0 for body in bodies), False])[pairs.bodies].all(axis=1)
        stands = np.array([*(body.link == 1 for body in bodies), False])[pairs.bodies].any(axis=1)
        # What a later link touches in every posture is an error of the cell, which must show.
        never = (often == 1.0) & (parts | carried | stands)
        out = never | (parts & (often > _OFTEN))
        left = tuple(
            LeftOut(names[a], names[b], f"too near in {100 * share:.0f} % of all postures")
            for (a, b), share in zip(pairs.bodies[out].tolist(), often[out].tolist(), strict=True)
        )
        kept = _Pairs(pairs.bodies[~out], pairs.needed_m[~out], pairs.levers[~out])
        return kept, left


def _all_pairs(robot: Robot, bodies: Sequence[Body], clearance_m: float, floor: bool) -> _Pairs:
    """All pairs of bodies that move against one another, but for links that share a joint."""
    found: list[tuple[int, int]] = []
    needed: list[float] = []
    places = sorted(range(len(bodies)), key=lambda place: bodies[place].link)
    for at, a in enumerate(places):
        for b in places[at + 1 :]:
            apart = bodies[b].link - bodies[a].link
            if apart == 0 or (apart == 1 and bodies[a].of_arm and bodies[b].of_arm):
                continue
            unsure = np.hypot(bodies[a].unsure_m, bodies[b].unsure_m)
            found.append((a, b))
            needed.append(clearance_m + (unsure if bodies[a].link == 0 else 0.0))
    if floor:
        moving = [place for place in places if bodies[place].link > 0]
        found += [(len(bodies), place) for place in moving]
        needed += [clearance_m + bodies[place].unsure_m for place in moving]
    links = np.array([*(body.link for body in bodies), 0])
    pairs = np.array(found, dtype=np.int64).reshape(-1, 2)
    levers = [_levers(robot, links[a], bodies[b]) for a, b in pairs.tolist()]
    return _Pairs(pairs, np.array(needed), np.array(levers).reshape(-1, len(robot.chain)))


def _levers(robot: Robot, before: int, body: Body) -> FloatArray:
    """How far points of a body move, at most, seen from an earlier link, by (n,) joints [m]."""
    chain = robot.chain
    lengths = np.linalg.norm(chain.placements[:-1, :3, 3], axis=1)
    most = np.maximum(np.abs(chain.lower), np.abs(chain.upper))
    lengths += np.where(chain.prismatic, np.where(np.isfinite(most), most, _TRAVEL_M), 0.0)
    levers = np.zeros(len(chain))
    lever = body.extent_m
    for joint in range(body.link - 1, before - 1, -1):
        levers[joint] = 1.0 if chain.prismatic[joint] else lever
        lever += float(lengths[joint])
    return levers


def _geometry(bodies: Sequence[Body], floor_m: float | None) -> "pin.GeometryModel":
    """Pinocchio's model of the bodies, the floor last."""
    import coal
    import pinocchio as pin

    model = pin.GeometryModel()
    for place, body in enumerate(bodies):
        model.addGeometryObject(
            pin.GeometryObject(
                f"{place} {body.name}", body.link, pin.SE3(body.link_from_body), _shape(body)
            )
        )
    if floor_m is not None:
        below = coal.Halfspace(np.array([0.0, 0.0, 1.0]), floor_m)
        model.addGeometryObject(pin.GeometryObject("floor", 0, pin.SE3.Identity(), below))
    return model


def _shape(body: Body) -> "coal.ShapeBase":
    import coal

    if body.shape == "box":
        return coal.Box(*body.size_m.tolist())
    kind = coal.Capsule if body.shape == "capsule" else coal.Cylinder
    return kind(*body.size_m.tolist())


def urdf_bodies(robot: Robot) -> tuple[tuple[Body, ...], frozenset[int]]:
    """The boxes, cylinders and spheres that a URDF gives to its links for collisions.

    Returns:
        The bodies, and the joints with which links move whose form is in files elsewhere.
    """
    import pinocchio as pin

    root = ElementTree.fromstring(robot.document["urdf"])
    elsewhere = set()
    for link in root.findall("link"):
        for collision in link.findall("collision"):
            shape = collision.find("geometry")
            if shape is None or all(
                shape.find(name) is None for name in ("box", "cylinder", "sphere")
            ):
                link.remove(collision)
                elsewhere.add(link.get("name"))
    text = ElementTree.tostring(root, encoding="unicode")
    model = pin.buildModelFromXML(text)
    geometry = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    places = {name: place for place, name in enumerate(robot.joint_names, start=1)}
    others = [joint for joint in range(1, model.njoints) if model.names[joint] not in places]
    model, reduced = pin.buildReducedModel(model, [geometry], others, pin.neutral(model))
    bodies = [
        _body(geometryobject, places.get(model.names[geometryobject.parentJoint], 0), robot)
        for geometryobject in reduced[0].geometryObjects
    ]
    undrawn = {
        places.get(model.names[frame.parentJoint], 0)
        for frame in model.frames
        if frame.name in elsewhere
    }
    return tuple(bodies), frozenset(undrawn)


def _body(item: "pin.GeometryObject", link: int, robot: Robot) -> Body:
    name, pose, form = body_name(robot, link), item.placement.homogeneous, item.geometry
    if type(form).__name__ == "Box":
        return Body(name, link, "box", 2.0 * np.asarray(form.halfSide), pose, of_arm=True)
    if type(form).__name__ == "Cylinder":
        size = np.array([form.radius, 2.0 * form.halfLength])
        return Body(name, link, "cylinder", size, pose, of_arm=True)
    return Body(name, link, "capsule", np.array([form.radius, 0.0]), pose, of_arm=True)
