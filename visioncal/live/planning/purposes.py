"""What stops are planned for: which unknowns they should determine, and which errors count.

A later stage registers its purpose by one more entry of `PURPOSES`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, TypeAlias

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean

# Errors of a point that the camera sees, or of what the arm carries all over its workspace.
Judged: TypeAlias = Literal["sight", "workspace"]


@dataclass(frozen=True)
class Purpose:
    """What stops are planned for.

    Both edges are unknown for any purpose.

    Attributes:
        name: Its name, as a user gives it.
        blocks: The arm's errors that are unknown too (see `ArmModel`), with the standard deviation
            that is known of them beforehand [rad]; lengths are off by 0.5 m times as much.
        judged: Which errors count.
        errors: What they are, in words.
        stops: How many a plan of its own has; with more, each adds little.
    """

    name: str
    judged: Judged
    errors: str
    stops: int
    blocks: Mapping[str, float] = field(default_factory=dict)


# Where the robot finds what the camera sees is the camera's edge alone; the target's is scaffold.
_HAND_EYE = Purpose("hand-eye", "sight", "the camera's pose", 12)
_OFFSETS = Purpose(
    "offsets",
    "workspace",
    "the arm's place all over its workspace",
    20,
    # A lost encoder is set again by eye, to about this.
    {"offsets": 2e-3},
)
_KINEMATICS = Purpose(
    "kinematics",
    "workspace",
    "the arm's place all over its workspace",
    30,
    # Arms come off by 1 mrad and 0.5 mm a link.
    {"links": 1e-3},
)
_ELASTIC = Purpose(
    "elastic",
    "workspace",
    "the bending arm's place all over its workspace",
    30,
    # A cobot's joints yield by 10 mrad to the arm's own weight where that turns them most.
    {"links": 1e-3, "compliance": 1e-2},
)
PURPOSES: Mapping[str, Purpose] = MappingProxyType(
    {purpose.name: purpose for purpose in (_HAND_EYE, _OFFSETS, _KINEMATICS, _ELASTIC)}
)


def purpose_of(name: str, culprit: str = "purpose") -> Purpose:
    """Finds a purpose.

    Args:
        name: Its name.
        culprit: Where it was named, for the error.

    Raises:
        DataError: There is none of that name.
    """
    if name not in PURPOSES:
        raise DataError(
            f"{culprit} is {name!r}; stops can be planned for {', '.join(PURPOSES)}.",
            culprits=[culprit],
            next_step=did_you_mean(name, PURPOSES),
        )
    return PURPOSES[name]
