"""What pushes at an arm: the residual of its generalised momentum.

No acceleration is needed, and no mass matrix is inverted (De Luca and Mattone 2003, 2005,
Sensorless robot collision detection and hybrid force/motion control).
"""

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.dynamics.arm import ArmDynamics
from visioncal.dynamics.motion import Measured

# How fast the residual follows: a push is seen to 63 % after the inverse of it [1/s].
USUAL_GAIN = 25.0


class MomentumObserver:
    """Follows a moving arm sample by sample, and estimates external torques on its joints.

    The residual r obeys `dr/dt = gain (external torque - r)`: that of a push comes through a
    first-order filter, joint by joint. It is computed by an implicit Euler step, which is stable
    for any sampling.
    """

    def __init__(self, arm: ArmDynamics, gain_per_s: float | FloatArray = USUAL_GAIN) -> None:
        """Begins to observe.

        Args:
            arm: The arm with what it carries (`ArmDynamics.carrying`).
            gain_per_s: How fast the residual follows, one for all joints or (n,) [1/s].

        Raises:
            DataError: A gain is not above zero.
        """
        gain = np.broadcast_to(np.asarray(gain_per_s, dtype=float), (arm.robot.joint_count,))
        if not (np.isfinite(gain).all() and (gain > 0.0).all()):
            raise DataError(
                f"gain_per_s is {gain_per_s}; numbers above 0 are needed.", culprits=["gain_per_s"]
            )
        self._arm, self._gain = arm, gain
        self._time_s: float | None = None
        self._begun = self._given = self._push = self._residual = np.zeros(len(gain))

    def update(
        self, time_s: float, q: FloatArray, dq: FloatArray, torques_nm: FloatArray
    ) -> FloatArray:
        """Takes one sample in.

        Args:
            time_s: When [s], later than the sample before.
            q: (n,) joint angles [rad].
            dq: (n,) their speeds [rad/s].
            torques_nm: (n,) what the drives gave [N m].

        Returns:
            (n,) the torques that others put on the joints, positive in the joints' sense [N m].

        Raises:
            DataError: Time does not go on, or a shape is wrong.
        """
        rows = (np.asarray(array, dtype=float)[None] for array in (q, dq))
        momentum, rate = (array[0] for array in self._arm.momentum(*rows))
        return self._step(time_s, momentum, rate + torques_nm)

    def _step(self, time_s: float, momentum: FloatArray, push: FloatArray) -> FloatArray:
        """The residual after a sample with a momentum and all that is known to change it."""
        if self._time_s is None:
            self._begun = momentum
        else:
            step_s = time_s - self._time_s
            if not step_s > 0.0:
                raise DataError(
                    f"the sample at {time_s:g} s does not follow that at {self._time_s:g} s; "
                    "ascending times are needed.",
                    culprits=["time_s"],
                )
            # The known push by the trapezium's rule, the residual by its new value.
            given = self._given + 0.5 * step_s * (self._push + push)
            left = momentum - self._begun - given
            self._residual = self._gain * left / (1.0 + self._gain * step_s)
            self._given = given + step_s * self._residual
        self._time_s, self._push = time_s, push
        return self._residual


def external_torques(
    arm: ArmDynamics, measured: Measured, gain_per_s: float | FloatArray = USUAL_GAIN
) -> FloatArray:
    """Tells the torques that others put on the joints during a recorded motion.

    Args:
        arm: The arm with what it carries.
        measured: The motion and the drives' torques; accelerations do not matter.
        gain_per_s: As for `MomentumObserver`.

    Returns:
        (m, n) positive in the joints' sense [N m]; zero at the first sample.

    Raises:
        DataError: As `MomentumObserver` has it.
    """
    observer = MomentumObserver(arm, gain_per_s)
    motion = measured.motion
    momentum, rate = arm.momentum(motion.q, motion.dq)
    samples = zip(motion.times_s.tolist(), momentum, rate + measured.torques_nm, strict=True)
    return np.array([observer._step(*sample) for sample in samples])
