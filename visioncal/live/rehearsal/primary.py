"""The primary interface of a simulated controller: its tool and geometry.

Source: Universal Robots, "Remote Control Via TCP/IP": a robot state message is its size (int32),
16, and packages of size, type and content; numbers are big-endian.
"""

import struct

from visioncal.live.rehearsal.kinematics import tool_pose
from visioncal.live.rehearsal.machine import Machine

PRIMARY_PORTS = (30001, 30002, 30011, 30012)
_ROBOT_STATE, _CARTESIAN, _KINEMATICS = 16, 4, 5
_LINEARISED = 1


def state_message(machine: Machine, now_s: float) -> bytes:
    """A robot state message with the tool's pose and offset, and with the arm's table of joints."""
    q, _ = machine.joints(now_s)
    pose = tool_pose(machine, q).tolist()
    cartesian = struct.pack(">12d", *pose, *machine.tcp.tolist())
    arm = machine.believed
    columns = (arm.offset, arm.a, arm.d, arm.alpha)
    numbers = [float(it) for column in columns for it in column]
    kinematics = struct.pack(f">6I{len(numbers)}dI", *range(1, 7), *numbers, _LINEARISED)
    body = _package(_CARTESIAN, cartesian) + _package(_KINEMATICS, kinematics)
    return _package(_ROBOT_STATE, body)


def _package(kind: int, content: bytes) -> bytes:
    return struct.pack(">IB", 5 + len(content), kind) + content
