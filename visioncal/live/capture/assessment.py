"""Assessment of the views so far: coverage, advice, predicted accuracy, joints against poses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import TypeAlias

import numpy as np

from visioncal.core.errors import VisioncalError
from visioncal.core.transforms import distances, invert
from visioncal.core.types import Camera, Corners, FloatArray, Mask, Target
from visioncal.live.drivers.protocols import ArmState
from visioncal.planning.design import Accuracy
from visioncal.planning.information import predict_worlds
from visioncal.planning.plan_file import PlanFile
from visioncal.robot import Robot
from visioncal.vision.pnp import measure_poses

# Greatest deviation of a controller's calibrated arm from the nominal model [m, rad].
_SAME_M, _SAME_RAD = 1e-2, 2e-2

# Accuracy predicted with some views, by their numbers; None while there is no prediction.
Prediction: TypeAlias = Callable[[Sequence[int]], Accuracy | None]


@dataclass(eq=False)
class Coach:
    """Coverage of a recording by its views."""

    target: Target
    resolution: tuple[int, int]  # (width, height) of the images [px].
    camera: Camera | None  # Intrinsics for tilt and distance; None where they are not known.
    corners: dict[int, Corners] = field(default_factory=dict)  # Corners found, by view.
    _poses: dict[int, FloatArray] = field(default_factory=dict)

    @property
    def poses(self) -> list[FloatArray]:
        """(4, 4) `cam_from_target` of the views; of an unknown lens, through a usual one [m]."""
        return [*self._poses.values()]

    @property
    def covered(self) -> Mask:
        """(rows, columns) parts of the image in which a view shows the board."""
        covered = np.zeros((5, 8), dtype=bool)
        counts = np.array(covered.shape[::-1])
        for corners in self.corners.values():
            cells = np.floor(corners.px * counts / self.resolution).astype(int)
            columns, rows = np.clip(cells, 0, counts - 1).T
            covered[rows, columns] = True
        return covered

    @property
    def lens(self) -> Camera:
        """Intrinsics; of an unknown lens, those of one with a horizontal field of 53 degrees."""
        if self.camera is not None:
            return self.camera
        width, height = self.resolution
        matrix = np.array([width, width, 0.5 * (width - 1), 0.5 * (height - 1)], dtype=float)
        return Camera("brown", self.resolution, matrix, np.zeros(5))

    def add(self, corners: Corners) -> None:
        """Takes a view into account, in place of one with its number."""
        self.drop(corners.view)
        self.corners[corners.view] = corners
        try:
            by_view = {corners.view: corners}
            # Assumed corner noise [px]; advice needs no better.
            views = measure_poses(by_view, (self.target,), self.lens, 0.2)
        except VisioncalError:
            return
        self._poses.update((corners.view, view.cam_from_target[0]) for view in views)

    def drop(self, view: int) -> None:
        """Takes a view out of account."""
        self.corners.pop(view, None)
        self._poses.pop(view, None)

    @property
    def _tilts(self) -> FloatArray:
        """Angles between the optical axis and the board's normal [deg]."""
        # The target's z axis points into the board, away from the camera.
        along = [pose[2, 2] for pose in self._poses.values()]
        return np.asarray(np.rad2deg(np.arccos(np.clip(along, -1.0, 1.0))))

    @property
    def _distances(self) -> list[float]:
        """Distances of the camera from the board [m]."""
        return [float(np.linalg.norm(pose[:3, 3])) for pose in self._poses.values()]

    def unseen(self) -> str:
        """Names the corners of the image in which no view shows the board; empty for none."""
        covered, rows = self.covered, {"top": slice(2), "bottom": slice(-2, None)}
        columns = {"left": slice(2), "right": slice(-2, None)}
        names = (
            f"{row} {column}"
            for row, column in product(rows, columns)
            if self.corners and covered[rows[row], columns[column]].mean() < 0.5
        )
        return ", ".join(names)

    def words(self) -> str:
        """States the coverage: `coverage 45 %, tilts to 32 deg, 0.4 to 0.7 m away`."""
        words = [f"coverage {100 * self.covered.mean():.0f} %"]
        if self.poses and self.camera is not None:
            words.append(f"tilts to {self._tilts.max():.0f} deg")
            words.append(f"{min(self._distances):.2f} to {max(self._distances):.2f} m away")
        return ", ".join(words)

    def advice(self) -> str:
        """Advice for the next view, where a person chooses it; empty where nothing is missing."""
        if len(self.corners) < 3:
            return "another place, with the board large in the image"
        if self.poses and self.camera is not None:
            tilts = self._tilts
            # Tilted views separate the board's distance from the focal length.
            if tilts.max() < 20.0:
                return f"tilt the camera: the steepest view leans by {tilts.max():.0f} deg only"
            if max(self._distances) < 1.25 * min(self._distances):
                return f"another distance: all views are about {self._distances[0]:.2f} m away"
        if unseen := self.unseen():
            return f"bring the board into the image's corners: it was hardly in the {unseen}"
        if self.covered.mean() < 0.8:
            return "bring the board to where it was not yet in the image, near the edges too"
        return ""


@dataclass(eq=False)
class JointPoseCheck:
    """Comparison of poses with the robot's model, up to a constant base or tool.

    It keeps the states so far that were consistent with one another.
    """

    robot: Robot | None  # The nominal model; None where it is not known, and nothing is compared.
    _states: list[ArmState] = field(default_factory=list)

    def why_not(self, state: ArmState) -> str:
        """States why a state's joints and pose are inconsistent; empty where they are not.

        A consistent state is kept.
        """
        if self.robot is None or state.q is None:
            return ""
        if len(state.q) != self.robot.joint_count:
            return (
                f"the arm reports {len(state.q)} joints, and {self.robot.name} has "
                f"{self.robot.joint_count}: check --robot"
            )
        q = np.array([state.q, *(other.q for other in self._states)])
        pose = np.array([other.base_from_flange for other in (state, *self._states)])
        model = self.robot.base_from_flange(q)
        found = [(0.0, 0.0)] if len(pose) == 1 else []
        # With a tool on the flange, `invert(model) @ pose` is constant; with another base,
        # `pose @ invert(model)` is.
        for constant in (invert(model) @ pose, pose @ invert(model)):
            shifts, angles = distances(constant[1:], constant[0])
            found += zip(shifts.tolist(), angles.tolist(), strict=True)
        shift_m, angle = min(found, key=lambda pair: pair[0] / _SAME_M + pair[1] / _SAME_RAD)
        if shift_m <= _SAME_M and angle <= _SAME_RAD:
            self._states.append(state)
            return ""
        cause = (
            "one of them is stale, the tool was changed on the pendant, or the arm is no "
            f"{self.robot.name}"
        )
        return (
            f"joint angles and pose disagree by {1e3 * shift_m:.0f} mm and "
            f"{np.rad2deg(angle):.1f} deg (limits {1e3 * _SAME_M:.0f} mm and "
            f"{np.rad2deg(_SAME_RAD):.1f} deg): {cause}"
        )


def planned_accuracy(plan: PlanFile) -> Prediction:
    """Prediction from the information of a plan's stops; it takes a millisecond."""
    q = np.array([stop.q for stop in plan.stops])
    (world,) = predict_worlds((plan.cell,), plan.purpose, q)

    def after(views: Sequence[int]) -> Accuracy | None:
        rows = [row for row, stop in enumerate(plan.stops) if stop.view in set(views)]
        return Accuracy.of(*world.variances(world.covariance(rows))) if rows else None

    return after
