"""The calibrated arm, as calibration.json has it."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from visioncal.estimator.armmodel import ArmModel
from visioncal.estimator.workspace import observability, workspace_sigmas
from visioncal.pipeline.known import Known
from visioncal.pipeline.unseen import unseen_views
from visioncal.robot import Robot
from visioncal.robot.conversion import convert_table, parallel_axes, table_of
from visioncal.robot.tables import DHTable, table_from_document
from visioncal.stages.kinematics import Kinematics, Level
from visioncal.targets import corner_positions
from visioncal.types import FloatArray

# Errors of these sizes are told well: what an edge's sigma is worth when columns are compared.
_EDGE_UNITS = np.tile(np.repeat([1e-3, 5e-4], 3), 2)


def kinematics_document(known: Known) -> dict[str, Any] | None:
    """Writes the levels that were compared and, where one was taken, the arm; None for neither."""
    found, model = known.kinematics, known.arm_model
    if found is None:
        return None
    document: dict[str, Any] = {
        "level": found.level,
        "levels": [_level(it) for it in found.levels],
    }
    if model is None:
        return document
    return document | {
        "robot": dict(model.robot.document),
        "parameters": list(_parameters(model.nominal, model.robot)),
        **unseen_views(known, found),
        **_worth(known, found, model),
    }


def _level(level: Level) -> dict[str, Any]:
    return {
        "level": level.name,
        "unknowns": level.unknowns,
        "rms_mm": level.inside.mm,
        "rms_deg": level.inside.deg,
        "held_out_mm": level.left_out.mm,
        "held_out_deg": level.left_out.deg,
        "likelihood_ratio": level.likelihood_ratio,
    }


def _worth(known: Known, found: Kinematics, model: ArmModel) -> dict[str, Any]:
    """What the arm's poses are worth all over the workspace, and what the stops tell."""
    sigmas_mm, edges = workspace_mm(known, model), known.solved.edges
    first = next(iter(found.errors.values())).sigma
    units = np.concatenate([_EDGE_UNITS, np.full(len(model.values), first)])
    q = known.joints(known.used)
    seen = observability(model, edges, known.session.mount, q, units)
    return {
        "workspace_sigma_mm": {
            "median": float(np.median(sigmas_mm)),
            "p95": float(np.quantile(sigmas_mm, 0.95)),
        },
        "observability": {
            "columns": seen.columns,
            "identifiable": seen.rank,
            "told": seen.told,
            "condition": seen.condition,
        },
    }


def workspace_mm(known: Known, model: ArmModel) -> FloatArray:
    """Predicted sigma (k,) of a tool's place, seen from the target, all over the workspace [mm]."""
    result, size = known.solved, len(model.values)
    rows = np.concatenate([np.arange(12), np.arange(-size, 0)])
    spread = result.covariance[np.ix_(rows, rows)]
    target = known.session.target
    middle = np.zeros(3) if target is None else corner_positions(target).mean(axis=0)
    sigmas = workspace_sigmas(model, result.edges, known.session.mount, spread, middle)
    return np.asarray(1e3 * sigmas)


def _parameters(nominal: Robot, identified: Robot) -> Iterator[dict[str, Any]]:
    """Each joint's numbers as stated and as found, in the table's own form.

    Where consecutive axes are nearly parallel it is Hayati's, which has no leap there.
    """
    before = _table(nominal)
    if parallel_axes(nominal).any():
        before = convert_table(before, "hayati")
    after = table_of(identified, before.convention, like=before)
    for place, joint in enumerate(before.joint_names):
        # In Craig's form the way across to a joint stands in its own row.
        across = place if before.convention == "modified" else place + 1
        for name, unit, old, new in (
            ("theta", "rad", before.theta_rad[place], after.theta_rad[place]),
            ("d", "m", before.d_m[place], after.d_m[place]),
            ("a", "m", before.a_m[across], after.a_m[across]),
            ("alpha", "rad", before.alpha_rad[across], after.alpha_rad[across]),
            ("beta", "rad", before.beta_rad[across], after.beta_rad[across]),
        ):
            if name != "beta" or before.parallel[across]:
                yield _number(joint, f"{name}_{unit}", float(old), float(new))
        functions: FloatArray = after.functions[place]
        for name, value in zip(("sine", "cosine"), functions[2:].tolist(), strict=True):
            if value:
                yield _number(joint, f"{name}_rad", 0.0, value)


def _number(joint: str, name: str, nominal: float, identified: float) -> dict[str, Any]:
    return {
        "joint": joint,
        "name": name,
        "nominal": nominal,
        "identified": identified,
        "change": identified - nominal,
    }


def _table(robot: Robot) -> DHTable:
    if "convention" in robot.document:
        return table_from_document(robot.document)
    return table_of(robot, "standard")
