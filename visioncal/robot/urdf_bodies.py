"""A given URDF with other inertias of its links, and nothing else changed."""

from collections.abc import Mapping, Sequence

from visioncal.core.documents import Element
from visioncal.core.errors import DataError
from visioncal.robot.inertia import Inertias
from visioncal.robot.model import Robot
from visioncal.robot.urdfs import edited, end_of, joints_of
from visioncal.robot.writing import comment_lines, inertial_lines


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
    root, joints = joints_of(data)
    links = {child.attributes["name"]: child for child in root.children if child.tag == "link"}
    masses = inertias.masses
    bodies = zip(masses.kg.tolist(), masses.centres_m, inertias.about_centres, strict=True)
    edits = []
    for joint, body in zip(robot.joint_names, bodies, strict=True):
        own = end_of(joints[joint], "child")
        for name in _moving_with(own, joints, robot.joint_names):
            lines = inertial_lines(*body) if name == own else []
            edits.append(_edit(data, links[name], "\n".join(lines)))
    if notes:
        head = "\n" + "\n".join(comment_lines(robot, notes))
        edits.append((root.inside, root.inside, head.encode("utf-8")))
    return edited(data, edits)


def _moving_with(link: str, joints: Mapping[str, Element], arm: Sequence[str]) -> list[str]:
    """A link and all that hang on it without one of the arm's joints between."""
    found = [link]
    for name in found:
        found += [
            end_of(element, "child")
            for joint, element in joints.items()
            if end_of(element, "parent") == name and joint not in arm
        ]
    return found


def _edit(data: bytes, link: Element, inertial: str) -> tuple[int, int, bytes]:
    """From where to where to put what, to give a link another inertia or none."""
    before = link.child("inertial")
    if before is not None:
        return before.begin, before.end, inertial.strip().encode("utf-8")
    if not inertial:
        return link.inside, link.inside, b""
    if not link.is_empty:
        return link.inside, link.inside, f"\n{inertial}".encode()
    slash = data.rindex(b"/", link.begin, link.inside)
    return slash, link.inside, f">\n{inertial}\n  </link>".encode()
