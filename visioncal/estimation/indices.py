"""Observability indices of an arm's errors at its stops, from singular values of the Jacobian."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray


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
