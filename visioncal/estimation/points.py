"""One fit of points: a frame, and where points lie in it.

Each row has a point in the parent of an unknown frame, and coordinates of it that are stated in the
frame:

    frame^-1 * carrier * point = scale * nominal        in the stated coordinates

Of a fixture the points are measured, without carriers. Of a tool the touched points are unknown,
the carrier is `flange_from_base`, and the nominal coordinates are zero. Of an instrument's mounting
the points are unknown on the flange, and the nominal coordinates are its readings.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.transforms import apply_each, exp, skew
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.groups import Groups


@dataclass(frozen=True, eq=False)
class Placement:
    """The unknowns: a frame in its parent, unknown points [m], and the scale of what is stated."""

    frame: FloatArray  # (4, 4).
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (k, 3).
    scale: float = 1.0


@dataclass(frozen=True, eq=False)
class PointProblem:
    """Points as a problem of groups, one per row.

    The unknowns' steps are the frame's right perturbation (rotation [rad], translation [m]), the
    points [m], and the scale.
    """

    nominal: FloatArray  # (n, 3) coordinates in the frame [m].
    stated: Mask  # (n, 3) mask of those that are stated.
    covariances: FloatArray  # (n, 3, 3) stated covariance of each point in the parent [m^2].
    starts: Callable[["PointProblem"], Iterable[Placement]]  # See `GroupProblem.guesses`.
    measured: FloatArray | None = None  # (n, 3) known points in the parent [m]; None for unknown.
    # (n, 4, 4) transforms that carry unknown points to the parent, and the (n,) indices of these.
    carriers: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    points: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    turn_rad: float = 0.0  # Standard deviation of the carriers' rotations, per axis of the parent.
    oriented: bool = True  # Whether the frame's rotation is estimated.
    scaled: bool = False  # Whether the scale is.

    def guesses(self) -> Iterable[Placement]:
        """Starts from all rows, then from small sets."""
        return self.starts(self)

    def in_parent(self, state: Placement) -> FloatArray:
        """(n, 3) the points in the frame's parent [m]."""
        if self.measured is not None:
            return self.measured
        return apply_each(self.carriers, state.points[self.points])

    def local(self, state: Placement) -> FloatArray:
        """(n, 3) the points in the frame [m]."""
        return np.asarray((self.in_parent(state) - state.frame[:3, 3]) @ state.frame[:3, :3])

    def linearise(self, state: Placement) -> Groups:
        """Residuals (n, 3) in the frame, and their Jacobian.

        A step (w, v) on the right moves a point q of the frame by `q x w - v`. Of unknown points
        the stated coordinates stand for q, where noise would pass for information on the rotation:
        the gradient stays exact as long as the noise is isotropic, as the neglected term is
        `residual x residual`.
        """
        rotation, count, stated = state.frame[:3, :3], len(self.nominal), self.stated
        local, nominal = self.local(state), state.scale * self.nominal
        lever = np.where(stated, nominal, local) if self.measured is None else local
        columns = [np.tile(-np.eye(3), (count, 1, 1))]
        if self.oriented:
            columns.insert(0, skew(lever))
        if self.measured is None:
            turns = rotation.T @ self.carriers[:, :3, :3]
            own = np.eye(len(state.points))[self.points]
            by_points = turns[:, :, None, :] * own[:, None, :, None]
            columns.append(by_points.reshape(count, 3, -1))
        if self.scaled:
            columns.append(-self.nominal[:, :, None])
        arms = self.turn_rad * skew(self.in_parent(state))
        known = self.covariances + arms @ np.swapaxes(arms, 1, 2)
        return Groups(
            np.where(stated, local - nominal, 0.0),
            np.where(stated[:, :, None], np.concatenate(columns, axis=2), 0.0),
            stated,
            rotation.T @ known @ rotation,
        )

    def move(self, state: Placement, step: FloatArray) -> Placement:
        """Takes a step from a state."""
        edge, size = 6 if self.oriented else 3, state.points.size
        twist = np.concatenate([np.zeros(6 - edge), step[:edge]])
        return Placement(
            state.frame @ exp(twist),
            state.points + step[edge : edge + size].reshape(-1, 3),
            state.scale + float(step[-1]) if self.scaled else state.scale,
        )
