"""Momentum observer: external torques from the residual of the generalised momentum.

No acceleration is needed, and no mass matrix is inverted (De Luca and Mattone 2003, 2005,
Sensorless robot collision detection and hybrid force/motion control).
"""

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.dynamics.arm import ArmDynamics
from visioncal.dynamics.motion import Measured

# Observer gain: the inverse of the residual's time constant [1/s].
USUAL_GAIN = 25.0


class MomentumObserver:
    """Estimates external torques on the joints of a moving arm, sample by sample.

    The residual r obeys `dr/dt = gain (external torque - r)`, a first-order filter joint by joint.
    It is integrated by implicit Euler steps, which are stable at any sampling rate.
    """

    def __init__(self, arm: ArmDynamics, gain_per_s: float | FloatArray = USUAL_GAIN) -> None:
        """Prepares an observer of an arm with its payload (`ArmDynamics.carrying`).

        The gain is the inverse time constant of the residual, one for all joints or (n,) [1/s];
        others than numbers above 0 raise DataError.
        """
        gain = np.broadcast_to(np.asarray(gain_per_s, dtype=float), (arm.robot.joint_count,))
        if not (np.isfinite(gain).all() and (gain > 0.0).all()):
            raise DataError(
                f"gain_per_s is {gain_per_s}; numbers above 0 are needed.", culprits=["gain_per_s"]
            )
        self._arm, self._gain = arm, gain
        self._time_s: float | None = None
        self._initial = self._integral = self._rate = self._residual = np.zeros(len(gain))

    def update(
        self, time_s: float, q: FloatArray, dq: FloatArray, torques_nm: FloatArray
    ) -> FloatArray:
        """Updates the residual with a sample.

        Args:
            time_s: Time [s], later than the sample before.
            q: (n,) joint angles [rad].
            dq: (n,) their speeds [rad/s].
            torques_nm: (n,) drive torques [N m].

        Returns:
            (n,) external torques, positive in the joints' sense [N m].

        Raises:
            DataError: Times do not ascend, or a shape is wrong.
        """
        rows = (np.asarray(array, dtype=float)[None] for array in (q, dq))
        momentum, rate = (array[0] for array in self._arm.momentum(*rows))
        return self._step(time_s, momentum, rate + torques_nm)

    def _step(self, time_s: float, momentum: FloatArray, rate: FloatArray) -> FloatArray:
        """Residual after a sample with its momentum and the momentum's known rate."""
        if self._time_s is None:
            self._initial = momentum
        else:
            step_s = time_s - self._time_s
            if not step_s > 0.0:
                raise DataError(
                    f"the sample at {time_s:g} s does not follow that at {self._time_s:g} s; "
                    "ascending times are needed.",
                    culprits=["time_s"],
                )
            # The known rate is integrated by the trapezoidal rule, the residual by its new value.
            integral = self._integral + 0.5 * step_s * (self._rate + rate)
            unexplained = momentum - self._initial - integral
            self._residual = self._gain * unexplained / (1.0 + self._gain * step_s)
            self._integral = integral + step_s * self._residual
        self._time_s, self._rate = time_s, rate
        return self._residual


def external_torques(
    arm: ArmDynamics, measured: Measured, gain_per_s: float | FloatArray = USUAL_GAIN
) -> FloatArray:
    """External torques on the joints during a recorded motion; see `MomentumObserver`.

    Accelerations are not used.

    Returns:
        (m, n) positive in the joints' sense [N m]; zero at the first sample.

    Raises:
        DataError: As for `MomentumObserver`.
    """
    observer = MomentumObserver(arm, gain_per_s)
    motion = measured.motion
    momentum, rate = arm.momentum(motion.q, motion.dq)
    samples = zip(motion.times_s.tolist(), momentum, rate + measured.torques_nm, strict=True)
    return np.array([observer._step(*sample) for sample in samples])
