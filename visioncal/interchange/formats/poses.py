"""Poses, joints and images out of named fields."""

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, PoseNumbers, Reading
from visioncal.core.documents import as_numbers
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.fields import Fields
from visioncal.interchange.formats.import_options import PoseImportOptions
from visioncal.interchange.formats.worded import ANGLE_UNITS, DEGREES, without_unit, worded_poses
from visioncal.session.columns import SELECTORS, joint_columns

# Names under which pose pairs are commonly stored, the most specific first.
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
    ("x", "y", "z", "rx", "ry", "rz"),
    ("x", "y", "z", "roll", "pitch", "yaw"),
    ("x", "y", "z", "a", "b", "c"),
    ("x", "y", "z", "w", "p", "r"),
    ("x", "y", "z", "q1", "q2", "q3", "q4"),
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

# A turn, and what rounding adds; joints may count some turns.
_MOST_RAD = 2 * np.pi + 0.01
_MOST_TURNS_RAD = 10 * 2 * np.pi

_JOINT_NAME = re.compile(
    r"(?:.*\.)?(joint|axis|j|a|q)[ _]?([1-9])((?:[ _]?(?:pos|position|angle))?(?:[ _]*\W*"
    r"(?:deg|rad|[°º])[a-z]*\W*)?)",
    re.IGNORECASE,
)
_LEAST_JOINTS = 5

_ROTATION_NAME = re.compile(r"rvec|rot|quat|orient|rpy|euler|(^|\.)R(_|$)")
_ANGLES_NAME = re.compile(r"rpy|roll|euler")


def known_names(
    fields: Fields, candidates: Sequence[tuple[str, ...]], taken: Collection[str]
) -> tuple[str, ...]:
    """Finds the first of several sets of names that are all there and free, in any case of letters.

    Units behind names do not count.

    What holds no numbers counts where its name is clear, so that it is refused by its place.

    Returns:
        The fields' full names; empty where no set is whole.
    """
    # One number in a field called `robot` or `camera` says which of several it is.
    numbers = (
        name for name, them in fields.numbers.items() if them.ndim > 1 or name not in SELECTORS
    )
    holding = [*numbers, *fields.ragged]
    worded = (name for name, cells in fields.texts.items() if any(cells) and name not in SELECTORS)
    names = list(dict.fromkeys([*holding, *worded]))
    whole = _sets_of_names(names, candidates, taken)
    return next((pair for pair in whole if len(pair) > 1 or pair[0] in holding), ())


def _sets_of_names(
    names: Sequence[str], candidates: Sequence[tuple[str, ...]], taken: Collection[str]
) -> Iterator[tuple[str, ...]]:
    """Yields the full names of every candidate that is whole."""
    free = [name for name in names if name not in taken]
    endings = Counter(name.rsplit(".", 1)[-1] for name in free)
    full = {end: name for name in free if endings[end := name.rsplit(".", 1)[-1]] == 1}
    full |= {name: name for name in free}
    # A name in the very letters of a candidate goes before one in other letters or with a unit.
    plain = {name: without_unit(name)[0].lower() for name in full}
    counts = Counter(plain.values())
    bare = {plain[word]: name for word, name in full.items() if counts[plain[word]] == 1}
    full = bare | {word.lower(): name for word, name in full.items()} | full
    for them in candidates:
        found = tuple(full.get(name, full.get(name.lower(), "")) for name in them)
        if all(found):
            yield found


def pose_names(
    fields: Fields,
    given: Sequence[str],
    unnamed: tuple[str, ...],
    whose: str,
    taken: Collection[str],
) -> tuple[str, ...]:
    """Finds the fields that hold poses.

    Args:
        fields: The fields.
        given: What the user names.
        unnamed: What they are in a table without a header.
        whose: `robot` or `camera`.
        taken: Full names of those that hold something else.

    Returns:
        Full names; empty where nothing says it.

    Raises:
        DataError: The user names what is not there.
    """
    if given:
        return tuple(fields.find(name) for name in given)
    if unnamed:
        return () if set(unnamed) & set(taken) else unnamed
    keys = ROBOT_KEYS if whose == "robot" else CAMERA_KEYS
    return known_names(fields, keys, taken) or worded_poses(fields, whose, taken)


