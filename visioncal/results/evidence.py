"""What was seen and computed of each view, for the report and the recording."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import Corners, FloatArray

_STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
# Residuals of ordinary size are drawn about this share of the image's width long.
_SHARE = 0.02


@dataclass(frozen=True, eq=False)
class ExplainedImage:
    """How far a calibration, with blur and light as measured, explains an image.

    Attributes:
        drawn: The image with the board as it should look in its place, as JPEG.
        rest: What that leaves of the image, magnified, about a middle grey, as JPEG.
        words: What blurs the image, and how much is left, in Markdown.
    """

    drawn: bytes
    rest: bytes
    words: str


@dataclass(frozen=True, eq=False)
class ViewEvidence:
    """What was seen and computed of one view, for the report and the recording.

    Attributes:
        view: The view's number.
        corners: The corners that were found, if any.
        predicted_px: (n, 2) where the calibrated chain puts these corners [px].
        base_from_flange: (4, 4) as the controller reported it, or as the calibrated arm has it
            where there is one.
        cam_from_target: (4, 4) as this view alone shows it.
        explained: How far its image is explained, where that was looked at; it is drawn, and not
            read back.
    """

    view: int
    corners: Corners | None = None
    predicted_px: FloatArray | None = None
    base_from_flange: FloatArray | None = None
    cam_from_target: FloatArray | None = None
    explained: ExplainedImage | None = None


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
        view.predicted_px - view.corners.px
        for view in evidence
        if view.corners is not None and view.predicted_px is not None
    ]
    if not errors or image_width <= 0:
        return 1
    squared_px2 = float(np.mean(np.sum(np.concatenate(errors) ** 2, axis=1)))
    if not squared_px2 > 0.0:
        return 1
    wanted = _SHARE * image_width / np.sqrt(squared_px2)
    return max((step for step in _STEPS if step <= wanted), default=1)
