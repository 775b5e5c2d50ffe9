"""Dynamics: the torques that an arm needs, and the parameters that measured ones tell."""

from visioncal.dynamics.arm import ArmDynamics
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.curves import friction_at, left_for_friction
from visioncal.dynamics.document import stribeck_rows
from visioncal.dynamics.friction import Friction, FrictionTerms, sign
from visioncal.dynamics.gains import Gains, drive_gains
from visioncal.dynamics.identified import FILE, Identified
from visioncal.dynamics.judge import judge
from visioncal.dynamics.model import DynamicModel
from visioncal.dynamics.motion import Measured, Motion
from visioncal.dynamics.observer import MomentumObserver, external_torques
from visioncal.dynamics.payload import Payload, estimate_payload
from visioncal.dynamics.run import Run
from visioncal.dynamics.validate import Prediction

__all__ = [
    "FILE",
    "ArmDynamics",
    "BaseModel",
    "DynamicModel",
    "Friction",
    "FrictionTerms",
    "Gains",
    "Identified",
    "Measured",
    "MomentumObserver",
    "Motion",
    "Payload",
    "Prediction",
    "Run",
    "drive_gains",
    "estimate_payload",
    "external_torques",
    "friction_at",
    "judge",
    "left_for_friction",
    "sign",
    "stribeck_rows",
]
