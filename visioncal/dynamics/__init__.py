"""Arm dynamics: inverse dynamics, and identification of inertias and friction from torques."""

from visioncal.dynamics.arm import ArmDynamics
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.document import stribeck_rows
from visioncal.dynamics.excitation import Excitation, ExcitationRequest, excite
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.judge import judge
from visioncal.dynamics.limits import Missing, Share, allowed_motion
from visioncal.dynamics.model import DynamicModel, Friction, FrictionTerms, sign
from visioncal.dynamics.motion import JointMotion, Measured
from visioncal.dynamics.observer import MomentumObserver, external_torques
from visioncal.dynamics.payload import Gains, Payload, drive_gains, estimate_payload
from visioncal.dynamics.run import Run
from visioncal.dynamics.sweeps import SweepRequest, Sweeps, plan_sweeps
from visioncal.dynamics.validate import Prediction, friction_at, left_for_friction

__all__ = [
    "ArmDynamics",
    "BaseModel",
    "DynamicModel",
    "Excitation",
    "ExcitationRequest",
    "Friction",
    "FrictionTerms",
    "Gains",
    "Identified",
    "JointMotion",
    "Measured",
    "Missing",
    "MomentumObserver",
    "Payload",
    "Prediction",
    "Run",
    "Share",
    "SweepRequest",
    "Sweeps",
    "allowed_motion",
    "drive_gains",
    "estimate_payload",
    "excite",
    "external_torques",
    "friction_at",
    "judge",
    "left_for_friction",
    "plan_sweeps",
    "sign",
    "stribeck_rows",
]
