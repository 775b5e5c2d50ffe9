"""A transform for ROS 2 as a launch file that publishes it."""

from collections.abc import Sequence

from visioncal.core.conventions import POSE_FORMS, write_pose
from visioncal.interchange.exports.content import Content
from visioncal.interchange.exports.format import ExportFormat, comments, numbers
from visioncal.interchange.exports.ros import ROS_FRAMES, ros_notes

_NUMBERS = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")


# Neither file starts with a comment: in its first lines Python looks for an encoding, which a
# session's name must not choose.


def _program(contents: Sequence[Content]) -> str:
    """Writes the program of a launch file (tf2_ros, static_transform_publisher's named options)."""
    nodes = "".join(map(_node, contents))
    return (
        "from launch import LaunchDescription\n"
        "from launch_ros.actions import Node\n"
        "\n\n"
        "def generate_launch_description() -> LaunchDescription:\n"
        f"    nodes = [\n{nodes}    ]\n"
        "    return LaunchDescription(nodes)\n"
    )


def _node(content: Content) -> str:
    pose = numbers(write_pose(content.matrix, POSE_FORMS["ros"]))
    options = {"--frame-id": content.parent, "--child-frame-id": content.child} | {
        option: repr(number) for option, number in zip(_NUMBERS, pose, strict=True)
    }
    # Frames are letters, digits and _ / - . throughout, so that quotes hold them.
    arguments = "".join(
        f'                "{option}",\n                "{value}",\n'
        for option, value in options.items()
    )
    return (
        "        Node(\n"
        '            package="tf2_ros",\n'
        '            executable="static_transform_publisher",\n'
        '            output="log",\n'
        f"            arguments=[\n{arguments}            ],\n"
        "        ),\n"
    )


def _write_launch(content: Content) -> str:
    first = f'"""Publishes where {content.child} is in {content.parent}."""\n\n'
    return first + comments("#", ros_notes(content)) + _program([content])


def _write_launches(contents: Sequence[Content]) -> str:
    first = '"""Publishes where all frames of a cell are."""\n\n'
    notes = [note for it in contents for note in it.notes[1:]]
    return first + comments("#", [contents[0].origin, *notes]) + _program(contents)


def _write_moveit(content: Content) -> str:
    """Writes a launch file laid out as MoveIt 2's calibration does.

    moveit_calibration, handeye_control_widget.cpp (ROS 2), puts the mount and both frames first.
    The Euler angles that it adds in a comment are left out: its order is not the one that the
    publisher's --roll, --pitch and --yaw have.
    """
    mount = "" if content.mount is None else f"{content.mount.upper()}: "
    first = f'""" {mount}{content.parent} -> {content.child} """\n'
    return first + comments("#", ros_notes(content)) + _program([content])


ROS_LAUNCH = ExportFormat(
    "ros-launch",
    "a ROS 2 launch file with a static_transform_publisher [m, quaternion]",
    _write_launch,
    frames=ROS_FRAMES,
    write_all=_write_launches,
)
MOVEIT = ExportFormat(
    "moveit",
    "the same laid out as MoveIt 2's hand-eye calibration writes it [m, quaternion]",
    _write_moveit,
    frames=ROS_FRAMES,
)
