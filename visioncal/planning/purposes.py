"""Purposes of a plan: which unknowns the stops should determine, and which errors count."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, TypeAlias

from visioncal.core.number_format import known_name

# Errors of a point that the camera observes, or of what the arm carries all over its workspace.
Judged: TypeAlias = Literal["sight", "workspace"]


@dataclass(frozen=True)
class Purpose:
    """Purpose of a plan. Both edges are unknown for any purpose."""

    name: str  # Its name, as a user gives it.
    judged: Judged  # The errors that count.
    errors: str  # The same in words.
    stops: int  # Default number of stops of a plan that adds to no session.
    # Unknown errors of the arm (see `ArmModel`) with their prior standard deviation [rad]; that of
    # lengths is 0.5 m times as much.
    blocks: Mapping[str, float] = field(default_factory=dict)


_ALL_OVER = "arm's place all over its workspace"
_PURPOSES = (
    # Picks depend on the camera's edge alone; the target's is a nuisance parameter.
    Purpose("hand-eye", "sight", "the camera's pose", 12),
    # A lost encoder zero is set again by eye to about this.
    Purpose("offsets", "workspace", f"the {_ALL_OVER}", 20, {"offsets": 2e-3}),
    # Arms deviate by 1 mrad and 0.5 mm per link.
    Purpose("kinematics", "workspace", f"the {_ALL_OVER}", 30, {"links": 1e-3}),
    # A cobot's joints deflect by 10 mrad under the greatest torque of the arm's own weight.
    Purpose(
        "elastic", "workspace", f"the bending {_ALL_OVER}", 30, {"links": 1e-3, "compliance": 1e-2}
    ),
)
PURPOSES: Mapping[str, Purpose] = MappingProxyType({each.name: each for each in _PURPOSES})


def purpose_of(name: str, culprit: str = "purpose") -> Purpose:
    """Finds a purpose by its name; raises DataError."""
    return PURPOSES[known_name("purpose", name, PURPOSES, culprit)]
