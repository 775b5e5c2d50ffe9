"""Pose notations: units, rotation forms, and those of robot manufacturers, for both directions."""

import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.choices import POSE_FORMS as POSE_FORMS
from visioncal.core.choices import UNITS_M as UNITS_M
from visioncal.core.choices import PoseForm as PoseForm
from visioncal.core.errors import DataError
from visioncal.core.limits import NORM_TOLERANCE
from visioncal.core.number_format import known_name, some_of
from visioncal.core.transforms import compose, invert, nearest_rotation
from visioncal.core.types import FloatArray, IntArray, Mask, chosen_rows


@dataclass(frozen=True)
class RotationForm:
    """A representation of rotations as numbers."""

    name: str  # Name on the command line.
    words: str  # Description for messages.
    size: int  # Number of values.
    # (n, size) numbers to (n, 3, 3) rotations; NaN where they are invalid.
    read: Callable[[FloatArray], FloatArray]
    write: Callable[[FloatArray], FloatArray]  # (n, 3, 3) rotations to (n, size) numbers.


def _quaternions(name: str, words: str, order: Sequence[int]) -> RotationForm:
    """Builds a form whose number i is component `order[i]` of x, y, z, w."""
    from_xyzw = np.array(order)
    to_xyzw = np.argsort(from_xyzw)

    def read(numbers: FloatArray) -> FloatArray:
        # Clipped, because squares of the largest numbers overflow.
        norms = np.linalg.norm(np.clip(numbers, -2.0, 2.0), axis=1)
        invalid = np.abs(norms - 1.0) > NORM_TOLERANCE
        unit = np.where(invalid[:, None] | ~np.isfinite(numbers), 0.5, numbers)
        rotations = Rotation.from_quat(unit[:, to_xyzw]).as_matrix()
        return _without(rotations, np.asarray(invalid) | ~_finite_rows(numbers))

    def write(rotations: FloatArray) -> FloatArray:
        # A quaternion and its negative are the same rotation; manufacturers write w >= 0.
        numbers = Rotation.from_matrix(rotations).as_quat(canonical=True)
        return np.asarray(numbers[:, from_xyzw])

    return RotationForm(name, words, 4, read, write)


def _quaternion_vectors() -> RotationForm:
    """The form of a quaternion's x, y, z, whose real part was not written, and is not negative."""

    def read(numbers: FloatArray) -> FloatArray:
        squares = (np.clip(numbers, -2.0, 2.0) ** 2).sum(axis=1)
        # False of NaN, too.
        valid = squares < 1.0 + NORM_TOLERANCE
        safe = np.where(valid[:, None], numbers, 0.0)
        real = np.sqrt(np.maximum(1.0 - np.where(valid, squares, 0.0), 0.0))
        return _without(Rotation.from_quat(np.column_stack([safe, real])).as_matrix(), ~valid)

    return RotationForm(
        "quaternion-xyz",
        "a quaternion's x, y, z without its real part",
        3,
        read,
        lambda rotations: Rotation.from_matrix(rotations).as_quat(canonical=True)[:, :3],
    )


def _rotation_vectors(name: str, words: str, unit_rad: float) -> RotationForm:
    def read(numbers: FloatArray) -> FloatArray:
        finite = _finite_rows(numbers)
        safe = np.where(finite[:, None], numbers, 0.0)
        return _without(Rotation.from_rotvec(safe * unit_rad).as_matrix(), ~finite)

    return RotationForm(
        name,
        words,
        3,
        read,
        lambda rotations: Rotation.from_matrix(rotations).as_rotvec() / unit_rad,
    )


def _euler(order: str, unit: str) -> RotationForm:
    """Builds a form of Euler angles: capitals for moving axes, small letters for fixed axes."""
    degrees = unit == "deg"
    about = "moving" if order.isupper() else "fixed"

    def write(rotations: FloatArray) -> FloatArray:
        with warnings.catch_warnings():
            # At the singularity any of the equivalent triples will do.
            warnings.simplefilter("ignore", UserWarning)
            return np.asarray(Rotation.from_matrix(rotations).as_euler(order, degrees=degrees))

    return RotationForm(
        f"euler-{order}-{unit}",
        f"Euler angles {order} about {about} axes in {'degrees' if degrees else 'radians'}",
        3,
        lambda numbers: _composed(order, np.deg2rad(numbers) if degrees else numbers),
        write,
    )


