"""Inverse kinematics: joint positions that bring an arm's flange where it is wanted.

One posture at a time: Pinocchio evaluates one in a microsecond, less than numpy needs to look at a
batch of one, and each target is best started from the posture of the one before. Only where many
poses come together, each with a posture near to it, numpy goes to all at once.

Joints stand at their effective positions here (`Chain.effective`, `Chain.encoded`): in these a turn
is exactly two pi, whatever the gear's ratio.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dposv

from visioncal.core.types import FloatArray, Mask
from visioncal.robot.batch import reached_from
from visioncal.robot.model import Robot

if TYPE_CHECKING:
    import pinocchio as pin

# A pose counts as reached from here on [m] and [rad]: rounding leaves a thousandth of it.
_REACHED = 1e-9
# The sum of squares [m^2 + rad^2] at which a pose is reached beyond doubt; one more step would be
# lost in rounding.
_DONE = 1e-20
# With fewer than six joints the position is kept and the rotation is what is left. Beyond this
# [rad] the target was never one of the arm's: errors of links are far smaller.
_TURN_LEFT_RAD = float(np.deg2rad(1.0))
# What a radian then counts against a metre, once both are near: what is left of the rotation moves
# the position by the square of it.
_LIGHT = 1e-4
# Postures to start from where the seed does not lead there; an arm of six joints has up to sixteen
# solutions, and half of the starts find one.
_STARTS = 40
_STEPS = 80
# A search ends where a step gains less than this share of the sum of squares; the nearest of many
# is then followed to the second.
_SEARCH, _POLISH = 1e-3, 1e-9
_MILDEST, _HARSHEST = 1e-4, 1e8
# How far starts spread where a joint has no limits [rad or m].
_SPREAD = float(np.pi)
_TURN = 2 * np.pi
# Keeps a singular system solvable; far below the square of any singular value that matters.
_FLOOR = 1e-13


@dataclass(frozen=True, eq=False)
class Posture:
    """The distance between a pose and the nearest that an arm reaches.

    Attributes:
        positions: (n,) effective positions of the joints [rad or m].
        off_m: Distance of the flange from where it is wanted [m].
        off_rad: Angle between the flange and how it is wanted [rad].
        reached: Whether it is there, within the joints' limits.
        beyond: Where it is not, the joints whose limits alone are in the way; empty where no
            posture at all would do.
    """

    positions: FloatArray
    off_m: float
    off_rad: float
    reached: bool
    beyond: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Bounds:
    """Limits of the effective positions, (n,) each, infinite where there are none."""

    lower: FloatArray
    upper: FloatArray
    turning: Mask

    def nearest(self, positions: FloatArray, wanted: FloatArray) -> FloatArray:
        """Turns joints by whole turns, within the limits, as near to `wanted` as can be."""
        # Positions within the limits stay so.
        turns = np.round((wanted - positions) / _TURN)
        if not turns.any():
            return positions
        least = np.minimum(np.ceil((self.lower - positions) / _TURN), 0.0)
        most = np.maximum(np.floor((self.upper - positions) / _TURN), 0.0)
        turns = np.where(self.turning, np.minimum(np.maximum(turns, least), most), 0.0)
        return np.asarray(positions + _TURN * turns)

    def apart(self, turned: FloatArray) -> float:
        """How far postures are apart that differ by (n,) positions; whole turns do not count."""
        # A posture that is a whole turn away is the same branch of the arm; any other is not.
        turns = np.where(self.turning, np.round(turned / _TURN), 0.0)
        return float(np.linalg.norm(turned - _TURN * turns))

    def middle_and_half(self, around: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Middle (n,) and half (n,) of the range; about the given positions if unlimited."""
        known = np.isfinite(self.lower) & np.isfinite(self.upper)
        lower, upper = (np.where(known, array, 0.0) for array in (self.lower, self.upper))
        half = np.where(known, 0.5 * (upper - lower), _SPREAD)
        half = np.where(self.turning, np.minimum(half, _SPREAD), half)
        return np.where(known, 0.5 * (lower + upper), around), half

    def beyond(self, positions: FloatArray) -> FloatArray:
        """How far (n,) positions are beyond the limits [rad or m]."""
        return np.maximum(np.maximum(self.lower - positions, positions - self.upper), 0.0)


