"""Pictures of a recording in progress: what the camera sees, and what the views cover."""

import cv2
import numpy as np

from visioncal.core.transforms import apply
from visioncal.core.types import Camera, Corners, FloatArray, Image, Mask, Target
from visioncal.vision.camera import project
from visioncal.vision.targets import closed_outline, corner_positions

# Width of the picture on the page [px]; colours in the order blue, green, red.
_WIDTH = 960
_SEEN, _WANTED = (60, 200, 60), (0, 150, 255)


def live_picture(
    image: Image, target: Target, corners: Corners | None, lens: Camera, wanted: FloatArray | None
) -> bytes:
    """Draws found corners and the wanted place of the board into a picture.

    Args:
        image: (h, w) grey or (h, w, 3) blue, green, red.
        target: The board.
        corners: Corners found in it; None for none.
        lens: Intrinsics for the wanted place; rough ones are enough.
        wanted: (4, 4) `cam_from_target` of the next view [m]; None for none.

    Returns:
        A JPEG. The board's first corner is a ring, so that a turned board is noticed.
    """
    scale = min(1.0, _WIDTH / image.shape[1])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    drawn = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR) if small.ndim == 2 else small
    if wanted is not None:
        points = np.vstack([closed_outline(target, 8), corner_positions(target)[:1]])
        px = scale * project(lens, apply(wanted, points))
        if np.isfinite(px).all() and np.abs(px).max() < 20 * _WIDTH:
            *line, first = np.rint(px).astype(int)
            cv2.polylines(drawn, [np.array(line)], isClosed=False, color=_WANTED, thickness=3)
            cv2.circle(drawn, first.tolist(), 9, _WANTED, 3)
    if corners is not None:
        for number, place in zip(corners.ids, scale * corners.px, strict=True):
            centre = np.rint(place).astype(int).tolist()
            is_first = number == 0
            cv2.circle(drawn, centre, 9 if is_first else 3, _SEEN, 3 if is_first else -1)
    return cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()


def coverage_svg(covered: Mask, poses: list[FloatArray]) -> str:
    """Draws the covered parts of the image, and the tilts of the board, as SVG.

    Args:
        covered: (rows, columns) parts of the image in which the board was.
        poses: (4, 4) `cam_from_target` of the views [m].
    """
    rows, columns = covered.shape
    parts = [
        f'<rect x="{20 * x}" y="{20 * y}" width="19" height="19" '
        f'fill="{"#3cc83c" if covered[y, x] else "#ddd"}"/>'
        for y, x in np.ndindex(rows, columns)
    ]
    # Tilts as a pole figure: rings at 20 and 40 degrees, a dot a view.
    middle, reach = 20 * columns + 70, 20 * rows / 2
    for tilt_deg in (20.0, 40.0):
        radius = reach * tilt_deg / 45.0
        parts.append(
            f'<circle cx="{middle}" cy="{reach}" r="{radius:.1f}" fill="none" stroke="#999"/>'
            f'<text x="{middle + radius:.1f}" y="{reach}" font-size="9">{tilt_deg:.0f}°</text>'
        )
    for pose in poses:
        x, y, along = pose[:3, 2]
        share = reach * np.rad2deg(np.arctan2(np.hypot(x, y), along)) / 45.0
        x, y = share * np.array([x, y]) / max(np.hypot(x, y), 1e-9)
        parts.append(f'<circle cx="{middle + x:.1f}" cy="{reach + y:.1f}" r="4" fill="#3cc83c"/>')
    size = f'width="{20 * columns + 150}" height="{20 * rows}"'
    return f'<svg role="img" aria-label="coverage" {size}>{"".join(parts)}</svg>'
