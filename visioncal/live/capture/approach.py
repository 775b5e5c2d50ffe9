"""Ways to the stops of a plan from where the arm really stands."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.live.planning.path import ordered
from visioncal.live.planning.read_back import PlanFile, Stop

# An arm this near to where the plan has it is there [rad].
_THERE_RAD = 5e-3


@dataclass(frozen=True, eq=False)
class Ways:
    """Ways that were looked at: those of the plan, and others where the arm stands elsewhere."""

    plan: PlanFile

    def to(self, stop: Stop, here: FloatArray) -> tuple[FloatArray, ...]:
        """Finds the way to a stop.

        Args:
            stop: One of the plan.
            here: (n,) where the joints are [rad].

        Returns:
            The postures (n,) to drive through, the last of which is the stop's.

        Raises:
            DataError: No way that is clear of everything declared was found, or the arm stands too
                near to something.
        """
        if _there(here, stop.q):
            return (stop.q,)
        planned = self._planned_from(stop)
        if planned is not None and _there(here, planned):
            return (*stop.via, stop.q)
        self._check_limits(here)
        route = ordered(self.plan.cell, here, stop.q[None])
        if route.unreachable:
            (obstacle,) = route.unreachable.values()
            raise DataError(
                f"view {stop.view}: no clear way leads there from where the arm stands "
                f"({_deg(here)}): in the way are {obstacle}.",
                culprits=[f"view {stop.view}"],
                next_step="Bring the arm near to the plan's first stop by hand, or plan anew with "
                "--start-joints as it stands.",
            )
        return (*route.segments[0], stop.q)

    def _planned_from(self, stop: Stop) -> FloatArray | None:
        """Where the plan has the arm come from; None where it does not say."""
        at = self.plan.stops.index(stop)
        return self.plan.stops[at - 1].q if at else self.plan.start_q

    def _check_limits(self, here: FloatArray) -> None:
        robot = self.plan.cell.robot
        outside = (here < robot.lower_rad) | (here > robot.upper_rad)
        if outside.any():
            joint = robot.joint_names[int(np.argmax(outside))]
            raise DataError(
                f"{joint} stands at {np.rad2deg(here[np.argmax(outside)]):.1f} deg, outside the "
                f"limits of {robot.name}.",
                culprits=[joint],
                next_step="Turn it back by hand.",
            )


def _there(here: FloatArray, posture: FloatArray) -> bool:
    return here.shape == posture.shape and bool(np.abs(here - posture).max() < _THERE_RAD)


def _deg(q: FloatArray) -> str:
    return ", ".join(f"{it:.0f}" for it in np.rad2deg(q)) + " deg"
