"""Inverse kinematics.

Poses are solved one at a time: Pinocchio evaluates a posture in a microsecond, less than numpy's
overhead, and the posture of the target before is the best start.

Joint positions are effective ones here (`Chain.effective`, `Chain.encoded`): in these a turn is
exactly two pi, whatever the gear ratio.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dposv

from visioncal.core.types import FloatArray, Mask
from visioncal.robot.model import Robot

if TYPE_CHECKING:
    import pinocchio as pin

# Greatest error of a reached pose [m] and [rad]; rounding is a thousandth of it.
_REACHED = 1e-9
# With fewer than six joints the position is reached, and the rotation may be off by this [rad]:
# errors of links are far smaller.
_TURN_LEFT_RAD = float(np.deg2rad(1.0))
# Weight of a radian against a metre for these arms, near the solution: the rotation error moves the
# position by its square.
_ROTATION_WEIGHT = 1e-4
# Relative gain in the sum of squares at which a search ends, and the final search from the nearest
# posture.
_SEARCH, _POLISH = 1e-3, 1e-9
_LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e8  # Shares of the diagonal.
# Half range of random starts for joints without limits [rad or m].
_SPREAD = float(np.pi)
_TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class Posture:
    """A solution of the inverse kinematics, or the nearest posture."""

    positions: FloatArray  # (n,) effective positions of the joints [rad or m].
    off_m: float  # Position error of the flange [m].
    off_rad: float  # Rotation error of the flange [rad].
    reached: bool  # Whether the pose is reached within the joints' limits.


@dataclass(frozen=True, eq=False)
class _Bounds:
    """Limits (n,) of the effective positions, infinite where there are none."""

    lower: FloatArray
    upper: FloatArray
    turning: Mask

    def nearest(self, positions: FloatArray, wanted: FloatArray) -> FloatArray:
        """Positions turned by whole turns within the limits, nearest to `wanted`."""
        # Positions within the limits stay so.
        turns = np.round((wanted - positions) / _TURN)
        if not turns.any():
            return positions
        least = np.minimum(np.ceil((self.lower - positions) / _TURN), 0.0)
        most = np.maximum(np.floor((self.upper - positions) / _TURN), 0.0)
        turns = np.where(self.turning, np.minimum(np.maximum(turns, least), most), 0.0)
        return np.asarray(positions + _TURN * turns)

    def apart(self, difference: FloatArray) -> float:
        """Norm of a difference (n,) of postures, modulo whole turns, which keep the branch."""
        turns = np.where(self.turning, np.round(difference / _TURN), 0.0)
        return float(np.linalg.norm(difference - _TURN * turns))

    def middle_and_half(self, around: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Centre (n,) and half width (n,) of the ranges, about given positions if unlimited."""
        known = np.isfinite(self.lower) & np.isfinite(self.upper)
        lower, upper = (np.where(known, array, 0.0) for array in (self.lower, self.upper))
        half = np.where(known, 0.5 * (upper - lower), _SPREAD)
        half = np.where(self.turning, np.minimum(half, _SPREAD), half)
        return np.where(known, 0.5 * (lower + upper), around), half


