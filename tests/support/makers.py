"""Poses as the makers of robots write them, by SciPy from their manuals, without visioncal."""

import re

import numpy as np
from scipy.spatial.transform import Rotation
from support.marks import slow


def _euler(order, *, degrees=True):
    """A rotation from and to angles; capitals turn about moving axes."""
    return (
        lambda angles: Rotation.from_euler(order, angles, degrees=degrees),
        lambda turn: turn.as_euler(order, degrees=degrees),
    )


# By maker: the names of a pose's numbers, and its rotation from and to the last of them. Positions
# are in millimetres, but for those of METRES.
MAKERS = {
    # p[x, y, z, rx, ry, rz]: a rotation vector in radians (Script manual).
    "ur": ("x,y,z,rx,ry,rz", Rotation.from_rotvec, Rotation.as_rotvec),
    # A about z, B about the new y, C about the new x (System variables, FRAME).
    "kuka": ("X,Y,Z,A,B,C", *_euler("ZYX")),
    # W, P, R about the fixed x, y, z.
    "fanuc": ("X,Y,Z,W,P,R", *_euler("xyz")),
    "yaskawa": ("X,Y,Z,Rx,Ry,Rz", *_euler("xyz")),
    # orient: q1 is the scalar (RAPID, data types).
    "abb": (
        "X,Y,Z,q1,q2,q3,q4",
        lambda q: Rotation.from_quat(q, scalar_first=True),
        lambda turn: turn.as_quat(scalar_first=True, canonical=True),
    ),
    # About the moving x, y, z (VAL 3, trsf).
    "staubli": ("X,Y,Z,Rx,Ry,Rz", *_euler("XYZ")),
    # About the moving z, y, z (DRL, posx).
    "doosan": ("X,Y,Z,A,B,C", *_euler("ZYZ")),
    # Roll, pitch, yaw about the fixed x, y, z (xArm user manual, terms and definitions).
    "xarm": ("X,Y,Z,roll,pitch,yaw", *_euler("xyz")),
    # Intrinsic XYZ (mecademicpy, MovePose).
    "mecademic": ("X,Y,Z,alpha,beta,gamma", *_euler("XYZ")),
    # O about z, A about the new y, T about the new z (rc_visard manual, pose formats).
    "kawasaki": ("X,Y,Z,O,A,T", *_euler("ZYZ")),
    # eDO_core, vZYZm.
    "comau": ("X,Y,Z,A,E,R", *_euler("ZYZ")),
    # Roll, pitch, yaw, intrinsic ZYX [rad and m] (SDK FAQ).
    "realman": ("x,y,z,rx,ry,rz", *_euler("xyz", degrees=False)),
    # setRPY of Rx, Ry, Rz (tmr_ros1).
    "techman": ("X,Y,Z,Rx,Ry,Rz", *_euler("xyz")),
    # U about z, V about y, W about x (SPEL+ language reference, point data).
    "epson": ("X,Y,Z,U,V,W", *_euler("ZYX")),
}
# Makers one of each form, and those whose poses are written as another one's: left to the long run
# where only the form of the poses counts.
ALIKE = {"yaskawa", "xarm", "mecademic", "kawasaki", "comau", "techman", "epson"}
BY_FORM = [slow(maker) if maker in ALIKE else maker for maker in MAKERS]
# Of these, those in metres and radians.
METRES = ("ur", "realman")
NUMBER = r"-?\d+\.?\d*(?:e-?\d+)?"


def unit_m(maker):
    return 1.0 if maker in METRES else 1e-3


def written(maker, pose):
    """The numbers of a (4, 4) pose [m]."""
    turn = MAKERS[maker][2](Rotation.from_matrix(pose[:3, :3]))
    return [*(pose[:3, 3] / unit_m(maker)).tolist(), *turn.tolist()]


def pose_of(maker, numbers, length_m=None):
    """The (4, 4) pose [m] of numbers; positions in `length_m`, else as the maker has them."""
    numbers, pose = np.array(numbers, dtype=float), np.eye(4)
    pose[:3, 3] = numbers[:3] * (length_m or unit_m(maker))
    pose[:3, :3] = MAKERS[maker][1](numbers[3:]).as_matrix()
    return pose


def shown(maker, line):
    """The (4, 4) pose [m] of a line as a pendant shows it, `X 512.3 mm, ... A 10.1 deg ...`."""
    names = MAKERS[maker][0].split(",")
    found = [re.search(rf"\b{name} ({NUMBER})", line, re.IGNORECASE)[1] for name in names]
    units = set(re.findall(rf"{NUMBER} (mm|m|deg|rad)\b", line))
    assert units == {"mm", *([] if maker == "abb" else ["rad" if maker in METRES else "deg"])}, line
    return pose_of(maker, found, 1e-3)
