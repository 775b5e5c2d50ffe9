"""Residuals of tool touches: positions of touched points in the tool's frame.

Every touch gives the flange's pose when a fixed point met the tool. In the tool's frame that point
is `tool_from_flange * flange_from_base * point`, and the kind of the touch says which of its
coordinates are zero:

    point   x = y = z = 0             the tool's origin, its tip, is at the point
    z       x = y = 0,  z > 0         the point lies on the tool's positive z axis
    xz      y = 0,      x > 0         it lies in the tool's xz plane, on the side of positive x

Touches of kind `point` alone determine the tip but not the tool's rotation.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.transforms import apply_each, compose, exp, invert, nearest_rotation, skew
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.groups import Groups
from visioncal.estimation.placing import LEAST_NOISE_M
from visioncal.estimation.problem_parts import Noise

TouchKind: TypeAlias = Literal["point", "z", "xz"]

# The coordinates that are zero, by kind.
_OBSERVED = {"point": (True, True, True), "z": (True, True, False), "xz": (False, True, False)}
# Number of small sets: with 40 % outliers, all contain one with probability 3e-7.
_SETS = 60


@dataclass(frozen=True, eq=False)
class Touches:
    """n touches of k points."""

    base_from_flange: FloatArray  # (n, 4, 4) poses of the flange [m].
    points: IntArray  # (n,) index of the touched point.
    kinds: tuple[TouchKind, ...]  # (n,) kind of each touch.
    labels: tuple[str, ...]  # (n,) names of the touches, for messages.
    names: tuple[str, ...]  # (k,) names of the points, for messages.

    def __len__(self) -> int:
        return len(self.points)

    def are(self, kind: TouchKind) -> Mask:
        """Mask (n,) of the touches of one kind."""
        return np.array([name == kind for name in self.kinds])

    def subset(self, chosen: Mask) -> "Touches":
        """Returns the touches of an (n,) mask; the points keep their numbers."""
        rows = np.flatnonzero(chosen)
        return replace(
            self,
            base_from_flange=self.base_from_flange[rows],
            points=self.points[rows],
            kinds=tuple(self.kinds[row] for row in rows),
            labels=tuple(self.labels[row] for row in rows),
        )


@dataclass(frozen=True, eq=False)
class TouchUnknowns:
    """The unknowns: the tool on the flange (4, 4), and the points (k, 3) in the base [m]."""

    flange_from_tool: FloatArray
    points: FloatArray


@dataclass(frozen=True, eq=False)
class TouchProblem:
    """Touches as a problem of groups, one per touch.

    The unknowns' steps are the tool's right perturbation (rotation [rad], translation [m]), without
    the rotation where that is not estimated, and the points in the base [m].
    """

    touches: Touches
    noise: Noise  # Stated errors of the flange.
    oriented: bool  # Whether the tool's rotation is estimated.

    def guesses(self) -> Iterator[TouchUnknowns]:
        """Yields starts from all touches of kind `point`, and from small sets of them."""
        tips = np.flatnonzero(self.touches.are("point"))
        yield self.guess(tips)
        yield from (self.guess(rows) for rows in _small_sets(self.touches, tips))

    def guess(self, rows: IntArray) -> TouchUnknowns:
        """Start with the tip by some touches of kind `point`."""
        touches = self.touches
        base_from_flange = touches.base_from_flange
        tip = linear_tip(base_from_flange[rows], touches.points[rows])
        tips = base_from_flange[:, :3, :3] @ tip + base_from_flange[:, :3, 3]
        are_tips = touches.are("point")
        points = np.array(
            [
                np.median(tips[are_tips & (touches.points == index)], axis=0)
                for index in range(len(touches.names))
            ]
        )
        state = TouchUnknowns(compose(np.eye(3), tip), points)
        return self.turned(state) if self.oriented else state

    def turned(self, state: TouchUnknowns) -> TouchUnknowns:
        """Rotates the tool to the axes by the touches of kind `z` and `xz`."""
        touches, tip = self.touches, state.flange_from_tool[:3, 3]
        offsets = _in_flange(touches, state.points) - tip
        z_axis = _main_direction(offsets[touches.are("z")])
        aside = offsets[touches.are("xz")]
        x_axis = _main_direction(aside - np.outer(aside @ z_axis, z_axis))
        axes = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=1)
        return replace(state, flange_from_tool=compose(nearest_rotation(axes), tip))

    def linearise(self, state: TouchUnknowns) -> Groups:
        """Coordinates of each touched point in the tool that should be zero, and their Jacobian.

        They are taken as zero in the Jacobian, where noise would pass for information about the
        tool's rotation. The gradient stays exact as long as the noise is isotropic: the neglected
        term is `residual x residual`.
        """
        touches, count = self.touches, len(self.touches)
        rotation = state.flange_from_tool[:3, :3]
        local = in_tool(touches, state)
        observed = np.array([_OBSERVED[kind] for kind in touches.kinds])
        jacobian = np.zeros((count, 3, 6 + state.points.size))
        jacobian[:, :, :3] = skew(np.where(observed, 0.0, local))
        jacobian[:, :, 3:6] = -np.eye(3)
        tool_from_base = rotation.T @ np.swapaxes(touches.base_from_flange[:, :3, :3], 1, 2)
        columns = 6 + 3 * touches.points[:, None] + np.arange(3)
        np.put_along_axis(
            jacobian, np.broadcast_to(columns[:, None], (count, 3, 3)), tool_from_base, axis=2
        )
        return Groups(
            np.where(observed, local, 0.0),
            np.where(observed[:, :, None], jacobian, 0.0)[:, :, 0 if self.oriented else 3 :],
            observed,
            self._known(rotation, _in_flange(touches, state.points)),
        )

    def move(self, state: TouchUnknowns, step: FloatArray) -> TouchUnknowns:
        """Takes a step from a state."""
        edge = 6 if self.oriented else 3
        twist = np.concatenate([np.zeros(6 - edge), step[:edge]])
        return TouchUnknowns(
            state.flange_from_tool @ exp(twist), state.points + step[edge:].reshape(-1, 3)
        )

    def _known(self, rotation: FloatArray, seen: FloatArray) -> FloatArray:
        """Covariances (n, 3, 3) of the touched points in the tool, by the flange's errors."""
        lever = rotation.T @ skew(seen)
        turn_sq, shift_sq = self.noise.robots[0] ** 2
        by_rotation = turn_sq * lever @ np.swapaxes(lever, 1, 2)
        return np.asarray((shift_sq + LEAST_NOISE_M**2) * np.eye(3) + by_rotation)


