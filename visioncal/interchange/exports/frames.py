"""What ROS calls our frames.

A robot's ROS description calls the controller's own base frame `base`, and the frame of the poses
that the controller reports without a tool `tool0` (ROS-Industrial, draft REP 199; Universal Robots,
ur_description, doc/robot_frames.rst). Its `base_link` and `flange` may be turned against those: by
180 degrees about z in the former case for a UR. Our camera frame, z forward and x right, is what
REP 103 calls an optical frame.
"""

from collections.abc import Mapping

from visioncal.interchange.exports.content import Content

ROS_FRAMES: Mapping[str, str] = {
    "base": "base",
    "flange": "tool0",
    "cam": "camera_optical_frame",
}

_MEANINGS: Mapping[str, str] = {
    "base": "the controller's own base frame; base_link may differ (on a UR it is turned by "
    "180 deg about z)",
    "flange": "the frame of the session's robot poses, which is the robot's tool0 where they were "
    "reported without a tool",
    "cam": "the camera's optical frame: z forward, x right, y down",
    "target": "the frame of the printed target",
    "tool": "the tool's frame: its origin is the tool's centre point",
    "fixture": "the fixture's own frame",
}


def ros_notes(content: Content) -> list[str]:
    """Says in lines for a comment what the transform is, its quality, and what its frames are."""
    names = zip((content.parent, content.child), content.frames, strict=True)
    meanings = [f"{name}: {_MEANINGS[own]}" for name, own in names if own in _MEANINGS]
    return [*content.notes, *meanings]
