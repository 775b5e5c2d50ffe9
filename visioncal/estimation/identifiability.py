"""Identifiability of an arm's errors: by given stops, and by any postures.

Jacobians are in units of the noise by rows and of the errors' prior size by columns, and the frames
at both ends of the chain, without a prior, are projected out. A singular value is then the ratio of
prior to measurement sigma of a direction: over one, it is determined. Observability indices are of
the same singular values.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import svd

from visioncal.core.types import FloatArray

# Directions whose singular value is below this share of the largest are unidentifiable.
LEAST_SHARE = 1e-7


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Identifiable and determined errors of an arm."""

    columns: int  # Number of unknowns: of the frames and of the arm's errors.
    # Number of them, or of their combinations, that any postures could determine.
    identifiable: int
    determined: int  # Number of them that the stops determine better than the prior.
    values: FloatArray  # (L,) singular values of the determined directions of the arm, descending.
    # (p, k) the k directions of the arm's errors identifiable but not determined.
    missing: FloatArray


@dataclass(frozen=True, eq=False)
class Jacobians:
    """Jacobians of the observations by the frames at both ends and by the arm's errors."""

    frames: FloatArray  # (r, f) by the frames.
    arm: FloatArray  # (r, p) by the arm's errors, in units of their prior size.

    def free(self) -> tuple[int, FloatArray]:
        """Rank of the frames, and (r, p) the arm's Jacobian projected off them.

        Both are exact where the frames have no prior.
        """
        scale = np.linalg.norm(self.frames, axis=0)
        shown = scale > LEAST_SHARE * scale.max()
        basis, sizes, _ = np.linalg.svd(self.frames[:, shown] / scale[shown], full_matrices=False)
        basis = basis[:, sizes > LEAST_SHARE * sizes[0]]
        return basis.shape[1], self.arm - basis @ (basis.T @ self.arm)


def identifiability(stops: Jacobians, anywhere: Jacobians) -> Identifiability:
    """Counts the directions that stops determine, and that postures over the workspace could."""
    frame_rank, free = anywhere.free()
    sizes, vectors = right_vectors(free)
    shown = vectors[sizes > LEAST_SHARE * sizes[0]]
    frames_determined, values, determined = _determined(stops)
    # The identifiable space without the determined one; both have orthonormal bases.
    missing = _singular(shown.T - determined.T @ (determined @ shown.T))[0]
    return Identifiability(
        columns=stops.frames.shape[1] + stops.arm.shape[1],
        identifiable=frame_rank + len(shown) + stops.frames.shape[1] - anywhere.frames.shape[1],
        determined=frames_determined + len(values),
        values=values,
        missing=missing[:, : max(len(shown) - len(values), 0)],
    )


def count_determined(jacobian: Jacobians) -> int:
    """Number of directions determined better than the prior."""
    frame_rank, values, _ = _determined(jacobian)
    return frame_rank + len(values)


def _determined(jacobian: Jacobians) -> tuple[int, FloatArray, FloatArray]:
    """Rank of the frames, and singular values and directions (k, p) of determined arm errors."""
    frame_rank, free = jacobian.free()
    sizes, vectors = right_vectors(free)
    return frame_rank, sizes[sizes > 1.0], vectors[sizes > 1.0]


def right_vectors(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Singular values (k,) of an (r, k) matrix, including zeros, and (k, k) right vectors."""
    padded = np.vstack([matrix, np.zeros((matrix.shape[1],) * 2)])
    _, sizes, vectors = _singular(np.asarray(np.linalg.qr(padded, mode="r")))
    return sizes, vectors


def _singular(matrix: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Thin singular value decomposition of a matrix that may be rank deficient."""
    # Divide and conquer, which numpy has, does not converge on some of these.
    left, sizes, right = svd(matrix, full_matrices=False, lapack_driver="gesvd")
    return left, sizes, right


@dataclass(frozen=True)
class Indices:
    """Observability indices, by which sets of stops are compared; larger is better.

    With the singular values s_1 >= ... >= s_L of the determined directions, over m stops:
    """

    # `(s_1 ... s_L)^(1/L) / sqrt(m)` (Borm and Menq 1991, eq. 14): the noise ellipsoid's volume.
    o1: float
    o2: float  # `s_L / s_1`, one over the condition number (Driels and Pathre 1990).
    o3: float  # `s_L` (Nahvi, Hollerbach and Hayward 1994).
    o4: float  # `s_L^2 / s_1`, the noise amplification index (Nahvi and Hollerbach 1996, eq. 9).
    o5: float  # `1 / (1 / s_1 + ... + 1 / s_L)` (Sun and Hollerbach 2008, of A-optimality).

    @property
    def condition(self) -> float:
        """Largest over smallest singular value."""
        return 1.0 / self.o2

    @classmethod
    def of(cls, values: FloatArray, stops: int) -> "Indices":
        """Computes the indices from (L,) nonzero singular values, and the number of stops."""
        least, greatest = float(values.min()), float(values.max())
        mean = float(np.exp(np.mean(np.log(values))))
        return cls(
            o1=mean / float(np.sqrt(stops)),
            o2=least / greatest,
            o3=least,
            o4=least**2 / greatest,
            o5=1.0 / float(np.sum(1.0 / values)),
        )
