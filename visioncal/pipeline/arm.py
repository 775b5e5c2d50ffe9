"""The calibrated arm, as calibration.json has it."""

from typing import Any

import numpy as np

from visioncal.estimation.armmodel import BACKLASH
from visioncal.estimation.told import EDGES
from visioncal.guess.joints import JointReading
from visioncal.pipeline.known import Known
from visioncal.pipeline.unseen import unseen_views
from visioncal.robot import Robot
from visioncal.stages.backlash import plays_of
from visioncal.stages.tell import ArmData, Estimate, Telling, tell
from visioncal.targets import corner_positions

# So many places are enough for a map.
_PLACES = 200


def telling_of(known: Known) -> Telling | None:
    """What the stops tell of a calibrated arm; None for one that stands as stated."""
    found, model = known.kinematics, known.arm_model
    # In the middle of its play an arm that has nothing but play stands as stated.
    if found is None or model is None or not found.errors.keys() - {BACKLASH}:
        return None
    targets, boards = tuple(known.session.boards.values()), known.shown(known.used)
    first = np.unique(known.stops, return_index=True)[1]
    data = known.closure(known.used).merged(known.stops)
    further = np.arange(boards.begin, boards.begin + boards.unknowns)
    # Readings of one point show its place and no rotation; several points make a frame.
    shows_pose = bool((data.told > 3).any())
    seen = ArmData(
        data,
        known.solved,
        model,
        next(iter(found.errors.values())).sigma,
        known.joints(known.used)[first],
        corner_positions(targets[known.boards[0]]).mean(axis=0) if targets else np.zeros(3),
        np.concatenate([EDGES, 12 + further]),
        measured=np.repeat([shows_pose, True], 3),
    )
    return tell(seen, known.convention)


def kinematics_document(known: Known) -> dict[str, Any] | None:
    """Writes the levels that were compared and, where one was taken, the arm; None for neither."""
    found, model, telling = known.kinematics, known.arm_model, known.telling
    if found is None:
        return None
    document: dict[str, Any] = {
        **found.document(),
        **_backlash(known),
    }
    if model is None:
        return document
    document["robot"] = dict(model.robot.document)
    if telling is None:
        return document
    return document | {
        "convention": telling.convention,
        "parameters": [_number(it, model.nominal, known.lost_zero) for it in telling.estimates],
        **unseen_views(known, found),
        "workspace_sigma_mm": {
            "median": 1e3 * float(np.median(telling.sigmas_m)),
            "p95": 1e3 * float(np.quantile(telling.sigmas_m, 0.95)),
        },
        "workspace_map": [
            dict(zip(("x_m", "y_m", "z_m"), place, strict=True)) | {"sigma_mm": 1e3 * sigma}
            for place, sigma in list(
                zip(telling.places.tolist(), telling.sigmas_m.tolist(), strict=True)
            )[:_PLACES]
        ],
        "observability": _observability(telling),
        "not_told": list(telling.not_told),
        "stops": _stops(known, telling),
    }


def _backlash(known: Known) -> dict[str, list[dict[str, Any]]]:
    """The play of the joints, where stops were approached from both sides."""
    if known.arm_model is None:
        return {}
    rows = [it.document() for it in plays_of(known.arm_model, known.arm_spread)]
    return {"backlash": rows} if rows else {}


def _observability(telling: Telling) -> dict[str, Any]:
    told, indices = telling.told, telling.indices
    counted = {"columns": told.columns, "identifiable": told.identifiable, "told": told.told}
    if indices is None:
        return counted
    return counted | {
        "condition": indices.condition,
        "o1": indices.o1,
        "o2": indices.o2,
        "o3": indices.o3,
        "o4": indices.o4,
        "o5": indices.o5,
    }


def _stops(known: Known, telling: Telling) -> list[dict[str, Any]]:
    """What each stop is worth, by its first view, the most worth first."""
    first = np.unique(known.stops, return_index=True)[1]
    views = [known.used[at] for at in first]
    ordered = sorted(zip(telling.worth.tolist(), views, strict=True), key=lambda it: -it[0])
    return [{"view": view, "worth": worth} for worth, view in ordered]


def _number(estimate: Estimate, robot: Robot, lost: JointReading | None) -> dict[str, Any]:
    joint, nominal = estimate.parameter.joint, estimate.nominal
    if lost is not None and estimate.parameter.name == "theta_rad":
        # The fit starts where the zero was found; what is told starts where it was stated.
        nominal -= float(robot.chain.functions[joint, 1] * lost.zeros[joint])
    return {
        "joint": robot.joint_names[joint],
        "name": estimate.parameter.name,
        "nominal": nominal,
        "identified": estimate.identified,
        "change": estimate.identified - nominal,
        "sigma": estimate.sigma,
    }
