"""A given URDF with other inertias of its links, and nothing else changed."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from xml.parsers import expat

from visioncal.core.errors import DataError
from visioncal.robot.inertia import Inertias
from visioncal.robot.model import Robot
from visioncal.robot.writing import comment_lines, inertial_lines


@dataclass
class _Link:
    """A link as it stands in the text: places count bytes.

    Attributes:
        ends: Where its first tag and its last begin; the same where it is empty.
        inertial: Where its `<inertial>` begins and what follows it.
    """

    ends: list[int] = field(default_factory=list)
    inertial: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class _Tree:
    """The links by name, the links at either end of each joint, and where the content begins."""

    links: dict[str, _Link] = field(default_factory=dict)
    joints: dict[str, dict[str, str]] = field(default_factory=dict)
    begin: list[int] = field(default_factory=list)


def weighed_urdf(robot: Robot, inertias: Inertias, notes: Sequence[str] = ()) -> str:
    """Writes the URDF of a robot with the inertias that were identified.

    What moves with a joint of the arm is one body: the link behind the joint gets all of its
    inertia, and other links that move with it none.

    Args:
        robot: The robot as a URDF describes it.
        inertias: Of what moves with its joints.
        notes: Lines for comments at the head of the robot.

    Returns:
        The text.

    Raises:
        DataError: The robot is not of a URDF.
    """
    text = robot.document.get("urdf")
    if not isinstance(text, str):
        raise DataError(
            f"robot {robot.name}: a robot of a URDF is needed.",
            culprits=[robot.name],
            next_step="Write a small URDF or a joint table instead.",
        )
    data = text.encode("utf-8")
    tree = _read(data)
    masses = inertias.masses
    bodies = zip(masses.kg.tolist(), masses.centres_m, inertias.about_centres, strict=True)
    edits = []
    for joint, body in zip(robot.joint_names, bodies, strict=True):
        own = tree.joints[joint]["child"]
        for name in _moving_with(own, tree, robot.joint_names):
            lines = inertial_lines(*body) if name == own else []
            edits.append(_edit(data, tree.links[name], "\n".join(lines)))
    if notes:
        head = "\n" + "\n".join(comment_lines(robot, notes))
        edits.append((tree.begin[0], tree.begin[0], head.encode("utf-8")))
    for begin, end, piece in sorted(edits, reverse=True):
        data = data[:begin] + piece + data[end:]
    return data.decode("utf-8")


def _moving_with(link: str, tree: _Tree, arm: Sequence[str]) -> list[str]:
    """A link and all that hang on it without one of the arm's joints between."""
    found = [link]
    for name in found:
        found += [
            ends["child"]
            for joint, ends in tree.joints.items()
            if ends["parent"] == name and joint not in arm
        ]
    return found


def _edit(data: bytes, link: _Link, inertial: str) -> tuple[int, int, bytes]:
    """From where to where to put what, to give a link another inertia or none."""
    if link.inertial:
        begin, end = link.inertial
        return begin, end, inertial.strip().encode("utf-8")
    begin = data.index(b">", link.ends[0])
    if link.ends[0] != link.ends[1]:
        piece = f"\n{inertial}" if inertial else ""
        return begin + 1, begin + 1, piece.encode("utf-8")
    if not inertial:
        return begin, begin, b""
    # An empty link: `<link name="a"/>`.
    slash = data.rindex(b"/", 0, begin)
    return slash, begin + 1, f">\n{inertial}\n  </link>".encode()


def _read(data: bytes) -> _Tree:
    parser = expat.ParserCreate("utf-8")
    tree, names = _Tree(), [""]
    path: list[str] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        path.append(tag)
        at = parser.CurrentByteIndex
        if path == ["robot"]:
            tree.begin.append(data.index(b">", at) + 1)
        elif path == ["robot", "link"]:
            names[0] = attributes["name"]
            tree.links[names[0]] = _Link([at])
        elif path == ["robot", "link", "inertial"]:
            tree.links[names[0]].inertial.append(at)
        elif path == ["robot", "joint"]:
            names[0] = attributes["name"]
            tree.joints[names[0]] = {}
        elif path[:-1] == ["robot", "joint"] and tag in ("parent", "child"):
            tree.joints[names[0]][tag] = attributes["link"]

    def stop(_: str) -> None:
        at = parser.CurrentByteIndex
        if path == ["robot", "link"]:
            tree.links[names[0]].ends.append(at)
        elif path == ["robot", "link", "inertial"]:
            closed = data[at : at + 2] == b"</"
            tree.links[names[0]].inertial.append(data.index(b">", at) + 1 if closed else at)
        path.pop()

    parser.StartElementHandler = start
    parser.EndElementHandler = stop
    parser.Parse(data, True)
    return tree
