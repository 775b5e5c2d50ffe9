"""Sampled motion of a frame: interpolated poses and velocities.

Between two samples a pose follows the cubic through these and one on either side, in the
exponential coordinates of the first of them: its error is of fourth order in the sampling interval.
Where a neighbour is missing, the order is lower, down to linear. There is no interpolation across
gaps, and no extrapolation. Between samples of the same pose the frame was at rest: there is no gap
then, and neighbours do not count.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import exp, invert, log, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.robot.model import REPEATABILITY

# A gap is an interval over this multiple of the usual one, and over this time [s]; and any over the
# longest, in which a robot can go anywhere.
GAP_RATIO, SHORT_GAP_S, LONGEST_GAP_S = 2.5, 0.02, 0.25
# Samples of the cubic, relative to the one before a time.
_NODES = np.arange(-1, 3)


@dataclass(frozen=True, eq=False)
class Samples:
    """Sampling times."""

    stamps_s: FloatArray  # (n,) times [s], ascending; two or more.

    @property
    def step_s(self) -> float:
        """Usual sampling interval [s]."""
        return float(np.median(np.diff(self.stamps_s)))

    def covers(self, at_s: FloatArray, margin_s: float = 0.0) -> Mask:
        """Mask of the times (...,) that lie between samples without a gap, including a margin."""
        low, high = at_s - margin_s, at_s + margin_s
        inside = self.spans(low) & self.spans(high)
        breaks = np.concatenate([[0], np.cumsum(~self._joined)])
        first, last = self.before(low), self.before(high)
        # No gap from the sample before the first moment to the one behind the last.
        return np.asarray(inside & (breaks[first] == breaks[last + 1]))

    def spans(self, at_s: FloatArray) -> Mask:
        """Mask of the times (...,) between the first and the last sample."""
        return np.asarray((at_s >= self.stamps_s[0]) & (at_s <= self.stamps_s[-1]))

    def before(self, at_s: FloatArray) -> IntArray:
        """(...,) the samples at or before some times that have a successor."""
        before = np.searchsorted(self.stamps_s, at_s, side="right") - 1
        return np.clip(before, 0, len(self.stamps_s) - 2)

    def blend(self, values: FloatArray, at_s: FloatArray) -> FloatArray:
        """(m, k) values interpolated at (m,) covered times, from (n, k) at the samples."""
        before, last = self.before(at_s), len(self.stamps_s) - 1
        neighbours = values[np.clip(before[:, None] + _NODES, 0, last)]
        return np.asarray(np.einsum("mi,mik->mk", self._weights(before, at_s), neighbours))

    @cached_property
    def _joined(self) -> Mask:
        """(n - 1,) mask of the intervals without a gap."""
        steps = np.diff(self.stamps_s)
        limit_s = max(GAP_RATIO * self.step_s, SHORT_GAP_S)
        joined = (steps <= limit_s) & (steps < LONGEST_GAP_S)
        # No arm leaves a stop and is back at it within this time [s].
        return np.asarray(joined | (self._unmoved & (steps < 2.0)))

    @cached_property
    def _unmoved(self) -> Mask:
        """(n - 1,) mask of the intervals over which nothing is known to have moved."""
        return np.zeros(len(self.stamps_s) - 1, dtype=bool)

    def _weights(self, before: IntArray, at_s: FloatArray) -> FloatArray:
        """(m, 4) Lagrange weights of the samples around some times; zero for missing ones."""
        joined, last = self._joined, len(self.stamps_s) - 1
        present = np.ones((len(at_s), 4), dtype=bool)
        moved = ~self._unmoved[before]
        present[:, 0] = moved & (before > 0) & joined[np.maximum(before - 1, 0)]
        present[:, 3] = moved & (before + 2 <= last) & joined[np.minimum(before + 1, last - 1)]
        nodes_s = self.stamps_s[np.clip(before[:, None] + _NODES, 0, last)]
        counted = present[:, :, None] & present[:, None, :] & ~np.eye(4, dtype=bool)
        spans = np.where(counted, nodes_s[:, :, None] - nodes_s[:, None, :], 1.0)
        ways = np.where(counted, (at_s[:, None] - nodes_s)[:, None, :], 1.0)
        return np.asarray(present * (ways / spans).prod(axis=2))


@dataclass(frozen=True, eq=False)
class Trajectory(Samples):
    """A sampled motion."""

    poses: FloatArray  # (n, 4, 4) poses [m].

    @property
    def speed_window_s(self) -> float:
        """Time over which velocities are averaged [s]."""
        # Least time over which velocities are averaged, to limit the noise of reported poses [s].
        return max(2.0 * self.step_s, 0.04)

    @cached_property
    def _unmoved(self) -> Mask:
        return is_repeated(invert(self.poses[:-1]) @ self.poses[1:])

    def rests(self, at_s: FloatArray) -> Mask:
        """(m,) mask of the times (m,) between samples of the same pose."""
        return self._unmoved[self.before(at_s)]

    def at(self, at_s: FloatArray) -> FloatArray:
        """(m, 4, 4) poses at (m,) covered times [s]."""
        before = self.before(at_s)
        start, last = self.poses[before], len(self.poses) - 1
        twists = np.zeros((len(at_s), 6))
        for node, weight in zip(_NODES, self._weights(before, at_s).T, strict=True):
            if node:
                pose = self.poses[np.clip(before + node, 0, last)]
                twists += weight[:, None] * log(invert(start) @ pose)
        return np.asarray(start @ exp(twists))

    def rotations(self, at_s: FloatArray) -> tuple[FloatArray, Mask]:
        """(..., 4) quaternions about linear between samples, and a mask of the covered times."""
        before, covered = self.before(at_s), self.covers(at_s)
        share = (
            np.where(covered, at_s - self.stamps_s[before], 0.0) / np.diff(self.stamps_s)[before]
        )
        mixed = self._quaternions[before] * (1.0 - share)[..., None]
        mixed += self._quaternions[before + 1] * share[..., None]
        return mixed / np.linalg.norm(mixed, axis=-1, keepdims=True), covered

    @cached_property
    def _quaternions(self) -> FloatArray:
        """(n, 4) of the samples' rotations, each on the side of the one before."""
        found = Rotation.from_matrix(self.poses[:, :3, :3]).as_quat()
        turned = np.einsum("ni,ni->n", found[:-1], found[1:]) < 0.0
        signs = np.concatenate([[1.0], np.where(np.cumsum(turned) % 2, -1.0, 1.0)])
        return np.asarray(found * signs[:, None])

    def speeds(self, at_s: FloatArray) -> FloatArray:
        """(m, 6) twists per second at (m,) times, in the moving frame [rad/s, m/s].

        They are means over `speed_window_s`, truncated at the ends of the samples.
        """
        half_s = 0.5 * self.speed_window_s
        early, late = np.clip([at_s - half_s, at_s + half_s], self.stamps_s[0], self.stamps_s[-1])
        middle = invert(self.at(at_s))
        twists = log(middle @ self.at(late)) - log(middle @ self.at(early))
        return np.asarray(twists / (late - early)[:, None])


def is_repeated(moved: FloatArray) -> Mask:
    """(m,) mask of motions (m, 4, 4) [m] within what arms repeat to."""
    is_near = 1e3 * np.linalg.norm(moved[:, :3, 3], axis=1) < REPEATABILITY[0]
    return np.asarray(is_near & (np.rad2deg(rotation_angle(moved)) < REPEATABILITY[1]))
