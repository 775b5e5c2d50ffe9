"""Directions in words: the least certain ones of a transform, and the axes of a robot's turns."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.number_format import figure
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray

# Largest predicted sigmas at a typical noise with which stops can calibrate.
SIGMA_LIMIT_M, SIGMA_LIMIT_RAD = 5e-3, float(np.deg2rad(0.5))
# A direction with a larger predicted sigma is not determined at all [m or rad].
_OPEN = 0.2


@dataclass(frozen=True)
class Direction:
    """The least certain direction of an edge."""

    words: str  # Its name, such as `the camera's offset along the tool's z`.
    sigma: float  # Its predicted standard deviation [m or rad].
    limit: float  # The largest accepted one, in the same unit.
    is_rotation: bool  # Whether it is an angle.

    @property
    def figure(self) -> str:
        """The sigma and its limit with their unit."""
        unit, scale = ("deg", np.rad2deg(1.0)) if self.is_rotation else ("mm", 1e3)
        return f"{figure(self.sigma * scale)} {unit} (limit {figure(self.limit * scale)})"

    @property
    def is_open(self) -> bool:
        """Whether the direction is not determined at all."""
        return self.sigma > _OPEN

    def fault(self, at: str) -> str:
        """The fault of the motion, at a noise in words."""
        if self.is_open:
            return "is not determined at all"
        return f"has a predicted sigma of {self.figure}{at}"


@dataclass(frozen=True, eq=False)
class Turning:
    """How a robot's part of a chain turns between its poses."""

    largest_rad: float  # The largest rotation between two poses [rad].
    main: FloatArray  # (3,) the main axis of the rotations.
    aside_rad: float  # The largest rotation beside it [rad].

    @classmethod
    def of(cls, robot: FloatArray) -> "Turning":
        """The rotations between all pairs of (m, 4, 4) poses, m of two or more.

        Of more than 300 poses as many are paired, which include those that rotate least and most.
        """
        ranked = robot[np.argsort(rotation_angle(invert(robot[0]) @ robot))]
        chosen = np.linspace(0, len(robot) - 1, min(len(robot), 300)).round().astype(np.int64)
        i, j = np.triu_indices(len(chosen), 1)
        relative = invert(ranked[chosen[j]]) @ ranked[chosen[i]]
        return cls.by(np.asarray(Rotation.from_matrix(relative[:, :3, :3]).as_rotvec()))

    @classmethod
    def by(cls, turns: FloatArray) -> "Turning":
        """Rotations by (p, 3) rotation vectors [rad]."""
        main = np.asarray(np.linalg.svd(turns, full_matrices=False)[2][0])
        aside = np.linalg.norm(turns - np.outer(turns @ main, main), axis=1).max()
        return cls(float(np.linalg.norm(turns, axis=1).max()), main, float(aside))

    @property
    def is_still(self) -> bool:
        """Whether the robot hardly turns at all."""
        return self.largest_rad < SIGMA_LIMIT_RAD

    @property
    def has_lone_axis(self) -> bool:
        """Whether all turns are about one axis."""
        return self.aside_rad < 0.1 * self.largest_rad

    @property
    def is_enough(self) -> bool:
        """Whether the robot turns about two axes."""
        return not self.is_still and not self.has_lone_axis

    def words(self, flange: FloatArray, stops: str, frame: str) -> str:
        """The fault of the motion of an (m, 4, 4) flange, by names of stops and frame."""
        largest, aside = np.rad2deg(self.largest_rad), np.rad2deg(self.aside_rad)
        if self.is_still and np.linalg.norm(np.ptp(flange[:, :3, 3], axis=0)) < 1e-3:
            return f"the {stops} are all from one pose of the robot"
        if self.is_still:
            return (
                f"the {stops} differ in position only (largest rotation between two of them: "
                f"{figure(largest)} deg)"
            )
        if self.has_lone_axis:
            return (
                f"all {stops} turn about {frame}'s {axis_words(self.main)} to within "
                f"{figure(max(aside, 0.01))} deg"
            )
        return (
            f"the {stops} turn by at most {figure(largest)} deg, and by {figure(aside)} deg about "
            "a second axis"
        )


def edge_directions(
    matrix: FloatArray, covariance: FloatArray, thing: str, frame: str
) -> tuple[Direction, Direction]:
    """Least certain directions of a (4, 4) edge with a (6, 6) covariance: offset, and rotation.

    It places a thing in a frame, by their names.
    """

    def worst(block: slice, limit: float, *, is_rotation: bool) -> Direction:
        values, vectors = np.linalg.eigh(covariance[block, block])
        quantity = "rotation about" if is_rotation else "offset along"
        words = f"{thing}'s {quantity} {frame}'s {axis_words(matrix[:3, :3] @ vectors[:, -1])}"
        if values[1] > _OPEN**2:
            words = f"{thing}'s {'rotation' if is_rotation else 'offset from ' + frame}"
        return Direction(words, float(np.sqrt(max(values[-1], 0.0))), limit, is_rotation)

    offset = worst(slice(3, 6), SIGMA_LIMIT_M, is_rotation=False)
    return offset, worst(slice(0, 3), SIGMA_LIMIT_RAD, is_rotation=True)


def axis_words(direction: FloatArray) -> str:
    """Names a direction (3,): `x`, or `direction (0.71, 0.71, 0.00)`."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) > 0.95:
        return "xyz"[axis]
    signed = direction * np.sign(direction[axis])
    return "direction ({:.2f}, {:.2f}, {:.2f})".format(*signed)
