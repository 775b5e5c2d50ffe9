"""A given robot or URDF with other origins of its joints or inertias, and nothing else changed."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from visioncal.core.conventions import ROTATION_FORMS
from visioncal.core.documents import Element, parse_xml
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray
from visioncal.robot.chain import chain_document
from visioncal.robot.inertia import Inertias
from visioncal.robot.model import Robot
from visioncal.robot.tables import row_frames, table_from_document
from visioncal.robot.writing import comment_lines, inertial_lines, numbers_text


def corrected_urdf(nominal: Robot, corrected: Robot, notes: Sequence[str] = ()) -> str:
    """Writes the URDF of a robot with the geometry that a calibration found.

    Only the origins of the joints between base and tip change, and that of the fixed joint before
    the tip; where there is none, a link NAME_corrected with a fixed joint is added for it. Joint
    offsets go into the origins. Gear ratio and eccentricity have no place in a URDF; a comment
    says which are missing.

    Args:
        nominal: The robot as the URDF describes it.
        corrected: Its corrected model.
        notes: Lines for comments at the head of the robot.

    Returns:
        The text.

    Raises:
        DataError: The nominal robot is not of a URDF, or the two have other joints.
    """
    text = nominal.document.get("urdf")
    if not isinstance(text, str) or nominal.joint_names != corrected.joint_names:
        raise DataError(
            f"robot {nominal.name}: a robot of a URDF and its corrected model are needed.",
            culprits=[nominal.name],
            next_step="Write a small URDF or a joint table instead.",
        )
    data = text.encode("utf-8")
    root, joints = joints_of(data)
    was, now = nominal.chain, corrected.chain.with_offsets_placed()
    steps = invert(was.placements) @ now.placements
    edits, comments = [], comment_lines(corrected, notes)
    for name, before, after, step in zip(
        (*was.joint_names, None), was.placements, now.placements, steps, strict=True
    ):
        if np.array_equal(before, after):
            continue
        joint = _of_tip(joints, nominal) if name is None else joints[name]
        if joint is None:
            edits.append((root.close, root.close, _more(nominal.tip, joints, step)))
        else:
            edits.append(_edit(joint, _placement(joint) @ step))
    if comments:
        edits.append((root.inside, root.inside, ("\n" + "\n".join(comments)).encode("utf-8")))
    return edited(data, edits)


def corrected_tip(nominal: Robot, corrected: Robot) -> str:
    """Names the frame in `corrected_urdf` whose pose `corrected.base_from_flange` gives."""
    if np.array_equal(nominal.chain.placements[-1], corrected.chain.placements[-1]):
        return nominal.tip
    _, joints = joints_of(str(nominal.document["urdf"]).encode("utf-8"))
    return nominal.tip if _of_tip(joints, nominal) else f"{nominal.tip}_corrected"


def joints_of(data: bytes) -> tuple[Element, dict[str, Element]]:
    """The root of a URDF, and its joints by name; those of transmissions are deeper down."""
    root = parse_xml(data, "the URDF")
    return root, {
        child.attributes["name"]: child for child in root.children if child.tag == "joint"
    }


def end_of(joint: Element, end: str) -> str:
    """The link at the `parent` or the `child` end of a joint; empty where it is not said."""
    found = joint.child(end)
    return "" if found is None else found.attributes.get("link", "")


def edited(data: bytes, edits: Iterable[tuple[int, int, bytes]]) -> str:
    """A text with other pieces in it, each from where to where."""
    for begin, end, piece in sorted(edits, reverse=True):
        data = data[:begin] + piece + data[end:]
    return data.decode("utf-8")


def _placement(joint: Element) -> FloatArray:
    """(4, 4) a joint's origin [m]."""
    origin = joint.child("origin")
    said = {} if origin is None else origin.attributes
    xyz, rpy = (np.array(said.get(key, "0 0 0").split(), dtype=float) for key in ("xyz", "rpy"))
    return compose(ROTATION_FORMS["euler-xyz-rad"].read(rpy[None])[0], xyz)


def _of_tip(joints: Mapping[str, Element], robot: Robot) -> Element | None:
    """The fixed joint that places the tip; None where a moving joint does."""
    fixed = {name: joint for name, joint in joints.items() if name not in robot.joint_names}
    named = (
        element for name, element in fixed.items() if robot.tip in (name, end_of(element, "child"))
    )
    return next(named, None)


def _edit(joint: Element, placement: FloatArray) -> tuple[int, int, bytes]:
    """From where to where to put what, to give a joint another origin."""
    xyz, rpy = numbers_text(placement)
    text = f'<origin xyz="{" ".join(xyz)}" rpy="{" ".join(rpy)}"'.encode()
    origin = joint.child("origin")
    if origin is None:
        return joint.inside, joint.inside, b"\n    " + text + b"/>"
    return origin.begin, origin.inside, text + (b"/>" if origin.is_empty else b">")


def _more(tip: str, joints: Mapping[str, Element], step: FloatArray) -> bytes:
    """A link for the corrected tip behind a tip that no fixed joint places."""
    xyz, rpy = numbers_text(step)
    parent = end_of(joints[tip], "child") if tip in joints else tip
    link = quoteattr(f"{tip}_corrected")
    return (
        f"  <link name={link}/>\n"
        f'  <joint name={quoteattr(f"{tip}_correction")} type="fixed">\n'
        f"    <parent link={quoteattr(parent)}/>\n"
        f"    <child link={link}/>\n"
        f'    <origin xyz="{" ".join(xyz)}" rpy="{" ".join(rpy)}"/>\n'
        "  </joint>\n"
    ).encode()


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
            edits.append(_inertial_edit(data, links[name], "\n".join(lines)))
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


def _inertial_edit(data: bytes, link: Element, inertial: str) -> tuple[int, int, bytes]:
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
