"""Friction over speed, as it was identified and as measured torques have it."""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.motion import Motion
from visioncal.dynamics.validate import Prediction


def friction_at(identified: Identified, dq: FloatArray) -> FloatArray:
    """The friction of all joints at (m, n) speeds, without what rotors take: (m, n) [N m]."""
    model = identified.base.model
    values = np.zeros(len(model.names))
    values[identified.base.independent] = identified.values
    still = np.zeros_like(dq)
    motion = Motion(np.zeros(len(dq)), still, dq, still)
    own = model.terms.columns(motion) @ values[10 * model.robot.joint_count :]
    return np.asarray(own + identified.stribeck.torques(motion))


def left_for_friction(identified: Identified, prediction: Prediction) -> FloatArray:
    """What measured torques leave for friction: (k, n) its curve plus the errors [N m]."""
    off = prediction.measured_nm - prediction.predicted_nm
    return np.asarray(friction_at(identified, prediction.dq) + off)
