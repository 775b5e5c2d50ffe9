"""Driving an arm's tip to a safe height above points that a person then touches."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from visioncal.core.errors import DataError, DriverError
from visioncal.core.transforms import invert, pose_difference
from visioncal.core.types import FloatArray
from visioncal.live.capture.drive import JointPace, wait_until_stopped
from visioncal.live.capture.live import HostClock
from visioncal.live.drivers.protocols import MovingArm
from visioncal.robot import Robot
from visioncal.robot.inverse import Inverse

# Somebody stands beside the arm.
_PACE = JointPace(speed=0.25, acceleration=0.5)
# Share of the height that the tip keeps on its path, and the number of checked postures.
_KEPT, _PLACES = 0.5, 100
# Greatest travel of a joint [rad]; beyond it the arm is guided nearer by hand.
_FARTHEST_RAD = 2.5
# Flange error above which the deviation of the controller's model from ours is corrected [mm].
_THERE_MM = 0.05


@dataclass(frozen=True, eq=False)
class Hovering:
    """Driven arm, and the plane that its tip stays above.

    Attributes:
        robot: Model of the arm, as in its controller.
        tip_m: (3,) the tip in the flange frame [m].
        point_m: (3,) a point of the plane, in the base [m].
        normal: (3,) normal of the plane, in the base, into what is touched.
        height_m: Height of the tip [m].
    """

    arm: MovingArm
    robot: Robot
    tip_m: FloatArray
    point_m: FloatArray
    normal: FloatArray
    height_m: float

    def bring(self, base_from_flange: FloatArray) -> None:
        """Drives the flange to a (4, 4) pose, as its controller reports it [m].

        A tip that is too low is first lifted along the normal.

        Raises:
            DataError: The path is too long, or leads the tip too near to the plane.
            DriverError: The arm is stopped or lost, or does not arrive.
        """
        start = self._joints()
        path = [*self._path(start, base_from_flange)]
        self._check(np.array([start, *path]))
        try:
            for goal in path:
                self._move(goal)
            reported = self.arm.state().base_from_flange
            if pose_difference(reported, base_from_flange)[0] > _THERE_MM:
                # Local deviation of the controller's model from ours.
                correction = invert(reported) @ self.robot.base_from_flange(path[-1][None])[0]
                corrected = self._posture(base_from_flange @ correction, path[-1])
                self._check(np.array([path[-1], corrected]))
                self._move(corrected)
        except BaseException:
            self.arm.halt()
            raise

    def _path(self, start: FloatArray, goal: FloatArray) -> Iterator[FloatArray]:
        base_from_flange = self.robot.base_from_flange(start[None])[0]
        lift = self.height_m - float(self._heights(base_from_flange[None])[0])
        if lift > 0.0:
            raised = base_from_flange.copy()
            raised[:3, 3] -= lift * self.normal
            start = self._posture(raised, start)
            yield start
        yield self._posture(goal, start)

    def _posture(self, goal: FloatArray, near: FloatArray) -> FloatArray:
        """Joint angles (n,) for a pose of the flange, near to others [rad]."""
        chain = self.robot.chain
        solution = Inverse(self.robot).solve(goal, chain.effective(near[None])[0])
        if not solution.reached:
            raise DataError(
                f"{self.arm.name} does not reach a point: {1e3 * solution.off_m:.0f} mm are left.",
                culprits=["--drive"],
                next_step="Put the board nearer, or give the robot's model as it is.",
            )
        return np.asarray(chain.encoded(solution.positions[None])[0])

    def _heights(self, base_from_flange: FloatArray) -> FloatArray:
        """Heights (m,) of the tip above the plane for (m, 4, 4) poses of the flange [m]."""
        tips = base_from_flange[:, :3, :3] @ self.tip_m + base_from_flange[:, :3, 3]
        return np.asarray((self.point_m - tips) @ self.normal)

    def _check(self, path: FloatArray) -> None:
        """Refuses a path of (k, n) postures that is too long or too low."""
        largest_turn = np.abs(np.diff(path, axis=0)).max()
        if largest_turn > _FARTHEST_RAD:
            raise DataError(
                f"{self.arm.name}: a joint would turn by {np.rad2deg(largest_turn):.0f} deg; up to "
                f"{np.rad2deg(_FARTHEST_RAD):.0f} are driven.",
                culprits=["--drive"],
                next_step="Bring the tip above the board by hand first.",
            )
        for start, end in pairwise(path):
            postures = start + np.linspace(0.0, 1.0, _PLACES)[:, None] * (end - start)
            heights = self._heights(self.robot.base_from_flange(postures))
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
        wait_until_stopped(self.arm, expected_s, HostClock(), self.arm.state)