def _composed(order: str, angles: FloatArray) -> FloatArray:
    """(n, 3, 3) rotations of Euler angles (n, 3) [rad], several times as fast as SciPy's of many.

    Those about fixed axes are those about moving ones in reverse order.
    """
    finite = _finite_rows(angles)
    safe = np.where(finite[:, None], angles, 0.0)
    cosines, sines = np.cos(safe), np.sin(safe)
    rotations = np.eye(3)
    for at in range(3) if order.isupper() else range(2, -1, -1):
        axis = "xyz".index(order[at].lower())
        second, third = (axis + 1) % 3, (axis + 2) % 3
        turns = np.zeros((len(angles), 3, 3))
        turns[:, axis, axis] = 1.0
        turns[:, second, second] = turns[:, third, third] = cosines[:, at]
        turns[:, third, second], turns[:, second, third] = sines[:, at], -sines[:, at]
        rotations = rotations @ turns
    return _without(rotations, ~finite)


def _matrices(name: str, words: str, *, transposed: bool) -> RotationForm:
    def oriented(rotations: FloatArray) -> FloatArray:
        return np.swapaxes(rotations, 1, 2) if transposed else rotations

    def read(numbers: FloatArray) -> FloatArray:
        rotations = oriented(numbers.reshape(-1, 3, 3))
        finite = _finite_rows(rotations.reshape(-1, 9))
        safe = np.where(finite[:, None, None], rotations, np.eye(3))
        nearest = nearest_rotation(safe)
        invalid = np.abs(nearest - safe).max(axis=(1, 2)) > NORM_TOLERANCE
        return _without(nearest, np.asarray(invalid) | ~finite)

    return RotationForm(
        name, words, 9, read, lambda rotations: oriented(rotations).reshape(-1, 9).copy()
    )


def _finite_rows(numbers: FloatArray) -> Mask:
    return np.asarray(np.isfinite(numbers).all(axis=1))


def _without(rotations: FloatArray, missing: Mask) -> FloatArray:
    return np.asarray(np.where(missing[:, None, None], np.nan, rotations))


ROTATION_FORMS: Mapping[str, RotationForm] = {
    form.name: form
    for form in (
        _quaternions("quaternion-xyzw", "a quaternion x, y, z, w", (0, 1, 2, 3)),
        _quaternions("quaternion-wxyz", "a quaternion w, x, y, z", (3, 0, 1, 2)),
        _quaternions(
            "quaternion-yzwx",
            "a quaternion y, z, w, x (x, y, z, w under the names w, x, y, z)",
            (1, 2, 3, 0),
        ),
        _quaternion_vectors(),
        _rotation_vectors("rotation-vector", "a rotation vector in radians", 1.0),
        _rotation_vectors(
            "rotation-vector-deg", "a rotation vector in degrees", float(np.deg2rad(1.0))
        ),
        _matrices("matrix", "a rotation matrix by rows", transposed=False),
        _matrices("matrix-transposed", "a rotation matrix by columns", transposed=True),
        *(
            _euler(name, unit)
            # The twelve sequences, about moving axes (capitals) and about fixed axes.
            for order in (*permutations("XYZ"), *((a, b, a) for a, b in permutations("XYZ", 2)))
            for name in ("".join(order), "".join(order).lower())
            for unit in ("rad", "deg")
        ),
    )
}


@dataclass(frozen=True)
class Reading:
    """Interpretation of poses that are given as numbers."""

    rotation: str = "quaternion-xyzw"  # A name among `ROTATION_FORMS`.
    unit: str = "m"  # A name among `UNITS_M`.
    inverse: bool = False  # Whether the numbers give the inverse of the wanted pose.

    @property
    def words(self) -> str:
        """Description of the reading."""
        rotation = ROTATION_FORMS[self.rotation].words
        return f"{self.unit}, {rotation}{', inverse' if self.inverse else ''}"


