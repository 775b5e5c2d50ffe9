"""Words by which fields of poses are called, and the sides that they name."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from visioncal.interchange.formats.fields import (
    Fields,
    without_unit,
)


def _set(words: str) -> set[str]:
    return {*words.split()}


POSITION_WORDS = _set("translation translational position pos ort posición tvec tvecs trans xyz t")
ROTATION_WORDS = _set(
    "rotation orientation quaternion quat rotvec rot r ori winkel drehung angle "
    "rotational ángulo giro rotación rvec rvecs rpy euler vector matrix xyzw wxyz theta"
)
# Of `p_RS_R_x` the last R is a frame.
PLACE = _set("p position")
POSE_WORDS = _set("pose poses transform transforms t h matrix")
# Words of the parent frame and of the child frame, for the robot and for the camera.
FRAMES = {
    "robot": (
        _set("base world root basis sockel welt 基座"),
        _set("gripper flange ee tcp tool hand tip flansch greifer werkzeug brida pinza")
        | _set("herramienta bride outil 法兰 法蘭 末端"),
    ),
    "camera": (
        _set("cam camera eye sensor kamera cámara camara caméra 相机 相機 vicon optitrack mocap"),
        _set("target board marker tag object tafel brett tablero mire 标定板 標定板"),
    ),
}
SIDE_WORDS = {
    "robot": _set("robot arm effector eef endeffector manipulator 机器人 機器人 机械臂 機械臂"),
    "camera": _set("charuco aruco chessboard checkerboard apriltag pattern cft"),
}
# Systems that measure the robot's pose, or the camera's where another side is named the robot's.
TRACKERS = _set("vicon optitrack mocap")
# Names of both sides of A X = X B, where no other poses stand beside them.
BOTH_SIDES = (("a", "b"), ("h", "e"), ("t1", "t2"))
# Frames by their initials, as in `t2c` and `g2b`: a parent of one side, and its children.
_INITIALS = (("b", "base", "gefht", "gripper"), ("c", "cam", "tmo", "target"))
# With these words between two frames the child is named first; otherwise second.
CHILD_FIRST = {"2", "to", "in", "wrt"}
# Frames in ViSP's names of homogeneous matrices, `wMe` and `cMo`: w, r or f of the robot's base.
_HOMOGENEOUS = re.compile(r"\b(?:([wrf])M[ef]|cMo)\b")
# Words of a script without spaces: flange, end, base, camera, board, robot, position, coordinates.
_UNSPACED = re.compile(
    "(法[兰蘭]|末端|基座|相[机機]|[标標]定板|[机機]器人|[机機]械臂|位置|位姿|[坐座][标標])"
)


def words_of(name: str) -> list[str]:
    """The words of a field's name, in small letters and without its unit."""
    name = _HOMOGENEOUS.sub(lambda found: "base_gripper" if found[1] else "cam_target", name)
    plain = re.sub(r"(?<=[a-z])(?=[A-Z][a-z])", "_", without_unit(name)[0])
    plain = _UNSPACED.sub(r"_\1_", plain)
    words = [part for part in re.split(r"[\W_]+|(2)", plain.lower()) if part]
    for at in (at for at, word in enumerate(words[1:-1], 1) if word == "2"):
        ends = (words[at - 1], words[at + 1])
        for letter, parent, letters, child in _INITIALS:
            if ends in ((letter, other) for other in letters):
                words[at - 1 : at + 2] = [parent, "2", child]
            elif ends in ((other, letter) for other in letters):
                words[at - 1 : at + 2] = [child, "2", parent]
    return words


@dataclass(frozen=True)
class PoseFields:
    """Fields that may hold poses: one, or those of a position and of a rotation."""

    names: tuple[str, ...]
    words: tuple[str, ...]  # Words of the names beside `position` and the like.
    is_named: bool = True  # Whether the names are those of a pose.

    @property
    def sides(self) -> list[str]:
        """The sides, robot or camera, whose frames the words name."""
        return [
            frame
            for frame in FRAMES
            if {*self.words} & (FRAMES[frame][0] | FRAMES[frame][1] | SIDE_WORDS[frame])
        ]

    @property
    def is_seen(self) -> bool:
        """Whether they are vectors of the target, as OpenCV and MATLAB call them."""
        return not self.sides and any(map(SEEN.search, self.names))

    @property
    def is_of_target(self) -> bool:
        """Whether the names suggest poses of the target."""
        return self.is_named and (self.is_seen or self.sides == ["camera"])

    def is_like(self, names: Sequence[str], fields: Fields) -> bool:
        """Whether other fields have as many numbers each: of the likeliest, which agree, copies."""
        sizes = [[fields.column(name).shape[1] for name in each] for each in (self.names, names)]
        return sizes[0] == sizes[1]

    def is_reversed(self, side: str) -> bool:
        """Whether the words name the frames of a side in the order of the inverse pose."""
        parent, child = FRAMES[side]
        frames = [word for word in self.words if word in parent | child]
        if not ({*frames} & parent and {*frames} & child):
            return False
        return (frames[0] in child) != bool({*self.words} & CHILD_FIRST)


# Vectors that a calibration of the camera gives.
SEEN = re.compile("[rt]vecs?$|(rotation|translation)(al)?_?vectors$", re.IGNORECASE)