def in_tool(touches: Touches, state: TouchUnknowns) -> FloatArray:
    """Position of each touch's point in the tool's frame: (n, 3) [m]."""
    offsets = _in_flange(touches, state.points) - state.flange_from_tool[:3, 3]
    return np.asarray(offsets @ state.flange_from_tool[:3, :3])


def linear_tip(base_from_flange: FloatArray, points: IntArray) -> FloatArray:
    """The tip (3,) [m] in the flange by linear least squares: `R_i tip - point = -t_i`.

    The minimum-norm solution where the touches leave it undetermined.

    Args:
        base_from_flange: (n, 4, 4) poses of the flange [m].
        points: (n,) the point that the tip met.
    """
    index = np.unique(points, return_inverse=True)[1]
    system = np.zeros((len(points), 3, 3 + 3 * (index.max() + 1)))
    system[:, :, :3] = base_from_flange[:, :3, :3]
    for row, point in enumerate(index):
        system[row, :, 3 + 3 * point : 6 + 3 * point] = -np.eye(3)
    target = -base_from_flange[:, :3, 3].ravel()
    return np.asarray(np.linalg.lstsq(system.reshape(len(target), -1), target, rcond=None)[0][:3])


def _in_flange(touches: Touches, points: FloatArray) -> FloatArray:
    """Position of each touch's point in the flange's frame: (n, 3) [m]."""
    return apply_each(invert(touches.base_from_flange), points[touches.points])


def _main_direction(vectors: FloatArray) -> FloatArray:
    """Unit direction (3,) of a line along (n, 3) vectors, with the sign of the majority."""
    direction = np.linalg.svd(vectors, full_matrices=False)[2][0]
    side = np.sign(vectors @ direction)
    return np.asarray(direction * (1.0 if side.sum() + 0.5 * side[0] >= 0.0 else -1.0))


def _small_sets(touches: Touches, tips: IntArray) -> Iterator[IntArray]:
    """Random small sets of touches: three of one point, or two each of two points."""
    rng = np.random.default_rng(0)
    by_point = [tips[touches.points[tips] == index] for index in range(len(touches.names))]
    several = [rows for rows in by_point if len(rows) > 1]
    drawn = set()
    for _ in range(_SETS):
        chosen: list[int] = []
        wanted = 2
        for point in rng.permutation(len(several)):
            rows = rng.permutation(several[point])[: wanted + 1]
            chosen.extend(rows.tolist())
            wanted -= len(rows) - 1
            if wanted < 1:
                break
        drawn.add(tuple(sorted(chosen)))
    yield from (np.array(rows) for rows in sorted(drawn))
