"""Dynamics: the torques that an arm needs, and the parameters that measured ones tell."""

from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.friction import FrictionTerms, sign
from visioncal.dynamics.model import DynamicModel
from visioncal.dynamics.motion import Measured, Motion

__all__ = ["BaseModel", "DynamicModel", "FrictionTerms", "Measured", "Motion", "sign"]
