"""How an arm drifts as it warms up: what heats it, how it moves with that, and when it is warm."""

from visioncal.thermal.compensator import Advice, OnlineCompensator
from visioncal.thermal.fit import Stops, ThermalFit, fit_thermal
from visioncal.thermal.heating import Heating, Inputs, Kind
from visioncal.thermal.model import ThermalModel
from visioncal.thermal.sources import inputs_of

__all__ = [
    "Advice",
    "Heating",
    "Inputs",
    "Kind",
    "OnlineCompensator",
    "Stops",
    "ThermalFit",
    "ThermalModel",
    "fit_thermal",
    "inputs_of",
]
