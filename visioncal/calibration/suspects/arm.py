"""Errors of arms: those that follow the posture, and what an arm's calibration leaves to say."""

from collections.abc import Iterator

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages import thermal
from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.kinematics import findings
from visioncal.calibration.suspects.mounting import other_mounting
from visioncal.calibration.suspects.suspect import ARM_ERRORS, REMARK, Suspect
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import mm_and_deg
from visioncal.core.transforms import LEVER_M
from visioncal.core.verdict import NOTE, PLAN, Finding, Remedy, remarks
from visioncal.estimation.arm import stops_of
from visioncal.estimation.steps import DRIFT
from visioncal.robot.errors import SIGNIFICANT

_LIMITS = CalibrationLimits()
# Remedy for errors of an arm whose joints are not known.
NO_JOINTS = Remedy(
    "Name the arm as [robot] model in session.toml, and record its joint angles (q1_rad, ... of "
    "views.csv) unless that is done: calibrate then estimates the arm, too."
)


def _found(run: RunState) -> Iterator[Finding]:
    arms, reports = run.cell_fit.arms, run.assessment.arms
    for name, arm in arms.items():
        drifts = () if arm.thermal is None else thermal.findings(arm.thermal)
        mounting = other_mounting(run, arm)
        # Encoders, zeros and springs are those of an arm that is mounted otherwise.
        found = () if mounting is not None else reports[name].notes
        notes = remarks((*drifts, *findings(arm, run.cell_fit.level), *found), NOTE)
        stops = len(stops_of(run.assessment.fit.problem, name))
        arm_findings = (*([mounting] if mounting else []), *_of(arm, run.cell_fit.level, stops))
        for finding in (*arm_findings, *reports[name].doubts, *notes):
            yield finding.of("" if len(arms) == 1 else f"Robot {name}")


def _of(arm: Arm, level: str, stops: int) -> Iterator[Finding]:
    is_cold = level == thermal.LEVEL and arm.thermal is None
    if is_cold or (arm.joints_rad is None and level not in ("auto", "hand-eye")):
        words = f"It stays as it reports itself: its rows lack what --level {level} needs."
        step = "Record joint angles, and name the arm as [robot] model in session.toml"
        step += "; record temp1_c ... or current1_a ... in a stream." * is_cold or "."
        yield Finding("level", words, Remedy(step))
    errors = arm.errors
    if errors is None or not errors.is_significant:
        return
    likely = f"(likelihood ratio {errors.gain:.0f}, noise stays under {SIGNIFICANT:.0f})"
    if errors.fit_sigmas is not None:
        turn_rad, shift_m = (np.sqrt(3.0) * errors.fit_sigmas).tolist()
        turn_deg, shift_mm = float(np.rad2deg(turn_rad)), 1e3 * shift_m
        repeats = (0.0, 0.0) if arm.nominal is None else arm.nominal.repeatability
        # A servo arm's own repeatability puts its flange so far off.
        limits = (_LIMITS.repeatability * np.sqrt(3.0) * np.array(repeats)).tolist()
        limit_mm, limit_deg = map(max, _LIMITS.arm_errors, limits)
        # By fewer stops than check a result, no pattern among them is known for the arm's.
        if shift_mm > limit_mm or turn_deg > limit_deg or stops < _LIMITS.stops[0]:
            return
        words = (
            f"Residuals follow the arm's posture, or last from stop to stop {likely}: a look near "
            f"the views errs by {mm_and_deg(shift_mm, turn_deg)} (rms). "
            "More views will not help: joint angles or a kinematic calibration of the arm will."
        )
        do = NO_JOINTS
    elif arm.model is None:
        size = mm_and_deg(1e3 * LEVER_M * errors.sigma, float(np.rad2deg(errors.sigma)))
        words = (
            f"Residuals follow the arm's posture {likely}: its links are off from the model by "
            f"typically {size}; they were estimated along."
        )
        step = "Add stops all over the workspace, so that the arm can be calibrated along."
        do = Remedy(step, f"{PLAN} --for kinematics")
    else:
        return
    words += " What of these errors looks the same in all views is in no residual, and counts in "
    words += "the covariance."
    yield Finding(ARM_ERRORS, words, do, until_mm=0.0, mahalanobis_sq=errors.gain)


def _heat(run: RunState) -> Iterator[Finding]:
    arms, steps = run.cell_fit.arms, run.assessment.steps
    is_late = bool(steps) and steps[0].kind == DRIFT
    for name, arm in arms.items():
        found = [] if arm.thermal is None else [*thermal.doubts(arm.thermal)]
        is_open = arm.thermal is None and run.cell_fit.level == "auto"
        if is_open and (words := thermal.unrecorded(arm)):
            # Without drift of the residuals they are of no use.
            kind = thermal.TEMPERATURES if is_late else NOTE
            step = Remedy("Write stamp_s of streams and views.csv in seconds of one clock.")
            found.append(Finding(kind, f"{words[0].upper()}{words[1:]}", step if is_late else None))
        for finding in found:
            yield finding.of("" if len(arms) == 1 else f"Robot {name}")


ERRORS = Suspect(ARM_ERRORS, _found, 1e-4, True, order=1)
# Drift of an arm that warms up looks like that of its base.
HEAT = Suspect(thermal.TEMPERATURES, _heat, REMARK, hides=("moved_slowly",))
