"""A plan to identify an arm's dynamics: an exciting motion, and sweeps for its friction."""

from dataclasses import dataclass

from visioncal.dynamics.excitation import Excitation
from visioncal.dynamics.limits import Allowed
from visioncal.dynamics.sweeps import Sweeps


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """What is to be driven.

    Attributes:
        allowed: What all of it keeps.
        excitation: The exciting motion.
        sweeps: Those for friction; None where they were not wished.
    """

    allowed: Allowed
    excitation: Excitation
    sweeps: Sweeps | None