class Inverse:
    """The inverse kinematics of one arm.

    Levenberg-Marquardt with damping in proportion to the squared error (Sugihara 2011,
    Solvability-unconcerned inverse kinematics): convergence is quadratic where the pose can be
    reached, and to the nearest pose where it cannot. Joints at a limit that would leave it are
    held. An arm with more than six joints takes the shortest step, so that it stays near its start;
    with fewer than six the position is reached, and the rotation as nearly as possible.

    It holds Pinocchio's working memory, so each thread needs its own.
    """

    def __init__(self, robot: Robot) -> None:
        """Prepares the search for an arm."""
        chain = robot.chain
        self._model = robot.pinocchio_model
        self._data: pin.Data = self._model.createData()
        self._frame: int = self._model.getFrameId(robot.tip)
        limits = np.array([chain.lower, chain.upper])
        known = np.isfinite(limits)
        limits = np.where(known, chain.effective(np.where(known, limits, 0.0)), limits)
        self._bounds = _Bounds(limits[0], limits[1], ~chain.prismatic)

    def solve(
        self, base_from_flange: FloatArray, wanted: FloatArray, *, widest_rad: float = np.inf
    ) -> Posture:
        """Finds the posture that reaches a pose, near a given one.

        Args:
            base_from_flange: (4, 4) the pose [m].
            wanted: (n,) effective positions to start from [rad or m].
            widest_rad: Where a joint turns farther than this from there, other solutions are
                searched, and the nearest one, modulo whole turns, is taken [rad].

        Returns:
            The posture; where none reaches the pose, the nearest one.
        """
        import pinocchio as pin

        goal, bounds = pin.SE3(base_from_flange), self._bounds
        first = self._descend(goal, wanted, wanted)
        turns = np.abs(first.positions - wanted)[bounds.turning]
        if first.reached and turns.max(initial=0.0) <= widest_rad:
            return first
        # The same random starts every time, where the given one does not converge to the pose; an
        # arm of six joints has up to sixteen solutions, and half of the starts find one.
        starts = self.starts(40, np.random.default_rng(0), wanted)
        candidates = [first, *(self._descend(goal, start, wanted) for start in starts)]
        reached = [posture for posture in candidates if posture.reached]
        if reached:
            return min(reached, key=lambda value: bounds.apart(value.positions - wanted))
        nearest = min(candidates, key=lambda value: value.off_m**2 + value.off_rad**2)
        return self._descend(goal, nearest.positions, wanted, settle=_POLISH)

    def from_starts(
        self, base_from_flange: FloatArray, starts: FloatArray
    ) -> tuple[FloatArray, Mask]:
        """Solves many poses (m, 4, 4) [m], each from one given start; some may fail.

        Returns:
            (m, n) effective positions, by whole turns nearest to zero, and (m,) whether reached.
        """
        import pinocchio as pin

        zero = np.zeros(starts.shape[1])
        pairs = zip(base_from_flange, starts, strict=True)
        found = [self._descend(pin.SE3(pose), start, zero) for pose, start in pairs]
        positions = np.array([posture.positions for posture in found]).reshape(starts.shape)
        return positions, np.array([posture.reached for posture in found], dtype=bool)

    def starts(
        self, count: int, rng: np.random.Generator, around: FloatArray | None = None
    ) -> FloatArray:
        """Draws (count, n) effective positions over the joints' ranges [rad or m].

        Those of joints without limits are about given ones (n,), or about zero.
        """
        around = np.zeros(self._model.nq) if around is None else around
        centre, half = self._bounds.middle_and_half(around)
        return np.asarray(centre + rng.uniform(-1.0, 1.0, (count, len(half))) * half)

    def _descend(
        self, goal: "pin.SE3", start: FloatArray, wanted: FloatArray, *, settle: float = _SEARCH
    ) -> Posture:
        """Searches from a start; the result is turned by whole turns towards `wanted`."""
        bounds, underactuated = self._bounds, len(start) < 6
        begin = np.minimum(np.maximum(start, bounds.lower), bounds.upper)
        positions, error = self._downhill(goal, begin, 1.0, settle)
        if underactuated:
            settle = _POLISH * _ROTATION_WEIGHT**2
            positions, error = self._downhill(goal, positions, _ROTATION_WEIGHT, settle)
            error[3:] /= _ROTATION_WEIGHT
        off_m, off_rad = math.hypot(*error[:3]), math.hypot(*error[3:])
        reached = off_m < _REACHED and off_rad < (_TURN_LEFT_RAD if underactuated else _REACHED)
        return Posture(bounds.nearest(positions, wanted), off_m, off_rad, reached)

    def _downhill(
        self, goal: "pin.SE3", positions: FloatArray, weight: float, settle: float
    ) -> tuple[FloatArray, FloatArray]:
        """Levenberg-Marquardt iteration: positions, and the error there."""
        damping = 1.0
        error, rotation = self._error(goal, positions, weight)
        size = float(error @ error)
        for _ in range(80):
            # Another step would be rounding [m^2 + rad^2].
            if size < 1e-20 or damping > _MOST_DAMPING:
                break
            jacobian = self._jacobian(rotation, weight)
            while damping <= _MOST_DAMPING:
                # Regularises singular systems.
                moved = _moved(positions, error, jacobian, damping * size + 1e-13, self._bounds)
                next_error, rotation = self._error(goal, moved, weight)
                next_size = float(next_error @ next_error)
                if next_size < size:
                    break
                damping *= 8.0
            else:
                break
            gained = size - next_size
            positions, error, size = moved, next_error, next_size
            damping = max(damping / 8.0, _LEAST_DAMPING)
            if gained < settle * (size + gained):
                break
        return positions, error

    def _error(
        self, goal: "pin.SE3", positions: FloatArray, weight: float
    ) -> tuple[FloatArray, FloatArray]:
        """Error (6,) of a posture in the goal's frame, and its rotation (3, 3)."""
        # In Pinocchio's order, translation [m] first; the rotation [rad] is weighted.
        import pinocchio as pin

        pin.computeJointJacobians(self._model, self._data, positions)
        pose = pin.updateFramePlacement(self._model, self._data, self._frame)
        goal_from_flange = goal.actInv(pose)
        rotation, error = goal_from_flange.rotation, np.empty(6)
        error[:3], error[3:] = goal_from_flange.translation, weight * pin.log3(rotation)
        return error, rotation

    def _jacobian(self, rotation: FloatArray, weight: float) -> FloatArray:
        """Jacobian (6, n) of the error at the posture of the last call of `_error`."""
        import pinocchio as pin

        frame_jacobian = pin.getFrameJacobian(self._model, self._data, self._frame, pin.LOCAL)
        jacobian: FloatArray = np.empty_like(frame_jacobian)
        np.matmul(rotation, frame_jacobian[:3], out=jacobian[:3])
        np.matmul(weight * pin.Jlog3(rotation), frame_jacobian[3:], out=jacobian[3:])
        return jacobian


def _moved(
    positions: FloatArray, error: FloatArray, jacobian: FloatArray, damping: float, bounds: _Bounds
) -> FloatArray:
    """One damped step within the bounds; joints that would leave them from a limit are held."""
    for _ in range(len(positions)):
        # The smaller of two equivalent systems, by LAPACK directly: numpy's overhead would double
        # the time of a step.
        rows, columns = jacobian.shape
        long = columns > rows
        gram = jacobian @ jacobian.T if long else jacobian.T @ jacobian
        gram.flat[:: len(gram) + 1] += damping
        solution = dposv(gram, error if long else error @ jacobian)[1]
        wanted = positions - np.asarray(solution @ jacobian if long else solution)
        moved = np.minimum(np.maximum(wanted, bounds.lower), bounds.upper)
        limited = moved != wanted
        if not limited.any():
            break
        held = limited & (moved == positions)
        if not held.any():
            break
        jacobian = np.where(held, 0.0, jacobian)
    return np.asarray(moved)
