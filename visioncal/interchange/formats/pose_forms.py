"""The form of the poses in some columns: order, rotations, units and maker."""

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, PoseNumbers, Reading
from visioncal.core.documents.pendants import forms_named
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.fields import (
    ANGLES,
    DEGREES,
    Fields,
    named_by,
    position_first,
    split_matrices,
    unit_by_size,
    without_unit,
)
from visioncal.interchange.formats.foreign import PoseImportOptions, Side, Unstated

_ANGLES_NAME = re.compile(r"rpy|roll|euler")
ROTATION_NAME = re.compile(r"rvec|rot|winkel|angle|quat|orient|rpy|euler|(^|\.)R(_|$)")


def poses_from(
    fields: Fields, names: Sequence[str], requested: PoseImportOptions, side: Side
) -> tuple[PoseNumbers, tuple[str, ...], Unstated]:
    """Reads the poses of the `robot` or `camera` from fields: (poses, notes, what is assumed).

    16 numbers are a matrix, by rows or by columns as its last row of 0, 0, 0, 1 shows; 12 are its
    upper three rows, or a position and a rotation by rows, whichever gives rotations; otherwise a
    position of three numbers and a rotation, ordered as names such as rvec and tvec show. Raises
    DataError.
    """
    if side == "robot":
        requested = _stated_form(fields, names, requested)
    if not requested.names and len(names) == 7 and requested.rotation == "quaternion-wxyz":
        # --form refers to the columns in their order in the file, and these were found by their
        # names.
        order = {name: at for at, name in enumerate(fields.numbers)}
        names = (*names[:3], *sorted(names[3:], key=lambda name: order.get(name, 0)))
    blocks = [fields.column(name) for name in names]
    sizes, units = [block.shape[1] for block in blocks], {without_unit(name)[1] for name in names}
    notes, unstated = list[str](), set[str]() if requested.inverse is not None else {"inverse"}
    if sum(sizes) in (12, 16) and 9 not in sizes:
        positions, rotations = split_matrices(np.hstack(blocks))
        rotation = "matrix"
        requested = _by_rows(requested, sum(sizes))
    else:
        positions, rotations, of_rotation = split_pose(fields, names, blocks, side)
        rotation, doubt = _likely_rotation(
            rotations, of_rotation, requested, side, degrees=bool(units & {*DEGREES})
        )
        notes += [doubt] * bool(doubt)
        unstated |= {"angles"} if requested.form is None and rotations.shape[1] == 3 else set()
        unstated |= {"rotation"} if "does not say" in doubt else set()
    lengths = units - {"", *ANGLES}
    unit = requested.unit or (lengths.pop() if len(lengths) == 1 else None)
    form = POSE_FORMS.get(requested.form or "")
    # So far no arm reaches, whatever the unit of a maker's form is.
    is_far = unit_by_size(positions) == "mm" and (form is None or form.unit == "m")
    if unit is None and (form is None or is_far):
        unstated.add("unit")
        unit, farthest = ("mm" if is_far else None), np.nanmax(np.abs(positions), initial=0.0)
        words = f"millimetres, as {farthest:.0f} m is far," if unit else "metres,"
        notes.append(
            f"The {side}'s positions are taken for {words} as the source does not say; "
            f"--{side}-unit names another unit."
        )
    reading = replace(requested, unit=unit).reading(Reading(rotation))
    numbers = PoseNumbers(positions, rotations, reading, fields.places)
    return numbers, tuple(notes), frozenset(unstated)


def _stated_form(
    fields: Fields, names: Sequence[str], requested: PoseImportOptions
) -> PoseImportOptions:
    """The robot's options with the form that its own or the rows state; raises DataError."""
    if requested.form is None:
        requested = replace(requested, form=_usual_form(names, requested.usual))
    if fields.form and requested.form not in (None, fields.form):
        raise DataError(
            f"{fields.places[0]}: the pose is written as {POSE_FORMS[fields.form].words}, not "
            f"as {requested.form}.",
            culprits=["--robot-form"],
        )
    return replace(requested, form=fields.form or requested.form)


