"""Arm dynamics: inverse dynamics, and identification of inertias and friction from torques."""

from visioncal.dynamics.arm import ArmDynamics
from visioncal.dynamics.identified import Identified
