"""Figures that recording and report show alike."""

from collections.abc import Iterable

import numpy as np

from visioncal.calibration import ViewEvidence
from visioncal.transforms import invert, rotation_angle
from visioncal.types import FloatArray

_STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
# Residuals of ordinary size are drawn about this share of the image's width long.
_SHARE = 0.02


def magnification(evidence: Iterable[ViewEvidence], image_width: int) -> int:
    """Chooses a round factor that makes residuals visible in an image.

    Args:
        evidence: The views that are drawn with this factor; those without predictions count not.
        image_width: Width of their images [px].

    Returns:
        The factor, such that the root mean square residual is drawn at most a fiftieth of the
        image's width long.
    """
    errors = [
        it.predicted_px - it.corners.px
        for it in evidence
        if it.corners is not None and it.predicted_px is not None
    ]
    if not errors or image_width <= 0:
        return 1
    squared_px2 = float(np.mean(np.sum(np.concatenate(errors) ** 2, axis=1)))
    if not squared_px2 > 0.0:
        return 1
    wanted = _SHARE * image_width / np.sqrt(squared_px2)
    return max((step for step in _STEPS if step <= wanted), default=1)


def pose_difference(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Distance between the origins [mm] and angle [deg] of two (4, 4) poses in one frame."""
    between = invert(a) @ b
    return 1e3 * float(np.linalg.norm(between[:3, 3])), float(np.rad2deg(rotation_angle(between)))
