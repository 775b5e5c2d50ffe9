"""The five poses of ISO 9283 (6.4.2) in the largest cube that an arm reaches.

The cube's edges are parallel to the base. P1 is its centre; P2 to P5 lie in a diagonal plane, a
tenth of the diagonal from its corners. The flange keeps one orientation, looking down.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from visioncal.core.documents.tables import csv_text
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray
from visioncal.planning.cell import Limits
from visioncal.robot import Robot
from visioncal.robot.collision import Collisions, arm_bodies
from visioncal.robot.inverse import Inverse
from visioncal.session.columns import POSE, pose_row

# Corners of the diagonal plane, and of the cube, in half sides.
_PLANE = np.array([[1, 1, -1], [1, -1, -1], [-1, -1, 1], [-1, 1, 1]], dtype=float)
_CORNERS = np.array([*product((-1.0, 1.0), repeat=3)])
_DOWN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class CubePlan:
    """Five poses in a cube."""

    robot: Robot
    centre_m: FloatArray  # (3,) in the base.
    side_m: float
    q: FloatArray  # (5, n) joint angles [rad].

    def table(self, cycles: int, *, mount: str) -> str:
        """The cycles as a views.csv, from P5 to P1, whose measurements are empty."""
        poses = self.robot.base_from_flange(self.q)
        joints = [f"q{index + 1}_rad" for index in range(self.robot.joint_count)]
        read = ["meas_x_m", "meas_y_m", "meas_z_m"] if mount == "instrument" else ["image"]
        rows: list[list[object]] = [["view", "group", *joints, *POSE, *read]]
        for view in range(5 * cycles):
            at = 4 - view % 5
            numbers = [*self.q[at].tolist(), *pose_row(poses[at]).values()]
            cells = [""] * 3 if mount == "instrument" else [f"images/{view:03d}.png"]
            rows.append([view, f"P{at + 1}", *(f"{number:.9f}" for number in numbers), *cells])
        return csv_text(rows)


def largest_cube(robot: Robot, limits: Limits) -> CubePlan:
    """Finds the largest cube in front of an arm; raises DataError where there is none."""
    inverse = Inverse(robot)
    collisions = Collisions(robot, arm_bodies(robot), limits.clearance_m, limits.floor_m)
    reach = float(np.linalg.norm(robot.chain.placements[1:, :3, 3], axis=1).sum())
    margin = limits.joint_margin_rad
    low, high = robot.lower_rad + margin, robot.upper_rad - margin

    def postures(centre: FloatArray, side: float) -> FloatArray | None:
        found, start = list[FloatArray](), np.zeros(robot.joint_count)
        # P1 first: its posture is where the others are looked for.
        for point in (np.zeros(3), *(0.8 * _PLANE), *_CORNERS):
            pose = compose(_DOWN, centre + 0.5 * side * point)
            posture = inverse.solve(pose, start, widest_rad=1e-3 if not found else 1.5)
            q = robot.chain.encoded(posture.positions[None])
            if not posture.reached or (q < low).any() or (q > high).any():
                return None
            if collisions.first_contact(q)[0] >= 0:
                return None
            found.append(q[0])
            start = found[0] if len(found) == 1 else start
        return np.array(found[:5])

    best: CubePlan | None = None
    for x, z in product(np.linspace(0.25, 0.75, 6), np.linspace(0.05, 0.55, 6)):
        centre = reach * np.array([x, 0.0, z])
        # In steps of a fiftieth of the reach, as long as they are larger than the best.
        side = reach / 50.0 if best is None else best.side_m + reach / 50.0
        while (q := postures(centre, side)) is not None:
            best = CubePlan(robot, centre, side, q)
            side += reach / 50.0
    if best is None:
        raise DataError(
            f"plan: no cube in front of {robot.name} is reached with the flange looking down.",
            culprits=[robot.name],
            next_step="Lower --clearance-mm or --margin-deg, or set --floor to where the floor is.",
        )
    return best
