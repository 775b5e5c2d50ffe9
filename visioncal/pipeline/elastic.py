"""The springs of a calibrated arm: what loads can tell, what they do, and how that is written."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from visioncal.estimation.armmodel import COMPLIANCE, WEIGHT
from visioncal.pipeline.known import Known
from visioncal.stages import backlash, elastic
from visioncal.stages.backlash import plays_of
from visioncal.stages.elastic import Elastic, Spring, springs_of
from visioncal.stages.loads import check_elastic, check_poses, check_stops


def check_loads(known: Known) -> None:
    """Refuses loads that tell nothing.

    Raises:
        DataError: Views of one stop differ in them, or springs are asked for that nothing bends.
        DegenerateError: They change while the arm stands still.
    """
    views = tuple(known.base_from_flange)
    declared = {it.number: it.stop for it in known.session.views}
    check_stops(known.loads(views), views, [declared[it] for it in views])
    check_poses(known.loads(views), known.flange_poses(views))
    check_elastic(known.level, known.robot, known.loads(views))


def with_springs(known: Known) -> Known:
    """Adds what the stops tell of the arm's springs, and of the play in its joints."""
    plays = () if known.arm_model is None else plays_of(known.arm_model, known.arm_spread)
    known = replace(known, notes=(*known.notes, *backlash.remarks(plays)))
    found = _springs(known)
    if found is None:
        return known
    known = replace(known, elastic=found, notes=(*known.notes, *elastic.remarks(found)))
    return known.noting((), elastic.doubts(found))


def _springs(known: Known) -> Elastic | None:
    """What the stops tell of the springs; None for a rigid arm."""
    found, model = known.kinematics, known.arm_model
    if found is None or model is None or not found.errors.keys() & {COMPLIANCE, WEIGHT}:
        return None
    first = np.unique(known.stops, return_index=True)[1]
    data = known.closure(known.used).merged(known.stops)
    q, loads = known.joints(known.used)[first], known.loads(known.used).chosen(first)
    springs = found.errors.get(COMPLIANCE)
    prior = 0.0 if springs is None else springs.sigma / model.torque_nm
    return springs_of(data, known.solved, model, q, loads, prior)


def elastic_document(known: Known) -> dict[str, Any] | None:
    """Writes the springs; None where the level is a rigid one."""
    found = known.elastic
    if found is None:
        return None
    document: dict[str, Any] = {
        "joints": [_joint(it) for it in found.springs],
        "not_told": list(found.untold),
        "weight": "of the model's masses" if found.weighs else "unknown",
        "payload_kg": [float(found.payload_kg.min()), float(found.payload_kg.max())],
        "sag_mm": {
            "median": float(np.median(found.sag_mm)),
            "most": float(found.sag_mm.max()),
        },
        "stops": list(_stops(known, found)),
    }
    if found.weight_moments is not None:
        document["weight_moments"] = found.weight_moments.tolist()
    if found.payload is not None:
        document["payload_factor"] = {
            "value": found.payload.value,
            "sigma": found.payload.sigma,
        }
    return document


def _joint(spring: Spring) -> dict[str, Any]:
    row: dict[str, Any] = {
        "joint": spring.joint,
        "compliance_rad_per_nm": spring.compliance,
        "sigma_rad_per_nm": spring.sigma,
        "told": spring.is_told,
        "torque_nm": list(spring.torque_nm),
    }
    if spring.stiffness is not None:
        row["stiffness_nm_per_rad"] = spring.stiffness
        row["stiffness_sigma_nm_per_rad"] = spring.stiffness_sigma
    return row


def _stops(known: Known, found: Elastic) -> Iterator[dict[str, Any]]:
    """Torques and bends stop by stop, by the first view; a bend that is not told is left out."""
    first = np.unique(known.stops, return_index=True)[1]
    for at, (torques, bends) in enumerate(zip(found.torques_nm, found.bends_rad, strict=True)):
        seen = {
            name: 1e3 * float(bend)
            for name, bend in zip((it.joint for it in found.springs), bends, strict=True)
            if np.isfinite(bend)
        }
        yield {
            "view": known.used[int(first[at])],
            "payload_kg": float(found.payload_kg[at]),
            "sag_mm": float(found.sag_mm[at]),
            "torque_nm": torques.tolist(),
            "bend_mrad": seen,
        }
