"""Identifiability: the errors of an arm that the stops determine, and that any posture would.

Slopes are taken in units of the noise by rows and of the errors' own size by columns, and the
frames at both ends of the chain, of which nothing is known, are taken out. A singular value is then
how much better the stops know a direction than it was known before: over one, it is determined.
Observability indices are of the same singular values.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import svd

from visioncal.core.types import FloatArray

# Directions that move the pose by less than this share of the best determined move nothing.
LEAST_SHARE = 1e-7


@dataclass(frozen=True, eq=False)
class Identifiability:
    """What stops determine of an arm.

    Attributes:
        columns: How many values are carried: the frames' and the arm's errors.
        identifiable: How many of them, or of their combinations, any postures distinguish.
        determined: How many of them the stops determine better than they were known before.
        values: (L,) singular values of the arm's part of what is determined, in descending order.
        missing: (p, k) the k directions of the arm's errors identifiable but not determined.
    """

    columns: int
    identifiable: int
    determined: int
    values: FloatArray
    missing: FloatArray


@dataclass(frozen=True, eq=False)
class Jacobians:
    """How what is seen moves with the frames at both ends and the arm's errors.

    Attributes:
        frames: (r, f) by the frames.
        arm: (r, p) by the arm's errors, each in its own size.
    """

    frames: FloatArray
    arm: FloatArray

    def free(self) -> tuple[int, FloatArray]:
        """How many directions of the frames show, and (r, p) what of the arm they cannot imitate.

        Both are exact where nothing is known of the frames.
        """
        scale = np.linalg.norm(self.frames, axis=0)
        shown = scale > LEAST_SHARE * scale.max()
        basis, sizes, _ = np.linalg.svd(self.frames[:, shown] / scale[shown], full_matrices=False)
        basis = basis[:, sizes > LEAST_SHARE * sizes[0]]
        return basis.shape[1], self.arm - basis @ (basis.T @ self.arm)


def identifiability(stops: Jacobians, anywhere: Jacobians) -> Identifiability:
    """Counts what stops determine, and what any stops could.

    Args:
        stops: Slopes at the stops.
        anywhere: Slopes at postures all over the workspace.
    """
    most, free = anywhere.free()
    sizes, turned = right_vectors(free)
    can = turned[sizes > LEAST_SHARE * sizes[0]]
    seen, values, here = _determined(stops)
    # What is identifiable and not among what is determined; both are spanned by unit vectors.
    missing = _singular(can.T - here.T @ (here @ can.T))[0]
    return Identifiability(
        columns=stops.frames.shape[1] + stops.arm.shape[1],
        identifiable=most + len(can) + stops.frames.shape[1] - anywhere.frames.shape[1],
        determined=seen + len(values),
        values=values,
        missing=missing[:, : max(len(can) - len(values), 0)],
    )


def count_determined(jacobian: Jacobians) -> int:
    """How many values and combinations are determined better than they were known before."""
    seen, values, _ = _determined(jacobian)
    return seen + len(values)


def _determined(jacobian: Jacobians) -> tuple[int, FloatArray, FloatArray]:
    """Directions of the frames, and values and directions (k, p) of the arm that are determined."""
    seen, free = jacobian.free()
    sizes, turned = right_vectors(free)
    return seen, sizes[sizes > 1.0], turned[sizes > 1.0]


def right_vectors(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Singular values (k,) of an (r, k) matrix, zeros among them, and (k, k) right vectors."""
    padded = np.vstack([matrix, np.zeros((matrix.shape[1],) * 2)])
    _, sizes, turned = _singular(np.asarray(np.linalg.qr(padded, mode="r")))
    return sizes, turned


def _singular(matrix: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The thin singular value decomposition of a matrix that may lack directions."""
    # Divide and conquer, which numpy has, does not converge on some of these.
    left, sizes, right = svd(matrix, full_matrices=False, lapack_driver="gesvd")
    return left, sizes, right


@dataclass(frozen=True)
class Indices:
    """What has been proposed to compare sets of stops by; all are larger where stops are better.

    With the singular values s_1 >= ... >= s_L of the slopes by what is determined, over m stops:

    Attributes:
        o1: `(s_1 ... s_L)^(1/L) / sqrt(m)` (Borm and Menq 1991, eq. 14): the volume that noise
            fills.
        o2: `s_L / s_1`, one over the condition number (Driels and Pathre 1990).
        o3: `s_L` (Nahvi, Hollerbach and Hayward 1994).
        o4: `s_L^2 / s_1`, the noise amplification index (Nahvi and Hollerbach 1996, eq. 9).
        o5: `1 / (1 / s_1 + ... + 1 / s_L)` (Sun and Hollerbach 2008, of A-optimality).
    """

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float

    @property
    def condition(self) -> float:
        """Largest over smallest singular value."""
        return 1.0 / self.o2

    @classmethod
    def of(cls, values: FloatArray, stops: int) -> "Indices":
        """Computes the indices.

        Args:
            values: (L,) singular values of what is determined, none of them zero.
            stops: How many stops of the arm they are of.
        """
        least, greatest = float(values.min()), float(values.max())
        mean = float(np.exp(np.mean(np.log(values))))
        return cls(
            o1=mean / float(np.sqrt(stops)),
            o2=least / greatest,
            o3=least,
            o4=least**2 / greatest,
            o5=1.0 / float(np.sum(1.0 / values)),
        )
