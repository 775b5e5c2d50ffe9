"""An arm that hangs or is on a wall, where its mounting is not stated: loads bend it otherwise."""

from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.arm_results import one_nominal
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.cell import robot_key
from visioncal.calibration.stages.kinematics import with_likely_errors
from visioncal.calibration.suspects.suspect import ARM_ERRORS, INFLATED, UNEXPLAINED, Suspect
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.number_format import figure
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.robot import Robot
from visioncal.robot.loads import gravity_words

KIND = "mounting"  # Of the finding.
# Twice the gain in log-likelihood that chance leaves to one of five directions in a million.
_CLEAR = 30.0


def other_mounting(run: RunState, arm: Arm) -> Finding | None:
    """The finding that another direction of gravity explains what bends an arm, if one does."""
    kinematics, fit = arm.kinematics, run.cell_fit.fit
    documents = {robot_key(name): at for name, at in run.session.robot_documents.items()}
    if kinematics is None or arm.nominal is None or arm.robot not in documents:
        return None
    known, declared = arm.nominal, Robot.from_document(documents[arm.robot])
    noise_rad, noise_m = fit.noise.robots[fit.robots.index(arm.robot)].tolist()
    repeats_mm, repeats_deg = known.repeatability
    # An arm of this repeatability leaves as much anyway.
    is_usual = 1e3 * noise_m < repeats_mm and np.rad2deg(noise_rad) < repeats_deg
    if is_usual or not (known.masses is not None or arm.loads.any):
        return None
    home = np.zeros((1, known.joint_count))
    moved = (known.base_from_flange(home) @ invert(declared.base_from_flange(home)))[0]
    size = float(np.linalg.norm(declared.gravity))
    axes = size * np.concatenate([np.eye(3), -np.eye(3)])
    others = axes[axes @ declared.gravity <= 0.9 * size**2]
    found = _with_gravity(run, arm, known, others @ moved[:3, :3].T)
    if found.kinematics is None or found.model is None:
        return None
    axis = size * np.round(moved[:3, :3].T @ found.model.nominal.gravity / size)
    chosen, likelier = kinematics.chosen, found.kinematics.chosen
    gain = likelier.likelihood_ratio - chosen.likelihood_ratio
    before_mm, after_mm = chosen.held_out_mm, likelier.held_out_mm
    if gain < _CLEAR or CLEAR_RATIO * after_mm > before_mm:
        return None
    line = f"gravity_m_s2 = {gravity_words(axis)}"
    was = "stated" if "gravity_m_s2" in declared.document else "assumed, since none is stated"
    return Finding(
        KIND,
        f"Gravity acts along another direction of the robot's base than is {was}, as on an arm "
        f"that hangs or is on a wall: with {line}, stops left out are predicted to "
        f"{figure(after_mm)} mm, else to {figure(before_mm)} mm.",
        Remedy(f"Write {line} under [robot] of session.toml, and calibrate again.", CALIBRATE),
        mahalanobis_sq=gain,
        is_proven=True,
    )


def _with_gravity(run: RunState, arm: Arm, robot: Robot, directions: FloatArray) -> Arm:
    """The arm with its errors at the likeliest of (k, 3) gravities in the base of its poses."""
    cell_fit = run.cell_fit
    robots = [
        replace(robot, document={**robot.document, "gravity_m_s2": at.tolist()}, gravity=at)
        for at in directions
    ]

    (problem, start), *_ = (
        (problem, start)
        for other, problem, start in one_nominal(cell_fit.arms, cell_fit.fit)
        if other is arm
    )
    bare, level, noise = replace(arm, model=None, kinematics=None), cell_fit.level, cell_fit.noise
    return with_likely_errors(bare, problem, start, level, noise, run.used, stated=robots)


# Its misfit goes into encoders, links and scatter, and puts some views far off.
_EFFECTS = (ARM_ERRORS, UNEXPLAINED, "arm_parameter", "load", "wrong_views")
MOUNTING = Suspect(KIND, None, 1e-6, True, _EFFECTS, INFLATED)