def poses_from(
    fields: Fields, names: Sequence[str], requested: PoseImportOptions, whose: str
) -> tuple[PoseNumbers, tuple[str, ...]]:
    """Takes poses out of fields.

    16 numbers are a matrix, by rows or by columns as its last row of 0, 0, 0, 1 shows; 12 its upper
    three rows, or a position and a rotation by rows, whichever makes rotations; else three of
    position and those of a rotation, in whichever order names such as rvec and tvec say it.

    Args:
        fields: The fields.
        names: Which of them hold the poses.
        requested: What the user says of them.
        whose: `robot` or `camera`, for messages.

    Returns:
        The poses, and what was assumed of them.

    Raises:
        DataError: There are no such fields, or their numbers make up no pose.
    """
    if whose == "robot" and fields.form:
        requested = _with_own_form(fields, requested)
    if not requested.names and len(names) == 7 and requested.is_scalar_first:
        # That is said of the columns as they stand, and these were found by their names.
        written = {name: at for at, name in enumerate(fields.numbers)}
        names = (*names[:3], *sorted(names[3:], key=lambda name: written.get(name, 0)))
    blocks = [fields.column(name) for name in names]
    sizes = [block.shape[1] for block in blocks]
    places = fields.places
    if sum(sizes) in (12, 16) and 9 not in sizes:
        numbers = PoseNumbers(*_matrices(np.hstack(blocks)), Reading("matrix"), places)
        return _checked(requested.applied_to(numbers), requested, whose, ())
    positions, rotations, turned = _split(blocks, names)
    if rotations.shape[1] not in (3, 4, 9) or positions.shape[1] != 3:
        raise DataError(
            f"{fields.name}: {', '.join(names)} have {sum(sizes)} numbers; a pose has 16 or 12 "
            "(matrix), 7 (quaternion) or 6 (three angles). There are " + fields.listing() + ".",
            culprits=list(names),
            next_step=f"Name the fields of the {whose}'s poses with --{whose}-columns.",
        )
    units = {without_unit(name)[1] for name in names}
    rotation, notes = _likely_rotation(
        rotations.shape[1], turned, requested, whose, degrees=bool(units & {*DEGREES})
    )
    numbers = PoseNumbers(positions, rotations, Reading(rotation), places)
    lengths = units - {"", *ANGLE_UNITS}
    if len(lengths) == 1:
        requested = replace(requested, unit=requested.unit or lengths.pop())
    return _checked(requested.applied_to(numbers), requested, whose, notes)


def _with_own_form(fields: Fields, requested: PoseImportOptions) -> PoseImportOptions:
    """Reads the robot's poses in the form that their rows say."""
    if requested.form not in (None, fields.form):
        raise DataError(
            f"{fields.places[0]}: the pose is written as {POSE_FORMS[fields.form].words}, not as "
            f"{requested.form}.",
            culprits=[fields.places[0]],
            next_step="Leave --robot-form out.",
        )
    return replace(requested, form=fields.form)


def joint_names(fields: Fields, taken: Collection[str]) -> tuple[str, ...]:
    """Finds the fields of joint angles: a list of them, or one a joint that counts from one."""
    if whole := joint_columns(tuple(fields.numbers)):
        return whole
    if listed := known_names(fields, [(key,) for key in JOINT_KEYS], taken):
        return listed
    counted: dict[tuple[str, ...], dict[int, str]] = defaultdict(dict)
    for name, numbers in fields.numbers.items():
        match = _JOINT_NAME.fullmatch(name)
        is_whole = numbers.ndim == 1 and bool(np.isfinite(numbers).all())
        if match and is_whole and name not in taken:
            counted[match.group(1, 3)][int(match[2])] = name
    for them in counted.values():
        # Four numbers q1 ... may be a quaternion.
        if len(them) >= _LEAST_JOINTS and [*them] == [*range(1, len(them) + 1)]:
            return tuple(them.values())
    return ()


