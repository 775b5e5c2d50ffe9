"""Postures of simulated arms that an operator would choose."""

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, Mask
from visioncal.simulation.arms import DhArm, inverse, link_frames

# Smallest dexterity at which a posture is far enough from a singularity.
LEAST_DEXTERITY = 0.04


def home_posture(arm: DhArm, base_from_flange: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(n,) most dexterous posture at one pose (1, 4, 4), from which all views start."""
    starts = rng.uniform(-np.pi, np.pi, size=(64, arm.a.size))
    reach = inverse(arm, np.tile(base_from_flange, (64, 1, 1)), starts)
    elbow_up = link_frames(arm, reach.joints)[:, 2, 2, 3] > arm.d[0]
    merit = np.where(reach.solved & elbow_up, reach.dexterity, 0.0)
    if not merit.any():
        raise DataError(
            f"simulation: the {arm.name} cannot reach the middle of the views.",
            next_step="Take another working distance, board or robot.",
        )
    best = reach.joints[np.argmax(merit)]
    # All joints within half a turn.
    return np.asarray((best + np.pi) % (2.0 * np.pi) - np.pi)


def reachable_postures(
    arm: DhArm, base_from_flange: FloatArray, starts: FloatArray, floor_m: float
) -> tuple[FloatArray, Mask]:
    """(m, n) postures [rad] at (m, 4, 4) poses, and (m,) mask of acceptable ones.

    The search starts at (m, n) postures [rad]; links must stay above the floor.
    """
    reach = inverse(arm, base_from_flange, starts)
    good = reach.solved & (reach.dexterity > LEAST_DEXTERITY)
    return reach.joints, np.asarray(good & (lowest_m(arm, reach.joints) > floor_m))


def lowest_m(arm: DhArm, joints: FloatArray) -> FloatArray:
    """(m,) height of the lowest of elbow, wrists and flange over the base [m]."""
    return np.asarray(link_frames(arm, joints)[:, 2:, 2, 3].min(axis=1))
