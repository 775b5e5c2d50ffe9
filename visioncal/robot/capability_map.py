"""Reachability of poses, and start postures for inverse kinematics, from sampled postures."""

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.robot.inverse import Inverse
from visioncal.robot.model import Robot

# Number of postures: dense enough that every reachable pose is near one of them.
_POSTURES = 60_000
# Random postures that calibrate the distance of a reachable pose to its nearest neighbour, and
# number of neighbours of which one is drawn, so that all branches of the arm occur.
_PROBES, _NEIGHBOURS = 1000, 6
# Weight of the last axis' direction [1/rad], relative to positions over the arm's reach.
_TURN_SHARE = 0.5


class CapabilityMap:
    """Capability map of an arm: random postures, indexed by their flange poses.

    Postures that differ by the first and last joint alone are equivalent, since these turn the pose
    about the first and the last axis (Zacharias, Borst and Hirzinger 2007). Of a pose there remain
    height and distance from the first axis, and the last axis' direction seen from there: four
    dimensions, which some ten thousand postures fill. A pose far from all of them is out of reach.
    """

    def __init__(self, robot: Robot, inverse: Inverse, rng: np.random.Generator) -> None:
        """Draws the postures from the ranges of the inverse kinematics."""
        self._robot, self._chain = robot, robot.chain
        self._reach_m = float(np.linalg.norm(self._chain.placements[1:, :3, 3], axis=1).sum())
        self._positions = inverse.starts(_POSTURES, rng)
        self._flange, self._angles, features = self._features(self._poses(self._positions))
        self._tree = cKDTree(features)
        probes = self._features(self._poses(inverse.starts(_PROBES, rng)))[2]
        self._limit = float(self._tree.query(probes)[0].max())

    def starts(
        self, base_from_flange: FloatArray, rng: np.random.Generator
    ) -> tuple[Mask, FloatArray]:
        """Finds postures near (k, 4, 4) poses [m], drawn among neighbours.

        Returns:
            (k,) mask of the poses that may be reachable, and (r, n) effective positions [rad or m]
            near these.
        """
        flange, angles, features = self._features(base_from_flange)
        distances, rows = self._tree.query(features, _NEIGHBOURS, distance_upper_bound=self._limit)
        near = np.isfinite(distances)
        reachable = np.asarray(near[:, 0])
        drawn = (rng.random(len(near)) * near.sum(axis=1)).astype(np.int64)
        chosen = rows[np.arange(len(rows)), drawn][reachable]
        return reachable, self._turned(chosen, flange[reachable], angles[reachable])

    def _poses(self, positions: FloatArray) -> FloatArray:
        return self._robot.base_from_flange(self._chain.encoded(positions))

    def _features(self, base_from_flange: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Last joint's rotation (k, 3, 3), turn (k,) about the first axis, and features (k, 6)."""
        chain = self._chain
        ends = invert(chain.placements[0]) @ base_from_flange @ invert(chain.placements[-1])
        axis, positions, last_axes = chain.axes[0], ends[:, :3, 3], ends[:, :3, :3] @ chain.axes[-1]
        aside = np.eye(3)[np.argmin(np.abs(axis))]
        x = np.cross(axis, aside) / np.linalg.norm(np.cross(axis, aside))
        y = np.cross(axis, x)
        angles = np.arctan2(positions @ y, positions @ x) * ~chain.prismatic[0]
        outward = np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * y
        frame = np.stack(
            [outward, np.cross(axis, outward), np.broadcast_to(axis, positions.shape)], 1
        )
        features = [
            (frame @ positions[:, :, None])[:, :, 0] / self._reach_m,
            _TURN_SHARE * (frame @ last_axes[:, :, None])[:, :, 0],
        ]
        return ends[:, :3, :3], angles, np.concatenate(features, axis=1)

    def _turned(self, rows: IntArray, rotation: FloatArray, angles: FloatArray) -> FloatArray:
        """Postures of the map (r, n), with the first and the last joint turned towards a pose."""
        chain, positions = self._chain, self._positions[rows].copy()
        turn = angles - self._angles[rows]
        about = Rotation.from_rotvec(turn[:, None] * chain.axes[0]).as_matrix()
        rest = np.swapaxes(about @ self._flange[rows], 1, 2) @ rotation
        axis = chain.axes[-1]
        vector = np.stack([rest[:, i, j] - rest[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], 1)
        along = np.einsum("i,kij,j->k", axis, rest, axis)
        spin = np.arctan2(vector @ axis, np.trace(rest, axis1=1, axis2=2) - along)
        for joint, angle in ((0, turn), (-1, spin)):
            if not chain.prismatic[joint]:
                turned = positions[:, joint] + angle
                positions[:, joint] = np.remainder(turned + np.pi, 2.0 * np.pi) - np.pi
        return positions
