"""An arm with three joints: quick to plan for, with all that a plan of motions needs."""

from typing import Any

from visioncal.robot import Robot

RATES = {"velocity_rad_s": 2.5, "acceleration_rad_s2": 8.0, "torque_nm": 60.0}


def small_document(**changed: Any) -> dict[str, Any]:
    """Its description; of every joint, what is None is left out."""
    shapes = [(0.0, 1.5707963267948966, 0.3), (0.35, 0.0, 0.0), (0.3, 0.0, 0.0)]
    joints = []
    for place, (a, alpha, d) in enumerate(shapes):
        row = {
            "name": f"joint_{place + 1}",
            "a_m": a,
            "alpha_rad": alpha,
            "d_m": d,
            "lower_deg": -170.0,
            "upper_deg": 170.0,
            "mass_kg": 4.0 - place,
            "com_m": [-0.4 * a, 0.02, 0.01],
            "inertia_kg_m2": [0.01, 0.001, 0.03, 0.0, 0.002, 0.03],
            **RATES,
        }
        joints.append({key: value for key, value in (row | changed).items() if value is not None})
    return {"schema": 1, "name": "small", "tip": "tool0", "convention": "standard", "joint": joints}


def small_arm(**changed: Any) -> Robot:
    """The arm."""
    return Robot.from_document(small_document(**changed))
