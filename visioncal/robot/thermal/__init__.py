"""How an arm drifts as it warms up: what heats it, how it moves with that, and when it is warm."""

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
