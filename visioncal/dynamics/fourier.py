"""Joint motions as finite Fourier series that begin and end at rest.

Swevers, Ganseman, Tuekel, De Schutter and Van Brussel (1997, Optimal robot excitation and
identification): a periodic motion of few harmonics is known exactly from its coefficients, and its
band is narrow. Rest at the beginning, and so at the end, are two linear equations in a joint's
coefficients; they are eliminated, not penalised.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import null_space

from visioncal.core.types import FloatArray
from visioncal.dynamics.motion import JointMotion


@dataclass(frozen=True)
class Harmonics:
    """Basis functions of one joint's motion: `count` harmonics of the period `period_s` [s]."""

    period_s: float
    count: int

    @cached_property
    def resting(self) -> FloatArray:
        """(1 + 2 count, 2 count - 1) orthonormal basis of the coefficients that begin at rest."""
        _, speed, acceleration = self._functions(np.zeros(1))
        return np.asarray(null_space(np.vstack([speed, acceleration])))

    def basis(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Positions, speeds, accelerations (m, 2 count - 1) for a unit of each free coefficient."""
        q, dq, ddq = (function @ self.resting for function in self._functions(times_s))
        return q, dq, ddq

    def _functions(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(m, 1 + 2 count) constant, sines and cosines, and their first and second derivatives."""
        rates = 2.0 * np.pi / self.period_s * np.arange(1, self.count + 1)
        phases = np.asarray(times_s)[:, None] * rates
        sine, cosine = np.sin(phases), np.cos(phases)
        one = np.ones((len(phases), 1))
        return (
            np.hstack([one, sine, cosine]),
            np.hstack([0.0 * one, rates * cosine, -rates * sine]),
            np.hstack([0.0 * one, -(rates**2) * sine, -(rates**2) * cosine]),
        )


@dataclass(frozen=True, eq=False)
class Series:
    """Fourier series of n joints that begin and end at rest."""

    harmonics: Harmonics  # The basis functions.
    free: FloatArray  # (n, 2 count - 1) coefficients in the basis `Harmonics.resting` [rad].

    @property
    def coefficients(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean (n,), sines (n, count) and cosines (n, count) of each joint's position [rad]."""
        full, count = self.free @ self.harmonics.resting.T, self.harmonics.count
        return full[:, 0], full[:, 1 : 1 + count], full[:, 1 + count :]

    @property
    def start(self) -> FloatArray:
        """(n,) posture at beginning and end [rad]."""
        mean, _, cosines = self.coefficients
        return np.asarray(mean + cosines.sum(axis=1))

    def motion(self, times_s: FloatArray) -> JointMotion:
        """The motion at (m,) times [s]."""
        q, dq, ddq = (array @ self.free.T for array in self.harmonics.basis(times_s))
        return JointMotion(np.asarray(times_s, dtype=float), q, dq, ddq)

    def sampled(self, rate_hz: float) -> JointMotion:
        """The motion from its beginning to its end, evenly sampled."""
        return self.motion(even_times(self.harmonics.period_s, rate_hz))

    def shrunk(self, share: float) -> "Series":
        """The motion scaled by a factor about its mean."""
        # The mean is in the span of the free coefficients: the conditions of rest do not limit it.
        middle = np.outer(self.coefficients[0], self.harmonics.resting[0])
        return Series(self.harmonics, middle + share * (self.free - middle))


def even_times(duration_s: float, rate_hz: float) -> FloatArray:
    """(m,) times from zero to a duration, both included, at a rate or slightly more."""
    return np.linspace(0.0, duration_s, 1 + int(np.ceil(duration_s * rate_hz - 1e-9)))
