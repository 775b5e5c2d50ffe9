"""Where an arm reaches, and postures to start from: many of them, found by their flange's pose."""

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.robot.inverse import Inverse
from visioncal.robot.model import Robot

# So many postures leave no hole in which a reachable pose is far from all of them.
_POSTURES = 60_000
# Postures of its own by which an atlas learns how far a reachable pose is from the next one; one of
# several neighbours is taken, so that all branches of the arm are.
_PROBES, _NEIGHBOURS = 1000, 6
# A radian of the last axis counts as this share of the outstretched arm.
_TURN_SHARE = 0.5


class Atlas:
    """Postures all over an arm's range, by where they bring the flange.

    A turn of the first joint turns the pose about the first axis, and a turn of the last one about
    the last: postures that differ by these alone are one (as in a capability map; Zacharias, Borst
    and Hirzinger 2007). What is left of a pose are height and distance from the first axis, and
    the last axis' direction seen from there: four numbers, which a few ten thousand postures fill.
    A pose that is far from all of them is out of reach.
    """

    def __init__(self, robot: Robot, inverse: Inverse, rng: np.random.Generator) -> None:
        """Draws the postures.

        Args:
            robot: The arm.
            inverse: Its inverse kinematics, which knows its range.
            rng: Source of randomness.
        """
        self._robot, self._chain = robot, robot.chain
        self._reach_m = float(np.linalg.norm(self._chain.placements[1:, :3, 3], axis=1).sum())
        self._positions = inverse.starts(_POSTURES, rng)
        self._flange, self._angles, places = self._places(self._poses(self._positions))
        self._tree = cKDTree(places)
        probes = self._places(self._poses(inverse.starts(_PROBES, rng)))[2]
        self._far = float(self._tree.query(probes)[0].max())

    def starts(
        self, base_from_flange: FloatArray, rng: np.random.Generator
    ) -> tuple[Mask, FloatArray]:
        """Finds postures that come near to poses.

        Args:
            base_from_flange: (k, 4, 4) the poses [m].
            rng: Chooses among neighbours.

        Returns:
            Which of the poses (k,) the arm may reach, and for those (r, n) effective positions
            [rad or m] that nearly do.
        """
        flange, angles, places = self._places(base_from_flange)
        apart, rows = self._tree.query(places, _NEIGHBOURS, distance_upper_bound=self._far)
        near = np.isfinite(apart)
        within = np.asarray(near[:, 0])
        taken = (rng.random(len(near)) * near.sum(axis=1)).astype(np.int64)
        chosen = rows[np.arange(len(rows)), taken][within]
        return within, self._turned(chosen, flange[within], angles[within])

    def _poses(self, positions: FloatArray) -> FloatArray:
        return self._robot.base_from_flange(self._chain.encoded(positions))

    def _places(self, base_from_flange: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Last joint's rotation (k, 3, 3), turn (k,) about the first axis, and the rest (k, 6)."""
        chain = self._chain
        ends = invert(chain.placements[0]) @ base_from_flange @ invert(chain.placements[-1])
        axis, at, along = chain.axes[0], ends[:, :3, 3], ends[:, :3, :3] @ chain.axes[-1]
        aside = np.eye(3)[np.argmin(np.abs(axis))]
        x = np.cross(axis, aside) / np.linalg.norm(np.cross(axis, aside))
        y = np.cross(axis, x)
        angles = np.arctan2(at @ y, at @ x) * ~chain.prismatic[0]
        outward = np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * y
        frame = np.stack([outward, np.cross(axis, outward), np.broadcast_to(axis, at.shape)], 1)
        places = [
            (frame @ at[:, :, None])[:, :, 0] / self._reach_m,
            _TURN_SHARE * (frame @ along[:, :, None])[:, :, 0],
        ]
        return ends[:, :3, :3], angles, np.concatenate(places, axis=1)

    def _turned(self, rows: IntArray, rotation: FloatArray, angles: FloatArray) -> FloatArray:
        """Postures of the atlas (r, n) with the first and the last joint turned to a pose."""
        chain, positions = self._chain, self._positions[rows].copy()
        turn = angles - self._angles[rows]
        about = Rotation.from_rotvec(turn[:, None] * chain.axes[0]).as_matrix()
        left = np.swapaxes(about @ self._flange[rows], 1, 2) @ rotation
        axis = chain.axes[-1]
        vector = np.stack([left[:, i, j] - left[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], 1)
        along = np.einsum("i,kij,j->k", axis, left, axis)
        spin = np.arctan2(vector @ axis, np.trace(left, axis1=1, axis2=2) - along)
        for joint, angle in ((0, turn), (-1, spin)):
            if not chain.prismatic[joint]:
                turned = positions[:, joint] + angle
                positions[:, joint] = np.remainder(turned + np.pi, 2.0 * np.pi) - np.pi
        return positions
