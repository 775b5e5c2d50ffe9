"""A robot's arm as it was built: off its data sheet, giving way, and repeating so well."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import exp
from visioncal.core.types import FloatArray
from visioncal.simulation.arms import ArmErrors, DhArm, arm_named, disturb, forward
from visioncal.simulation.sag import Payload, giving_of, sagging


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmOptions(ArmErrors):
    """An arm, how the real one departs from it, and what it carries.

    Attributes:
        robot: `ur3e`, `ur5e`, `ur10e` or `generic-6r-1800`.
        robot_sigma_m: Repeatability: where the flange really stands, per axis [m].
        robot_sigma_rad: The same for its rotation [rad].
        compliance_rad_per_nm: What each joint yields to a torque; empty for a rigid arm.
        payloads: What the arm carries, stop by stop in turn; empty for nothing.
        mass_share: Real over published masses of the links.
        backlash_rad: Play of each joint; empty for none. With play, stops are approached from
            either side in turn.
    """

    robot: str = "ur10e"
    robot_sigma_m: float = 3e-5
    robot_sigma_rad: float = 5e-5
    compliance_rad_per_nm: tuple[float, ...] = ()
    payloads: tuple[Payload, ...] = ()
    mass_share: float = 1.0
    backlash_rad: tuple[float, ...] = ()

    @property
    def sigma(self) -> FloatArray:
        """(6,) repeatability of the flange: rotation [rad], translation [m]."""
        return np.repeat([self.robot_sigma_rad, self.robot_sigma_m], 3)

    def loads(self, stops: int) -> tuple[Payload, ...]:
        """What the arm carries at so many stops; empty where it carries nothing."""
        loads = self.payloads
        return tuple(loads[at % len(loads)] for at in range(stops)) if loads else ()

    def approach(self, stops: int) -> FloatArray | None:
        """(stops,) the sides from which stops are approached, +1 or -1; None without play."""
        return np.where(np.arange(stops) % 2, 1.0, -1.0) if self.backlash_rad else None

    def built(self, rng: np.random.Generator) -> DhArm:
        """Draws the arm as it was built."""
        return disturb(arm_named(self.robot), self, rng)

    def flange_at(
        self,
        arm: DhArm,
        q: FloatArray,
        payloads: Sequence[Payload] = (),
        approach: FloatArray | None = None,
    ) -> FloatArray:
        """Where the flange of an arm of this kind stands, before the error of its repeatability.

        Args:
            arm: The arm as it was built.
            q: (k, n) joint angles as the encoders have them [rad].
            payloads: k loads; none where empty.
            approach: (k,) the side from which it came; None for the middle of its play.

        Returns:
            (k, 4, 4) `base_from_flange`.
        """
        giving = giving_of(arm, self.compliance_rad_per_nm, self.mass_share, self.backlash_rad)
        return forward(arm, sagging(arm, giving, q, payloads, approach))

    def jitter(self, stops: int, rng: np.random.Generator) -> FloatArray:
        """(stops, 4, 4) `flange_from_stood`: by how much the flange does not repeat."""
        return exp(rng.standard_normal((stops, 6)) * self.sigma)
