"""The springs of a calibrated arm: what loads can tell, what they do, and how that is written."""

from dataclasses import replace
from typing import Any

from visioncal.pipeline.arm import arm_data
from visioncal.pipeline.known import Known
from visioncal.stages import backlash, elastic
from visioncal.stages.backlash import plays_of
from visioncal.stages.elastic import Elastic, springs_of
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
    found, seen = known.kinematics, arm_data(known)
    return None if found is None or seen is None else springs_of(seen, found.errors)


def elastic_document(known: Known) -> dict[str, Any] | None:
    """Writes the springs; None where the level is a rigid one."""
    return (
        None if known.elastic is None else known.elastic.document(known.first_of_stops(known.used))
    )
