"""A given URDF with other origins of its joints, and nothing else changed."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from visioncal.core.conventions import ROTATION_FORMS
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray
from visioncal.robot.model import Robot
from visioncal.robot.writing import comment_lines, numbers_text

_TAG = re.compile(rb"""<[^\s/>]+(\s+[^\s=]+\s*=\s*("[^"]*"|'[^']*'))*\s*(/?)>""")


@dataclass
class _Joint:
    """A joint as it stands in the text: places count bytes."""

    name: str
    at: int
    child: str = ""
    origin_at: int | None = None
    origin: dict[str, str] = field(default_factory=dict)

    @property
    def placement(self) -> FloatArray:
        """(4, 4) its origin [m]."""
        xyz, rpy = (
            np.array(self.origin.get(key, "0 0 0").split(), dtype=float) for key in ("xyz", "rpy")
        )
        return compose(ROTATION_FORMS["euler-xyz-rad"].read(rpy[None])[0], xyz)


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
    joints, (start, end) = _read(data)
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
            edits.append((end, 0, _more(nominal.tip, joints, step)))
        else:
            edits.append(_edit(data, joint, joint.placement @ step))
    if comments:
        edits.append((start, 0, ("\n" + "\n".join(comments)).encode("utf-8")))
    for at, length, piece in sorted(edits, reverse=True):
        data = data[:at] + piece + data[at + length :]
    return data.decode("utf-8")


def corrected_tip(nominal: Robot, corrected: Robot) -> str:
    """Names the frame in `corrected_urdf` whose pose `corrected.base_from_flange` gives."""
    if np.array_equal(nominal.chain.placements[-1], corrected.chain.placements[-1]):
        return nominal.tip
    joints, _ = _read(str(nominal.document["urdf"]).encode("utf-8"))
    return nominal.tip if _of_tip(joints, nominal) else f"{nominal.tip}_corrected"


def _read(data: bytes) -> tuple[dict[str, _Joint], tuple[int, int]]:
    """The joints by name, and where the robot's content starts and ends."""
    parser = expat.ParserCreate("utf-8")
    joints: dict[str, _Joint] = {}
    path: list[str] = []
    ends = [0, 0]

    def start(tag: str, attributes: dict[str, str]) -> None:
        path.append(tag)
        at = parser.CurrentByteIndex
        if path == ["robot"]:
            ends[0] = at + _length(data, at)
        elif path == ["robot", "joint"]:
            # A transmission has joints too, deeper down.
            joints[attributes["name"]] = _Joint(attributes["name"], at)
        elif path[:-1] == ["robot", "joint"]:
            joint = list(joints.values())[-1]
            if tag == "child":
                joint.child = attributes.get("link", "")
            elif tag == "origin":
                joint.origin_at, joint.origin = at, attributes

    def stop(_: str) -> None:
        if path == ["robot"]:
            ends[1] = parser.CurrentByteIndex
        path.pop()

    parser.StartElementHandler = start
    parser.EndElementHandler = stop
    parser.Parse(data, True)
    return joints, (ends[0], ends[1])


def _length(data: bytes, at: int) -> int:
    match = _TAG.match(data, at)
    return len(match[0]) if match else 0


def _of_tip(joints: dict[str, _Joint], robot: Robot) -> _Joint | None:
    """The fixed joint that places the tip; None where a moving joint does."""
    fixed = [it for it in joints.values() if it.name not in robot.joint_names]
    return next((it for it in fixed if robot.tip in (it.name, it.child)), None)


def _edit(data: bytes, joint: _Joint, placement: FloatArray) -> tuple[int, int, bytes]:
    """Where to replace how many bytes by what, to give a joint another origin."""
    xyz, rpy = numbers_text(placement)
    origin = f'<origin xyz="{" ".join(xyz)}" rpy="{" ".join(rpy)}"'.encode()
    if joint.origin_at is None:
        return joint.at + _length(data, joint.at), 0, b"\n    " + origin + b"/>"
    match = _TAG.match(data, joint.origin_at)
    closed = b"/>" if match and match[3] else b">"
    return joint.origin_at, _length(data, joint.origin_at), origin + closed


def _more(tip: str, joints: dict[str, _Joint], step: FloatArray) -> bytes:
    """A link for the corrected tip behind a tip that no fixed joint places."""
    xyz, rpy = numbers_text(step)
    parent = joints[tip].child if tip in joints else tip
    link = quoteattr(f"{tip}_corrected")
    return (
        f"  <link name={link}/>\n"
        f'  <joint name={quoteattr(f"{tip}_correction")} type="fixed">\n'
        f"    <parent link={quoteattr(parent)}/>\n"
        f"    <child link={link}/>\n"
        f'    <origin xyz="{" ".join(xyz)}" rpy="{" ".join(rpy)}"/>\n'
        "  </joint>\n"
    ).encode()
