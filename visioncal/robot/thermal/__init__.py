"""Thermal drift of an arm: heating of its links, their growth, and online compensation."""

from visioncal.robot.thermal.compensator import Advice, OnlineCompensator
from visioncal.robot.thermal.heating import Heating, Inputs, Kind
from visioncal.robot.thermal.model import ThermalModel

__all__ = [
    "Advice",
    "Heating",
    "Inputs",
    "Kind",
    "OnlineCompensator",
    "ThermalModel",
]
