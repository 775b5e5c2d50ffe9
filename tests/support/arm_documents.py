"""What a calibration says of a calibrated arm, for tests of the report and the recording."""

from dataclasses import replace
from typing import Any

import numpy as np

from visioncal.core.codec import read
from visioncal.core.types import FloatArray
from visioncal.results.arm import ArmResult
from visioncal.robot import Robot, load_robot

# What the parameters' changes are, with their sigmas: one sure, one chance, one held.
SURE, CHANCE = (1.2e-3, 1e-4), (-2e-4, 1.5e-4)
NOT_TOLD = "the offset of <b>shoulder_pan_joint</b> cannot be separated from the base frame"
WORKSPACE_MM = {"median": 0.071, "p95": 0.14}


def levels() -> list[dict[str, Any]]:
    """The arm as stated, offsets of its joints, and its links."""
    figures = (
        ("nominal", 0, 0.76, 0.083, 0.79, 0.086, 0.0),
        ("offsets", 6, 0.61, 0.063, 0.66, 0.067, 24.3),
        ("geometry", 36, 0.073, 0.0049, 0.085, 0.0055, 1026.9),
    )
    names = ("level", "unknowns", "rms_mm", "rms_deg")
    names += ("held_out_mm", "held_out_deg", "likelihood_ratio")
    return [dict(zip(names, figure, strict=True)) for figure in figures]


def arm_of(robot: Robot, **changes: Any) -> ArmResult:
    """An arm that was calibrated, with other values of some fields."""
    found = read(ArmResult, {"level": "geometry", "levels": levels()}, "kinematics")
    return replace(found, robot=robot, **changes)


def bent_ur10e() -> tuple[dict[str, Any], FloatArray]:
    """The document of a UR10e whose third joint's zero is off by 10 mrad, and by how much [rad]."""
    functions = np.zeros((6, 4))
    functions[2, 0] = 0.01
    robot = load_robot("ur10e").corrected(np.zeros((7, 6)), functions)
    return dict(robot.document), functions[:, 0]


def calibrated() -> dict[str, Any]:
    """All that is said of an arm whose geometry was found."""
    rng = np.random.default_rng(3)
    places = rng.uniform([-1, -1, 0], [1, 1, 1.2], (40, 3))
    return {
        "level": "geometry",
        "levels": levels(),
        "robot": bent_ur10e()[0],
        "convention": "hayati",
        "parameters": [
            _parameter("shoulder_pan_joint", "a_m", 0.0, *SURE),
            _parameter("shoulder_pan_joint", "alpha_rad", 0.5 * np.pi, *CHANCE),
            _parameter("elbow_joint", "d_m", -0.5723, 0.0, 0.0),
            _parameter("elbow_joint", "sine_rad", 0.0, *SURE),
        ],
        "workspace_sigma_mm": WORKSPACE_MM,
        "workspace_map": [
            {"x_m": x, "y_m": y, "z_m": z, "sigma_mm": 0.05 + 0.1 * float(np.hypot(x, y))}
            for x, y, z in places.tolist()
        ],
        "observability": {"columns": 48, "identifiable": 30, "determined": 29, "condition": 54.2}
        | {"o1": 0.21, "o2": 0.0184, "o3": 0.0031, "o4": 6e-5, "o5": 0.0012},
        "not_determined": [NOT_TOLD],
        "left_out": [unseen(view) for view in (0, 1, 2, 4, 5, 7, 8)],
    }


def _parameter(
    joint: str, name: str, nominal: float, change: float, sigma: float
) -> dict[str, Any]:
    identified = nominal + change
    figures = {"nominal": nominal, "identified": identified, "change": change, "sigma": sigma}
    return {"joint": joint, "name": name} | figures


def unseen(view: int) -> dict[str, Any]:
    figures = {"nominal_mm": 0.6 + 0.05 * view, "nominal_deg": 0.08, "mm": 0.06, "deg": 0.004}
    return {"view": view} | figures