def _by_rows(requested: PoseImportOptions, count: int) -> PoseImportOptions:
    """Options of matrices: whether 16 numbers are by rows or by columns is known."""
    form = POSE_FORMS.get(requested.form or "")
    if count == 12 or not requested.rotation.startswith("matrix"):
        return requested
    return replace(requested, form=None, unit=requested.unit or (form.unit if form else None))


def makers_of(names: Sequence[str]) -> tuple[str, ...]:
    """Forms of poses whose rotations have the names of a pose's fields, position first."""
    return tuple(forms_named([without_unit(name)[0].lower() for name in names[3:]]))


def _usual_form(names: Sequence[str], usual: str | None) -> str | None:
    """The robot's own form, where names of a pose's numbers fit it; raises DataError."""
    units = [without_unit(name)[1] for name in names]
    form, makers = POSE_FORMS.get(usual or ""), makers_of(names)
    if form is None or "ros" in makers:
        return None
    if makers and form.name not in makers:
        raise DataError(
            f"{', '.join(names)} are not {form.words}, the form of this robot's poses.",
            culprits=names,
            next_step=f"Name their maker, as --robot-form {makers[0]}.",
        )
    fits = len(names) == 3 + ROTATION_FORMS[form.rotation].size
    fits &= {*units[3:]} <= {"", *(DEGREES if form.rotation.endswith("-deg") else ("rad",))}
    return form.name if fits and (makers or all(map(str.isdecimal, names))) else None


def check_radians(
    poses: PoseNumbers, requested: PoseImportOptions, side: str, *, guesses: bool = True
) -> None:
    """Checks that angles of unstated unit can be radians; raises DataError.

    `guesses` says whether the command can try other readings, which the message then suggests.
    """
    is_present, rotation = poses.present, poses.reading.rotation
    radians = rotation == "rotation-vector" or rotation.endswith("-rad")
    is_degrees = rotation == "rotation-vector-deg" and requested.form is None
    if not (radians or is_degrees) or not is_present.any():
        return
    largest = np.abs(np.where(is_present[:, None], poses.rotations, 0.0)).max(axis=1)
    row = int(largest.argmax())
    if not is_degrees and largest[row] <= 2 * np.pi + 0.01:
        return
    size = "in degrees" if is_degrees else "too large for radians"
    needed = "it needs its form"
    makers = defaultdict[str, list[str]](list)
    for form in POSE_FORMS.values():
        if form.models and form.rotation.endswith("-deg"):
            makers[form.words.partition("Z, ")[2]].append(form.name)
    listed = (f"{' or '.join(forms)} for {names}" for names, forms in makers.items())
    next_step = f"Give --{side}-form: {'; '.join(listed)}; rotation-vector-deg, euler-ZYX-deg ..."
    if requested.form is not None:
        needed = f"poses of the form {requested.form} are in radians"
        degrees = f"{rotation.removesuffix('-rad')}-deg"
        degrees = f"{requested.form}-deg" if f"{requested.form}-deg" in POSE_FORMS else degrees
        next_step = f"Give --{side}-form {degrees}, where these are degrees"
    raise DataError(
        f"{poses.places[row]}: the {side}'s rotation has an angle of {largest[row]:.4g}, "
        f"{size}, and {needed}.",
        culprits=[poses.places[row]],
        next_step=next_step + ("; or let --guess find it." if guesses else "."),
    )


