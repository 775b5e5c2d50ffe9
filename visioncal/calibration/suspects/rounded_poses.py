"""Poses that were written with too few digits, as by hand from a controller's display."""

from collections.abc import Iterator, Sequence

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import robot_key
from visioncal.calibration.suspects.suspect import ARM_ERRORS, Suspect
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.verdict import Finding, Remedy
from visioncal.session import View
from visioncal.session.columns import POSE

# Share of a rounding's standard deviation that residuals show, at least: commanded poses may be
# round numbers, and exact.
_SHOWN = 0.7
_MORE_DIGITS = Remedy(
    "Read the poses from the controller's interface, not from its display, and write them to "
    "0.01 mm and 0.00001 of the quaternion; then record again."
)


def _found(run: RunState) -> Iterator[Finding]:
    limits, robots = CalibrationLimits(), run.session.robots
    for name in robots:
        rows = [seen.robots[name] for seen in run.timed.observations if name in seen.robots]
        arm = run.cell_fit.arms.get(robot_key(name))
        # A calibrated arm is where its joints say.
        if arm is None or arm.model is not None:
            continue
        noise = run.assessment.sigmas[arm.robot]
        step_m, step = _step(rows, POSE[:3]), _step(rows, POSE[3:])
        # A quaternion's components are half as large as the turn.
        sigma_mm, sigma_deg = 1e3 * step_m / 12**0.5, float(np.rad2deg(2.0 * step / 12**0.5))
        parts = []
        if limits.robot_mm < sigma_mm < noise["translation_mm"] / _SHOWN:
            parts.append(f"their positions to {figure(1e3 * step_m)} mm")
        if limits.robot_deg < sigma_deg < noise["rotation_deg"] / _SHOWN:
            parts.append(f"their quaternions to {figure(step)}")
        if parts:
            yield Finding(
                "rounded_poses",
                f"The robot's poses are rounded, {' and '.join(parts)}: this alone puts the flange "
                f"off by {mm_and_deg(sigma_mm, sigma_deg)} from stop to stop, and the fit finds "
                f"{mm_and_deg(noise['translation_mm'], noise['rotation_deg'])}.",
                _MORE_DIGITS,
                until_mm=0.0,
            ).of(f"Robot {name}" if len(robots) > 1 else "")


def _step(rows: Sequence[View], columns: Sequence[str]) -> float:
    """The power of ten that all numbers of some columns are multiples of; 0 without rounding."""
    numbers = [row.numbers[name] for row in rows for name in columns if name in row.numbers]
    for step in 10.0 ** -np.arange(1.0, 6.0) if numbers else ():
        shares = np.array(numbers) / step
        if np.abs(shares - np.round(shares)).max() < 1e-6:
            return float(step)
    return 0.0


ROUNDED_POSES = Suspect(
    "rounded_poses",
    _found,
    1e-6,
    of_chain=True,
    inflates=("robot_noise", "robot_noise_of_pick", ARM_ERRORS),
)
