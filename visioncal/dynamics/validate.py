"""Prediction of torques, its errors, and friction over speed."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from visioncal.core.errors import DegenerateError
from visioncal.core.types import FloatArray, Mask
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.identified import Identified, TorqueValidation
from visioncal.dynamics.identify import Identification
from visioncal.dynamics.model import DynamicModel
from visioncal.dynamics.motion import JointMotion
from visioncal.dynamics.regression import NoiseBlock, regress, rms_of, std_of
from visioncal.robot import joint_torques


@dataclass(frozen=True, eq=False)
class Prediction:
    """Filtered torques of a stream, measured and predicted."""

    label: str  # The stream's file.
    times_s: FloatArray  # (k,) times [s].
    measured_nm: FloatArray  # (k, n) [N m].
    predicted_nm: FloatArray  # (k, n) by the base parameters [N m].
    # (k, n) by the consistent standard parameters [N m]; None without these.
    consistent_nm: FloatArray | None
    # (k, n) by the robot's own inertias and friction fitted to them [N m]; None where it has no
    # inertias.
    known_nm: FloatArray | None
    used: Mask  # (k, n) mask of valid torques.
    q: FloatArray  # (k, n) joint angles, filtered likewise [rad].
    dq: FloatArray  # (k, n) their speeds [rad/s].
    notes: tuple[str, ...] = ()  # Messages on faults of the samples.

    def rms_nm(self, predicted_nm: FloatArray) -> FloatArray:
        """(n,) root mean square error of a prediction [N m]."""
        return rms_of(predicted_nm - self.measured_nm, self.used)

    @property
    def torque_nm(self) -> FloatArray:
        """(n,) standard deviation of the measured torques, as their range [N m]."""
        return std_of(self.measured_nm, self.used)


def predict(
    identified: Identified, stream: Conditioned, own_friction: FloatArray | None = None
) -> Prediction:
    """Predicts a stream's filtered torques.

    Args:
        identified: The arm's dynamics.
        stream: The samples.
        own_friction: (f,) friction fitted to the robot's own inertias; see `fit_friction_to_known`.
    """
    with_bodies = identified.consistent is not None
    known = None
    if own_friction is not None:
        known = stream.filtered(partial(_known_torques, identified, own_friction))
    return Prediction(
        stream.label,
        stream.times_s,
        stream.torques_nm,
        stream.filtered(identified.torques),
        stream.filtered(identified.consistent_torques) if with_bodies else None,
        known,
        stream.used,
        stream.filtered(lambda motion: motion.q),
        stream.filtered(lambda motion: motion.dq),
        stream.notes,
    )


def validate(identified: Identified, prediction: Prediction) -> TorqueValidation:
    """Compares predicted with measured torques."""
    consistent, known = prediction.consistent_nm, prediction.known_nm
    return TorqueValidation(
        prediction.label,
        prediction.rms_nm(prediction.predicted_nm),
        prediction.torque_nm,
        np.max([stream.noise_nm for stream in identified.streams], axis=0),
        None if consistent is None else prediction.rms_nm(consistent),
        None if known is None else prediction.rms_nm(known),
    )


def fit_friction_to_known(identification: Identification) -> FloatArray | None:
    """Fits friction to the robot's own inertias.

    Returns:
        (f,) parameters in the model's order; None where the robot has no inertias, or the model no
        friction.
    """
    identified = identification.identified
    robot, model = identified.robot, identified.base.model
    if robot.inertias is None or not model.terms.symbols:
        return None
    blocks = []
    for stream, block in zip(identification.streams, identification.fit.blocks, strict=True):
        links = stream.filtered(partial(_link_torques, model))
        x = stream.filtered(model.terms.columns)
        blocks.append(NoiseBlock(x, block.y - links, block.used, block.correlation))
    try:
        return regress(blocks).values
    except np.linalg.LinAlgError as error:
        raise DegenerateError("dynamics: the motion does not determine friction.") from error


def _link_torques(model: DynamicModel, motion: JointMotion) -> FloatArray:
    robot = model.robot
    if robot.inertias is None:
        return np.zeros_like(motion.q)
    return joint_torques(robot, robot.inertias, motion.q, motion.dq, motion.ddq)


def _known_torques(identified: Identified, friction: FloatArray, motion: JointMotion) -> FloatArray:
    model = identified.base.model
    return np.asarray(_link_torques(model, motion) + model.terms.columns(motion) @ friction)


def friction_at(identified: Identified, dq: FloatArray) -> FloatArray:
    """Friction torques (m, n) of all joints at (m, n) speeds [N m]."""
    model = identified.base.model
    values = np.zeros(len(model.names))
    values[identified.base.independent] = identified.values
    still = np.zeros_like(dq)
    motion = JointMotion(np.zeros(len(dq)), still, dq, still)
    own = model.terms.columns(motion) @ values[10 * model.robot.joint_count :]
    return np.asarray(own + identified.stribeck.torques(motion))


def measured_friction(identified: Identified, prediction: Prediction) -> FloatArray:
    """Measured torques less all predicted ones but friction's: (k, n) [N m]."""
    error = prediction.measured_nm - prediction.predicted_nm
    return np.asarray(friction_at(identified, prediction.dq) + error)
