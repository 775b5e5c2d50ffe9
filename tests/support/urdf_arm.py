"""A chain of all that a URDF may have, and its joints and errors."""

import numpy as np

from visioncal.robot import Robot

# A lift and a slanted joint, a fixed joint on the way and one that carries the tip, a joint without
# an origin, and what a rewritten file must keep.
URDF = """<?xml version="1.0" encoding="utf-8"?>
<!-- kept: before -->
<robot name="arm">
  <link name="base_link"/> <link name="a"/> <link name="b"/> <link name="c"/> <link name="d"/>
  <link name="flange"/>
  <joint name="lift" type="prismatic">
    <parent link="base_link"/> <child link="a"/> <axis xyz="0.6 0 0.8"/>
    <origin rpy='0.1 0.2 0.3' xyz="0.1 0 0.5"></origin>
    <limit lower="-0.1" upper="0.4" effort="1" velocity="1"/>
  </joint>
  <joint name="turn" type="continuous">
    <parent link="a"/><child link="b"/><axis xyz="0 0.6 0.8"/>
  </joint>
  <joint name="step" type="fixed">
    <parent link="b"/> <child link="c"/> <origin xyz="0.2 0.1 0" rpy="0 1.5707963267948966 0"/>
  </joint>
  <joint name="bend" type="revolute">
    <parent link="c"/> <child link="d"/> <axis xyz="0 1 0"/>
    <origin xyz="0 0 0.3"/> <!-- kept: inside -->
    <limit lower="-1.5" upper="2.5" effort="1" velocity="1"/>
  </joint>
  <joint name="mount" type="fixed"><parent link="d"/><child link="flange"/></joint>
  <transmission name="t"><joint name="bend"><origin xyz="9 9 9"/></joint></transmission>
</robot>
"""


def of_urdf(tip: str = "") -> Robot:
    return Robot.from_document({"schema": 1, "name": "arm", "tip": tip, "urdf": URDF})


def some_joints(robot: Robot, count: int = 4, seed: int = 3) -> np.ndarray:
    lower, upper = np.maximum(robot.lower_rad, -3.0), np.minimum(robot.upper_rad, 3.0)
    return np.random.default_rng(seed).uniform(lower, upper, (count, robot.joint_count))


def some_changes(robot: Robot, seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Placements and functions off by some mm and mrad."""
    rng = np.random.default_rng(seed)
    functions = rng.normal(scale=2e-3, size=(robot.joint_count, 4))
    functions[robot.chain.prismatic, 2:] = 0.0
    return rng.normal(scale=2e-3, size=(robot.joint_count + 1, 6)), functions
