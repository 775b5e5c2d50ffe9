"""Inertial parameters that are those of a body whatever their coordinates are.

The pseudo-inertia of a body is positive, and so has a root: log-Cholesky coordinates (Rucker and
Wensing 2022, Smooth parameterization of rigid-body inertia) are the entries of that root, those on
its diagonal as logarithms. Here they are given relative to a body that is known, which lies at
zero: then a change of 0.1 is one of ten percent, whatever the body's size and place.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.robot.inertia import Inertias, parameters_of, pseudo_inertias

# A body without extent in some direction gets this share of its largest [-].
_THIN = 1e-6


@dataclass(frozen=True, eq=False)
class LogCholesky:
    """Log-Cholesky coordinates around n bodies.

    Attributes:
        maps: (n, 10, 10) from the parameters of the body that Pinocchio's coordinates describe, by
            congruence with the root of the known body, to those of the link.
    """

    maps: FloatArray

    @classmethod
    def around(cls, known: Inertias) -> Self:
        """Coordinates that are zero at known bodies.

        Raises:
            DataError: One of them can be no body.
        """
        pseudo = pseudo_inertias(known.values)
        values, vectors = np.linalg.eigh(pseudo)
        wrong = np.flatnonzero((values[:, 0] < -1e-9 * values[:, -1]) | (values[:, -1] <= 0.0))
        if len(wrong):
            raise DataError(
                f"robot: the inertia stated for link {wrong[0] + 1} is that of no body: its "
                "second moments of mass are negative.",
                culprits=[f"joint {it + 1}" for it in wrong],
                next_step="Check mass_kg, com_m and inertia_kg_m2 (about the centre of mass).",
            )
        raised = np.maximum(values, _THIN * values[:, -1:])
        roots = np.linalg.cholesky((vectors * raised[:, None, :]) @ np.swapaxes(vectors, 1, 2))
        units = pseudo_inertias(np.eye(10))
        moved = roots[:, None] @ units @ np.swapaxes(roots, 1, 2)[:, None]
        return cls(np.swapaxes(parameters_of(moved), 1, 2))

    def values(self, coordinates: FloatArray) -> FloatArray:
        """(n, 10) inertial parameters of (n, 10) coordinates."""
        import pinocchio as pin

        own = [pin.LogCholeskyParameters(it).toDynamicParameters() for it in coordinates]
        return np.asarray((self.maps @ np.array(own)[:, :, None])[:, :, 0])

    def jacobians(self, coordinates: FloatArray) -> FloatArray:
        """(n, 10, 10) derivatives of the parameters by the coordinates."""
        import pinocchio as pin

        own = [pin.LogCholeskyParameters(it).calculateJacobian() for it in coordinates]
        return np.asarray(self.maps @ np.array(own))
