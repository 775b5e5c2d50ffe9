"""The calibrated arm, as calibration.json has it."""

from typing import Any

import numpy as np

from visioncal.estimation.armmodel import RIGID
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.problem import ROBOT
from visioncal.pipeline.known import Known
from visioncal.pipeline.unseen import unseen_views
from visioncal.stages.backlash import plays_of
from visioncal.stages.tell import Telling, tell
from visioncal.targets import corner_positions


def telling_of(known: Known) -> Telling | None:
    """What the stops tell of a calibrated arm; None for one that stands as stated."""
    seen = arm_data(known)
    # With nothing but play and springs its numbers are as stated.
    if seen is None or not seen.model.weights.keys() & set(RIGID):
        return None
    return tell(seen, known.convention)


def arm_data(known: Known) -> ArmData | None:
    """What was seen of a calibrated arm; None for one that stands as stated."""
    found, model = known.kinematics, known.arm_model
    if found is None or model is None:
        return None
    targets, result = tuple(known.session.boards.values()), known.solved
    first, problem = known.first_of_stops(known.used), result.problem
    # Readings of one point show its place and no rotation; several points make a frame.
    shows_pose = bool((problem.observations.directions > 3).any())
    return ArmData(
        problem,
        result.state,
        result.noise,
        result.covariance,
        ROBOT,
        model,
        np.arange(problem.size - len(model.values), problem.size),
        next(iter(found.errors.values())).sigma,
        np.arange(len(first)),
        known.joints(first),
        known.loads(first),
        corner_positions(targets[known.boards[0]]).mean(axis=0) if targets else np.zeros(3),
        np.arange(6 * len(problem.unknown)),
        measured=np.repeat([shows_pose, True], 3),
    )


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
        **telling.document(model.nominal, known.first_of_stops(known.used), known.lost_zero),
        **unseen_views(known, found),
    }


def _backlash(known: Known) -> dict[str, list[dict[str, Any]]]:
    """The play of the joints, where stops were approached from both sides."""
    if known.arm_model is None:
        return {}
    rows = [it.document() for it in plays_of(known.arm_model, known.arm_spread)]
    return {"backlash": rows} if rows else {}