@dataclass(frozen=True, eq=False)
class PoseNumbers:
    """Poses as uninterpreted numbers with their assumed reading."""

    positions: FloatArray  # (n, 3) in the reading's unit; NaN in a row without a pose.
    rotations: FloatArray  # (n, k) in the reading's form.
    reading: Reading  # The interpretation by the file or the user.
    places: tuple[str, ...]  # (n,) origin of each, for messages: `poses.csv, line 3`.

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def of_poses(cls, poses: FloatArray, places: Sequence[str]) -> "PoseNumbers":
        """From (n, 4, 4) transforms [m], NaN in a row without one."""
        rotations = poses[:, :3, :3].reshape(-1, 9)
        return cls(poses[:, :3, 3], rotations, Reading("matrix"), tuple(places))

    @classmethod
    def written(cls, poses: FloatArray, reading: Reading, places: Sequence[str]) -> "PoseNumbers":
        """From (n, 4, 4) transforms [m], as numbers that a reading turns into them."""
        meant = invert(poses) if reading.inverse else poses
        rotations = ROTATION_FORMS[reading.rotation].write(meant[:, :3, :3])
        return cls(meant[:, :3, 3] / UNITS_M[reading.unit], rotations, reading, tuple(places))

    @classmethod
    def empty(cls, places: Sequence[str]) -> "PoseNumbers":
        """Rows without poses."""
        none = np.full((len(places), 7), np.nan)
        return cls(none[:, :3], none[:, 3:], Reading(), tuple(places))

    @property
    def present(self) -> Mask:
        """(n,) rows that have a pose, valid or not."""
        return _finite_rows(self.positions) & _finite_rows(self.rotations)

    def rows(self, rows: IntArray) -> "PoseNumbers":
        """The given rows, in their order."""
        return chosen_rows(self, rows)

    def read_as(self, reading: Reading) -> "PoseNumbers":
        """The same numbers under another reading."""
        return replace(self, reading=reading)

    def poses(self) -> FloatArray:
        """Interprets the numbers.

        Returns:
            (n, 4, 4) transforms [m]; NaN in a row without a pose.

        Raises:
            DataError: Rows have incomplete poses or invalid rotations; they are named.
        """
        form = ROTATION_FORMS[self.reading.rotation]
        if self.rotations.shape[1] != form.size:
            raise DataError(
                f"{self.places[0]}: the rotation has {self.rotations.shape[1]} numbers, but "
                f"{form.words} has {form.size}.",
                culprits=[self.places[0]],
            )
        present = self.present
        given = np.isfinite(np.hstack([self.positions, self.rotations]))
        partly = self._places_of(given.any(axis=1) & ~present)
        if partly:
            raise DataError(
                f"{some_of(partly)}: a part of the pose's numbers is missing; all or none are "
                "needed.",
                culprits=partly,
                next_step="Fill in what is missing, or leave the whole pose of that row empty.",
            )
        rotations = form.read(self.rotations)
        invalid = self._places_of(present & ~np.isfinite(rotations).all(axis=(1, 2)))
        if invalid:
            raise DataError(
                f"{some_of(invalid)}: the numbers are not {form.words}.",
                culprits=invalid,
                next_step="Name another form of rotation, or other numbers.",
            )
        poses = compose(rotations, UNITS_M[self.reading.unit] * self.positions)
        poses[~present] = np.nan
        return invert(poses) if self.reading.inverse else poses

    def _places_of(self, rows: Mask) -> list[str]:
        return [self.places[index] for index in np.flatnonzero(rows)]


def stated_pose(numbers: Sequence[float], place: str) -> FloatArray:
    """(4, 4) pose of x, y, z [m], qx, qy, qz, qw as stated at a place; raises DataError."""
    row = np.array([numbers], dtype=float)
    return np.asarray(PoseNumbers(row[:, :3], row[:, 3:], Reading(), (place,)).poses()[0])


def controller_form(robot: str, stated: str | None = None) -> PoseForm | None:
    """The notation of a robot's controller: stated, or by its model's name; None where unknown."""
    if stated is not None:
        return POSE_FORMS[known_name("form of poses", stated, POSE_FORMS)]
    name = re.sub(r"[^a-z0-9]", "", robot.lower())
    forms = (form for form in POSE_FORMS.values() if form.models)
    return next((form for form in forms if re.match(form.models, name)), None)


def write_pose(pose: FloatArray, form: PoseForm) -> FloatArray:
    """Writes a (4, 4) pose [m] as numbers in a manufacturer's notation: position, rotation."""
    position = pose[:3, 3] / UNITS_M[form.unit]
    rotation = ROTATION_FORMS[form.rotation].write(pose[None, :3, :3])[0]
    return np.concatenate([position, rotation])
