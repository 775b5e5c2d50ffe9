"""Brings the tip of a driven arm to a safe height above points that a person then touches."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from visioncal.core.errors import DataError, DriverError
from visioncal.core.transforms import invert, pose_difference
from visioncal.core.types import FloatArray
from visioncal.live.capture.drive import JointPace, watched
from visioncal.live.capture.live import HostClock
from visioncal.live.drivers.protocols import MovingArm
from visioncal.robot import Robot
from visioncal.robot.inverse import Inverse

# Somebody stands beside the arm.
_PACE = JointPace(speed=0.25, acceleration=0.5)
# On its way the tip keeps this share of the height; it is looked at in so many places.
_KEPT, _PLACES = 0.5, 100
# Joints that turn farther are brought nearer by hand [rad].
_FARTHEST_RAD = 2.5
# A controller's own model of the arm may depart from ours by more than this [mm].
_THERE_MM = 0.05


@dataclass(frozen=True, eq=False)
class Hovering:
    """What is driven, and the plane that its tip stays above.

    Attributes:
        arm: What is driven.
        robot: Its model, as its controller has it.
        tip_m: (3,) the tip in the flange's frame [m].
        point_m: (3,) a point of the plane, in the base [m].
        normal: (3,) of the plane, in the base, into what is touched.
        height_m: How high the tip hovers [m].
    """

    arm: MovingArm
    robot: Robot
    tip_m: FloatArray
    point_m: FloatArray
    normal: FloatArray
    height_m: float

    def bring(self, base_from_flange: FloatArray) -> None:
        """Drives the flange to a (4, 4) pose, as its controller reports it.

        A tip that stands lower than it is to hover is lifted first, straight up.

        Raises:
            DataError: The way is too long, or leads the tip too near to the plane.
            DriverError: The arm is stopped or lost, or does not arrive.
        """
        start = self._joints()
        way = [*self._way(start, base_from_flange)]
        self._check(np.array([start, *way]))
        try:
            for goal in way:
                self._move(goal)
            reported = self.arm.state().base_from_flange
            if pose_difference(reported, base_from_flange)[0] > _THERE_MM:
                # By how much the controller's model of the arm departs from ours, here.
                away = invert(reported) @ self.robot.base_from_flange(way[-1][None])[0]
                again = self._posture(base_from_flange @ away, way[-1])
                self._check(np.array([way[-1], again]))
                self._move(again)
        except BaseException:
            self.arm.halt()
            raise

    def _way(self, start: FloatArray, goal: FloatArray) -> Iterator[FloatArray]:
        here = self.robot.base_from_flange(start[None])[0]
        lift = self.height_m - float(self._heights(here[None])[0])
        if lift > 0.0:
            raised = here.copy()
            raised[:3, 3] -= lift * self.normal
            start = self._posture(raised, start)
            yield start
        yield self._posture(goal, start)

    def _posture(self, goal: FloatArray, near: FloatArray) -> FloatArray:
        """(n,) joint angles that bring the flange to a pose, near to others [rad]."""
        chain = self.robot.chain
        found = Inverse(self.robot).solve(goal, chain.effective(near[None])[0])
        if not found.reached:
            raise DataError(
                f"{self.arm.name} does not reach a point: {1e3 * found.off_m:.0f} mm are left.",
                culprits=["--drive"],
                next_step="Put the board nearer, or give the robot's model as it is.",
            )
        return np.asarray(chain.encoded(found.positions[None])[0])

    def _heights(self, base_from_flange: FloatArray) -> FloatArray:
        """(m,) how high the tip is above the plane, of (m, 4, 4) poses of the flange [m]."""
        tips = base_from_flange[:, :3, :3] @ self.tip_m + base_from_flange[:, :3, 3]
        return np.asarray((self.point_m - tips) @ self.normal)

    def _check(self, way: FloatArray) -> None:
        """Refuses a way of (k, n) postures that is long or low."""
        turned = np.abs(np.diff(way, axis=0)).max()
        if turned > _FARTHEST_RAD:
            raise DataError(
                f"{self.arm.name}: a joint would turn by {np.rad2deg(turned):.0f} deg; up to "
                f"{np.rad2deg(_FARTHEST_RAD):.0f} are driven.",
                culprits=["--drive"],
                next_step="Bring the tip above the board by hand first.",
            )
        for begin, end in pairwise(way):
            between = begin + np.linspace(0.0, 1.0, _PLACES)[:, None] * (end - begin)
            heights = self._heights(self.robot.base_from_flange(between))
            least = min(float(heights[0]), _KEPT * self.height_m) - 1e-4
            if heights.min() < least:
                raise DataError(
                    f"{self.arm.name}: on its way the tip would come to "
                    f"{1e3 * heights.min():.0f} mm above the board; {1e3 * least:.0f} mm are "
                    "needed.",
                    culprits=["--drive"],
                    next_step="Bring the tip above the board by hand first, or hover higher "
                    "(--height-mm).",
                )

    def _joints(self) -> FloatArray:
        state = self.arm.state()
        if state.q is None or state.safety not in ("normal", "reduced"):
            raise DriverError(
                f"{self.arm.name} cannot be driven: it is in {state.safety}, or reports no joint "
                "angles.",
                culprits=[self.arm.name],
                next_step="Start it on the pendant.",
            )
        return state.q

    def _move(self, goal: FloatArray) -> None:
        expected_s = _PACE.travel_s(self._joints(), goal)
        self.arm.start_move(goal, speed=_PACE.speed, acceleration=_PACE.acceleration)
        watched(self.arm, expected_s, HostClock(), self.arm.state)
