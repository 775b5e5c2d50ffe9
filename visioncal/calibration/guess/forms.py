"""Screening of rotation forms by the angles of relative motions.

The angle of a relative motion between two views is the same for robot and camera, whatever the
unknown edges are (Chen 1991, "A screw motion approach to uniqueness analysis of head-eye
geometry"). So forms and pairings are screened without solving for anything. The angle is also the
same for a pose and its inverse: inverses, and all that concerns positions, are distinguished later.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration.guess.hypothesis import Turns
from visioncal.core.conventions import ROTATION_FORMS, PoseNumbers
from visioncal.core.types import FloatArray, IntArray

# Radians that were read as degrees leave all rotations within 2 pi degrees of identity, per angle.
_RADIANS_AS_DEGREES_RAD = np.deg2rad(12.0)
# Quantile of the pairs' mismatch: with a quarter of the views wrong, 56 % of pairs are right.
_PAIRS_SHARE = 0.35
SHIFTS = (0, 1, -1, 2, -2)


@dataclass(frozen=True, eq=False)
class Forms:
    """Readings of one side's rotations: (f, n, 3, 3), the declared form first."""

    turns: tuple[Turns, ...]
    rotations: FloatArray


@dataclass(frozen=True)
class Pairing:
    """A form of the robot's rotations, one of the camera's, and a shift between their rows."""

    robot: int  # Index of the robot's form.
    camera: int  # Index of the camera's form.
    shift: int  # As in `Hypothesis`.
    # Low quantile of the differences between the angles of relative motions [rad].
    mismatch_rad: float


def robot_forms(numbers: PoseNumbers) -> Forms:
    """Reads the robot's rotations in every form, misread Euler angles among them."""
    declared = numbers.reading.rotation
    return _read(numbers, [*_same_size_forms(declared), *_misread_forms(numbers)])


def camera_forms(numbers: PoseNumbers, *, is_measured: bool) -> Forms:
    """Reads the camera's rotations in every form; in one where they were measured here."""
    declared = numbers.reading.rotation
    return _read(numbers, [Turns(declared)] if is_measured else list(_same_size_forms(declared)))


def _same_size_forms(declared: str) -> Iterator[Turns]:
    yield Turns(declared)
    size = ROTATION_FORMS[declared].size
    # A matrix by columns is one by rows, transposed, and that is tried for every form.
    if size != 9:
        yield from (
            Turns(name)
            for name, form in ROTATION_FORMS.items()
            if form.size == size and name != declared
        )


def _misread_forms(numbers: PoseNumbers) -> Iterator[Turns]:
    """Forms of rotations that were written after others were misread as Euler angles."""
    if ROTATION_FORMS[numbers.reading.rotation].size == 3:
        return
    rotations = ROTATION_FORMS[numbers.reading.rotation].read(numbers.rotations)
    angles = [
        name for name in ROTATION_FORMS if name.startswith("euler-") and name.endswith("-deg")
    ]
    # An order about fixed axes is the reverse order about moving ones.
    intrinsic = [name for name in angles if name.split("-")[1].isupper()]
    for written in intrinsic:
        yield from (Turns(form, written) for form in angles if form != written)
        if not _is_about_two_axes(written):
            yield from (Turns(form, written, True) for form in angles if _is_about_two_axes(form))
    if not _all_small(rotations):
        return
    in_radians = [name.replace("-deg", "-rad") for name in angles]
    for written in intrinsic:
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
    """Reads the rotations in every form, dropping unreadable ones; each `written` form once."""
    by_written = {(turn.written, turn.is_beyond): turn for turn in turns}
    written = {key: item.numbers(numbers) for key, item in by_written.items()}
    forms = [
        (turn, ROTATION_FORMS[turn.form].read(written[turn.written, turn.is_beyond]).copy())
        for turn in turns
    ]
    for _, rotations in forms:
        rotations[~numbers.present] = np.nan
    # The declared form stays first even where it is unreadable.
    usable = [
        (item, rotations)
        for at, (item, rotations) in enumerate(forms)
        if at == 0 or np.isfinite(rotations[numbers.present]).all()
    ]
    return Forms(tuple(turn for turn, _ in usable), np.array([array for _, array in usable]))


def screen(robot: Forms, camera: Forms, rows: IntArray) -> tuple[Pairing, ...]:
    """Compares the relative angles of all forms at all shifts.

    Returns:
        All pairings with enough common rows, the declared forms without shift first.
    """
    return tuple(
        Pairing(robot_form, camera_form, shift, float(mismatch))
        for camera_form, shift, mismatches in _mismatches(robot, camera, rows)
        for robot_form, mismatch in enumerate(mismatches)
    )


def _mismatches(
    robot: Forms, camera: Forms, rows: IntArray
) -> Iterator[tuple[int, int, FloatArray]]:
    for shift in SHIFTS:
        inside = rows[(rows + shift >= 0) & (rows + shift < robot.rotations.shape[1])]
        if len(inside) < len(rows) - abs(shift):
            continue
        robot_angles = _angles(robot.rotations[:, inside + shift])
        camera_angles = _angles(camera.rotations[:, inside])
        for form, angles in enumerate(camera_angles):
            yield form, shift, _low_quantiles(robot_angles, angles)


def _angles(rotations: FloatArray) -> FloatArray:
    """(f, p) angles [rad] of the relative rotations of all pairs of views."""
    flat = rotations.reshape(*rotations.shape[:2], 9)
    first, second = np.triu_indices(flat.shape[1], 1)
    traces = (flat @ np.swapaxes(flat, 1, 2))[:, first, second]
    return np.asarray(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))


def _low_quantiles(robot: FloatArray, camera: FloatArray) -> FloatArray:
    """(f,) low quantile of the angles' differences; infinite with too few to compare."""
    difference = np.abs(robot - camera)
    difference = np.where(np.isfinite(difference), difference, np.inf)
    rank = int(_PAIRS_SHARE * difference.shape[1])
    return np.asarray(np.partition(difference, rank, axis=1)[:, rank])
