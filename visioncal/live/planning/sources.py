"""Cells as an earlier calibration knows them."""

from dataclasses import replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import Target
from visioncal.estimation.parts import Noise
from visioncal.frames.touches import robot_noise
from visioncal.live.planning.cell import Box, Limits, PlanCell
from visioncal.results import Calibration
from visioncal.robot import Robot

# What well-kept arms and cameras repeat to, where nothing is known of it [rad, m and px].
TYPICAL_NOISE, TYPICAL_PX = Noise.of_robot(5e-5, 3e-5), 0.1
# A calibrated cell may have been touched since, by about this [rad and m].
_TOUCHED_RAD, _TOUCHED_M = 5e-3, 2e-3


def cell_of_calibration(
    calibration: Calibration,
    target: Target,
    limits: Limits,
    boxes: tuple[Box, ...] = (),
    *,
    robot: Robot | None = None,
) -> PlanCell:
    """Takes a calibrated cell as the guess for another calibration of it.

    Both edges are trusted as far as they are known, but not beyond a millimetre or two: the reason
    for another calibration may be that somebody touched the camera or the board.

    Args:
        calibration: The result; its arm is taken as far as it is calibrated.
        target: The board, which a calibration does not keep.
        limits: What the stops must keep.
        boxes: What else stands in the cell.
        robot: The arm, where the calibration has none.

    Raises:
        DataError: The calibration has no robot or no camera.
    """
    arm = calibration.calibrated_robot or robot
    if arm is None:
        raise DataError(
            f"calibration {calibration.session_name!r} names no robot, and its stops cannot be "
            "planned without one.",
            culprits=["robot"],
            next_step="Name it with --robot.",
        )
    if calibration.camera is None:
        raise DataError(
            f"calibration {calibration.session_name!r} was made from measured poses and knows no "
            "camera.",
            culprits=["camera"],
            next_step="Plan from a robot, with --camera, --cam and --board.",
        )
    x, z = calibration.edges.values()
    sigma_m = max(1e-3 * x.sigma_mm, 1e-3 * z.sigma_mm) / np.sqrt(3.0)
    sigma_rad = np.deg2rad(max(x.sigma_deg, z.sigma_deg)) / np.sqrt(3.0)
    noise, pixel_px = _noise(calibration)
    return PlanCell(
        calibration.mount,
        arm,
        calibration.camera.camera,
        target,
        x.matrix,
        z.matrix,
        max(float(sigma_rad), _TOUCHED_RAD),
        max(float(sigma_m), _TOUCHED_M),
        noise,
        pixel_px,
        limits,
        boxes,
    )


def _noise(calibration: Calibration) -> tuple[Noise, float]:
    found = calibration.noise
    noise = robot_noise(calibration)
    # A few stops may show less than there is by chance.
    at_least = np.maximum(noise.robots, 0.5 * TYPICAL_NOISE.robots)
    return replace(noise, robots=at_least), found.get("pixel_px", TYPICAL_PX)
