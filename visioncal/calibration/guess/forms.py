"""Which forms a rotation's numbers may have, and which of them agree with the other side.

The angle of a relative motion between two views is the same for robot and camera, whatever the
unknown edges are (Chen 1991, "A screw motion approach to uniqueness analysis of head-eye
geometry"). So forms and pairings are screened without solving for anything. The angle is also the
same for a pose and its inverse: these, and all that concerns positions, are distinguished later.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration.guess.hypothesis import Turns
from visioncal.core.conventions import ROTATION_FORMS, PoseNumbers
from visioncal.core.types import FloatArray, IntArray

# Radians that were read as degrees leave all rotations within 2 pi degrees of identity, per angle.
_RADIANS_AS_DEGREES_RAD = np.deg2rad(12.0)
# The share of pairs of views that decide: with a quarter of the views wrong, 56 % of pairs are not.
_PAIRS_SHARE = 0.35
SHIFTS = (0, 1, -1, 2, -2)


@dataclass(frozen=True, eq=False)
class Forms:
    """The ways to read one side's rotations: (f, n, 3, 3), the declared one first."""

    turns: tuple[Turns, ...]
    rotations: FloatArray


@dataclass(frozen=True)
class Pairing:
    """A form of the robot's rotations, one of the camera's, and the rows' shift.

    Attributes:
        robot: Index of the robot's form.
        camera: Index of the camera's.
        shift: As in `Hypothesis`.
        mismatch_rad: By how much the angles of relative motions differ, in the better pairs.
    """

    robot: int
    camera: int
    shift: int
    mismatch_rad: float


def robot_forms(numbers: PoseNumbers) -> Forms:
    """Collects the ways to read the robot's rotations, misreadings of Euler angles among them."""
    declared = numbers.reading.rotation
    return _read(numbers, [*_direct(declared), *_mistaken(numbers)])


def camera_forms(numbers: PoseNumbers, *, is_measured: bool) -> Forms:
    """Collects the ways to read the camera's rotations; one where they were measured here."""
    declared = numbers.reading.rotation
    return _read(numbers, [Turns(declared)] if is_measured else list(_direct(declared)))


def _direct(declared: str) -> Iterator[Turns]:
    yield Turns(declared)
    size = ROTATION_FORMS[declared].size
    # A matrix by columns is one by rows, transposed, and that is tried for every form.
    if size != 9:
        yield from (
            Turns(name)
            for name, form in ROTATION_FORMS.items()
            if form.size == size and name != declared
        )


def _mistaken(numbers: PoseNumbers) -> Iterator[Turns]:
    """Forms of angles that may have been taken for others before the numbers were made."""
    if ROTATION_FORMS[numbers.reading.rotation].size == 3:
        return
    rotations = ROTATION_FORMS[numbers.reading.rotation].read(numbers.rotations)
    angles = [
        name for name in ROTATION_FORMS if name.startswith("euler-") and name.endswith("-deg")
    ]
    # An order about fixed axes is the reverse order about moving ones: half of them are enough.
    moving = [name for name in angles if name.split("-")[1].isupper()]
    for written in moving:
        yield from (Turns(form, written) for form in angles if form != written)
        if not _is_about_two_axes(written):
            yield from (Turns(form, written, True) for form in angles if _is_about_two_axes(form))
    if not _all_small(rotations):
        return
    in_radians = [name.replace("-deg", "-rad") for name in angles]
    for written in moving:
        yield from (Turns(form, written) for form in (*in_radians, "rotation-vector"))
    yield from (Turns(form, "rotation-vector-deg") for form in ("rotation-vector", *in_radians))


def _is_about_two_axes(form: str) -> bool:
    order = form.split("-")[1]
    return order[0] == order[2]


def _all_small(rotations: FloatArray) -> bool:
    traces = np.trace(rotations, axis1=1, axis2=2)
    angles = np.arccos(np.clip(0.5 * (traces[np.isfinite(traces)] - 1.0), -1.0, 1.0))
    return bool(len(angles)) and bool(angles.max() < _RADIANS_AS_DEGREES_RAD)


def _read(numbers: PoseNumbers, turns: Sequence[Turns]) -> Forms:
    """Reads every way, each written form's numbers computed once; unreadable ways are dropped."""
    one_of_each = {(turn.written, turn.is_beyond): turn for turn in turns}
    written = {key: item.numbers(numbers) for key, item in one_of_each.items()}
    pairs = [
        (turn, ROTATION_FORMS[turn.form].read(written[turn.written, turn.is_beyond]).copy())
        for turn in turns
    ]
    for _, rotations in pairs:
        rotations[~numbers.there] = np.nan
    # The declared way stays first even where it is unreadable; nothing of it will fit.
    whole = [
        (item, rotations)
        for at, (item, rotations) in enumerate(pairs)
        if at == 0 or np.isfinite(rotations[numbers.there]).all()
    ]
    return Forms(tuple(item for item, _ in whole), np.array([rotations for _, rotations in whole]))


def screen(robot: Forms, camera: Forms, rows: IntArray) -> tuple[Pairing, ...]:
    """Compares the relative angles of all forms under all shifts.

    Returns:
        All pairings with enough common rows, the declared forms without shift first.
    """
    return tuple(
        Pairing(form, other, shift, float(mismatch))
        for other, shift, mismatches in _compared(robot, camera, rows)
        for form, mismatch in enumerate(mismatches)
    )


def _compared(robot: Forms, camera: Forms, rows: IntArray) -> Iterator[tuple[int, int, FloatArray]]:
    for shift in SHIFTS:
        inside = rows[(rows + shift >= 0) & (rows + shift < robot.rotations.shape[1])]
        if len(inside) < len(rows) - abs(shift):
            continue
        of_robot = _angles(robot.rotations[:, inside + shift])
        of_camera = _angles(camera.rotations[:, inside])
        for other, angles in enumerate(of_camera):
            yield other, shift, _mismatches(of_robot, angles)


def _angles(rotations: FloatArray) -> FloatArray:
    """(f, p) angles [rad] of the relative rotations of all pairs of views."""
    count = rotations.shape[1]
    flat = rotations.reshape(len(rotations), count, 9)
    first, second = np.triu_indices(count, 1)
    traces = (flat @ np.swapaxes(flat, 1, 2))[:, first, second]
    return np.asarray(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))


def _mismatches(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """(f,) low quantile of how much angles differ; infinite where too few can be compared."""
    apart = np.abs(robot - camera)
    apart = np.where(np.isfinite(apart), apart, np.inf)
    rank = int(_PAIRS_SHARE * apart.shape[1])
    return np.asarray(np.partition(apart, rank, axis=1)[:, rank])
