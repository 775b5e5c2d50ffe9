"""A moving frame that was sampled: where it was in between, and how fast it moved.

Between two samples a pose follows the cubic through the two on either side, in the exponential
coordinates of the first of them: its error is of the fourth order in the distance of the samples.
Where a sample is missing beside them, it follows the line. Nothing is said across gaps, and nothing
beyond the ends.
"""

from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import FloatArray, IntArray, Mask

# Samples farther apart than so many times the usual, and than so much [s], have others missing
# between them; across the longest gap a robot can go anywhere.
_GAP_RATIO, _SHORT_GAP_S, LONGEST_GAP_S = 2.5, 0.02, 0.25
# Speeds are taken over at least this time, so that the noise of reported poses is not taken for
# motion [s].
_SPEED_S = 0.04
# Which samples the cubic goes through, by their places from the one before a moment.
_NODES = np.arange(-1, 3)


@dataclass(frozen=True, eq=False)
class Samples:
    """Moments at which something was sampled.

    Attributes:
        stamps_s: (n,) times [s], ascending; two or more.
    """

    stamps_s: FloatArray

    @property
    def step_s(self) -> float:
        """How far apart samples usually are [s]."""
        return float(np.median(np.diff(self.stamps_s)))

    def covers(self, at_s: FloatArray, margin_s: float = 0.0) -> Mask:
        """Tells which moments (m,) lie between two samples without a gap, with all around them."""
        low, high = at_s - margin_s, at_s + margin_s
        inside = (low >= self.stamps_s[0]) & (high <= self.stamps_s[-1])
        breaks = np.concatenate([[0], np.cumsum(~self._joined)])
        first, last = self._before(low), self._before(high)
        # No gap from the sample before the first moment to the one behind the last.
        return np.asarray(inside & (breaks[first] == breaks[last + 1]))

    def blend(self, values: FloatArray, at_s: FloatArray) -> FloatArray:
        """(m, k) numbers at (m,) moments that are covered, out of (n, k) at the samples."""
        before, last = self._before(at_s), len(self.stamps_s) - 1
        around = values[np.clip(before[:, None] + _NODES, 0, last)]
        return np.asarray(np.einsum("mi,mik->mk", self._weights(before, at_s), around))

    @property
    def _joined(self) -> Mask:
        """(n - 1,) between which neighbours nothing is missing."""
        steps = np.diff(self.stamps_s)
        limit_s = min(max(_GAP_RATIO * float(np.median(steps)), _SHORT_GAP_S), LONGEST_GAP_S)
        return np.asarray((steps <= limit_s) & (steps < LONGEST_GAP_S))

    def _before(self, at_s: FloatArray) -> IntArray:
        """(m,) the samples at or before some moments, with one behind them."""
        before = np.searchsorted(self.stamps_s, at_s, side="right") - 1
        return np.clip(before, 0, len(self.stamps_s) - 2)

    def _weights(self, before: IntArray, at_s: FloatArray) -> FloatArray:
        """(m, 4) Lagrange's weights of the samples around some moments; none of missing ones."""
        joined, last = self._joined, len(self.stamps_s) - 1
        there = np.ones((len(at_s), 4), dtype=bool)
        there[:, 0] = (before > 0) & joined[np.maximum(before - 1, 0)]
        there[:, 3] = (before + 2 <= last) & joined[np.minimum(before + 1, last - 1)]
        nodes_s = self.stamps_s[np.clip(before[:, None] + _NODES, 0, last)]
        weights = there.astype(float)
        for at in range(4):
            for other in range(4):
                if other != at:
                    both = there[:, at] & there[:, other]
                    span = np.where(both, nodes_s[:, at] - nodes_s[:, other], 1.0)
                    weights[:, at] *= np.where(both, (at_s - nodes_s[:, other]) / span, 1.0)
        return weights


@dataclass(frozen=True, eq=False)
class Trajectory(Samples):
    """A sampled motion.

    Attributes:
        poses: (n, 4, 4) poses [m].
    """

    poses: FloatArray

    @property
    def speed_window_s(self) -> float:
        """Over how long speeds are taken [s]."""
        return max(2.0 * self.step_s, _SPEED_S)

    def at(self, at_s: FloatArray) -> FloatArray:
        """(m, 4, 4) poses at (m,) moments that are covered [s]."""
        before = self._before(at_s)
        here, last = self.poses[before], len(self.poses) - 1
        twists = np.zeros((len(at_s), 6))
        for node, weight in zip(_NODES, self._weights(before, at_s).T, strict=True):
            if node:
                there = self.poses[np.clip(before + node, 0, last)]
                twists += weight[:, None] * log(invert(here) @ there)
        return np.asarray(here @ exp(twists))

    def speeds(self, at_s: FloatArray) -> FloatArray:
        """(m, 6) twists a second at (m,) moments, in the moving frame [rad/s, m/s].

        They are means over `speed_window_s`, cut where the samples end.
        """
        half_s = 0.5 * self.speed_window_s
        early, late = np.clip([at_s - half_s, at_s + half_s], self.stamps_s[0], self.stamps_s[-1])
        middle = invert(self.at(at_s))
        way = log(middle @ self.at(late)) - log(middle @ self.at(early))
        return np.asarray(way / (late - early)[:, None])
