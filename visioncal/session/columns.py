"""Columns of views.csv: known ones, and groups of them."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache

from scipy.spatial.transform import Rotation

from visioncal.core.documents.columns import Column
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import FloatArray
from visioncal.core.verdict import READ_AGAIN
from visioncal.robot.loads import MOST_CENTRE_M, MOST_KG

POSITION = ("x_m", "y_m", "z_m")
QUATERNION = ("qx", "qy", "qz", "qw")
POSE = POSITION + QUATERNION
MEASURED_CAM_POSE = tuple(f"cft_{name}" for name in POSE)
INSTRUMENT_POSITION = tuple(f"meas_{name}" for name in POSITION)
INSTRUMENT_QUATERNION = tuple(f"meas_{name}" for name in QUATERNION)

# Groups of columns that a row fills completely or not at all.
WHOLE_GROUPS = (POSE, MEASURED_CAM_POSE, INSTRUMENT_POSITION, INSTRUMENT_QUATERNION)
QUATERNION_GROUPS = (QUATERNION, MEASURED_CAM_POSE[3:], INSTRUMENT_QUATERNION)

# Payload on the flange and external force.
LOAD = (
    "payload_kg",
    *(f"payload_{axis}_m" for axis in "xyz"),
    *(f"force_{axis}_n" for axis in "xyz"),
)
# Columns of rotations other than quaternions.
ROTATIONS = tuple(
    tuple(f"{name}{unit}" for name in names)
    for names in (("rx", "ry", "rz"), ("a", "b", "c"), ("w", "p", "r"), ("roll", "pitch", "yaw"))
    for unit in ("", "_deg", "_rad")
)
# Names of position columns other than in metres.
_POSITIONS = (("x", "y", "z"), ("tx", "ty", "tz"), ("x_mm", "y_mm", "z_mm"))
_PLAIN_NUMBERS = frozenset({"stamp_s", "ambient_c", *LOAD}.union(*WHOLE_GROUPS))
_NUMBERED = re.compile(r"(q[1-9]\d*_rad|tau[1-9]\d*_nm|current[1-9]\d*_a|temp[1-9]\d*_c)", re.ASCII)
_JOINT = re.compile(r"q([1-9][0-9]*)_rad")
_TEXTS = frozenset(
    {"view", "stop", "role", "image", "depth", "point", "group", "approach"}
    | {"camera", "robot", "target", "instrument"}
)
# Largest plausible numbers by unit, with the message for a larger one. The limits of metres and
# radians admit poses in micrometres and turns in degrees. Stamps beyond the year 2286 do not
# resolve microseconds, and are in milliseconds or less.
_SIZES: Mapping[str, tuple[float, str]] = {
    "m": (1e7, "{0:g} m is beyond every robot cell; write metres ({0:g} mm?)"),
    "rad": (1e4, "{0:g} rad is beyond every joint; write radians"),
    "s": (1e10, "{0:g} s is beyond every recording; write seconds"),
    "rad_s": (1e5, "{0:g} rad/s is beyond every joint's speed"),
    "rad_s2": (1e8, "{0:g} rad/s^2 is beyond every joint's acceleration"),
    "nm": (1e6, "{0:g} Nm is beyond every joint's torque"),
    "a": (1e6, "{0:g} A is beyond every motor's current"),
    "n": (25_000.0, "{0:g} N is beyond every force on a robot's flange; write newtons"),
}
_RATE = re.compile(r"d{1,2}q[1-9]\d*_(rad_s2?)", re.ASCII)
# Columns that name one of several cameras, robots or instruments.
SELECTORS = ("camera", "robot", "instrument")


def is_number(column: str) -> bool:
    """Whether a column is a known one of numbers."""
    return column in _PLAIN_NUMBERS or _NUMBERED.fullmatch(column) is not None


def column_of(name: str) -> Column:
    """A column of views.csv or a stream with the plausible range of its numbers."""
    if name == "payload_kg":
        words = f"{{:g}} kg must be a payload of 0 to {MOST_KG:g} kg"
        return Column(name, 0.0, MOST_KG, words.format)
    if name in LOAD[1:4]:
        words = (
            f"{{0:g}} m must be within {MOST_CENTRE_M:g} m, the place of a payload's centre in the "
            "flange's frame; write metres ({0:g} mm?)"
        )
        return Column(name, -MOST_CENTRE_M, MOST_CENTRE_M, words.format)
    rate = _RATE.fullmatch(name)
    unit = rate[1] if rate else name.rpartition("_")[2] if is_number(name) else ""
    if unit == "c":
        words = (
            "{:g} deg C must be a temperature of a robot or its air, -60 to 200 degrees Celsius, "
            "and not in kelvin"
        )
        return Column(name, -60.0, 200.0, words.format)
    # Limit in other columns, so that squares and products do not overflow.
    most, words = _SIZES.get(unit, (1e60, "{0:g} is beyond every number of a cell"))
    return Column(name, -most, most, words.format)


@cache
def joint_columns(columns: tuple[str, ...]) -> tuple[str, ...]:
    """The columns of joint angles, q1_rad first."""
    numbers = sorted(int(match[1]) for name in columns if (match := _JOINT.fullmatch(name)))
    return tuple(f"q{number}_rad" for number in numbers)


def pose_row(pose: FloatArray) -> dict[str, float]:
    """Values of a pose (4, 4) by column."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    return dict(zip(POSE, map(float, [*pose[:3, 3], *quaternion]), strict=True))