def joints_from(
    fields: Fields, names: Sequence[str], *, degrees: bool
) -> tuple[FloatArray, tuple[str, ...]]:
    """Takes joint angles out of fields, in degrees where they or their names say so.

    Returns:
        (n, j) angles [rad], and what was assumed of them.

    Raises:
        DataError: There are no such fields, a row lacks some, or they are no radians as named.
    """
    joints = np.hstack([fields.column(name) for name in names])
    bad = ~np.isfinite(joints).all(axis=1)
    if bad.any():
        place = fields.places[int(np.argmax(bad))]
        raise DataError(f"{place}: a joint angle is missing or infinite.", culprits=[place])
    ends = [name.rsplit(".", 1)[-1].lower() for name in names]
    if degrees or all(any(unit in end for unit in DEGREES) for end in ends):
        return np.deg2rad(joints), ()
    if (largest := np.abs(joints).max(initial=0.0)) > _MOST_TURNS_RAD:
        words = f"Joint angles up to {largest:.0f} are no radians"
        if any("rad" in end for end in ends):
            raise DataError(
                f"{fields.name}: {words.lower()}.",
                culprits=list(names),
                next_step="Say --joint-unit deg.",
            )
        return np.deg2rad(joints), (f"{words}, and are taken for degrees.",)
    return joints, ()


def check_radians(
    poses: PoseNumbers, requested: PoseImportOptions, whose: str, *, guesses: bool = True
) -> None:
    """Checks that angles of which nobody says what they are can be radians.

    Args:
        poses: The poses.
        requested: What the user says of them.
        whose: `robot` or `camera`, for messages.
        guesses: Whether the command can try other readings.

    Raises:
        DataError: They turn farther than once about.
    """
    there, rotation = poses.there, poses.reading.rotation
    radians = rotation == "rotation-vector" or rotation.endswith("-rad")
    open_degrees = rotation == "rotation-vector-deg" and requested.form is None
    if not (radians or open_degrees) or not there.any():
        return
    largest = np.abs(np.where(there[:, None], poses.rotations, 0.0)).max(axis=1)
    row = int(largest.argmax())
    if open_degrees or largest[row] > _MOST_RAD:
        found = "angles in degrees" if open_degrees else f"an angle of {largest[row]:.4g}"
        raise DataError(
            f"{poses.places[row]}: the {whose}'s rotation has {found}"
            + ("" if open_degrees else ", too large for radians")
            + ("." if requested.form else ", and the source does not say what it is."),
            culprits=[poses.places[row]],
            next_step=f"Say --{whose}-form: kuka, or doosan, where the angles are A, B, C; fanuc "
            "for W, P, R; yaskawa or staubli for Rx, Ry, Rz; rotation-vector-deg, euler-ZYX-deg ..."
            + ("; or let --guess find it." if guesses else ""),
        )


def as_matrix(value: object, where: str) -> FloatArray:
    """Reads the 16 numbers of a matrix: (4, 4).

    Raises:
        DataError: They are not as many, or not finite.
    """
    numbers = as_numbers(value, where)
    if numbers.size != 16 or not np.isfinite(numbers).all():
        raise DataError(
            f"{where} has {numbers.size} numbers; the 16 finite ones of a matrix are needed.",
            culprits=[where],
        )
    return numbers.reshape(4, 4)


def matrix_numbers(matrices: FloatArray, places: Sequence[str], *, unit: str = "m") -> PoseNumbers:
    """Takes (n, 4, 4) matrices as poses."""
    flat = matrices.reshape(len(matrices), 16)
    return PoseNumbers(*_matrices(flat), Reading("matrix", unit), tuple(places))


