"""Mistakes that people make with poses, planted into sound ones."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.conventions import ROTATION_FORMS, UNITS_M, PoseNumbers, Reading
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, Mount

OTHER: Mapping[Mount, Mount] = {"eye-in-hand": "eye-to-hand", "eye-to-hand": "eye-in-hand"}
HALF_TURNS = [np.diag([*pair, 1.0]) for pair in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a cell as they are told, and as they are."""

    robot: PoseNumbers  # The robot's numbers, as told.
    camera: PoseNumbers  # The camera's.
    mount: Mount  # The mount, as told.
    # (n, 4, 4) `base_from_flange`, NaN in rows that no reading can give back.
    true_robot: FloatArray
    true_mount: Mount  # The mount.
    true_scale: float = 1.0  # What the board's size is to be multiplied with.
    # (n, 4, 4) the poses through the robot's model, where the session has joints.
    chain: FloatArray | None = None
    is_measured: bool = True  # Whether the camera's poses come from images.


Plant = Callable[[Poses, np.random.Generator], Poses]


def numbers(poses: FloatArray, rotation: str = "quaternion-xyzw", unit: str = "m") -> PoseNumbers:
    """Poses as numbers in some form, declared as what they are."""
    return PoseNumbers(
        poses[:, :3, 3] / UNITS_M[unit],
        ROTATION_FORMS[rotation].write(poses[:, :3, :3]),
        Reading(rotation, unit),
        tuple(f"view {at}" for at in range(len(poses))),
    )


def sound(robot: FloatArray, camera: FloatArray, mount: Mount, **more) -> Poses:
    """Poses that are told as they are."""
    return Poses(numbers(robot), numbers(camera), mount, robot, mount, **more)


def _misread(poses: Poses, rotation: str, unit: str, reading: Reading) -> Poses:
    return replace(poses, robot=numbers(poses.true_robot, rotation, unit).read_as(reading))


def _unit(poses: Poses, rng: np.random.Generator) -> Poses:
    unit = ("mm", "cm", "inch")[rng.integers(3)]
    return _misread(poses, "quaternion-xyzw", unit, Reading())


def _inverse(poses: Poses, _: np.random.Generator) -> Poses:
    return replace(poses, robot=numbers(invert(poses.true_robot)))


def _wxyz(poses: Poses, rng: np.random.Generator) -> Poses:
    """One order of a quaternion's numbers under the names of the other."""
    written = ("quaternion-wxyz", "quaternion-yzwx")[rng.integers(2)]
    return _misread(poses, written, "m", Reading())


def _order(poses: Poses, rng: np.random.Generator) -> Poses:
    """Angles about Z, Y, X that are taken for X, Y, Z: as they stand, or made into quaternions."""
    mistaken = _misread(poses, "euler-ZYX-deg", "m", Reading("euler-XYZ-deg"))
    return mistaken if rng.integers(2) else replace(mistaken, robot=numbers(mistaken.robot.poses()))


def _degrees(poses: Poses, rng: np.random.Generator) -> Poses:
    """Degrees taken for radians; or radians for degrees, which were made into quaternions."""
    if rng.integers(2):
        return _misread(poses, "euler-xyz-deg", "m", Reading("euler-xyz-rad"))
    mistaken = _misread(poses, "euler-xyz-rad", "m", Reading("euler-xyz-deg"))
    return replace(mistaken, robot=numbers(mistaken.robot.poses()))


def _wrapped(poses: Poses, rng: np.random.Generator) -> Poses:
    """Degrees taken for radians, or vectors for angles, that were made into quaternions."""
    mistaken = _misread(poses, "rotation-vector-deg", "m", Reading("rotation-vector"))
    if rng.integers(2):
        mistaken = _misread(poses, "rotation-vector", "m", Reading("euler-xyz-rad"))
    return replace(mistaken, robot=numbers(mistaken.robot.poses()))


def _mount(poses: Poses, _: np.random.Generator) -> Poses:
    return replace(poses, mount=OTHER[poses.mount])


