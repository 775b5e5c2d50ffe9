"""Touches of a tool as residuals: where touched points lie in the tool's frame.

Every touch says where the flange stood when a fixed point met the tool. In the tool's frame that
point is `tool_from_flange * flange_from_base * point`, whatever was touched with, and the kind of
the touch says which of its coordinates are zero:

    point   x = y = z = 0             the tool's origin, its tip, is at the point
    z       x = y = 0,  z > 0         the point lies on the tool's positive z axis
    xz      y = 0,      x > 0         it lies in the tool's xz plane, on the side of positive x

Touches of kind `point` alone determine the tip and nothing of the tool's rotation.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.transforms import apply_each, compose, exp, invert, nearest_rotation, skew
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.groups import Groups
from visioncal.estimation.parts import Noise
from visioncal.estimation.placing import LEAST_NOISE_M

TouchKind: TypeAlias = Literal["point", "z", "xz"]

# The coordinates that are zero, by kind.
_OBSERVED = {"point": (True, True, True), "z": (True, True, False), "xz": (False, True, False)}
# As many small sets of touches are tried: with 40 % wrong, all hold a wrong one with probability
# 3e-7.
_SETS = 60


@dataclass(frozen=True, eq=False)
class Touches:
    """n touches of k points.

    Attributes:
        base_from_flange: (n, 4, 4) where the flange stood [m].
        points: (n,) which point was touched, numbered from 0.
        kinds: (n,) what of the tool met it.
        labels: (n,) what messages call the touches.
        names: (k,) what messages call the points.
    """

    base_from_flange: FloatArray
    points: IntArray
    kinds: tuple[TouchKind, ...]
    labels: tuple[str, ...]
    names: tuple[str, ...]

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
    """Touches as a problem of groups, one a touch.

    The unknowns' steps are the tool's right perturbation (rotation [rad], translation [m]), of
    which the rotation is left out where it is not sought, and the points in the base [m].

    Attributes:
        touches: The touches.
        noise: What is known beforehand of the flange's errors.
        oriented: Whether the tool's rotation is sought.
    """

    touches: Touches
    noise: Noise
    oriented: bool

    def guesses(self) -> Iterator[TouchUnknowns]:
        """Gives starts from all touches of kind `point`, and from small sets of them."""
        there = np.flatnonzero(self.touches.are("point"))
        yield self.guess(there)
        yield from (self.guess(rows) for rows in _small_sets(self.touches, there))

    def guess(self, rows: IntArray) -> TouchUnknowns:
        """Starts with the tip that some touches of kind `point` determine."""
        touches = self.touches
        base_from_flange = touches.base_from_flange
        tip = linear_tip(base_from_flange[rows], touches.points[rows])
        seen = base_from_flange[:, :3, :3] @ tip + base_from_flange[:, :3, 3]
        there = touches.are("point")
        points = np.array(
            [
                np.median(seen[there & (touches.points == index)], axis=0)
                for index in range(len(touches.names))
            ]
        )
        state = TouchUnknowns(compose(np.eye(3), tip), points)
        return self.turned(state) if self.oriented else state

    def turned(self, state: TouchUnknowns) -> TouchUnknowns:
        """Turns the tool to where the touches of kind `z` and `xz` have its axes."""
        touches, tip = self.touches, state.flange_from_tool[:3, 3]
        away = _in_flange(touches, state.points) - tip
        z_axis = _main_direction(away[touches.are("z")])
        aside = away[touches.are("xz")]
        x_axis = _main_direction(aside - np.outer(aside @ z_axis, z_axis))
        axes = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=1)
        return replace(state, flange_from_tool=compose(nearest_rotation(axes), tip))

    def linearise(self, state: TouchUnknowns) -> Groups:
        """Gives the coordinates of each touched point in the tool that should be zero.

        They are taken as zero in the derivatives, where noise would pass for information about the
        tool's rotation. The gradient stays exact as long as the noise is the same in all axes: what
        is left out of it is `residual x residual`.
        """
        touches, count = self.touches, len(self.touches)
        rotation = state.flange_from_tool[:3, :3]
        seen = in_tool(touches, state)
        observed = np.array([_OBSERVED[kind] for kind in touches.kinds])
        jacobian = np.zeros((count, 3, 6 + state.points.size))
        jacobian[:, :, :3] = skew(np.where(observed, 0.0, seen))
        jacobian[:, :, 3:6] = -np.eye(3)
        tool_from_base = rotation.T @ np.swapaxes(touches.base_from_flange[:, :3, :3], 1, 2)
        columns = 6 + 3 * touches.points[:, None] + np.arange(3)
        np.put_along_axis(
            jacobian, np.broadcast_to(columns[:, None], (count, 3, 3)), tool_from_base, axis=2
        )
        return Groups(
            np.where(observed, seen, 0.0),
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
        """Covariances (n, 3, 3) of the touched points in the tool, from the flange's errors."""
        lever = rotation.T @ skew(seen)
        turn_sq, shift_sq = self.noise.robots[0] ** 2
        turned = turn_sq * lever @ np.swapaxes(lever, 1, 2)
        return np.asarray((shift_sq + LEAST_NOISE_M**2) * np.eye(3) + turned)


def in_tool(touches: Touches, state: TouchUnknowns) -> FloatArray:
    """Where each touch has its point in the tool's frame: (n, 3) [m]."""
    away = _in_flange(touches, state.points) - state.flange_from_tool[:3, 3]
    return np.asarray(away @ state.flange_from_tool[:3, :3])


def linear_tip(base_from_flange: FloatArray, points: IntArray) -> FloatArray:
    """The tip (3,) [m] in the flange by linear least squares: `R_i tip - point = -t_i`.

    The shortest where the touches leave it open.

    Args:
        base_from_flange: (n, 4, 4) where the flange stood [m].
        points: (n,) which point the tip met.
    """
    which = np.unique(points, return_inverse=True)[1]
    system = np.zeros((len(points), 3, 3 + 3 * (which.max() + 1)))
    system[:, :, :3] = base_from_flange[:, :3, :3]
    for row, at in enumerate(which):
        system[row, :, 3 + 3 * at : 6 + 3 * at] = -np.eye(3)
    target = -base_from_flange[:, :3, 3].ravel()
    return np.asarray(np.linalg.lstsq(system.reshape(len(target), -1), target, rcond=None)[0][:3])


def _in_flange(touches: Touches, points: FloatArray) -> FloatArray:
    """Where each touch has its point in the flange's frame: (n, 3) [m]."""
    return apply_each(invert(touches.base_from_flange), points[touches.points])


def _main_direction(vectors: FloatArray) -> FloatArray:
    """The unit direction (3,) of a line that (n, 3) vectors lie along, on the side of the most."""
    direction = np.linalg.svd(vectors, full_matrices=False)[2][0]
    side = np.sign(vectors @ direction)
    return np.asarray(direction * (1.0 if side.sum() + 0.5 * side[0] >= 0.0 else -1.0))


def _small_sets(touches: Touches, there: IntArray) -> Iterator[IntArray]:
    """Gives small sets of touches by chance: three of one point, or two each of two points."""
    rng = np.random.default_rng(0)
    by_point = [there[touches.points[there] == index] for index in range(len(touches.names))]
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
