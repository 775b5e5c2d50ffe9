"""Arm dynamics: inverse dynamics, and identification of inertias and friction from torques."""

from visioncal.dynamics.arm import ArmDynamics
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.excitation import Excitation, ExcitationRequest, excite
from visioncal.dynamics.identified import Identified, judge, stribeck_rows
from visioncal.dynamics.identify import Prediction, friction_at, measured_friction
from visioncal.dynamics.limits import DefaultLimits, MotionMargins, motion_limits
from visioncal.dynamics.model import (
    DynamicModel,
    Friction,
    FrictionTerms,
    JointMotion,
    Measured,
    sign,
)
from visioncal.dynamics.payload import Gains, Payload, drive_gains, estimate_payload
from visioncal.dynamics.run import Run
from visioncal.dynamics.sweeps import SweepRequest, Sweeps, plan_sweeps

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
    "MotionMargins",
    "Payload",
    "Prediction",
    "Run",
    "SweepRequest",
    "Sweeps",
    "drive_gains",
    "estimate_payload",
    "excite",
    "friction_at",
    "judge",
    "measured_friction",
    "motion_limits",
    "plan_sweeps",
    "sign",
    "stribeck_rows",
]