def _shifted(poses: Poses, rng: np.random.Generator) -> Poses:
    """One robot pose too many at one end and one too few at the other."""
    by = (-1, 1)[rng.integers(2)]
    true = poses.true_robot.copy()
    reported = np.roll(true, by, axis=0)
    true[-1 if by > 0 else 0] = np.nan
    return replace(poses, robot=numbers(reported), true_robot=true)


def _swapped(poses: Poses, rng: np.random.Generator) -> Poses:
    first, second = rng.choice(len(poses.robot), 2, replace=False)
    reported = poses.true_robot.copy()
    reported[[first, second]] = reported[[second, first]]
    return replace(poses, robot=numbers(reported))


def _reordered(poses: Poses, rng: np.random.Generator) -> Poses:
    """All rows in reverse; or one side's sorted as text, their numbers beginning with 0 or 1."""
    true, way, start = poses.true_robot, rng.integers(3), int(rng.integers(2))
    if way == 0:
        return replace(poses, robot=numbers(true[::-1].copy()))
    as_text = np.array(sorted(range(start, start + len(true)), key=str)) - start
    if way == 1:
        return replace(poses, robot=numbers(true[as_text]))
    reported = np.empty_like(true)
    reported[as_text] = true
    return replace(poses, robot=numbers(reported))


def _transposed(poses: Poses, _: np.random.Generator) -> Poses:
    return _misread(poses, "matrix-transposed", "m", Reading("matrix"))


def _left_handed(poses: Poses, rng: np.random.Generator) -> Poses:
    mirror = np.ones(4)
    mirror[rng.integers(3)] = -1.0
    return replace(poses, robot=numbers(poses.true_robot * np.outer(mirror, mirror)))


def _axes(poses: Poses, rng: np.random.Generator) -> Poses:
    """Positions of two exchanged axes or with another sign of one, beside right rotations.

    In circular order, or with two other signs, they close the chain as such rotations do.
    """
    reported = numbers(poses.true_robot)
    order = ((0, 2, 1), (1, 0, 2), (2, 1, 0), (0, 1, 2))[rng.integers(4)]
    signs = np.ones(3)
    if order == (0, 1, 2):
        signs[rng.integers(3)] = -1.0
    return replace(poses, robot=replace(reported, positions=reported.positions[:, order] * signs))


def _components(poses: Poses, rng: np.random.Generator) -> Poses:
    """Two numbers of a rotation vector exchanged, one of other sign, or Euler angles in gon."""
    form = ("rotation-vector", "euler-ZYX-deg", "euler-XYZ-deg")[rng.integers(3)]
    reported, terms = numbers(poses.true_robot, form), np.eye(3)
    if form == "euler-ZYX-deg" and rng.integers(2):
        terms /= 0.9
    elif form == "rotation-vector" and rng.integers(2):
        terms = terms[:, ((0, 2, 1), (1, 0, 2), (2, 1, 0))[rng.integers(3)]]
    else:
        terms[(at := rng.integers(3)), at] = -1.0
    reported = replace(reported, rotations=reported.rotations @ terms)
    return replace(poses, robot=reported if rng.integers(2) else numbers(reported.poses()))


def _board_mm(poses: Poses, _: np.random.Generator) -> Poses:
    camera = replace(poses.camera, positions=1e3 * poses.camera.positions)
    return replace(poses, camera=camera, true_scale=1e-3)


MISTAKES: Mapping[str, Plant] = {
    "another unit": _unit,
    "inverse poses": _inverse,
    "quaternion w, x, y, z": _wxyz,
    "Euler ZYX taken for XYZ": _order,
    "degrees and radians": _degrees,
    "degrees that lost turns": _wrapped,
    "the other mount": _mount,
    "rows shifted by one": _shifted,
    "two rows exchanged": _swapped,
    "rows in another order": _reordered,
    "matrices transposed": _transposed,
    "one axis left-handed": _left_handed,
    "board's size in mm": _board_mm,
    "axes of positions": _axes,
    "numbers of rotations": _components,
}
