"""Declared planes of features, whose depth no single image determines."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray
from visioncal.frames.camera_chain import FAR_M
from visioncal.results import Edge


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane in the base: `normal . p = offset`.

    Attributes:
        normal: (3,) of unit length.
        offset_m: Its distance from the base's origin along the normal [m].
        covariance: (4, 4) of normal and offset.
    """

    normal: FloatArray
    offset_m: float
    covariance: FloatArray

    @classmethod
    @typed
    def horizontal(cls, z_m: float, sigma_m: float = 0.0) -> Self:
        """The plane `z = z_m` of the base, of a height known to `sigma_m` [m]."""
        return cls.through(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, z_m]), sigma_m)

    @classmethod
    @typed
    def through(cls, normal: FloatArray, point: FloatArray, sigma_m: float = 0.0) -> Self:
        """A plane by its normal and a point in it.

        Args:
            normal: (3,) of any length but zero.
            point: (3,) in the base [m].
            sigma_m: How well its offset along the normal is known [m].

        Raises:
            DataError: The normal has no direction, or a number is not finite or no length in
                metres.
        """
        for name, array in (("normal", normal), ("point", point)):
            if np.shape(array) != (3,):
                raise DataError(f"plane: the {name} is {array!r}; three numbers are needed.")
        length = float(np.linalg.norm(normal))
        if not np.isfinite(length) or length < 1e-9:
            raise DataError(
                f"plane: the normal {np.asarray(normal).tolist()} has no direction.",
                next_step="Give one of any length but zero; 0,0,1 is upward in the base.",
            )
        unit = np.asarray(normal, dtype=float) / length
        return cls(unit, _length(float(unit @ point)), _offset_covariance(sigma_m))

    @classmethod
    @typed
    def of_frame(cls, edge: Edge, z_m: float = 0.0, sigma_m: float = 0.0) -> Self:
        """The plane `z = z_m` of a frame in the base, such as a fixture.

        The frame counts as independent of the calibration. One that this same camera has placed is
        not: what both have in common is counted twice then.

        Args:
            edge: `base_from_fixture`, with its covariance.
            z_m: Height of the plane in the frame [m].
            sigma_m: How well that height is known [m].
        """
        rotation, origin = edge.matrix[:3, :3], edge.matrix[:3, 3]
        normal = rotation[:, 2]
        # What moves the frame by (w, v) turns its normal by w x z and carries its origin along.
        by_rotation = -rotation @ skew(np.array([0.0, 0.0, 1.0]))
        slope = np.zeros((4, 6))
        slope[:3, :3] = by_rotation
        slope[3, :3] = origin @ by_rotation
        slope[3, 3:] = normal @ rotation
        offset = float(normal @ origin) + _length(z_m)
        covariance = slope @ edge.covariance @ slope.T + _offset_covariance(sigma_m)
        return cls(normal, _length(offset), covariance)


def _length(value_m: float) -> float:
    if not np.isfinite(value_m) or abs(value_m) > FAR_M:
        raise DataError(
            f"plane: it lies {value_m:.4g} m from the base's origin, and no arm reaches farther "
            f"than {FAR_M:g} m.",
            next_step="Give the plane in metres.",
        )
    return value_m


def _offset_covariance(sigma_m: float) -> FloatArray:
    if not np.isfinite(sigma_m) or sigma_m < 0.0:
        raise DataError(
            f"plane: sigma_m is {sigma_m!r}; a standard deviation is needed.",
            culprits=["sigma_m"],
            next_step="Give how well its height is known, 0 or more.",
        )
    return np.diag([0.0, 0.0, 0.0, sigma_m**2])
