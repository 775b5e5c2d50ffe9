"""What a result has of each kind, by name.

A whole cell has cameras, arms and boards with names; one camera with one robot is the case of one
of each, whose name is empty.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, Target
from visioncal.results import Calibration, CameraResult
from visioncal.results.sections import Intervals
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.frames import CELL


@dataclass(frozen=True, eq=False)
class FrameHierarchy:
    """What hangs on what.

    Attributes:
        parents: What each frame hangs on, the cell the first of them.
        matrices: (4, 4) `parent_from_frame` of those that no robot moves there.
        robots: The robot's name of each flange, by its frame.
    """

    parents: Mapping[str, str]
    matrices: Mapping[str, FloatArray]
    robots: Mapping[str, str]


@dataclass(frozen=True)
class Levels:
    """Levels of noise by name, as `pixel_px`, and those of their 95 % intervals that are known."""

    sigmas: Mapping[str, float]
    intervals: Intervals


def cameras(calibration: Calibration) -> Mapping[str, CameraResult]:
    """The cameras by their frames."""
    if calibration.cell is not None:
        return calibration.cell.lenses
    return {} if calibration.camera is None else {"": calibration.camera}


def image_width(calibration: Calibration) -> int | None:
    """Width of the images, of several cameras that of the widest [px]; None without a camera."""
    widths = [camera.camera.resolution[0] for camera in cameras(calibration).values()]
    return max(widths, default=None)


def robots(calibration: Calibration) -> dict[str, Robot]:
    """The nominal models of the robots, as far as they are known."""
    found = calibration.by_name.robots.items()
    return {name: robot.model for name, robot in found if robot.model is not None}


def calibrated_robots(calibration: Calibration) -> dict[str, Robot]:
    """The robots as they were calibrated, or else their nominal models."""
    calibrated = {
        name: robot.arm.robot
        for name, robot in calibration.by_name.robots.items()
        if robot.arm is not None and robot.arm.robot is not None
    }
    return {**robots(calibration), **calibrated}


def stated_boards(session: Session | None) -> dict[str, Target]:
    """The boards as the session states them, by the names that results give them."""
    if session is None:
        return {}
    found = {**session.plates, **session.boards}
    return {"target": found[""], **found} if "" in found else found


def noise(calibration: Calibration) -> dict[str, Levels]:
    """The levels of noise of each sensor and each robot."""
    named = calibration.by_name
    intervals = {} if named.uncertainty is None else named.uncertainty.noise_95
    robots = named.flanges.values()
    return {
        f"robot {name}" if name in robots else name: Levels(levels, intervals.get(name, {}))
        for name, levels in named.noise.items()
    }


def frames(calibration: Calibration | None) -> FrameHierarchy:
    """The frames of a result as they hang last, tools and fixtures among them.

    Without a result, base and flange of one robot.
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