class Inverse:
    """The inverse kinematics of one arm.

    Method: Levenberg and Marquardt's, with a damping that follows the remaining error and so
    vanishes at the end (Sugihara 2011, Solvability-unconcerned inverse kinematics): quadratic where
    the pose can be reached; where it cannot, the end is the nearest pose. Joints at a limit that
    would leave it are held. Of an arm with more than six joints the step is the shortest one, so
    that it stays near to where it started. With fewer than six the position is reached, and the
    rotation is as near as it can be.

    It holds Pinocchio's working memory: one object a thread.
    """

    def __init__(self, robot: Robot) -> None:
        """Prepares the search for an arm."""
        chain = robot.chain
        self._chain, self._names = chain, chain.joint_names
        self._model = robot.pinocchio_model
        self._data: pin.Data = self._model.createData()
        self._frame: int = self._model.getFrameId(robot.tip)
        self._bounds = _Bounds(*_effective_limits(robot), ~chain.prismatic)

    def solve(
        self, base_from_flange: FloatArray, wanted: FloatArray, *, widest_rad: float = np.inf
    ) -> Posture:
        """Finds the posture that reaches a pose, near to a given one.

        Args:
            base_from_flange: (4, 4) the pose [m].
            wanted: (n,) effective positions to start from [rad or m].
            widest_rad: Where a joint turns farther than this from there, other postures are looked
                for, and the nearest of all is taken, but for whole turns [rad].

        Returns:
            The posture; where none reaches the pose, the one that comes nearest.
        """
        import pinocchio as pin

        goal, bounds = pin.SE3(base_from_flange), self._bounds
        first = self._descend(goal, wanted, bounds, wanted)
        if first.reached and _widest(first.positions - wanted, bounds) <= widest_rad:
            return first
        tries = [first, *self._from_everywhere(goal, bounds, wanted)]
        reached = [posture for posture in tries if posture.reached]
        if reached:
            return min(reached, key=lambda value: bounds.apart(value.positions - wanted))
        nearest = min(tries, key=lambda value: value.off_m**2 + value.off_rad**2)
        nearest = self._descend(goal, nearest.positions, bounds, wanted, settle=_POLISH)
        return replace(nearest, beyond=self._in_the_way(goal, wanted))

    def from_starts(
        self, base_from_flange: FloatArray, starts: FloatArray
    ) -> tuple[FloatArray, Mask]:
        """Goes to poses from postures near to them: quick, for poses that may be left out.

        Args:
            base_from_flange: (m, 4, 4) the poses [m].
            starts: (m, n) effective positions to start from [rad or m]; six joints or more.

        Returns:
            (m, n) positions with joints turned as little as can be from zero, and whether the pose
            was reached there (m,).
        """
        bounds = self._bounds
        found, reached = reached_from(
            self._chain, base_from_flange, starts, (bounds.lower, bounds.upper), _REACHED
        )
        return bounds.nearest(found, np.zeros(len(self._names))), reached

    def starts(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draws (count, n) effective positions all over the joints' range [rad or m]."""
        middle, half = self._bounds.middle_and_half(np.zeros(len(self._names)))
        return np.asarray(middle + rng.uniform(-1.0, 1.0, (count, len(half))) * half)

    def _from_everywhere(
        self, goal: "pin.SE3", bounds: _Bounds, wanted: FloatArray
    ) -> Iterator[Posture]:
        """What is found from postures all over the joints' range, the same ones every time."""
        rng = np.random.default_rng(0)
        middle, half = self._bounds.middle_and_half(wanted)
        for share in rng.uniform(-1.0, 1.0, (_STARTS, len(wanted))):
            start = middle + share * half
            yield self._descend(goal, start, bounds, wanted)

    def _in_the_way(self, goal: "pin.SE3", wanted: FloatArray) -> tuple[str, ...]:
        """The joints whose limits alone keep the arm from a pose, for the nearest such posture."""
        free = replace(
            self._bounds,
            lower=np.full_like(self._bounds.lower, -np.inf),
            upper=np.full_like(self._bounds.upper, np.inf),
        )
        middle, _ = self._bounds.middle_and_half(wanted)
        tries = [
            posture for posture in self._from_everywhere(goal, free, middle) if posture.reached
        ]
        if not tries:
            return ()
        excess = [self._bounds.beyond(posture.positions) for posture in tries]
        least = min(excess, key=lambda value: float(np.sum(value)))
        names = zip(self._names, least, strict=True)
        return tuple(name for name, value in names if value > 0.0)

    def _descend(
        self,
        goal: "pin.SE3",
        start: FloatArray,
        bounds: _Bounds,
        wanted: FloatArray,
        *,
        settle: float = _SEARCH,
    ) -> Posture:
        """Goes downhill from a start, and turns what it finds towards what is wanted."""
        few = len(start) < 6
        begin = np.minimum(np.maximum(start, bounds.lower), bounds.upper)
        positions, error = self._downhill(goal, begin, bounds, 1.0, settle)
        if few:
            settle = _POLISH * _LIGHT**2
            positions, error = self._downhill(goal, positions, bounds, _LIGHT, settle)
            error[3:] /= _LIGHT
        off_m, off_rad = math.hypot(*error[:3]), math.hypot(*error[3:])
        reached = off_m < _REACHED and off_rad < (_TURN_LEFT_RAD if few else _REACHED)
        return Posture(bounds.nearest(positions, wanted), off_m, off_rad, reached)

    def _downhill(
        self, goal: "pin.SE3", positions: FloatArray, bounds: _Bounds, light: float, settle: float
    ) -> tuple[FloatArray, FloatArray]:
        """Levenberg and Marquardt's iteration: (the positions, what is left there)."""
        damping = 1.0
        error, rotation = self._left(goal, positions, light)
        size = float(error @ error)
        for _ in range(_STEPS):
            if size < _DONE or damping > _HARSHEST:
                break
            jacobian = self._jacobian(rotation, light)
            while damping <= _HARSHEST:
                moved = _moved(positions, error, jacobian, damping * size + _FLOOR, bounds)
                next_error, rotation = self._left(goal, moved, light)
                next_size = float(next_error @ next_error)
                if next_size < size:
                    break
                damping *= 8.0
            else:
                break
            gained = size - next_size
            positions, error, size = moved, next_error, next_size
            damping = max(damping / 8.0, _MILDEST)
            if gained < settle * (size + gained):
                break
        return positions, error

    def _left(
        self, goal: "pin.SE3", positions: FloatArray, light: float
    ) -> tuple[FloatArray, FloatArray]:
        """What is left to the goal, seen from it: (6,) and the rotation itself (3, 3)."""
        # In Pinocchio's order, translations [m] first; rotations [rad] count by `light`.
        import pinocchio as pin

        pin.computeJointJacobians(self._model, self._data, positions)
        pose = pin.updateFramePlacement(self._model, self._data, self._frame)
        goal_from_flange = goal.actInv(pose)
        rotation, error = goal_from_flange.rotation, np.empty(6)
        error[:3], error[3:] = goal_from_flange.translation, light * pin.log3(rotation)
        return error, rotation

    def _jacobian(self, rotation: FloatArray, light: float) -> FloatArray:
        """How the joints change what is left (6, n), where `_left` was called last."""
        import pinocchio as pin

        own = pin.getFrameJacobian(self._model, self._data, self._frame, pin.LOCAL)
        jacobian: FloatArray = np.empty_like(own)
        np.matmul(rotation, own[:3], out=jacobian[:3])
        np.matmul(light * pin.Jlog3(rotation), own[3:], out=jacobian[3:])
        return jacobian


def _widest(turned: FloatArray, bounds: _Bounds) -> float:
    """The largest of (n,) turns; a prismatic joint has none [rad]."""
    return float(np.abs(turned[bounds.turning]).max(initial=0.0))


def _moved(
    positions: FloatArray, error: FloatArray, jacobian: FloatArray, damping: float, bounds: _Bounds
) -> FloatArray:
    """One damped step within the bounds; joints that would leave them from a limit are held."""
    for _ in range(len(positions)):
        wish = positions - _step(jacobian, error, damping)
        moved = np.minimum(np.maximum(wish, bounds.lower), bounds.upper)
        cut = moved != wish
        if not cut.any():
            break
        held = cut & (moved == positions)
        if not held.any():
            break
        jacobian = np.where(held, 0.0, jacobian)
    return np.asarray(moved)


def _step(jacobian: FloatArray, error: FloatArray, damping: float) -> FloatArray:
    """The damped step; of the two equal forms the one with the smaller system."""
    # LAPACK itself: numpy's way to it takes as long as the rest of a step.
    rows, columns = jacobian.shape
    long = columns > rows
    gram = jacobian @ jacobian.T if long else jacobian.T @ jacobian
    gram.flat[:: len(gram) + 1] += damping
    solved = dposv(gram, error if long else error @ jacobian)[1]
    return np.asarray(solved @ jacobian if long else solved)


def _effective_limits(robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Lower and upper limits (n,) of the effective positions."""
    limits = np.array([robot.lower_rad, robot.upper_rad])
    known = np.isfinite(limits)
    moved = np.where(known, robot.chain.effective(np.where(known, limits, 0.0)), limits)
    return moved[0], moved[1]
