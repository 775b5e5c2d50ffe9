"""Which fields are poses, and whose, by the words in their names."""

import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence

from visioncal.core.choices import UNITS_M
from visioncal.interchange.formats.fields import Fields

# The sign of degrees is written by an ordinal indicator, too.
DEGREES = ("deg", "degrees", "°", "º")
ANGLE_UNITS = (*DEGREES, "rad", "radians")
# Joints are called q1_rad, and the numbers of quaternions q1.
_UNIT = re.compile(
    rf"(?!q[0-9])(.*?)[ _]*+(?:[(\[] *({'|'.join([*UNITS_M, *ANGLE_UNITS])}) *[)\]]"
    rf"|(?<=_)({'|'.join([*UNITS_M, *ANGLE_UNITS])}))",
    re.IGNORECASE,
)
_POSITIONS = {"translation", "position", "pos", "tvec", "trans", "xyz", "t"}
_ROTATIONS = {"rotation", "orientation", "quaternion", "quat", "rvec", "rotvec", "rot", "r"}
_ROTATIONS |= {"rpy", "euler", "vector", "matrix", "xyzw", "wxyz"}
_WHOLE = {"pose", "poses", "transform", "transforms", "t", "h", "matrix"}
# The frame that stays and the one that is placed in it, for the robot and for the camera.
_FRAMES = {
    "robot": ({"base", "world", "root"}, {"gripper", "flange", "ee", "tcp", "tool", "hand", "tip"}),
    "camera": ({"cam", "camera", "eye", "sensor"}, {"target", "board", "marker", "tag", "object"}),
}
_MEANT = {"robot": {"robot", "arm", "effector"}, "camera": {"charuco", "aruco", "chessboard"}}
# Between two frames: the one that is placed stands first; else it stands second.
_PLACED_FIRST = {"2", "to", "in", "wrt"}


def without_unit(name: str) -> tuple[str, str]:
    """Tells a field's name from the unit behind it: `rx(deg)`, `X [mm]`, `x_m`."""
    match = _UNIT.fullmatch(name)
    return (match[1], (match[2] or match[3]).lower()) if match and match[1] else (name, "")


def worded_poses(fields: Fields, whose: str, taken: Collection[str]) -> tuple[str, ...]:
    """Finds the fields of the robot's or of the camera's poses by the words of their names.

    Returns:
        The name of a matrix or a whole pose, or those of positions and rotations; empty where no
        field's name says it, or the names of several poses do.
    """
    free = {
        name: numbers.reshape(len(fields), -1).shape[1]
        for name, numbers in fields.numbers.items()
        if numbers.ndim > 1 and name not in taken
    }
    found = list(dict.fromkeys([*_whole(free, whose), *_in_two(free, whose)]))
    return found[0] if len(found) == 1 else ()


def _whole(sizes: dict[str, int], whose: str) -> Iterator[tuple[str, ...]]:
    for name, size in sizes.items():
        words = _words(name)
        is_whole = size == 16 or (size in (6, 7, 12) and (_WHOLE | _PLACED_FIRST) & {*words})
        # A matrix that is alone and of nobody is the robot's.
        is_plain = [*sizes.values()] == [16] and whose == "robot" and not _sides(words)
        if is_whole and (is_plain or _is_of(words, whose)):
            yield (name,)


def _in_two(sizes: dict[str, int], whose: str) -> Iterator[tuple[str, ...]]:
    """Positions and rotations whose names have all other words in common."""
    positions: dict[tuple[str, ...], str] = {}
    rotations: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for name, size in sizes.items():
        words = _words(name)
        if size in (3, 4, 9) and _ROTATIONS & {*words}:
            rotations[tuple(word for word in words if word not in _ROTATIONS)].append(name)
        elif size == 3 and _POSITIONS & {*words}:
            positions[tuple(word for word in words if word not in _POSITIONS)] = name
    for left, position in positions.items():
        is_plain = not {*left} - _WHOLE and whose == "robot"
        if rotations[left] and (is_plain or _is_of(left, whose)):
            # Of several, what leaves the least open: a matrix, then a quaternion.
            yield position, max(rotations[left], key=lambda index: sizes[index])


def _words(name: str) -> list[str]:
    return [part for part in re.split(r"[\W_]+|(2)", without_unit(name)[0].lower()) if part]


def _is_of(words: Sequence[str], whose: str) -> bool:
    """Whether words name frames of one side alone, in the order of the pose that is wanted."""
    stays, placed = _FRAMES[whose]
    if _sides(words) != [whose]:
        return False
    frames = [word for word in words if word in stays | placed]
    if {*frames} & stays and {*frames} & placed:
        return (frames[0] in placed) == bool({*words} & _PLACED_FIRST)
    return True


def _sides(words: Sequence[str]) -> list[str]:
    """Whose frames words name."""
    return [
        frame
        for frame in _FRAMES
        if {*words} & (_FRAMES[frame][0] | _FRAMES[frame][1] | _MEANT[frame])
    ]