def check_header(columns: Sequence[str], where: str) -> None:
    """Checks the header row of a views.csv; `where` names it in messages; raises DataError."""
    problems = list(_header_problems(columns))
    lower = {name.lower(): name for name in columns}
    others = [*(position_columns(columns) or ())]
    if not set(QUATERNION) & set(columns):
        rotations = (names for names in ROTATIONS if lower.keys() >= set(names))
        others += [lower[name] for name in next(rotations, ())]
    # Additional columns beside complete poses or joints are not meant as poses.
    has_state = bool(set(POSE) & set(columns) or joint_columns(tuple(columns)))
    if others and (problems or (not has_state and len(others) > len(POSITION))):
        raise DataError(
            f"{where}: poses are in {','.join(others)}, but must be in {', '.join(POSE)}, in "
            "metres and as quaternions.",
            culprits=[where],
            next_step=f"The images show their unit and form. {READ_AGAIN}",
        )
    if problems:
        raise DataError(f"{where}: {'; '.join(problems)}.", culprits=[where])


def position_columns(columns: Sequence[str]) -> tuple[str, ...] | None:
    """Columns of positions with other names; None where there are none."""
    lower = {name.lower(): name for name in columns}
    group = next((position for position in _POSITIONS if lower.keys() >= set(position)), None)
    if group is None or set(POSITION) & set(columns):
        return None
    return tuple(lower[word] for word in group)


def of_other_units(missing: Sequence[str], columns: Iterable[str]) -> str:
    """Words on columns of missing quantities, in other letters or units; empty for none."""
    stems = {name.rpartition("_")[0]: name for name in missing}
    pairs = [(name, stems.get(name.rpartition("_")[0])) for name in columns]
    if capitals := [f"{name} as {name.lower()}" for name in columns if name.lower() in missing]:
        return f"; write {', '.join(capitals)}, in small letters"
    turned = [f"{name} as {wanted}" for name, wanted in pairs if wanted and name != wanted]
    return f"; write {', '.join(turned)}, in the unit of that name" if turned else ""


def _header_problems(columns: Sequence[str]) -> Iterator[str]:
    for place, name in enumerate(columns, start=1):
        if not name:
            yield f"column {place} has no name"
        elif name in columns[: place - 1]:
            first = columns.index(name) + 1
            yield f"column {name} is there twice (columns {first} and {place}): delete one"
    if "view" not in columns:
        is_comment = columns and columns[0].startswith(("#", "//"))
        yield (
            "the first line is a comment, and has to be the header: delete it"
            if is_comment
            else "the column view, a whole number that names each row, is missing"
        )
        if is_comment:
            return
    joints = joint_columns(tuple(columns))
    wanted = [f"q{number}_rad" for number in range(1, len(joints) + 1)]
    gaps = [name for name in wanted if name not in joints]
    if gaps:
        unit_note = of_other_units(gaps, columns)
        yield f"the joint columns {', '.join(joints)} lack {', '.join(gaps)}{unit_note}"
    for group in WHOLE_GROUPS:
        missing = [name for name in group if name not in columns]
        if 0 < len(missing) < len(group):
            yield (
                f"the columns {', '.join(name for name in group if name in columns)} "
                f"lack {', '.join(missing)}{of_other_units(missing, columns)}"
            )


def column_warnings(columns: Sequence[str]) -> Iterator[str]:
    """Warnings of unknown columns of a views.csv that look like misspelt known ones."""
    known = _TEXTS | _PLAIN_NUMBERS | {f"q{number}_rad" for number in range(1, 8)}
    for name in columns:
        # A known word with a suffix, as target_id, is not misspelt.
        is_other = name in known or is_number(name) or re.split(r"[_.]", name)[0] in known
        in_radians = name.replace("_deg", "_rad")
        # The similarity of `status` and `stamp_s` is 0.62.
        if hint := "" if is_other else did_you_mean(in_radians, known, 0.76):
            yield f"views.csv: column {name} is not a known one and is kept as text. {hint}"
