"""A transform as a fixed joint of a URDF."""

import re
from collections.abc import Sequence

from visioncal.core.conventions import POSE_FORMS, write_pose
from visioncal.core.files import one_line
from visioncal.interchange.exports.content import Content, ExportFormat, numbers
from visioncal.interchange.exports.ros import ROS_FRAMES, ros_notes


def _write(content: Content) -> str:
    return _write_all([content])


def _write_all(contents: Sequence[Content]) -> str:
    """Writes a document that `xacro:include` takes in, with the children's links and the joints.

    `rpy` turns about the parent's fixed axes, x first, then y, then z: the rotation is Rz(yaw)
    Ry(pitch) Rx(roll) (ROS wiki, urdf/XML/joint; urdfdom, Rotation::setFromRPY).
    """
    # A cell's root is a parent alone, and no robot's description has a link for it.
    roots = {it.parent for it in contents if it.frames[0] == "cell"}
    links = "".join(f'  <link name="{it}"/>\n' for it in sorted(roots))
    joints = "".join(map(_joint, contents))
    return f'<?xml version="1.0"?>\n<robot name="visioncal">\n{links}{joints}</robot>\n'


def _joint(content: Content) -> str:
    # XML ends a comment at two hyphens.
    notes = "".join(
        f"  <!-- {re.sub('-(?=-)', '- ', one_line(it))} -->\n" for it in ros_notes(content)
    )
    pose = [repr(it) for it in numbers(write_pose(content.matrix, POSE_FORMS["rpy"]))]
    joint = f"{content.parent}-{content.child}".replace("/", "_")
    return (
        f"{notes}"
        f'  <link name="{content.child}"/>\n'
        f'  <joint name="{joint}" type="fixed">\n'
        f'    <parent link="{content.parent}"/>\n'
        f'    <child link="{content.child}"/>\n'
        f'    <origin xyz="{" ".join(pose[:3])}" rpy="{" ".join(pose[3:])}"/>\n'
        "  </joint>\n"
    )


URDF = ExportFormat(
    "urdf",
    "a link and a fixed joint for a URDF or xacro [m, rad about fixed x, y, z]",
    _write,
    frames=ROS_FRAMES,
    write_all=_write_all,
)
