"""Observations and predictions of each view, for report and recording."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import Corners, FloatArray


@dataclass(frozen=True, eq=False)
class ViewEvidence:
    """Observations and predictions of one view, for report and recording."""

    view: int  # The view's number.
    corners: Corners | None = None  # The detected corners, if any.
    # (n, 2) projection of these corners by the calibrated chain [px].
    predicted_px: FloatArray | None = None
    # (4, 4) as reported by the controller, or by the calibrated arm where there is one.
    base_from_flange: FloatArray | None = None
    cam_from_target: FloatArray | None = None  # (4, 4) as estimated from this view alone.
    # (n, 5) cells of its depth: their pixels in the image [px], predicted distance, measured minus
    # that, and the same after correction [m].
    depth: FloatArray | None = None


def magnification(evidence: Iterable[ViewEvidence], image_width: int) -> int:
    """Chooses a round magnification of residuals that makes them visible in an image.

    Args:
        evidence: The views to draw; those without predictions are ignored.
        image_width: Width of their images [px].

    Returns:
        A factor by which the rms residual is at most a fiftieth of the image's width long.
    """
    errors = [
        view.predicted_px - view.corners.px
        for view in evidence
        if view.corners is not None and view.predicted_px is not None
    ]
    if not errors or image_width <= 0:
        return 1
    squared_px2 = float(np.mean(np.sum(np.concatenate(errors) ** 2, axis=1)))
    if not squared_px2 > 0.0:
        return 1
    # An rms residual is drawn 2 % of the image's width long.
    wanted = 0.02 * image_width / np.sqrt(squared_px2)
    return max(
        (step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if step <= wanted), default=1
    )