def _likely_rotation(
    rotations: FloatArray,
    names: Sequence[str],
    requested: PoseImportOptions,
    side: Side,
    *,
    degrees: bool,
) -> tuple[str, str]:
    """The likely form of (n, k) numbers of rotations, and a note on what is assumed, or none."""
    size = rotations.shape[1]
    if size == 9:
        return "matrix", ""
    if size == 4:
        plain = [without_unit(name)[0].lower() for name in names]
        ends = plain[0][-4:] if len(names) == 1 else "".join(name[-1] for name in plain)
        # ABB numbers q1 to q4 from the scalar on, trackers q0 to q3.
        is_abb = "".join(name[-2:] for name in plain) in ("q1q2q3q4", "q0q1q2q3")
        rotation = f"quaternion-{'wxyz' if is_abb or ends == 'wxyz' else 'xyzw'}"
        # Of a mapping, whose numbers were joined by their names.
        is_mapping = len(names) > 1 and "." in names[0] and {*ends} == {*"xyzw"}
        if is_mapping or requested.form is not None or is_abb or ends in ("xyzw", "wxyz"):
            return "quaternion-xyzw" if is_mapping else rotation, ""
        return rotation, (
            f"The {side}'s quaternions are taken for x, y, z, w, as the source does not say; "
            f"--{side}-form quaternion-wxyz names the other order."
        )
    joined = " ".join(names).lower()
    largest = float(np.nanmax(np.abs(rotations), initial=0.0))
    if len(names) == 3 and [name[-2:].lower() for name in names] == ["qx", "qy", "qz"]:
        return "quaternion-xyz", (
            f"The {side}'s rotations have no qw, which is taken for the positive root of "
            "1 - qx² - qy² - qz²."
        )
    if _ANGLES_NAME.search(joined):
        is_large = not degrees and largest > 2 * np.pi + 0.01 and requested.form is None
        note = f"The {side}'s angles up to {largest:.0f} are no radians, and are taken for degrees."
        return f"euler-xyz-{'deg' if degrees or is_large else 'rad'}", note * is_large
    if degrees:
        # Angle units are checked later, unless the user states them.
        return "rotation-vector-deg", ""
    if requested.form is None and not re.search(r"rvec|rot\w*vec", joined):
        return "rotation-vector", (
            f"The {side}'s rotations ({', '.join(names)}) are taken for rotation vectors in "
            f"radians, as the source does not say; --{side}-form names another form."
        )
    return "rotation-vector", ""


def split_pose(
    fields: Fields, names: Sequence[str], blocks: Sequence[FloatArray], side: Side
) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """Positions, rotations, and the names of the rotations' fields; raises DataError."""
    flat, sizes = np.hstack(blocks), [block.shape[1] for block in blocks]
    if flat.shape[1] == 7 and 4 not in sizes:
        flat = position_first(flat)
    is_unnamed = len(blocks) == 1 or all(map(str.isdecimal, names))
    if flat.shape[1] == 6 and is_unnamed and _is_rotation_first(flat):
        flat = np.roll(flat, 3, axis=1)
    positions, rotations = flat[:, :3], flat[:, 3:]
    of_rotation = tuple(names[int(np.searchsorted(np.cumsum(sizes), 3)) + 1 :] or names)
    if len(blocks) == 2:
        rotation_first = sizes[1] == 3
        if sizes[0] == sizes[1]:
            rotation_first = ROTATION_NAME.search(names[0]) is not None
        positions, rotations = blocks[::-1] if rotation_first else blocks
        of_rotation = (names[0] if rotation_first else names[1],)
    if rotations.shape[1] not in (3, 4, 9) or positions.shape[1] != 3:
        raise DataError(
            f"{fields.name}: the {sum(sizes)} numbers of {', '.join(names)} are no pose, which has "
            "16 or 12 (matrix), 7 (quaternion) or 6 (three angles). There are "
            f"{fields.listing()}.",
            culprits=list(names),
            next_step=f"Name the fields of the {side}'s poses with --{side}-"
            f"{named_by(fields.places[0])}."
            + " What only moves, as a gantry, or only turns, as a gimbal about a fixed point, has "
            "zeros for the other three: add these columns." * (sum(sizes) == 3),
        )
    # The numbers of a mapping have names of their own.
    inner = tuple(name for name in fields.numbers if name.startswith(f"{of_rotation[0]}."))
    return positions, rotations, inner if len(of_rotation) == 1 and inner else of_rotation


def _is_rotation_first(flat: FloatArray) -> bool:
    """Whether of (n, 6) numbers the last three are no rotation, in any unit, and the first are."""
    filled = np.abs(flat[np.isfinite(flat).all(axis=1)])
    turns, places = filled[:, :3], filled[:, 3:]
    return bool(turns.max(initial=0.0) <= 2.0 * np.pi and (places > 360.0).sum() > len(filled) / 2)
