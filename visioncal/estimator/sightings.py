"""What a whole cell's network is made of: what was seen, what is unknown, and what is noise."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.transforms import exp
from visioncal.types import FloatArray, IntArray, Mask


@dataclass(frozen=True, eq=False)
class Sightings:
    """What n observations saw.

    Attributes:
        seers: (n,) the frame that saw.
        seen: (n,) the frame that was seen.
        stops: (n,) the stop, numbered from 0.
        sensors: (n,) whose noise level it is, numbered from 0; -1 where the covariance is known.
        measured: (n, 4, 4) `seer_from_seen`.
        covariance: (n, 6, 6) of its right perturbation, at a sensor's level of one.
        turned: (n,) whether its rotation was measured; else its place alone.
        by_shared: (n, 6, k) how it moves with what is shared.
    """

    seers: tuple[str, ...]
    seen: tuple[str, ...]
    stops: IntArray
    sensors: IntArray
    measured: FloatArray
    covariance: FloatArray
    turned: Mask
    by_shared: FloatArray

    def __len__(self) -> int:
        return len(self.stops)

    def subset(self, chosen: Mask) -> "Sightings":
        """Returns those of an (n,) mask."""
        rows = np.flatnonzero(chosen).tolist()
        return Sightings(
            tuple(self.seers[it] for it in rows),
            tuple(self.seen[it] for it in rows),
            self.stops[chosen],
            self.sensors[chosen],
            self.measured[chosen],
            self.covariance[chosen],
            self.turned[chosen],
            self.by_shared[chosen],
        )

    def renamed(self, frame: str, twin: str, rows: Mask) -> "Sightings":
        """Returns them with a frame that goes by another name in the rows of an (n,) mask."""

        def names(old: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(
                twin if name == frame and row else name
                for name, row in zip(old, rows.tolist(), strict=True)
            )

        return replace(self, seers=names(self.seers), seen=names(self.seen))

    def involves(self, frame: str) -> Mask:
        """(n,) which of them a frame saw or was seen in."""
        pairs = zip(self.seers, self.seen, strict=True)
        return np.array([frame in pair for pair in pairs], dtype=bool)


@dataclass(frozen=True, eq=False)
class Common:
    """What is known of the k values that sightings share, without any robot: lenses and boards.

    Attributes:
        information: (k, k) on them.
        pull: (k,) half the gradient of what is known, where the sightings were made.
    """

    information: FloatArray
    pull: FloatArray

    @classmethod
    def none(cls) -> "Common":
        """Nothing is shared."""
        return cls(np.zeros((0, 0)), np.zeros(0))


@dataclass(frozen=True, eq=False)
class State:
    """Values of the unknowns: (e, 4, 4) `parent_from_frame` of each unknown frame, and (k,)."""

    edges: FloatArray
    shared: FloatArray

    def moved(self, step: FloatArray) -> "State":
        """Returns the unknowns after a (6 e + k,) step, on the right of the edges."""
        size = 6 * len(self.edges)
        by = exp(step[:size].reshape(-1, 6))
        return State(self.edges @ by, self.shared + step[size:])


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations.

    Attributes:
        robots: (r, 2) of each robot's flange, of rotation [rad] and translation [m], per axis.
        sensors: (s,) by which each sensor's covariances are to be taken larger, as sigmas.
    """

    robots: FloatArray
    sensors: FloatArray
