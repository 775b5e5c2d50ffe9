"""Small pictures of views with detected and predicted corners."""

import base64
from dataclasses import dataclass

import cv2
import numpy as np

from visioncal.core.types import Image
from visioncal.results.evidence import ViewEvidence


@dataclass(frozen=True)
class Thumbnail:
    """A picture with its overlay, in the full image's pixel coordinates."""

    view: int  # The view's number.
    caption: str  # Text below it.
    jpeg_uri: str  # The picture as a data URI.
    left: float  # Image x of the left edge [px]; pixel centres are at integers.
    top: float  # Image y of the upper edge [px].
    width: float  # Width [px].
    height: float  # Height [px].
    corners: tuple[tuple[float, ...], ...] = ()  # (n, 2) detected corners [px].
    # (n, 4) arrows from detected corners towards their predictions, magnified: x, y of both ends.
    residuals: tuple[tuple[float, ...], ...] = ()

    @property
    def mark(self) -> float:
        """Radius of a corner's circle [px]."""
        return self.width / 130.0


def thumbnail(
    pixels: Image, evidence: ViewEvidence | None, caption: str, view: int, magnify: int
) -> Thumbnail:
    """Draws one view, cropped to the target where corners were found.

    Args:
        pixels: (h, w, 3) the image.
        evidence: Evidence of the view, if any.
        caption: Text below it.
        view: The view's number.
        magnify: Magnification of the residuals.
    """
    corners = None if evidence is None else evidence.corners
    if evidence is None or corners is None or len(corners.px) == 0:
        height, width = pixels.shape[:2]
        return Thumbnail(view, caption, _jpeg_uri(pixels), -0.5, -0.5, width, height)
    px, predicted_px = corners.px, evidence.predicted_px
    # The crop has the image's proportions.
    full, low, high = np.array(pixels.shape[1::-1]), px.min(axis=0), px.max(axis=0)
    share = min(1.0, 1.25 * float(np.max((high - low) / full)) + 0.05)
    size = np.maximum(np.round(share * full), 1.0)
    start = np.clip(np.round(0.5 * (low + high - size)), 0.0, full - size)
    left, top, right, bottom = np.concatenate([start, start + size]).astype(int).tolist()
    tips = np.zeros((0, 2)) if predicted_px is None else px + magnify * (predicted_px - px)
    arrows = np.hstack([px[: len(tips)], tips])
    corner_rows, arrow_rows = (tuple(map(tuple, xy.round(2).tolist())) for xy in (px, arrows))
    picture = _jpeg_uri(pixels[top:bottom, left:right])
    return Thumbnail(
        view,
        caption,
        picture,
        left - 0.5,
        top - 0.5,
        right - left,
        bottom - top,
        corner_rows,
        arrow_rows,
    )


def _jpeg_uri(image: Image) -> str:
    scale = min(1.0, 720 / image.shape[1])
    height, width = image.shape[:2]
    # A line scan of one row keeps a row, and a JPEG has no longer side.
    size = [min(max(round(scale * side), 1), 65_500) for side in (width, height)]
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    encoded = bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 78])[1])
    return "data:image/jpeg;base64," + base64.b64encode(encoded).decode("ascii")
