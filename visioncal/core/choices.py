"""Choices and default values of files and options, importable without numpy for quick help."""

import math
import re
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
# Criteria of planned stops: the mean variance of positions, or the determinant of the covariance.
Criterion: TypeAlias = Literal["I", "D"]
# Standards by which an arm is tested.
Standard: TypeAlias = Literal["iso9283"]
# Simulated arms, and built-in descriptions of whole cells.
SIMULATED_ARMS = ("ur3e", "ur5e", "ur10e", "generic-6r-1800", "generic-scara-600")
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

# Length units of foreign files [m]; of two that fit alike, the first is taken.
UNITS_M: Mapping[str, float] = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "inch": 0.0254, "um": 1e-6}


@dataclass(frozen=True)
class PoseForm:
    """Pose notation of a robot manufacturer or a library."""

    name: str
    words: str
    unit: str  # Length unit.
    rotation: str  # Rotation form, a name among `conventions.ROTATION_FORMS`.
    names: str  # Names of the rotation's numbers, in lower case.
    models: str  # Pattern of the beginning of its robots' names; empty for a library.
    likely: bool  # Whether the names alone suggest it, and not another form that has them, too.
    also: str  # Other names of the rotation's numbers, which suggest it.


# Universal Robots, "Script manual": p[x, y, z, rx, ry, rz]. KUKA, "System variables": FRAME X, Y,
# Z, A, B, C with A about Z, then B about Y, then C about X, moving. FANUC and Yaskawa: W, P, R
# (Rx, Ry, Rz) about fixed X, Y, Z. ABB, "RAPID data types": pos [mm], orient q1 .. q4 = w, x, y, z.
# Staubli VAL 3: Rx, Ry, Rz about moving axes. Doosan: A, B, C about moving Z, Y, Z. UFACTORY,
# "xArm user manual", terms: roll, pitch, yaw about fixed X, Y, Z. Mecademic, mecademicpy, MovePose:
# intrinsic XYZ. Kawasaki: O, A, T about moving Z, Y, Z (Roboception, "rc_visard manual", pose
# formats). Comau, eDO_core, vZYZm: A, E, R about moving Z, Y, Z. RealMan, "SDK FAQ", 4: ZYX
# intrinsic, given as rx, ry, rz [m, rad]. Techman, tmr_ros1, tm_ros_topic.cpp: Rx, Ry, Rz as fixed
# roll, pitch, yaw. Epson, "SPEL+ language reference", point data: U about Z, V about Y,
# W about X. Franka, libfranka, RobotState::O_T_EE: 4x4, column-major. URDF specification: roll,
# pitch, yaw about fixed x, y, z.
_FORMS = r"""
ur         Universal Robots p[...]                m   rotation-vector    rx ry rz  ur\d
kuka       KUKA X, Y, Z, A, B, C                  mm  euler-ZYX-deg      a b c  kuka|kr\d|lbr|iiwa
fanuc  FANUC X, Y, Z, W, P, R  mm  euler-xyz-deg  w p r  fanuc|lrmate|crx|m\d+i
yaskawa  Yaskawa X, Y, Z, Rx, Ry, Rz  mm  euler-xyz-deg  rx ry rz  yaskawa|motoman|gp\d|hc\d
abb  ABB X, Y, Z, q1, q2, q3, q4  mm  quaternion-wxyz  q1 q2 q3 q4  abb|irb|gofa|yumi
staubli  Staubli X, Y, Z, Rx, Ry, Rz  mm  euler-XYZ-deg  rx ry rz  staubli|tx2?\d|ts2
doosan     Doosan X, Y, Z, A, B, C                mm  euler-ZYZ-deg      a b c  doosan|[ahm]\d{4}
xarm  UFACTORY X, Y, Z, roll, pitch, yaw  mm  euler-xyz-deg  roll pitch yaw  xarm|uf850|lite6
mecademic  Mecademic X, Y, Z, alpha, beta, gamma  mm  euler-XYZ-deg      alpha beta gamma  meca
kawasaki   Kawasaki X, Y, Z, O, A, T              mm  euler-ZYZ-deg      o a t  kawasaki|rs\d{3}
comau      Comau X, Y, Z, A, E, R                 mm  euler-ZYZ-deg      a e r  comau|racer
realman    RealMan X, Y, Z, rx, ry, rz            m   euler-xyz-rad      rx ry rz  realman|rml?\d{2}
techman    Techman X, Y, Z, Rx, Ry, Rz            mm  euler-xyz-deg      rx ry rz  techman|tm\d
epson      Epson X, Y, Z, U, V, W                 mm  euler-ZYX-deg      u v w  epson
franka  Franka O_T_EE, by columns  m  matrix-transposed  r11 r21 r31 r12 r22 r32 r13 r23 r33
rpy        URDF xyz and rpy                       m   euler-xyz-rad      rx ry rz
rpy-deg    xyz and rpy in degrees                 m   euler-xyz-deg      rx ry rz
ros        ROS position and orientation           m   quaternion-xyzw    qx qy qz qw
"""
# Names that suggest another form than these, and other names that suggest these.
_UNLIKELY, _ALSO = ("doosan", "realman", "rpy", "rpy-deg"), ("rpy", "rpy-deg")
POSE_FORMS: Mapping[str, PoseForm] = {
    name: PoseForm(
        *(name, words, unit, rotation, names, "".join(models)),
        *(name not in _UNLIKELY, "roll pitch yaw" if name in _ALSO else ""),
    )
    for line in _FORMS.strip().splitlines()
    for name, words, unit, rotation, names, *models in [re.split(r" {2,}", line)]
}
