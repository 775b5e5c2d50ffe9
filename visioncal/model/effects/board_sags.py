"""A board on a flange that bends with its weight, by the attitude in which it is held."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Displacement


@dataclass(frozen=True, eq=False)
class BoardSags(Displacement):
    """Curvatures of a board that gravity pulls along its normal: along a line, across, twist [1/m].

    A thin plate bends in proportion to the load across it. It is taken to be held at its middle;
    held elsewhere, its pose gives way, too, as that of any load on a bracket.
    """

    kind, bounds, count = "board sags", (0.1, 1e-6, 2.0), 3
    clause = "the board bends with its weight"
    flange: str
    normal: FloatArray  # (3,) of the board, in the flange's frame.
    marks: FloatArray  # (n, 3) corners of the board [m].
    along: float  # The line's angle from the board's x [rad].

    @classmethod
    def tried(
        cls, camera: str, flange: str, normal: FloatArray, marks: FloatArray
    ) -> "tuple[BoardSags, ...]":
        """Sags about four lines of a board with (n, 3) corners."""
        return tuple(cls(camera, flange, normal, marks, at * np.pi / 4.0) for at in range(4))

    def bow_m(self, values: FloatArray) -> float:
        """Heights of the corners where the board lies level, by (3,) values, from end to end."""
        bent = self.bent(self.marks) @ values
        plane = np.column_stack([np.ones(len(bent)), self.marks[:, :2]])
        return float(np.ptp(bent - plane @ np.linalg.lstsq(plane, bent, rcond=None)[0]))

    def moved(self, points: FloatArray, poses: FloatArray) -> FloatArray:
        """See `Displacement`."""
        turns, origins = poses[..., :3, :3], poses[..., :3, 3]
        on_board = (np.swapaxes(turns, -1, -2) @ (points - origins)[:, :, None])[:, :, 0]
        return np.asarray(turns[..., 2, None] * self.bent(on_board)[:, None, :])

    def bent(self, on_board: FloatArray) -> FloatArray:
        """(n, 3) heights of (n, 3) points of the board by each curvature of one [m]."""
        cosine, sine = np.cos(self.along), np.sin(self.along)
        about = (on_board - self.marks.mean(axis=0))[:, :2]
        u, v = np.array([[cosine, sine], [-sine, cosine]]) @ about.T
        return np.stack([0.5 * u**2, 0.5 * v**2, u * v], axis=1)

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`: (k, 3, 3) shares of gravity along the normal; none where it is unknown."""
        del distances
        down = -moments.poses[self.flange][:, 2, :3] @ self.normal
        return np.asarray(np.nan_to_num(down)[:, None, None] * np.eye(3))
