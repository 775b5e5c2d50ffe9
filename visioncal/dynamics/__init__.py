"""Arm dynamics: inverse dynamics, and identification of inertias and friction from torques."""

from visioncal.dynamics.arm import ArmDynamics
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.document import stribeck_rows
from visioncal.dynamics.excitation import Excitation, ExcitationRequest, excite
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.judge import judge
from visioncal.dynamics.limits import DefaultLimits, MotionMargins, motion_limits
from visioncal.dynamics.model import DynamicModel, Friction, FrictionTerms, sign
from visioncal.dynamics.motion import JointMotion, Measured
from visioncal.dynamics.observer import MomentumObserver, external_torques
from visioncal.dynamics.payload import Gains, Payload, drive_gains, estimate_payload
from visioncal.dynamics.run import Run
from visioncal.dynamics.sweeps import SweepRequest, Sweeps, plan_sweeps
from visioncal.dynamics.validate import Prediction, friction_at, measured_friction

__all__ = [
    "ArmDynamics",
    "BaseModel",
    "DefaultLimits",
    "DynamicModel",
    "Excitation",
    "ExcitationRequest",
    "Friction",
    "FrictionTerms",
    "Gains",
    "Identified",
    "JointMotion",
    "Measured",
    "MomentumObserver",
    "MotionMargins",
    "Payload",
    "Prediction",
    "Run",
    "SweepRequest",
    "Sweeps",
    "drive_gains",
    "estimate_payload",
    "excite",
    "external_torques",
    "friction_at",
    "judge",
    "measured_friction",
    "motion_limits",
    "plan_sweeps",
    "sign",
    "stribeck_rows",
]
