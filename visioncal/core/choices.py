"""Choices and default values of files and options, importable without numpy for quick help."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

# The joint fit, or one of the closed forms.
SolverName: TypeAlias = Literal[
    "joint", "tsai", "park", "horaud", "daniilidis", "andreff", "shah", "li"
]
# How a recording keeps its session's images, beside their digests.
ImagesKept: TypeAlias = Literal["full", "thumbnail", "none"]
# Convention of a joint table.
Convention: TypeAlias = Literal["standard", "modified", "hayati"]
CONVENTIONS: tuple[Convention, ...] = ("standard", "modified", "hayati")
CameraMount: TypeAlias = Literal["eye-in-hand", "eye-to-hand"]
MOUNTS: tuple[CameraMount, ...] = ("eye-in-hand", "eye-to-hand")
# Mount of the observing device: a camera on the flange, a fixed camera, or a fixed measuring
# instrument that observes a probe or points on the flange.
Mount: TypeAlias = Literal["eye-in-hand", "eye-to-hand", "instrument"]
# Simulated arms, and built-in descriptions of whole cells.
SIMULATED_ARMS = ("ur3e", "ur5e", "ur10e", "generic-6r-1800")
SIMULATED_CELLS = ("camera-and-tracker", "two-arms", "two-cameras")

# Joint speed and acceleration of a UR that drives a plan, slow enough to reach the stop button
# [rad/s and rad/s^2].
PLAN_SPEED, PLAN_ACCELERATION = 0.4, 0.6
# Greatest joint motion between consecutive targets of a path on one branch of the arm [rad].
WIDEST_RAD = math.pi / 2

# The history of a site, for every session below its folder; kinds of what it has.
SITE_FILE = "visioncal-history.db"
ActKind: TypeAlias = Literal["calibrated", "verified", "tool", "fixture", "touched"]
# Output of `dynamics identify`.
DYNAMICS_FILE = "dynamics.json"
# Default relative standard deviation of a drive's gain: half the difference of two published lists
# of a UR10e's gains has an rms of 12 % [-].
GAIN_SIGMA = 0.12

# Length units of foreign files [m].
UNITS_M: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "inch": 0.0254}


@dataclass(frozen=True)
class PoseForm:
    """Pose notation of a robot manufacturer or a library."""

    name: str
    words: str
    unit: str  # Length unit.
    rotation: str  # Rotation form, a name among `conventions.ROTATION_FORMS`.
    names: str  # Names of the rotation's numbers, in lower case.
    models: str = ""  # Pattern of the beginning of its robots' names; empty for a library.
    # Whether the names alone suggest it, and not another form that has them, too.
    likely: bool = True
    also: str = ""  # Other names of the rotation's numbers, which suggest it.


# Universal Robots, "Script manual": p[x, y, z, rx, ry, rz]. KUKA, "System variables": FRAME X, Y,
# Z, A, B, C with A about Z, then B about Y, then C about X, moving. FANUC and Yaskawa: W, P, R
# (Rx, Ry, Rz) about fixed X, Y, Z. ABB, "RAPID data types": pos [mm], orient q1 .. q4 = w, x, y, z.
# Staubli VAL 3: Rx, Ry, Rz about moving axes. Doosan: A, B, C about moving Z, Y, Z. UFACTORY,
# "xArm user manual", terms: roll, pitch, yaw about fixed X, Y, Z. Mecademic, mecademicpy, MovePose:
# intrinsic XYZ. Kawasaki: O, A, T about moving Z, Y, Z (Roboception, "rc_visard manual", pose
# formats). Comau, eDO_core, vZYZm: A, E, R about moving Z, Y, Z. RealMan, "SDK FAQ", 4: ZYX
# intrinsic, given as rx, ry, rz [m, rad]. Techman, tmr_ros1, tm_ros_topic.cpp: Rx, Ry, Rz as fixed
# roll, pitch, yaw. Franka, libfranka, RobotState::O_T_EE: 4x4, column-major. URDF specification:
# roll, pitch, yaw about fixed x, y, z.
_RX, _RPY = "rx ry rz", "roll pitch yaw"
POSE_FORMS: Mapping[str, PoseForm] = {
    form.name: form
    for form in (
        PoseForm("ur", "Universal Robots p[...]", "m", "rotation-vector", _RX, r"ur\d"),
        PoseForm(
            *("kuka", "KUKA X, Y, Z, A, B, C", "mm", "euler-ZYX-deg", "a b c"),
            r"kuka|kr\d|lbr|iiwa",
        ),
        PoseForm(
            *("fanuc", "FANUC X, Y, Z, W, P, R", "mm", "euler-xyz-deg", "w p r"),
            r"fanuc|lrmate|crx|m\d+i",
        ),
        PoseForm(
            *("yaskawa", "Yaskawa X, Y, Z, Rx, Ry, Rz", "mm", "euler-xyz-deg", _RX),
            r"yaskawa|motoman|gp\d|hc\d",
        ),
        PoseForm(
            *("abb", "ABB X, Y, Z, q1, q2, q3, q4", "mm", "quaternion-wxyz", "q1 q2 q3 q4"),
            r"abb|irb|gofa|yumi",
        ),
        PoseForm(
            *("staubli", "Staubli X, Y, Z, Rx, Ry, Rz", "mm", "euler-XYZ-deg", _RX),
            r"staubli|tx2?\d|ts2",
        ),
        PoseForm(
            *("doosan", "Doosan X, Y, Z, A, B, C", "mm", "euler-ZYZ-deg", "a b c"),
            *(r"doosan|[ahm]\d{4}", False),
        ),
        PoseForm(
            *("xarm", "UFACTORY X, Y, Z, roll, pitch, yaw", "mm", "euler-xyz-deg", _RPY),
            r"xarm|uf850|lite6",
        ),
        PoseForm(
            *("mecademic", "Mecademic X, Y, Z, alpha, beta, gamma", "mm", "euler-XYZ-deg"),
            *("alpha beta gamma", r"meca"),
        ),
        PoseForm(
            *("kawasaki", "Kawasaki X, Y, Z, O, A, T", "mm", "euler-ZYZ-deg", "o a t"),
            r"kawasaki|rs\d{3}",
        ),
        PoseForm(
            *("comau", "Comau X, Y, Z, A, E, R", "mm", "euler-ZYZ-deg", "a e r"), r"comau|racer"
        ),
        PoseForm(
            *("realman", "RealMan X, Y, Z, rx, ry, rz", "m", "euler-xyz-rad", _RX),
            *(r"realman|rml?\d{2}", False),
        ),
        PoseForm(
            *("techman", "Techman X, Y, Z, Rx, Ry, Rz", "mm", "euler-xyz-deg", _RX), r"techman|tm\d"
        ),
        PoseForm(
            *("franka", "Franka O_T_EE, by columns", "m", "matrix-transposed"),
            "r11 r21 r31 r12 r22 r32 r13 r23 r33",
        ),
        PoseForm("rpy", "URDF xyz and rpy", "m", "euler-xyz-rad", _RX, likely=False, also=_RPY),
        PoseForm(
            "rpy-deg", "xyz and rpy in degrees", "m", "euler-xyz-deg", _RX, likely=False, also=_RPY
        ),
        PoseForm("ros", "ROS position and orientation", "m", "quaternion-xyzw", "qx qy qz qw"),
    )
}
