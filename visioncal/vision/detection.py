"""Detection of one target in one image, with the reason where it is not found."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2

from visioncal.core.limits import MAX_BLUR_PX
from visioncal.core.threads import SharedSetting
from visioncal.core.types import Corners, Image, Rejection, Target
from visioncal.vision.boards import NotFound, find_target, kind_of
from visioncal.vision.boards.imaging import blur_at_corners, poor_image_reason
from visioncal.vision.poses import determines_pose
from visioncal.vision.targets import corner_positions


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


# OpenCV's own threads inside these would slow both down.
ONE_OPENCV_THREAD = SharedSetting(_one_opencv_thread)


def corners_in(image: Image, target: Target, view: int = 0) -> Corners | NotFound:
    """Finds a target's corners in an (h, w) grey image, with their blur; see `find_target`."""
    seen = find_target(image, target)
    if isinstance(seen, NotFound):
        return seen
    blur = blur_at_corners(image, seen.px) if seen.blur_px is None else seen.blur_px
    return Corners(view, seen.ids, seen.px, blur, seen.weights, drawn_m=seen.drawn_m)


def find_corners(
    image: Image, target: Target, view: int, *, name: str = ""
) -> tuple[Corners | Rejection, bool]:
    """Finds a target in one image.

    Args:
        image: (h, w) grey image.
        target: The target.
        view: The view's number.
        name: Name of the target in the session, where it has several.

    Returns:
        The corners, or why the view is rejected; and whether markers were seen in another layout
        than the target's.
    """
    seen = corners_in(image, target, view)
    if isinstance(seen, NotFound):
        cause = poor_image_reason(image, MAX_BLUR_PX)
        reason = f"{seen.reason}; {cause}" if cause else seen.reason
        reason = f"{reason} (looked for target {name})" if name else reason
        return Rejection(view, reason), seen.misfit
    needed = min(kind_of(target).fewest, len(corner_positions(target)))
    reason = lack_of_corners(seen, target, needed)
    if not reason and seen.blur_px > MAX_BLUR_PX:
        reason = f"blurred: edges are {seen.blur_px:.1f} px wide (limit {MAX_BLUR_PX:.1f})"
    return (Rejection(view, reason) if reason else seen), False


def lack_of_corners(corners: Corners, target: Target, needed: int) -> str:
    """Why a view's corners determine no pose; empty where they do."""
    positions, count = corner_positions(target), len(corners.ids)
    if count < needed:
        return f"too few corners: {count} of {len(positions)}, needs {needed}"
    if not determines_pose(positions[corners.ids]):
        return f"corners on one line: all {count}, or all but one, lie in one row of the target"
    return ""