def _matrices(flat: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Splits (n, 16) or (n, 12) numbers of matrices into (n, 3) positions and (n, 9) rotations."""
    last = np.array([0.0, 0, 0, 1])
    if flat.shape[1] == 12:
        matrices = flat.reshape(-1, 3, 4)
        behind = ROTATION_FORMS["matrix"].read(flat[:, 3:])
        above = ROTATION_FORMS["matrix"].read(matrices[:, :, :3].reshape(-1, 9))
        if np.isfinite(behind).all(axis=(1, 2)).sum() > np.isfinite(above).all(axis=(1, 2)).sum():
            return flat[:, :3].copy(), flat[:, 3:].copy()
    else:
        square = flat.reshape(-1, 4, 4)
        by_columns = (square[:, :, 3] == last).all(axis=1) & ~(square[:, 3] == last).all(axis=1)
        matrices = np.where(by_columns[:, None, None], np.swapaxes(square, 1, 2), square)
        wrong = np.isfinite(matrices).all(axis=(1, 2)) & (
            np.abs(matrices[:, 3] - last).max(axis=1) > 1e-6
        )
        # A matrix with another last row is no rigid transform: its rotation is refused as such.
        matrices = np.where(wrong[:, None, None], 0.0, matrices)
    return matrices[:, :3, 3].copy(), matrices[:, :3, :3].reshape(-1, 9).copy()


def _split(
    blocks: Sequence[FloatArray], names: Sequence[str]
) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """Tells position from rotation: (positions, rotations, the rotation's names)."""
    if len(blocks) == 2:
        first, second = blocks
        rotation_first = (
            _ROTATION_NAME.search(names[0]) is not None
            if first.shape[1] == second.shape[1]
            else second.shape[1] == 3
        )
        if rotation_first:
            return second, first, (names[0],)
        return first, second, (names[1],)
    flat = np.hstack(blocks)
    return flat[:, :3], flat[:, 3:], tuple(names[3:] or names)


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
        # ABB counts q1 to q4 from the scalar on.
        counted = [name[-2:].lower() for name in names] == ["q1", "q2", "q3", "q4"]
        rotation = f"quaternion-{'wxyz' if counted or ends == 'wxyz' else 'xyzw'}"
        if requested.form is not None or counted or ends in ("xyzw", "wxyz"):
            return rotation, ()
        return rotation, (
            f"The {whose}'s quaternions are taken for x, y, z, w, as the source does not say; "
            f"--{whose}-form quaternion-wxyz names the other order.",
        )
    joined = " ".join(names).lower()
    if _ANGLES_NAME.search(joined):
        return f"euler-xyz-{'deg' if degrees else 'rad'}", ()
    if degrees:
        # What they are besides is asked for, unless the user says it.
        return "rotation-vector-deg", ()
    if requested.form is None and "rvec" not in joined:
        return "rotation-vector", (
            f"The {whose}'s rotations ({', '.join(names)}) are taken for rotation vectors in "
            f"radians, as the source does not say; --{whose}-form names another form.",
        )
    return "rotation-vector", ()


def _checked(
    numbers: PoseNumbers, requested: PoseImportOptions, whose: str, notes: tuple[str, ...]
) -> tuple[PoseNumbers, tuple[str, ...]]:
    infinite = np.isinf(numbers.positions).any(axis=1) | np.isinf(numbers.rotations).any(axis=1)
    if infinite.any():
        place = numbers.places[int(np.argmax(infinite))]
        raise DataError(
            f"{place}: a number of the pose is infinite.",
            culprits=[place],
            next_step="Correct it, or leave the whole pose of that row empty.",
        )
    if requested.unit is None and requested.form not in POSE_FORMS:
        notes = (
            *notes,
            f"The {whose}'s positions are taken for metres, as the source does not say; "
            f"--{whose}-unit names another unit.",
        )
    form = ROTATION_FORMS[numbers.reading.rotation]
    if form.size != numbers.rotations.shape[1]:
        raise DataError(
            f"{numbers.places[0]}: the {whose}'s rotation has {numbers.rotations.shape[1]} "
            f"numbers; {form.words} has {form.size}.",
            culprits=[numbers.places[0]],
            next_step=f"Name the fields with --{whose}-columns and the form with --{whose}-form.",
        )
    return numbers, notes
