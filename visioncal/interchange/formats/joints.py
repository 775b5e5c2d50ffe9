"""Finds the fields of joint angles by their names, and reads them."""

import re
from collections import defaultdict
from collections.abc import Collection, Sequence

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.fields import DEGREES, Fields, without_unit
from visioncal.session.columns import joint_columns

_JOINTS = re.compile(
    r"(?:.*[._])?(?:joint_pose|joints?|joint_angles|joint_(?:positions?|values?|states?)|q)"
)
_JOINT_NAME = re.compile(
    r"(?:.*\.)?((?:[^.]*_)?(?:joint|axis|gelenk|achse)|(?:actual_)?q|j|a|theta|θ)[ _]?([0-9])"
    r"((?:[ _]?(?:pos|position|angle))?(?:[ _]*\W*(?:deg|rad|[°º])[a-z]*\W*)?)",
    re.IGNORECASE,
)
# Words of joint angles within longer names, and the numbers of joints that arms have.
_JOINT_WORDS = re.compile(
    r"joint\w*angle|angle\w*joint|angle_?positions?|gelenkwinkel|achswinkel|关节|關節"
)
OF_ARMS = range(5, 9)
# Three angles may be a rotation.
_ANGLES = re.compile(r"(?:.*[._])?angles")
# Universal Robots' names, which ROS writes in the order of the alphabet.
_OF_UR = (
    *("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"),
    *("wrist_1_joint", "wrist_2_joint", "wrist_3_joint"),
)
# Numbers of joints that are no angles.
_NO_ANGLE = re.compile("vel|speed|acc|effort|torque|curr|temp|target|desired|command")


def joint_names(
    fields: Fields, taken: Collection[str], known: Sequence[str] = _OF_UR
) -> tuple[str, ...]:
    """Finds the fields of joint angles: one list, or a field a joint, numbered from one or `known`.

    Those of known names are in the order of these.
    """
    if columns := joint_columns(tuple(fields.numbers)):
        return columns
    if columns := _joints_called(fields, taken, known):
        return columns
    plain = {name: without_unit(name)[0].lower() for name in fields.numbers}
    lists = [
        name
        for name, numbers in fields.numbers.items()
        if numbers.ndim > 1
        and name not in taken
        and (
            _JOINTS.fullmatch(plain[name])
            or (numbers[0].size in OF_ARMS and _is_of_joints(plain[name]))
            or (numbers[0].size > 4 and _ANGLES.fullmatch(plain[name]))
        )
    ]
    if len(lists) == 1:
        return (lists[0],)
    counted: dict[tuple[str, ...], dict[int, str]] = defaultdict(dict)
    for name, numbers in fields.numbers.items():
        match = _JOINT_NAME.fullmatch(name)
        is_whole = numbers.ndim == 1 and bool(np.isfinite(numbers).all())
        if match and is_whole and name not in taken:
            counted[match.group(1, 3)][int(match[2])] = name
    for by_number in counted.values():
        # Four numbers q1 ... may be a quaternion. UR's programs count from zero.
        if len(by_number) >= 5 and [*by_number] in (
            [*range(len(by_number))],
            [*range(1, len(by_number) + 1)],
        ):
            return tuple(by_number.values())
    return ()


def _is_of_joints(plain: str) -> bool:
    """Whether a longer name, in small letters, has the words of joint angles."""
    last = plain.rpartition(".")[2]
    return bool(_JOINT_WORDS.search(last)) and not _NO_ANGLE.search(last)


def _joints_called(fields: Fields, taken: Collection[str], known: Sequence[str]) -> tuple[str, ...]:
    """The only columns of some joints' names, with words before or after; empty unless one each."""
    called = defaultdict[str, list[str]](list)
    for name, numbers in fields.numbers.items():
        plain = without_unit(name)[0].lower()
        if numbers.ndim > 1 or name in taken or _NO_ANGLE.search(plain):
            continue
        plain = re.sub(r"[._ ](?:pos|position|angle|value|state)$", "", plain)
        for joint in known:
            if re.search(rf"(?:^|[._ /]){re.escape(joint.lower())}$", plain):
                called[joint].append(name)
    columns = [called[joint] for joint in known]
    return tuple(names[0] for names in columns) if all(len(n) == 1 for n in columns) else ()


def joints_from(
    fields: Fields, names: Sequence[str], *, degrees: bool
) -> tuple[FloatArray, tuple[str, ...]]:
    """Reads joint angles from fields, in degrees where the options, the names or their size say so.

    Returns:
        (n, j) angles [rad], and notes on assumptions.

    Raises:
        DataError: There are no such fields, a row lacks some, or they are too large for the radians
            of their names.
    """
    joints = np.hstack([fields.column(name) for name in names])
    bad = ~np.isfinite(joints).all(axis=1)
    ends = [name.rsplit(".", 1)[-1].lower() for name in names]
    largest = np.abs(joints).max(initial=0.0)
    is_named = degrees or all(any(unit in end for unit in DEGREES) for end in ends)
    # Joints may make several turns.
    is_large = not is_named and bool(largest > 10 * 2 * np.pi)
    fault = "a joint angle is missing or infinite" if bad.any() else ""
    if is_large and any("rad" in end for end in ends):
        fault = f"joint angles up to {largest:.0f} are no radians: say --joint-unit deg"
    if fault:
        place = fields.places[int(np.argmax(bad))]
        raise DataError(f"{place}: {fault}.", culprits=[place])
    note = f"Joint angles up to {largest:.0f} are no radians, and are taken for degrees."
    return np.deg2rad(joints) if is_named or is_large else joints, (note,) if is_large else ()
