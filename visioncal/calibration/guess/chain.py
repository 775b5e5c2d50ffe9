"""The poses against the robot's own joints: what no camera can show.

Reported poses are `base_from_model @ FK(q) @ flange_from_tool` with two constant transforms. A
base that is turned, and an inverse that could as well be another mount, show here alone.
"""

from collections.abc import Sequence

import numpy as np

from visioncal.calibration.guess.fit import Fit, robust_fit
from visioncal.calibration.guess.hypothesis import HALF_TURN, Hypothesis
from visioncal.core.conventions import PoseNumbers
from visioncal.core.transforms import invert, pose_difference
from visioncal.core.types import FloatArray

# Nominal models differ from the controller's by a few millimetres; a half turn is far from that.
_NEAR_MM, _NEAR_DEG = 10.0, 2.0
# Poses of this many times the scatter of the others are not those of the joints.
_CLEARLY = 3.0
_FEWEST_ROWS = 4
# A reading that is right agrees with the joints within this share of the distances.
_AGREES = 0.02


def _chain_fit(hypothesis: Hypothesis, robot: PoseNumbers, chain: FloatArray) -> Fit | None:
    """Compares the poses of a reading with those of the joints."""
    poses = hypothesis.robot.poses(robot)
    there = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(chain).all(axis=(1, 2))
    if there.sum() < _FEWEST_ROWS:
        return None
    return robust_fit(invert(poses[there]), chain[there])


def by_chain(
    labels: Sequence[Hypothesis], robot: PoseNumbers, chain: FloatArray
) -> Hypothesis | None:
    """The reading, of several that close the camera's chain alike, that the joints speak for."""
    scored = [
        (fit.score, at)
        for at, label in enumerate(labels)
        if (fit := _chain_fit(label, robot, chain)) is not None
    ]
    scored.sort()
    if len(scored) < 2 or scored[1][0] < _CLEARLY * scored[0][0]:
        return None
    return labels[scored[0][1]]


def is_half_turned(hypothesis: Hypothesis, robot: PoseNumbers, chain: FloatArray) -> bool:
    """Whether the poses are in a base that is turned by 180 degrees about z against the model's.

    Universal Robots' controllers call the one base, ROS the other base_link (REP 199).
    """
    fit = _chain_fit(hypothesis, robot, chain)
    if fit is None or fit.score > _AGREES:
        return False
    away_mm, away_deg = pose_difference(HALF_TURN, fit.x)
    return away_mm < _NEAR_MM and away_deg < _NEAR_DEG
