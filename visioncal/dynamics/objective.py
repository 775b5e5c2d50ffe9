"""What an exciting motion is optimised for: the condition of its regressor, within its limits."""

from dataclasses import replace

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.dynamics.base import BaseModel, smooth_condition
from visioncal.dynamics.fourier import Harmonics, Series
from visioncal.dynamics.limits import Allowed
from visioncal.dynamics.model import DynamicModel
from visioncal.dynamics.motion import JointMotion

# Samples for each of the highest harmonic's periods: torques hold products of few of them. Limits
# and distances are looked at more often.
_SAMPLES, _LOOKS = 10, 3
# Dry friction is spread over this share of the greatest speed: else its sense jumps at a sample.
_SPREAD = 0.03
# Steps of the derivatives [rad and its rates]: far above rounding, and the regressor bends little.
_STEP, _STEP_CLEAR = 1e-6, 1e-5
# Peaks lie between samples: limits end earlier by this share, distances by this [m].
_EARLIER, _BUFFER_M = 0.03, 0.03
# A distance that lacks this much costs as much as a limit that is exceeded by its own size [m].
_SHORT_M = 0.1


class Objective:
    """The criterion of a motion and its derivatives, by the free numbers of its series.

    Attributes:
        harmonics: What the motion is made of.
    """

    def __init__(
        self, allowed: Allowed, base: BaseModel, weights: FloatArray, harmonics: Harmonics
    ) -> None:
        """Prepares the samples.

        Args:
            allowed: What the motion must keep.
            base: The parameters that it is to determine.
            weights: (n,) inverse of each joint's torque noise.
            harmonics: What it is made of.
        """
        self.harmonics = harmonics
        self._allowed, self._weights = allowed, weights
        terms = replace(base.model.terms, slow_rad_s=_SPREAD * float(allowed.speed.max()))
        self._base = replace(base, model=DynamicModel(base.model.robot, terms))
        count = _SAMPLES * harmonics.count
        # Between the ends, at which speeds are zero and have no sense.
        self._times = (np.arange(count) + 0.5) * harmonics.period_s / count
        self._basis = harmonics.basis(self._times)
        looks = (np.arange(_LOOKS * count) + 0.5) * harmonics.period_s / (_LOOKS * count)
        self._looks = harmonics.basis(looks)
        self._nominal = None
        if allowed.inertias is not None:
            standard = np.zeros(len(base.model.names))
            standard[: allowed.inertias.values.size] = allowed.inertias.values.ravel()
            self._nominal = base.of(standard)

    def series(self, free: FloatArray) -> Series:
        """The motion of (k,) free numbers."""
        return Series(self.harmonics, free.reshape(self._allowed.robot.joint_count, -1))

    def value(self, free: FloatArray, sharpness: float, price: float) -> tuple[float, FloatArray]:
        """The criterion.

        Args:
            free: (k,) free numbers of all joints.
            sharpness: Of `smooth_condition`.
            price: Of what is beyond the limits.

        Returns:
            The value, and its derivatives (k,).
        """
        numbers = self.series(free).free
        value, by_value = self._condition(numbers, sharpness, price)
        lost, by_lost = self._beyond(numbers)
        jacobian = _back(self._basis, by_value) + price * _back(self._looks, by_lost)
        return value + price * lost, jacobian.ravel()

    def _condition(
        self, numbers: FloatArray, sharpness: float, price: float
    ) -> tuple[float, list[FloatArray]]:
        """Condition and torques, with derivatives (m, n) by positions, speeds, accelerations."""
        states = [array @ numbers.T for array in self._basis]
        rows, jacobian = self._regressors(states)
        weighted = (rows * self._weights[:, None]).reshape(-1, rows.shape[2])
        value, by_weighted = smooth_condition(weighted, sharpness)
        by_rows = by_weighted.reshape(rows.shape) * self._weights[:, None]
        if self._nominal is not None:
            lost, by_torque = _hinge(rows @ self._nominal, self._allowed.torque)
            # As dear as the limits that are looked at more often.
            value += price * _LOOKS * lost
            by_rows = by_rows + price * _LOOKS * by_torque[:, :, None] * self._nominal
        by_states = np.einsum("kmjp,mjp->mk", jacobian, by_rows, optimize=True)
        return value, np.split(by_states, len(states), axis=1)

    def _regressors(self, states: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Rows (m, n, b), and their derivatives (3 n, m, n, b) by the numbers of the states."""
        # Forward differences; the rows are linear in the accelerations and quadratic in the speeds.
        count, joints = states[0].shape
        stepped = [np.repeat(state[None], 3 * joints + 1, axis=0) for state in states]
        for kind, values in enumerate(stepped):
            for joint in range(joints):
                values[1 + kind * joints + joint, :, joint] += _STEP
        times = np.tile(self._times, 3 * joints + 1)
        motion = JointMotion(times, *(array.reshape(-1, joints) for array in stepped))
        rows = self._base.regressor(motion).reshape(3 * joints + 1, count, joints, -1)
        return rows[0], (rows[1:] - rows[0]) / _STEP

    def _beyond(self, numbers: FloatArray) -> tuple[float, list[FloatArray]]:
        """What is beyond limits and distances, with derivatives (m, n)."""
        allowed, less = self._allowed, 1.0 - _EARLIER
        q, dq, ddq = (look @ numbers.T for look in self._looks)
        position, by_q = _hinge(q - allowed.middle, less * allowed.half)
        speed, by_dq = _hinge(dq, less * allowed.speed)
        hard, by_ddq = _hinge(ddq, less * allowed.acceleration)
        near, by_near = self._near(q)
        return position + speed + hard + near, [by_q + by_near, by_dq, by_ddq]

    def _near(self, q: FloatArray) -> tuple[float, FloatArray]:
        """What the distances fall short, squared, with derivatives (m, n) by the positions."""
        value, jacobian = 0.0, np.zeros_like(q)
        for row, posture in enumerate(q):
            short = self._shortfall(posture)
            if not short.any():
                continue
            value += float(short @ short)
            for joint in range(len(posture)):
                moved = posture.copy()
                moved[joint] += _STEP_CLEAR
                jacobian[row, joint] = 2.0 * short @ (self._shortfall(moved) - short) / _STEP_CLEAR
        return value, jacobian

    def _shortfall(self, posture: FloatArray) -> FloatArray:
        """(k,) how much each pair's distance lacks, in its unit; zero for those far apart."""
        collisions = self._allowed.collisions
        left = collisions.distances(posture) - collisions.needed_m() - _BUFFER_M
        return np.maximum(-left / _SHORT_M, 0.0)


def _hinge(values: FloatArray, limits: FloatArray) -> tuple[float, FloatArray]:
    """Squares of what (m, n) values exceed (n,) limits by, as shares of these; derivatives."""
    beyond = np.maximum(np.abs(values) / limits - 1.0, 0.0)
    return float(np.sum(beyond**2)), 2.0 * beyond * np.sign(values) / limits


def _back(basis: tuple[FloatArray, ...], jacobian: list[FloatArray]) -> FloatArray:
    """(n, k) derivatives by the free numbers, of those (m, n) by the states."""
    found = sum(values.T @ array for values, array in zip(basis, jacobian, strict=True))
    return np.asarray(found).T
