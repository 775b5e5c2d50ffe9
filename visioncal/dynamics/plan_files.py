"""Files of a plan to identify dynamics: tables and JSON."""

import io
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from visioncal.core.version import __version__
from visioncal.dynamics.excitation import Excitation
from visioncal.dynamics.limits import CHECK_HZ, MotionExtremes, MotionLimits
from visioncal.dynamics.model import JointMotion
from visioncal.dynamics.sweeps import Sweeps

SCHEMA = 1
MOTION_FILES = ("sweeps.csv", "excitation.csv")


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """Motions planned to identify an arm's dynamics; `sweeps` is None where not requested."""

    allowed: MotionLimits
    excitation: Excitation
    sweeps: Sweeps | None


def motion_files(plan: MotionPlan, rate_hz: float) -> dict[str, str]:
    """Tables: content by file name."""
    files = {"excitation.csv": _motion_table(plan.excitation.series.sampled(rate_hz))}
    if plan.sweeps is not None:
        files["sweeps.csv"] = _motion_table(plan.sweeps.sampled(rate_hz))
    return files


def _motion_table(motion: JointMotion) -> str:
    """Writes a motion as a table with the columns of a session's stream."""
    joints = range(1, motion.q.shape[1] + 1)
    columns = [
        "stamp_s",
        *(f"q{joint}_rad" for joint in joints),
        *(f"dq{joint}_rad_s" for joint in joints),
        *(f"ddq{joint}_rad_s2" for joint in joints),
    ]
    text = io.StringIO()
    rows = np.column_stack([motion.times_s, motion.q, motion.dq, motion.ddq])
    # A nanoradian is enough; adding 0.0 removes negative zeros.
    rows = np.round(rows, 9) + 0.0
    np.savetxt(text, rows, fmt="%.10g", delimiter=",", header=",".join(columns), comments="")
    return text.getvalue()


def motion_document(plan: MotionPlan) -> dict[str, Any]:
    """Builds the content of plan.json; fields that do not apply are absent."""
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


def _excitation(excitation: Excitation) -> dict[str, Any]:
    mean, sines, cosines = excitation.series.coefficients
    request = excitation.request
    search = {"seed": request.seed, "seconds": excitation.seconds, "starts": excitation.starts}
    if np.isfinite(request.seconds):
        search["wished_seconds"] = request.seconds
    return {
        "period_s": request.period_s,
        "harmonics": request.harmonics,
        "start_rad": excitation.series.start.tolist(),
        "mean_rad": mean.tolist(),
        "sine_rad": sines.tolist(),
        "cosine_rad": cosines.tolist(),
        "condition": excitation.condition,
        "condition_random": excitation.random,
        "base_parameters": list(excitation.base.names),
        "weights": excitation.weights.tolist(),
        "kept": _kept(excitation.extremes) | {"rate_hz": CHECK_HZ},
        "search": search,
    }


def _sweeps(sweeps: Sweeps) -> dict[str, Any]:
    begins = sweeps.begins_s.tolist()
    document: dict[str, Any] = {
        "duration_s": begins[-1],
        "home_rad": sweeps.home.tolist(),
        "kept": _kept(sweeps.extremes),
        "strokes": [
            {
                "joint": stroke.joint + 1,
                "begin_s": begin,
                "from_rad": stroke.begin,
                "to_rad": stroke.end,
                "speed_rad_s": stroke.speed,
                "ramp_s": stroke.ramp_s,
                "duration_s": stroke.duration_s,
            }
            for stroke, begin in zip(sweeps.strokes, begins[:-1], strict=True)
            if stroke.sweeps
        ],
    }
    if sweeps.left_out:
        document["left_out"] = list(sweeps.left_out)
    return document


def _kept(kept: MotionExtremes) -> dict[str, Any]:
    """Extremes of a motion, and the shares of the limits that they use."""
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


def _limits(allowed: MotionLimits) -> dict[str, Any]:
    """The limits, margins included."""
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
        "bodies": [body.name for body in allowed.bodies if not body.of_arm],
    }
    if not allowed.unchecked:
        document["torque_nm"] = allowed.torque.tolist()
    if share.floor_m is not None:
        document["floor_mm"] = 1e3 * share.floor_m
    return document
