"""A cell the other way round: inverse poses with the other mount, which fit the views as well."""

from collections.abc import Iterator

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.suspects.suspect import Suspect
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.types import MOUNTS
from visioncal.core.verdict import Finding, Remedy

# What rides on a flange may be so far from it [m], also where the poses are in the board's frame.
_NEAR_M = 0.3


def _found(run: RunState) -> Iterator[Finding]:
    if run.mount not in MOUNTS:
        return
    # Where a model's poses are those of the joints, they are no inverse ones.
    matched = run.reported.matched
    if matched is not None and matched.joints_rad:
        return
    camera, target = (
        (name, float(np.linalg.norm(edge.transform.translation)))
        for name, edge in [*run.assessment.last_edges.items()][:2]
    )
    in_hand = run.mount == MOUNTS[0]
    (carried, carried_m), (placed, placed_m) = (camera, target) if in_hand else (target, camera)
    if carried_m > max(_NEAR_M, CLEAR_RATIO * placed_m):
        yield Finding(
            "mirrored_cell",
            f"By this result, {carried} is {carried_m:.2f} m away from the flange that carries it, "
            f"and {placed} only {placed_m:.2f} m from the robot's base. With inverse poses of the "
            f"robot and the mount {MOUNTS[in_hand]} the views fit just as well, and both change "
            "places.",
            Remedy(
                "Measure roughly which is right. If it is the other, convert the recording again "
                f"with --mount {MOUNTS[in_hand]} and --robot-inverse (for easy_handeye, --mount "
                "alone)."
            ),
            until_mm=0.0,
        )


MIRRORED_CELL = Suspect("mirrored_cell", _found, 1e-2)
