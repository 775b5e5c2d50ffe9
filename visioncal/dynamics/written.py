"""A plan to identify an arm's dynamics as files: tables of its motions, and JSON."""

import io
from datetime import UTC, datetime
from typing import Any

import numpy as np

from visioncal.core.version import __version__
from visioncal.dynamics.condition import Condition
from visioncal.dynamics.excitation import Excitation
from visioncal.dynamics.limit_check import CHECK_HZ, Kept
from visioncal.dynamics.limits import Allowed
from visioncal.dynamics.motion import Motion
from visioncal.dynamics.planned import MotionPlan
from visioncal.dynamics.programs import excitation_program, sweeps_program
from visioncal.dynamics.sweeps import Sweeps
from visioncal.robot import has_ur_axes

SCHEMA = 1
MOTION_FILES = ("sweeps.script", "sweeps.csv", "excitation.script", "excitation.csv")


def motion_files(plan: MotionPlan, rate_hz: float) -> dict[str, str]:
    """Writes tables, and programs where the robot is one that takes them: content by file name."""
    robot, found = plan.allowed.robot, {}
    programmed = has_ur_axes(robot)
    if plan.sweeps is not None:
        found["sweeps.csv"] = motion_table(plan.sweeps.sampled(rate_hz))
        if programmed:
            found["sweeps.script"] = sweeps_program(robot, plan.sweeps)
    series = plan.excitation.series
    found["excitation.csv"] = motion_table(series.sampled(rate_hz))
    if programmed:
        found["excitation.script"] = excitation_program(robot, series)
    return found


def motion_table(motion: Motion) -> str:
    """Writes a motion as a table with the columns of a session's stream."""
    joints = range(1, motion.q.shape[1] + 1)
    columns = [
        "stamp_s",
        *(f"q{it}_rad" for it in joints),
        *(f"dq{it}_rad_s" for it in joints),
        *(f"ddq{it}_rad_s2" for it in joints),
    ]
    text = io.StringIO()
    rows = np.column_stack([motion.times_s, motion.q, motion.dq, motion.ddq])
    # A nanoradian is enough; a negative zero would only raise questions.
    rows = np.round(rows, 9) + 0.0
    np.savetxt(text, rows, fmt="%.10g", delimiter=",", header=",".join(columns), comments="")
    return text.getvalue()


def motion_document(plan: MotionPlan) -> dict[str, Any]:
    """Builds the content of plan.json; what does not apply is absent."""
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "kind": "dynamics",
        "visioncal": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "joints": list(plan.allowed.robot.joint_names),
        "excitation": _excitation(plan.excitation),
    }
    if plan.sweeps is not None:
        document["sweeps"] = _sweeps(plan.sweeps)
    if unchecked := plan.allowed.unchecked:
        document["not_checked"] = list(unchecked)
    return document | {
        "limits": _limits(plan.allowed),
        "robot": dict(plan.allowed.robot.document),
    }


def _excitation(found: Excitation) -> dict[str, Any]:
    mean, sines, cosines = found.series.coefficients
    request = found.request
    search = {"seed": request.seed, "seconds": found.seconds, "starts": found.starts}
    if np.isfinite(request.seconds):
        search["wished_seconds"] = request.seconds
    return {
        "period_s": request.period_s,
        "harmonics": request.harmonics,
        "start_rad": found.series.start.tolist(),
        "mean_rad": mean.tolist(),
        "sine_rad": sines.tolist(),
        "cosine_rad": cosines.tolist(),
        "condition": _condition(found.condition),
        "condition_random": _condition(found.random),
        "base_parameters": list(found.base.names),
        "weights": found.weights.tolist(),
        "kept": _kept(found.kept) | {"rate_hz": CHECK_HZ},
        "search": search,
    }


def _condition(found: Condition) -> dict[str, float]:
    return {"weighted": found.weighted, "scaled": found.scaled, "raw": found.raw}


def _sweeps(found: Sweeps) -> dict[str, Any]:
    begins = found.begins_s.tolist()
    document: dict[str, Any] = {
        "duration_s": begins[-1],
        "home_rad": found.home.tolist(),
        "kept": _kept(found.kept),
        "strokes": [
            {
                "joint": it.joint + 1,
                "begin_s": begin,
                "from_rad": it.begin,
                "to_rad": it.end,
                "speed_rad_s": it.speed,
                "ramp_s": it.ramp_s,
                "duration_s": it.duration_s,
            }
            for it, begin in zip(found.strokes, begins[:-1], strict=True)
            if it.sweeps
        ],
    }
    if found.left_out:
        document["left_out"] = list(found.left_out)
    return document


def _kept(kept: Kept) -> dict[str, Any]:
    """The extremes of a motion, and what share of what is allowed they are."""
    document: dict[str, Any] = {
        "lowest_rad": kept.lowest.tolist(),
        "highest_rad": kept.highest.tolist(),
        "speed_rad_s": kept.speed.tolist(),
        "acceleration_rad_s2": kept.acceleration.tolist(),
    }
    if kept.torque is not None:
        document["torque_nm"] = kept.torque.tolist()
    document["share_of_allowed"] = kept.shares
    if kept.nearest:
        document["nearest"] = {
            "mm": 1e3 * kept.clearance_m,
            "between": list(kept.nearest),
            "at_s": kept.nearest_s,
        }
    return document


def _limits(allowed: Allowed) -> dict[str, Any]:
    """What was allowed, margins taken off."""
    share = allowed.share
    document: dict[str, Any] = {
        "lower_rad": allowed.lower.tolist(),
        "upper_rad": allowed.upper.tolist(),
        "speed_rad_s": allowed.speed.tolist(),
        "acceleration_rad_s2": allowed.acceleration.tolist(),
        "clearance_mm": 1e3 * share.clearance_m,
        "margin_rad": share.margin_rad,
        "speed_share": share.speed,
        "acceleration_share": share.acceleration,
        "torque_margin": share.torque,
        "bodies": [it.name for it in allowed.bodies if not it.of_arm],
    }
    if not allowed.unchecked:
        document["torque_nm"] = allowed.torque.tolist()
    if share.floor_m is not None:
        document["floor_mm"] = 1e3 * share.floor_m
    return document
