"""Files of a plan to identify dynamics: tables and JSON."""

import io
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from visioncal.core.version import __version__
from visioncal.dynamics.excitation import Excitation
from visioncal.dynamics.limits import MotionExtremes, MotionLimits
from visioncal.dynamics.model import JointMotion
from visioncal.dynamics.sweeps import Sweeps

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
    mean, sines, cosines = plan.excitation.series.coefficients
    request = plan.excitation.request
    document: dict[str, Any] = {
        "schema": 1,
        "kind": "dynamics",
        "visioncal": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "joints": list(plan.allowed.robot.joint_names),
        "excitation": {
            "period_s": request.period_s,
            "harmonics": request.harmonics,
            "start_rad": plan.excitation.series.start.tolist(),
            "mean_rad": mean.tolist(),
            "sine_rad": sines.tolist(),
            "cosine_rad": cosines.tolist(),
            "condition": plan.excitation.condition,
            "condition_random": plan.excitation.random,
            "base_parameters": list(plan.excitation.base.names),
            "kept": _kept(plan.excitation.extremes),
            "seed": request.seed,
        },
    }
    if (sweeps := plan.sweeps) is not None:
        begins = sweeps.begins_s.tolist()
        document["sweeps"] = {
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
            document["sweeps"]["left_out"] = list(sweeps.left_out)
    if unchecked := plan.allowed.unchecked:
        document["not_checked"] = list(unchecked)
    return document | {"robot": dict(plan.allowed.robot.document)}


def _kept(kept: MotionExtremes) -> dict[str, Any]:
    """Shares of the limits that a motion uses."""
    document: dict[str, Any] = {"share_of_allowed": kept.shares}
    if kept.nearest:
        document["nearest"] = {
            "mm": 1e3 * kept.clearance_m,
            "between": list(kept.nearest),
            "at_s": kept.nearest_s,
        }
    return document
