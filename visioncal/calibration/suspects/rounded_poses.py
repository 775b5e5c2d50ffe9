"""Poses that were written with too few digits, as by hand from a controller's display."""

from collections.abc import Iterator

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import robot_key
from visioncal.calibration.suspects.suspect import ARM_ERRORS, UNEXPLAINED, Suspect
from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Remedy
from visioncal.robot.model import REPEATABILITY
from visioncal.session.columns import POSE

# Share of a rounding's standard deviation that residuals show at least: commanded poses may be
# round numbers, and exact.
_SHOWN = 0.7
# Decimals of quaternions that turn a flange by more than arms repeat.
_MOST_DIGITS = 3


def _found(run: RunState) -> Iterator[Finding]:
    robots, fit = run.session.robots, run.assessment.fit
    for name in robots:
        if (key := robot_key(name)) in fit.robots:
            rad, metres = fit.noise.robots[fit.robots.index(key)].tolist()
            found = rounded(run, name, 1e3 * metres, float(np.rad2deg(rad)))
            if found is not None:
                yield found.of(f"Robot {name}" if len(robots) > 1 else "")


def rounded(run: RunState, robot: str, noise_mm: float, noise_deg: float) -> Finding | None:
    """The finding that a robot's poses are rounded, which explains a noise of its flange."""
    rows = [seen.robots[robot] for seen in run.timed.observations if robot in seen.robots]
    poses = np.array([[row.numbers.get(key, np.nan) for key in POSE] for row in rows])
    poses = poses[np.isfinite(poses).all(axis=1)]
    if not len(poses):
        return None
    step_mm, (step_deg, form) = _step(1e3 * poses[:, :3]), _angle_step(poses[:, 3:])
    sigmas, noise = np.array([step_mm, step_deg]) / np.sqrt(12.0), np.array([noise_mm, noise_deg])
    counts = (np.array(REPEATABILITY) < sigmas) & (sigmas < noise / _SHOWN)
    # It is not the cause where another one is greater.
    counts &= noise < np.sqrt(2.0) * sigmas
    if not counts.any():
        return None
    words = (f"positions to {figure(step_mm)} mm", f"{form} to {figure(step_deg)} deg")
    offs = (f"{figure(sigmas[0])} mm", f"{figure(sigmas[1])} deg")
    parts, off = (" and ".join(each[at] for at in np.flatnonzero(counts)) for each in (words, offs))
    return Finding(
        "rounded_poses",
        f"The robot's poses are rounded, their {parts}: this alone puts the flange off by "
        f"{off} per axis from stop to stop (the fit finds "
        f"{mm_and_deg(noise_mm, noise_deg)}).",
        Remedy(
            "Read the poses from the controller's interface, not from its display, with 0.01 mm "
            "and 0.001 deg, and record again."
        ),
        until_mm=0.0,
    )


def _step(numbers: FloatArray) -> float:
    """The largest of 10, 1, 0.1 and their halves of which all rows are multiples, or zero.

    Where there is none, that of which most are.
    """
    steps = np.array([10.0, 5.0, 1.0, 0.5, 0.1])
    shares = numbers[None] / steps[:, None, None]
    # Digits of a table in metres and of quaternions.
    rows = (np.abs(shares - np.round(shares)) * steps[:, None, None] < 2e-4).all(axis=2)
    are_all, are_most = steps[rows.all(axis=1)], steps[rows.mean(axis=1) > 0.5]
    return float(max(are_all, default=max(are_most, default=0.0)))


def _angle_step(quaternions: FloatArray) -> tuple[float, str]:
    """Step of angles [deg] as they were written, and the name of their form."""
    round_rows = {
        digits: (quaternions == np.round(quaternions, digits)).all(axis=1).mean()
        for digits in range(1, _MOST_DIGITS + 1)
    }
    # All rows first: some of few digits may be of simple turns.
    for least in (1.0, 0.5):
        digits = next((at for at, share in round_rows.items() if share >= least), 0)
        if digits:
            # A part of a quaternion is half of an angle in radians.
            step = 2.0 * float(np.rad2deg(0.1**digits))
            return step, f"rotations (quaternions of {digits} decimals)"
    rotations = ROTATION_FORMS["quaternion-xyzw"].read(quaternions)
    names = {
        form.rotation.split("-")[1] for form in POSE_FORMS.values() if "euler" in form.rotation
    }
    forms = {f"euler-{name}-deg": "angles" for name in sorted(names)}
    for form, called in (forms | {"rotation-vector-deg": "rotation vectors"}).items():
        angles = ROTATION_FORMS[form].write(rotations)
        if step := _step(angles):
            return step, called
        if step := _step(1e3 * np.deg2rad(angles)):
            return float(np.rad2deg(1e-3 * step)), called
    return 0.0, ""


ROUNDED_POSES = Suspect(
    "rounded_poses",
    _found,
    1e-6,
    of_chain=True,
    hides=(UNEXPLAINED,),
    inflates=("robot_noise", "robot_noise_of_pick", ARM_ERRORS),
)
