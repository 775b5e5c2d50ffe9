"""Names to choose among and usual values, in files and in options.

Help lists them without waiting for numpy.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

# The joint fit, or one of the closed forms.
SolverName: TypeAlias = Literal[
    "joint", "tsai", "park", "horaud", "daniilidis", "andreff", "shah", "li"
]
# What a recording keeps of the images of its session, beside their digests.
ImagesKept: TypeAlias = Literal["full", "thumbnail", "none"]
# How a table of joints is meant.
Convention: TypeAlias = Literal["standard", "modified", "hayati"]
CONVENTIONS: tuple[Convention, ...] = ("standard", "modified", "hayati")
CameraMount: TypeAlias = Literal["eye-in-hand", "eye-to-hand"]
MOUNTS: tuple[CameraMount, ...] = ("eye-in-hand", "eye-to-hand")
# What observes whom: a camera on the flange, one that stands still, or a measuring instrument that
# stands still and reads a probe or points on the flange.
Mount: TypeAlias = Literal["eye-in-hand", "eye-to-hand", "instrument"]
# By what stops of a plan are chosen; `live.planning.design` says what each is.
Criterion: TypeAlias = Literal["I", "D", "A", "E", "O1"]
# What `convert` reads, and `export` writes, in the order of their registries.
FOREIGN_NAMES = (
    *("industrial-calibration", "industrial-kinematics", "visp", "zivid", "easy-handeye2"),
    *("moveit", "views", "table"),
)
EXPORT_NAMES = (
    *("ros", "ros-launch", "moveit", "easy-handeye", "easy-handeye2", "urdf", "camera-info"),
    *("kalibr", "oak", "opencv", "zivid", "text", "ur", "kuka", "fanuc", "abb", "staubli"),
    *("yaskawa", "doosan", "ur-tcp", "ur-feature", "abb-tooldata", "abb-wobjdata"),
    *("kuka-tool", "kuka-base", "fanuc-utool", "fanuc-uframe", "robot-urdf", "robot-dh"),
    *("ur-kinematics", "robot-json", "joint-corrections"),
)
# Simulated arms, and the whole cells whose descriptions come with visioncal.
SIMULATED_ARMS = ("ur3e", "ur5e", "ur10e", "generic-6r-1800")
SIMULATED_CELLS = ("camera-and-tracker", "two-arms", "two-cameras")

# The faults that can be rehearsed; the last two are the camera's, at a stop.
Faults: TypeAlias = Literal[
    "protective-stop",
    "emergency-stop",
    "remote-off",
    "link-lost",
    "silent",
    "unplugged",
    "covered",
]
# A UR's joints turn no faster while a plan is driven; slow enough to reach the stop button [rad/s
# and rad/s^2].
PLAN_SPEED, PLAN_ACCELERATION = 0.4, 0.6
# Joints that turn farther than this from one target to the next have taken another branch, or the
# targets are no path [rad].
WIDEST_RAD = math.pi / 2

# What `dynamics identify` writes.
DYNAMICS_FILE = "dynamics.json"
# What a drive's gain is known to, as a share, where nobody says it: half of what two published
# lists of a UR10e's gains differ by has an rms of 12 % [-].
GAIN_SIGMA = 0.12

# Lengths in which others write positions [m].
UNITS_M: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "inch": 0.0254}


@dataclass(frozen=True)
class PoseForm:
    """How a robot's maker or a library writes a pose: a length unit [m] and a rotation."""

    name: str
    words: str
    unit: str
    rotation: str


# Universal Robots, "Script manual": p[x, y, z, rx, ry, rz]. KUKA, "System variables": FRAME X, Y,
# Z, A, B, C with A about Z, then B about Y, then C about X, moving. FANUC and Yaskawa: W, P, R
# (Rx, Ry, Rz) about fixed X, Y, Z. ABB, "RAPID data types": pos [mm], orient q1 .. q4 = w, x, y, z.
# Staubli VAL 3: Rx, Ry, Rz about moving axes. Doosan: A, B, C about moving Z, Y, Z. URDF
# specification: roll, pitch, yaw about fixed x, y, z.
POSE_FORMS: Mapping[str, PoseForm] = {
    pose_form.name: pose_form
    for pose_form in (
        PoseForm("ur", "Universal Robots p[...]", "m", "rotation-vector"),
        PoseForm("kuka", "KUKA X, Y, Z, A, B, C", "mm", "euler-ZYX-deg"),
        PoseForm("fanuc", "FANUC X, Y, Z, W, P, R", "mm", "euler-xyz-deg"),
        PoseForm("yaskawa", "Yaskawa X, Y, Z, Rx, Ry, Rz", "mm", "euler-xyz-deg"),
        PoseForm("abb", "ABB pos and orient", "mm", "quaternion-wxyz"),
        PoseForm("staubli", "Staubli X, Y, Z, Rx, Ry, Rz", "mm", "euler-XYZ-deg"),
        PoseForm("doosan", "Doosan X, Y, Z, A, B, C", "mm", "euler-ZYZ-deg"),
        PoseForm("rpy", "URDF xyz and rpy", "m", "euler-xyz-rad"),
        PoseForm("ros", "ROS position and orientation", "m", "quaternion-xyzw"),
    )
}
