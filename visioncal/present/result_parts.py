"""The cameras, robots, boards and frames of a result, by name.

A cell has named cameras, arms and boards. One camera with one robot has one of each, whose name is
empty.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, Target
from visioncal.results import Calibration, CameraResult
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.frames import CELL


@dataclass(frozen=True, eq=False)
class FrameHierarchy:
    """The tree of frames, with the poses that are fixed."""

    parents: Mapping[str, str]  # Parent of each frame; the cell is the root.
    # (4, 4) `parent_from_frame` of the frames that no robot moves on their parent.
    matrices: Mapping[str, FloatArray]
    robots: Mapping[str, str]  # Robot name by its flange's frame.

    @property
    def fixed_m(self) -> list[FloatArray]:
        """Positions (3,) of the frames that are fixed in the cell, or in a lone robot's base."""
        return [
            matrix[:3, 3]
            for frame, matrix in self.matrices.items()
            if self.parents[frame] in (CELL, "base")
        ]


def cameras(calibration: Calibration) -> Mapping[str, CameraResult]:
    """Cameras by frame."""
    if calibration.cell is not None:
        return calibration.cell.lenses
    return {} if calibration.camera is None else {"": calibration.camera}


def image_width(calibration: Calibration) -> int | None:
    """Width of the widest camera's images [px]; None without a camera."""
    widths = [camera.camera.resolution[0] for camera in cameras(calibration).values()]
    return max(widths, default=None)


def robots(calibration: Calibration) -> dict[str, Robot]:
    """Nominal models of the robots, where known."""
    named = calibration.by_name.robots.items()
    return {name: robot.model for name, robot in named if robot.model is not None}


def calibrated_robots(calibration: Calibration) -> dict[str, Robot]:
    """Calibrated models of the robots, or else their nominal ones."""
    calibrated = {
        name: robot.arm.robot
        for name, robot in calibration.by_name.robots.items()
        if robot.arm is not None and robot.arm.robot is not None
    }
    return {**robots(calibration), **calibrated}


def stated_boards(session: Session | None) -> dict[str, Target]:
    """Boards as the session states them, by their names in results."""
    if session is None:
        return {}
    boards = {**session.plates, **session.boards}
    return {"target": boards[""], **boards} if "" in boards else boards


def frames(calibration: Calibration | None) -> FrameHierarchy:
    """Frames of a result at the end of the session, with tools and fixtures.

    Without a result: base and flange of one robot.
    """
    if calibration is None:
        return FrameHierarchy({"base": CELL, "flange": "base"}, {"base": np.eye(4)}, {"flange": ""})
    tree = calibration.tree
    parents, matrices = tree.last, {tree.reference: np.eye(4)}
    for name, edge in calibration.placed.items():
        parent, _, child = name.partition("_from_")
        if child not in tree.former:
            parents[child], matrices[child] = parent, edge.matrix
    robots = tree.flanges if calibration.cell is not None else dict.fromkeys(tree.flanges, "")
    return FrameHierarchy(parents, matrices, robots)
