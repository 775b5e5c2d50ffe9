"""Recognises fields of poses by the words in their names."""

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from visioncal.core.choices import UNITS_M
from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, PoseNumbers, Reading
from visioncal.core.documents.pendants import forms_named
from visioncal.core.errors import DataError
from visioncal.core.limits import FAR_M
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.foreign import PoseImportOptions
from visioncal.interchange.formats.reading import Fields, named_by
from visioncal.session.columns import SELECTORS, joint_columns

# An ordinal indicator is common for the degree sign, too.
_DEGREES = ("deg", "degrees", "°", "º")
_ANGLES = (*_DEGREES, "rad", "radians")
# q1_rad is a joint; q1 alone is part of a quaternion.
_UNIT = re.compile(
    rf"(?!q[0-9])(.*?)[ _]*+(?:[(\[] *({'|'.join([*UNITS_M, *_ANGLES])}) *[)\]]"
    rf"|(?<=_)({'|'.join([*UNITS_M, *_ANGLES])}))",
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
    """A field's name without its unit, and that, or none: `rx(deg)`, `X [mm]`, `x_m`."""
    match = _UNIT.fullmatch(name)
    return (match[1], (match[2] or match[3]).lower()) if match and match[1] else (name, "")


def _fields_by_words(fields: Fields, whose: str, taken: Collection[str]) -> tuple[str, ...]:
    """Finds the fields of the robot's or the camera's poses by the words of their names."""
    sizes = {
        name: numbers.reshape(len(fields), -1).shape[1]
        for name, numbers in fields.numbers.items()
        if numbers.ndim > 1 and name not in taken
    }
    found: dict[tuple[str, ...], None] = {}
    positions: dict[tuple[str, ...], str] = {}
    rotations: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for name, size in sizes.items():
        words = [part for part in re.split(r"[\W_]+|(2)", without_unit(name)[0].lower()) if part]
        is_whole = size == 16 or (size in (6, 7, 12) and (_POSE_WORDS | _CHILD_FIRST) & {*words})
        # A single matrix without frame words is the robot's.
        is_plain = [*sizes.values()] == [16] and whose == "robot" and not _sides(words)
        if is_whole and (is_plain or _is_of(words, whose)):
            found[(name,)] = None
        if size in (3, 4, 9) and _ROTATION_WORDS & {*words}:
            rotations[tuple(word for word in words if word not in _ROTATION_WORDS)].append(name)
        elif size == 3 and _POSITION_WORDS & {*words}:
            positions[tuple(word for word in words if word not in _POSITION_WORDS)] = name
    # Names of position and rotation share all other words.
    for rest, position in positions.items():
        is_plain = not {*rest} - _POSE_WORDS and whose == "robot"
        if rotations[rest] and (is_plain or _is_of(rest, whose)):
            # Of several rotations the least ambiguous: a matrix, then a quaternion.
            found[position, max(rotations[rest], key=lambda index: sizes[index])] = None
    return next(iter(found)) if len(found) == 1 else ()


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


# Common names of pose fields, the most specific first.
ROBOT_KEYS: tuple[tuple[str, ...], ...] = (
    ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
    ("effector_wrt_world",),
    ("O_T_EE",),
    ("base_from_flange",),
    ("base_T_flange",),
    ("base_T_tool",),
    ("base_T_ee",),
    ("T_base_ee",),
    ("robot_pose",),
    ("robot_poses",),
    ("R_gripper2base", "t_gripper2base"),
    ("x", "y", "z", "qx", "qy", "qz", "qw"),
    ("tx", "ty", "tz", "qx", "qy", "qz", "qw"),
    *dict.fromkeys(("x", "y", "z", *form.names.split()) for form in POSE_FORMS.values()),
    ("pose",),
    ("robot",),
    ("robot.rvec", "robot.tvec"),
    ("matrix",),
)
CAMERA_KEYS: tuple[tuple[str, ...], ...] = (
    ("cft_x_m", "cft_y_m", "cft_z_m", "cft_qx", "cft_qy", "cft_qz", "cft_qw"),
    ("object_wrt_sensor",),
    ("cam_from_target",),
    ("T_cam_target_rvec", "T_cam_target_tvec"),
    ("T_cam_target",),
    ("camera_T_target",),
    ("R_target2cam", "t_target2cam"),
    ("camera_pose",),
    ("camera_poses",),
    ("rvec", "tvec"),
    ("rvecs", "tvecs"),
    ("camera",),
    ("camera.rvec", "camera.tvec"),
)
JOINT_KEYS: tuple[str, ...] = ("joint_pose", "joints", "joint_angles", "joint_positions", "q")

_JOINT_NAME = re.compile(
    r"(?:.*\.)?(joint|axis|j|a|q)[ _]?([1-9])((?:[ _]?(?:pos|position|angle))?(?:[ _]*\W*"
    r"(?:deg|rad|[°º])[a-z]*\W*)?)",
    re.IGNORECASE,
)

_ROTATION_NAME = re.compile(r"rvec|rot|quat|orient|rpy|euler|(^|\.)R(_|$)")
_ANGLES_NAME = re.compile(r"rpy|roll|euler")


def known_names(
    fields: Fields, candidates: Sequence[tuple[str, ...]], taken: Collection[str]
) -> tuple[str, ...]:
    """Full names of the first candidate whose fields all exist and are not taken; else empty.

    Case and units are ignored. A text field counts only within a set of several names, so that a
    wrong cell is reported by its place.
    """
    # A single number in a field called `robot` or `camera` is a selector, not a pose.
    numbers = (
        name for name, values in fields.numbers.items() if values.ndim > 1 or name not in SELECTORS
    )
    numeric = [*numbers, *fields.shape_errors]
    textual = (name for name, cells in fields.texts.items() if any(cells) and name not in SELECTORS)
    free_names = [name for name in dict.fromkeys([*numeric, *textual]) if name not in taken]
    endings = Counter(name.rsplit(".", 1)[-1] for name in free_names)
    full = {end: name for name in free_names if endings[end := name.rsplit(".", 1)[-1]] == 1}
    full |= {name: name for name in free_names}
    # An exact match of a name goes before one in another case or with a unit.
    plain = {name: without_unit(name)[0].lower() for name in full}
    counts = Counter(plain.values())
    without_units = {plain[word]: name for word, name in full.items() if counts[plain[word]] == 1}
    full = without_units | {word.lower(): name for word, name in full.items()} | full
    for candidate in candidates:
        matches = tuple(full.get(name, full.get(name.lower(), "")) for name in candidate)
        if all(matches) and (len(matches) > 1 or matches[0] in numeric):
            return matches
    return ()


def pose_names(
    fields: Fields,
    given: Sequence[str],
    unnamed: tuple[str, ...],
    whose: str,
    taken: Collection[str],
) -> tuple[str, ...]:
    """Full names of the fields with the poses of the `robot` or `camera`; empty where none fit.

    They are those that the user gives, else the `unnamed` columns of a table without a header, else
    fields with a known name that are not `taken`. Raises DataError.
    """
    if given:
        return tuple(fields.find(name) for name in given)
    if unnamed:
        return () if set(unnamed) & set(taken) else unnamed
    keys = ROBOT_KEYS if whose == "robot" else CAMERA_KEYS
    return known_names(fields, keys, taken) or _fields_by_words(fields, whose, taken)


def poses_from(
    fields: Fields, names: Sequence[str], requested: PoseImportOptions, whose: str
) -> tuple[PoseNumbers, tuple[str, ...]]:
    """Reads the poses of the `robot` or `camera` from fields, with notes on assumptions.

    16 numbers are a matrix, by rows or by columns as its last row of 0, 0, 0, 1 shows; 12 are its
    upper three rows, or a position and a rotation by rows, whichever gives rotations; otherwise a
    position of three numbers and a rotation, ordered as names such as rvec and tvec show. Raises
    DataError.
    """
    if whose == "robot" and requested.form is None:
        requested = replace(requested, form=_usual_form(names, requested.usual))
    if whose == "robot" and fields.form:
        # The rows themselves state the form of their poses.
        if requested.form not in (None, fields.form):
            raise DataError(
                f"{fields.places[0]}: the pose is written as {POSE_FORMS[fields.form].words}, not "
                f"as {requested.form}.",
                culprits=["--robot-form"],
            )
        requested = replace(requested, form=fields.form)
    if not requested.names and len(names) == 7 and requested.rotation == "quaternion-wxyz":
        # --form refers to the columns in their order in the file, and these were found by their
        # names.
        order = {name: at for at, name in enumerate(fields.numbers)}
        names = (*names[:3], *sorted(names[3:], key=lambda name: order.get(name, 0)))
    blocks = [fields.column(name) for name in names]
    sizes = [block.shape[1] for block in blocks]
    flat, unit, notes = np.hstack(blocks), requested.unit, tuple[str, ...]()
    if sum(sizes) in (12, 16) and 9 not in sizes:
        positions, rotations = _matrices(flat)
        rotation = "matrix"
        requested = _by_rows(requested, sum(sizes))
        unit = requested.unit
    else:
        positions, rotations, rotation_names = flat[:, :3], flat[:, 3:], tuple(names[3:] or names)
        if len(blocks) == 2:
            rotation_first = sizes[1] == 3
            if sizes[0] == sizes[1]:
                rotation_first = _ROTATION_NAME.search(names[0]) is not None
            positions, rotations = blocks[::-1] if rotation_first else blocks
            rotation_names = (names[0] if rotation_first else names[1],)
        if rotations.shape[1] not in (3, 4, 9) or positions.shape[1] != 3:
            raise DataError(
                f"{fields.name}: {', '.join(names)} have {sum(sizes)} numbers; a pose has 16 or 12 "
                "(matrix), 7 (quaternion) or 6 (three angles). There are " + fields.listing() + ".",
                culprits=list(names),
                next_step=f"Name the fields of the {whose}'s poses with --{whose}-"
                f"{named_by(fields.places[0])}.",
            )
        units = {without_unit(name)[1] for name in names}
        rotation, notes = _likely_rotation(
            rotations.shape[1], rotation_names, requested, whose, degrees=bool(units & {*_DEGREES})
        )
        lengths = units - {"", *_ANGLES}
        unit = unit or (lengths.pop() if len(lengths) == 1 else None)
    if unit is None and requested.form not in POSE_FORMS:
        notes = (
            *notes,
            f"The {whose}'s positions are taken for metres, as the source does not say; "
            f"--{whose}-unit names another unit.",
        )
    reading = replace(requested, unit=unit).reading(Reading(rotation))
    return PoseNumbers(positions, rotations, reading, fields.places), notes


def _by_rows(requested: PoseImportOptions, count: int) -> PoseImportOptions:
    """Options of matrices: whether 16 numbers are by rows or by columns is known."""
    form = POSE_FORMS.get(requested.form or "")
    if count == 12 or not requested.rotation.startswith("matrix"):
        return requested
    return replace(requested, form=None, unit=requested.unit or (form.unit if form else None))


def _usual_form(names: Sequence[str], usual: str | None) -> str | None:
    """The robot's own form, where names of a pose's numbers fit it; raises DataError."""
    plain, units = zip(*map(without_unit, names), strict=True)
    form, makers = POSE_FORMS.get(usual or ""), forms_named([name.lower() for name in plain[3:]])
    if form is None or "ros" in makers:
        return None
    if makers and form.name not in makers:
        raise DataError(
            f"{', '.join(names)} are not {form.words}, the form of this robot's poses.",
            culprits=names,
            next_step=f"Say whose they are, as --robot-form {makers[0]}.",
        )
    fits = len(names) == 3 + ROTATION_FORMS[form.rotation].size
    fits &= {*units[3:]} <= {"", *(_DEGREES if form.rotation.endswith("-deg") else ("rad",))}
    return form.name if fits and (makers or all(map(str.isdecimal, names))) else None


def joint_names(fields: Fields, taken: Collection[str]) -> tuple[str, ...]:
    """Finds the fields of joint angles: one list, or a field a joint numbered from one."""
    if columns := joint_columns(tuple(fields.numbers)):
        return columns
    if listed := known_names(fields, [(key,) for key in JOINT_KEYS], taken):
        return listed
    counted: dict[tuple[str, ...], dict[int, str]] = defaultdict(dict)
    for name, numbers in fields.numbers.items():
        match = _JOINT_NAME.fullmatch(name)
        is_whole = numbers.ndim == 1 and bool(np.isfinite(numbers).all())
        if match and is_whole and name not in taken:
            counted[match.group(1, 3)][int(match[2])] = name
    for by_number in counted.values():
        # Four numbers q1 ... may be a quaternion.
        if len(by_number) >= 5 and [*by_number] == [*range(1, len(by_number) + 1)]:
            return tuple(by_number.values())
    return ()


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
    is_named = degrees or all(any(unit in end for unit in _DEGREES) for end in ends)
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


def check_radians(
    poses: PoseNumbers, requested: PoseImportOptions, whose: str, *, guesses: bool = True
) -> None:
    """Checks that angles of unstated unit can be radians; raises DataError.

    `guesses` says whether the command can try other readings, which the message then suggests.
    """
    there, rotation = poses.present, poses.reading.rotation
    radians = rotation == "rotation-vector" or rotation.endswith("-rad")
    is_degrees = rotation == "rotation-vector-deg" and requested.form is None
    if not (radians or is_degrees) or not there.any():
        return
    largest = np.abs(np.where(there[:, None], poses.rotations, 0.0)).max(axis=1)
    row = int(largest.argmax())
    if not is_degrees and largest[row] <= 2 * np.pi + 0.01:
        return
    size = "in degrees" if is_degrees else "too large for radians"
    needed = "its form is needed"
    makers = defaultdict[str, list[str]](list)
    for form in POSE_FORMS.values():
        if form.models and form.rotation.endswith("-deg"):
            makers[form.words.partition("Z, ")[2]].append(form.name)
    listed = (f"{' or '.join(forms)} for {names}" for names, forms in makers.items())
    next_step = f"Say --{whose}-form: {'; '.join(listed)}; rotation-vector-deg, euler-ZYX-deg ..."
    if requested.form is not None:
        needed = f"poses of the form {requested.form} are in radians"
        is_far = bool(np.abs(poses.positions[there]).max() > FAR_M) and poses.reading.unit == "m"
        degrees = f"{rotation.removesuffix('-rad')}-deg"
        degrees = f"{requested.form}-deg" if f"{requested.form}-deg" in POSE_FORMS else degrees
        next_step = (
            f"Say --{whose}-form {degrees}{f' --{whose}-unit mm' * is_far}, where these are degrees"
        )
    raise DataError(
        f"{poses.places[row]}: the {whose}'s rotation has an angle of {largest[row]:.4g}, "
        f"{size}, and {needed}.",
        culprits=[poses.places[row]],
        next_step=next_step + ("; or let --guess find it." if guesses else "."),
    )


def _matrices(flat: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Splits (n, 16) or (n, 12) numbers of matrices into (n, 3) positions and (n, 9) rotations."""
    last = np.array([0.0, 0, 0, 1])
    if flat.shape[1] == 12:
        matrices = flat.reshape(-1, 3, 4)
        after_position = ROTATION_FORMS["matrix"].read(flat[:, 3:])
        upper_rows = ROTATION_FORMS["matrix"].read(matrices[:, :, :3].reshape(-1, 9))
        if (
            np.isfinite(after_position).all(axis=(1, 2)).sum()
            > np.isfinite(upper_rows).all(axis=(1, 2)).sum()
        ):
            return flat[:, :3].copy(), flat[:, 3:].copy()
    else:
        square = flat.reshape(-1, 4, 4)
        by_columns = (square[:, :, 3] == last).all(axis=1) & ~(square[:, 3] == last).all(axis=1)
        matrices = np.where(by_columns[:, None, None], np.swapaxes(square, 1, 2), square)
        wrong = np.isfinite(matrices).all(axis=(1, 2)) & (
            np.abs(matrices[:, 3] - last).max(axis=1) > 1e-6
        )
        # A matrix with another last row is no rigid transform: its zeroed rotation is refused
        # later.
        matrices = np.where(wrong[:, None, None], 0.0, matrices)
    return matrices[:, :3, 3].copy(), matrices[:, :3, :3].reshape(-1, 9).copy()


def _likely_rotation(
    size: int, names: Sequence[str], requested: PoseImportOptions, whose: str, *, degrees: bool
) -> tuple[str, tuple[str, ...]]:
    if size == 9:
        return "matrix", ()
    if size == 4:
        ends = (
            names[0][-4:].lower()
            if len(names) == 1
            else "".join(name[-1].lower() for name in names)
        )
        # ABB numbers q1 to q4 from the scalar on.
        is_abb = [name[-2:].lower() for name in names] == ["q1", "q2", "q3", "q4"]
        rotation = f"quaternion-{'wxyz' if is_abb or ends == 'wxyz' else 'xyzw'}"
        if requested.form is not None or is_abb or ends in ("xyzw", "wxyz"):
            return rotation, ()
        return rotation, (
            f"The {whose}'s quaternions are taken for x, y, z, w, as the source does not say; "
            f"--{whose}-form quaternion-wxyz names the other order.",
        )
    joined = " ".join(names).lower()
    if _ANGLES_NAME.search(joined):
        return f"euler-xyz-{'deg' if degrees else 'rad'}", ()
    if degrees:
        # Angle units are checked later, unless the user states them.
        return "rotation-vector-deg", ()
    if requested.form is None and "rvec" not in joined:
        return "rotation-vector", (
            f"The {whose}'s rotations ({', '.join(names)}) are taken for rotation vectors in "
            f"radians, as the source does not say; --{whose}-form names another form.",
        )
    return "rotation-vector", ()
