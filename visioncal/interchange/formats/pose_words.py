"""Recognises fields of poses by the words in their names."""

import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence

from visioncal.core.choices import UNITS_M
from visioncal.interchange.formats.fields import Fields

# An ordinal indicator is common for the degree sign, too.
DEGREES = ("deg", "degrees", "°", "º")
ANGLE_UNITS = (*DEGREES, "rad", "radians")
# q1_rad is a joint; q1 alone is part of a quaternion.
_UNIT = re.compile(
    rf"(?!q[0-9])(.*?)[ _]*+(?:[(\[] *({'|'.join([*UNITS_M, *ANGLE_UNITS])}) *[)\]]"
    rf"|(?<=_)({'|'.join([*UNITS_M, *ANGLE_UNITS])}))",
    re.IGNORECASE,
)
_POSITION_WORDS = {"translation", "position", "pos", "tvec", "trans", "xyz", "t"}
_ROTATION_WORDS = {"rotation", "orientation", "quaternion", "quat", "rvec", "rotvec", "rot", "r"}
_ROTATION_WORDS |= {"rpy", "euler", "vector", "matrix", "xyzw", "wxyz"}
_POSE_WORDS = {"pose", "poses", "transform", "transforms", "t", "h", "matrix"}
# Words of the parent frame and of the child frame, for the robot and for the camera.
_FRAMES = {
    "robot": ({"base", "world", "root"}, {"gripper", "flange", "ee", "tcp", "tool", "hand", "tip"}),
    "camera": ({"cam", "camera", "eye", "sensor"}, {"target", "board", "marker", "tag", "object"}),
}
_SIDE_WORDS = {"robot": {"robot", "arm", "effector"}, "camera": {"charuco", "aruco", "chessboard"}}
# With these words between two frames the child is named first; otherwise second.
_CHILD_FIRST = {"2", "to", "in", "wrt"}


def without_unit(name: str) -> tuple[str, str]:
    """Splits a field's name from its unit: `rx(deg)`, `X [mm]`, `x_m`."""
    match = _UNIT.fullmatch(name)
    return (match[1], (match[2] or match[3]).lower()) if match and match[1] else (name, "")


def pose_fields_by_words(fields: Fields, whose: str, taken: Collection[str]) -> tuple[str, ...]:
    """Finds the fields of the robot's or the camera's poses by the words of their names.

    Returns:
        The name of a matrix or a whole pose, or those of position and rotation; empty where no name
        fits, or those of several poses do.
    """
    free = {
        name: numbers.reshape(len(fields), -1).shape[1]
        for name, numbers in fields.numbers.items()
        if numbers.ndim > 1 and name not in taken
    }
    candidates = list(dict.fromkeys([*_whole_poses(free, whose), *_split_poses(free, whose)]))
    return candidates[0] if len(candidates) == 1 else ()


def _whole_poses(sizes: dict[str, int], whose: str) -> Iterator[tuple[str, ...]]:
    for name, size in sizes.items():
        words = _words(name)
        is_whole = size == 16 or (size in (6, 7, 12) and (_POSE_WORDS | _CHILD_FIRST) & {*words})
        # A single matrix without frame words is the robot's.
        is_plain = [*sizes.values()] == [16] and whose == "robot" and not _sides(words)
        if is_whole and (is_plain or _is_of(words, whose)):
            yield (name,)


def _split_poses(sizes: dict[str, int], whose: str) -> Iterator[tuple[str, ...]]:
    """Pairs of position and rotation whose names share all other words."""
    positions: dict[tuple[str, ...], str] = {}
    rotations: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for name, size in sizes.items():
        words = _words(name)
        if size in (3, 4, 9) and _ROTATION_WORDS & {*words}:
            rotations[tuple(word for word in words if word not in _ROTATION_WORDS)].append(name)
        elif size == 3 and _POSITION_WORDS & {*words}:
            positions[tuple(word for word in words if word not in _POSITION_WORDS)] = name
    for rest, position in positions.items():
        is_plain = not {*rest} - _POSE_WORDS and whose == "robot"
        if rotations[rest] and (is_plain or _is_of(rest, whose)):
            # Of several rotations the least ambiguous: a matrix, then a quaternion.
            yield position, max(rotations[rest], key=lambda index: sizes[index])


def _words(name: str) -> list[str]:
    return [part for part in re.split(r"[\W_]+|(2)", without_unit(name)[0].lower()) if part]


def _is_of(words: Sequence[str], whose: str) -> bool:
    """Whether words name frames of one side only, in the order of the wanted pose."""
    parent, child = _FRAMES[whose]
    if _sides(words) != [whose]:
        return False
    frames = [word for word in words if word in parent | child]
    if {*frames} & parent and {*frames} & child:
        return (frames[0] in child) == bool({*words} & _CHILD_FIRST)
    return True


def _sides(words: Sequence[str]) -> list[str]:
    """The sides, robot or camera, whose frames the words name."""
    return [
        frame
        for frame in _FRAMES
        if {*words} & (_FRAMES[frame][0] | _FRAMES[frame][1] | _SIDE_WORDS[frame])
    ]
