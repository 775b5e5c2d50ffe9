"""Driving an arm's tip to a safe height above points that a person then touches."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, pose_difference
from visioncal.core.types import FloatArray, Target
from visioncal.frames.touch_test import TouchTargets
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.gate import Consent, Gate, JointPace, check_same_arm, clear_path
from visioncal.live.drivers.protocols import MovingArm
from visioncal.live.planning.cell import Limits, PlanCell, cell_of_calibration, touching_model
from visioncal.results import Calibration
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
    """Driven arm, and the board that all on its flange stays above."""

    gate: Gate
    cell: PlanCell  # The cell, with the arm's model as in its controller.
    targets: TouchTargets  # The board, and what the flange carries.
    height_m: float  # Height of the tip [m].

    @classmethod
    def of(
        cls,
        arm: MovingArm,
        calibration: Calibration,
        board: Target,
        targets: TouchTargets,
        height_m: float,
        consent: Consent,
    ) -> "Hovering":
        """Prepares the touch test of a board in a calibrated cell.

        Raises:
            DataError: The calibration has no model of the robot or no camera.
        """
        if calibration.robot is None:
            raise DataError(
                "--drive: the calibration has no model of the robot.",
                culprits=["--drive"],
                next_step="Name it as [robot] model in session.toml, and calibrate again.",
            )
        # The controller's own model, for which the targets are.
        limits = Limits(clearance_m=min(Limits.clearance_m, _KEPT * height_m))
        cell = replace(cell_of_calibration(calibration, board, limits), robot=calibration.robot)
        gate = Gate(LiveCell(arm), cell.robot, consent, _PACE)
        return cls(gate, cell, targets, height_m)

    def bring(self, base_from_flange: FloatArray, name: str) -> None:
        """Drives the flange to a (4, 4) pose above a named point, as its controller reports it [m].

        An arm that is too low is first lifted along the board's normal to the hovering height.

        Raises:
            DataError: There is no consent; or the path is too long, not clear of what is known, or
                leads too near to the board.
            DriverError: The arm is stopped or lost, or does not arrive.
        """
        live, robot = self.gate.live, self.cell.robot
        start = live.joints()
        check_same_arm(live, robot, start)
        path = [*self._path(start, base_from_flange, name)]
        self._check(np.array([start, *path]))
        with live.halting():
            self.gate.move(path, f"above {name}, at up to {_PACE.speed:g} rad/s")
            reported = live.state().base_from_flange
            if pose_difference(reported, base_from_flange)[0] > _THERE_MM:
                # Local deviation of the controller's model from ours.
                correction = invert(reported) @ robot.base_from_flange(path[-1][None])[0]
                corrected = self._posture(base_from_flange @ correction, path[-1])
                self._check(np.array([path[-1], corrected]))
                self.gate.move([corrected], f"to {name} more exactly")

    def _path(self, start: FloatArray, goal: FloatArray, name: str) -> Iterator[FloatArray]:
        tip = self.targets.flange_from_tip.matrix
        base_from_flange = self.cell.robot.base_from_flange(start[None])[0]
        lift_m = self.height_m - float(self._heights(base_from_flange[None]).min())
        if lift_m > 0.0:
            raised = base_from_flange.copy()
            raised[:3, 3] -= lift_m * self.targets.board.edge.matrix[:3, 2]
            lifted = self._posture(raised, start)
            # Upwards off what it touches: only the rest must be clear.
            off = touching_model(self.cell, tip, None)
            if off.path_contact(start, lifted) >= 0:
                pair = " and ".join(off.names[off.path_contact(start, lifted)])
                raise DataError(
                    f"{self.gate.live.arm.name}: lifted by {1e3 * lift_m:.0f} mm to the hovering "
                    f"height, {pair} would come too near to each other.",
                    culprits=["--drive"],
                    next_step="Bring the tip above the board by hand first.",
                )
            yield lifted
            start = lifted
        clear = touching_model(self.cell, tip, self.targets.board.edge)
        yield from clear_path(self.cell, start, self._posture(goal, start), name, clear)

    def _posture(self, goal: FloatArray, near: FloatArray) -> FloatArray:
        """Joint angles (n,) for a pose of the flange, near to others [rad]."""
        chain = self.cell.robot.chain
        solution = Inverse(self.cell.robot).solve(goal, chain.effective(near[None])[0])
        if not solution.reached:
            raise DataError(
                f"{self.gate.live.arm.name} does not reach a point: {1e3 * solution.off_m:.0f} mm "
                "are left.",
                culprits=["--drive"],
                next_step="Put the board nearer, or give the robot's model as it is.",
            )
        return np.asarray(chain.encoded(solution.positions[None])[0])

    def _heights(self, base_from_flange: FloatArray) -> FloatArray:
        """Heights (m, k) of all parts above the board for (m, 4, 4) poses of the flange [m]."""
        placed = self.targets.parts_m @ base_from_flange[:, :3, :3].transpose(0, 2, 1)
        placed += base_from_flange[:, None, :3, 3]
        board = self.targets.board.edge.matrix
        return np.asarray((board[:3, 3] - placed) @ board[:3, 2])

    def _check(self, path: FloatArray) -> None:
        """Refuses a path of (k, n) postures that is too long or too low."""
        name = self.gate.live.arm.name
        largest_turn = np.abs(np.diff(path, axis=0)).max()
        if largest_turn > _FARTHEST_RAD:
            raise DataError(
                f"{name}: a joint would turn by {np.rad2deg(largest_turn):.0f} deg; up to "
                f"{np.rad2deg(_FARTHEST_RAD):.0f} are driven.",
                culprits=["--drive"],
                next_step="Bring the tip above the board by hand first.",
            )
        for start, end in pairwise(path):
            postures = start + np.linspace(0.0, 1.0, _PLACES)[:, None] * (end - start)
            heights = self._heights(self.cell.robot.base_from_flange(postures)).min(axis=1)
            least = min(float(heights[0]), _KEPT * self.height_m) - 1e-4
            if heights.min() < least:
                raise DataError(
                    f"{name}: on its way it would come to {1e3 * heights.min():.0f} mm above the "
                    f"board; {1e3 * least:.0f} mm are needed.",
                    culprits=["--drive"],
                    next_step="Bring the tip above the board by hand first, or hover higher "
                    "(--height-mm).",
                )
