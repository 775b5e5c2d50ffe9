"""Single images that were turned or mirrored, beside others that were not.

Such an image is of another lens than the others and of a pose that the robot did not take; but its
corners, carried back, lie where the robot and the board predict them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray

# Corners lie where they are predicted within so many times what those of most views are off by.
_NEAR = 5.0
# Detectors are no better [px].
_LEAST_PX = 0.05
# Corners that lie anywhere amid the predicted ones are 0.4 of their spacing off the nearest.
_OF_SPACING = 0.15


@dataclass(frozen=True)
class ImageTurn:
    """How an image was changed.

    Attributes:
        words: What was done to it.
        option: Of ImageMagick, which undoes it.
    """

    words: str
    option: str


_Carried = Callable[[FloatArray, int, int], FloatArray]
_HALF = ImageTurn("turned by 180 deg", "-rotate 180")
_LEFT = ImageTurn("turned by 90 deg counterclockwise", "-rotate 90")
_RIGHT = ImageTurn("turned by 90 deg clockwise", "-rotate 270")
_FLOPPED = ImageTurn("mirrored left to right", "-flop")
_FLIPPED = ImageTurn("mirrored upside down", "-flip")
# Where corners (n, 2) lie once it is undone, in images of a width and a height [px].
_UNDONE: Mapping[ImageTurn, _Carried] = {
    _HALF: lambda px, width, height: np.array([width - 1, height - 1]) - px,
    _FLOPPED: lambda px, width, _: np.array([width - 1, 0]) + np.array([-1, 1]) * px,
    _FLIPPED: lambda px, _, height: np.array([0, height - 1]) + np.array([1, -1]) * px,
}
# Only square images keep their size.
_QUARTERS: Mapping[ImageTurn, _Carried] = {
    _LEFT: lambda px, _, height: np.stack([height - 1 - px[:, 1], px[:, 0]], axis=1),
    _RIGHT: lambda px, width, _: np.stack([px[:, 1], width - 1 - px[:, 0]], axis=1),
}


def turned_how(
    px: FloatArray, predicted_px: FloatArray, size: tuple[int, int], typical_px: float
) -> ImageTurn | None:
    """Says how the image of a view that disagrees was turned or mirrored.

    Corners are compared with the nearest predicted one: a checkerboard's are numbered otherwise in
    a mirror, and one that looks the same upside down may be numbered from either end.

    Args:
        px: (n, 2) its corners [px].
        predicted_px: (m, 2) all of the target's, as robot and board predict them [px].
        size: Width and height of the image [px].
        typical_px: What corners of views that agree are off by (rms) [px].

    Returns:
        It; None where the corners are where they are predicted, or nothing brings them there.
    """
    known = predicted_px[np.isfinite(predicted_px).all(axis=1)]
    limit_px = min(_NEAR * max(typical_px, _LEAST_PX), _OF_SPACING * _spacing_px(known))
    if not len(known) or _away_px(px, known) < limit_px:
        return None
    undone = {**_UNDONE, **(_QUARTERS if size[0] == size[1] else {})}
    how = min(undone, key=lambda index: _away_px(undone[index](px, *size), known))
    return how if _away_px(undone[how](px, *size), known) < limit_px else None


def _spacing_px(places: FloatArray) -> float:
    """How far places are from the nearest other one (median) [px]; infinite of one alone."""
    if len(places) < 2:
        return np.inf
    squares = np.sum((places[:, None] - places) ** 2, axis=2)
    np.fill_diagonal(squares, np.inf)
    return float(np.sqrt(np.median(squares.min(axis=1))))


def _away_px(px: FloatArray, places: FloatArray) -> float:
    """How far points are from the nearest of some places (rms) [px]."""
    squares = np.sum((px[:, None] - places) ** 2, axis=2).min(axis=1)
    return float(np.sqrt(squares.mean()))
