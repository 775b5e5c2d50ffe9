"""Dynamics: the torques that an arm needs, and the parameters that measured ones tell."""

from visioncal.dynamics.arm import ArmDynamics
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.friction import Friction, FrictionTerms, sign
from visioncal.dynamics.model import DynamicModel
from visioncal.dynamics.motion import Measured, Motion
from visioncal.dynamics.observer import MomentumObserver, external_torques

__all__ = [
    "ArmDynamics",
    "BaseModel",
    "DynamicModel",
    "Friction",
    "FrictionTerms",
    "Measured",
    "MomentumObserver",
    "Motion",
    "external_torques",
    "sign",
]
