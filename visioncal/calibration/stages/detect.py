"""Detection of targets in images by several threads, with a reason for each rejected view.

Corners that another detector found (corners.csv) are used as they are.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from threading import Lock

import cv2

from visioncal.calibration.stages.corner_numbers import usable_corners
from visioncal.calibration.stages.image_size import Size, common_size, stated_size
from visioncal.core.errors import DataError
from visioncal.core.limits import MAX_BLUR_PX
from visioncal.core.threads import SharedSetting
from visioncal.core.types import Corners, Image, Progress, Rejection, Searched, Target
from visioncal.estimation.poses import determines_pose
from visioncal.session import Session, View
from visioncal.vision.boards import NotFound, find_target, kind_of
from visioncal.vision.boards.aprilgrid import LACKS_SQUARES, free_tags_step
from visioncal.vision.boards.imaging import (
    MOST_PIXELS,
    blur_at_corners,
    claimed_size,
    decode_image,
    faint_jpeg,
    poor_image_reason,
)
from visioncal.vision.targets import corner_positions

# Number of images that show the printed layout.
_LAYOUT_SAMPLE = 3
# Share of the largest image from which on images are searched one at a time, as they fill memory.
_LARGE, _ALONE = 0.25, Lock()


@dataclass(frozen=True, eq=False)
class Detections:
    """Detected corners by view, in the session's order, and rejected views."""

    corners: Mapping[int, Corners]
    rejections: tuple[Rejection, ...]
    resolution: Size  # The camera's (width, height) [px].
    # The (width, height) of images of another size, by view [px].
    other_sizes: Mapping[int, Size]
    searches: Mapping[int, Searched]  # What was found in each image, by view.


def detect(
    session: Session,
    progress: Progress | None = None,
    *,
    among: Sequence[View] | None = None,
    threads: int = 0,
    pictures: bool = False,
) -> Detections:
    """Finds the declared target in each image of a session.

    Args:
        session: A session with a target; views without images or corners are skipped.
        progress: Called after each image.
        among: The views to search; None for all.
        threads: Number of parallel images; 0 for one a core.
        pictures: Whether faint copies of the images are kept, to look at.

    Returns:
        The corners and the rejected views.

    Raises:
        DataError: No view shows the target, half of the images or more have another size than the
            camera, the size of the images is unknown, or the printed board has another layout than
            the declared one.
    """
    if not session.boards:
        raise DataError("session: images need a target.", next_step="Name one in session.toml.")
    among = session.views if among is None else among
    views = [view for view in among if view.image and not view.has_corners]
    given = [view for view in among if view.has_corners]
    stated, found = stated_size(session, among), dict[int, Searched]()

    def search(view: View) -> Searched:
        return _search(session, view, stated, picture=pictures)

    with ONE_OPENCV_THREAD.held(), ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        for view, searched in zip(views, pool.map(search, views), strict=True):
            found[view.number] = searched
            if progress is not None:
                progress("detect", len(found), len(views))
    sizes = {view: searched.size for view, searched in found.items() if searched.size is not None}
    if sizes:
        resolution = common_size(session, views, sizes)
    elif given and stated is not None:
        resolution = stated
    else:
        raise _no_size(session, found)
    other_sizes = {view: size for view, size in sizes.items() if size != resolution}
    wide, high = resolution
    sized = found | {
        view.number: Searched(
            Rejection(
                view.number,
                f"{view.image} is {width} x {height} px, and the camera's images are {wide} x "
                f"{high}",
            ),
            None,
        )
        for view in views
        if view.number in other_sizes
        for width, height in [other_sizes[view.number]]
    }
    for name in session.boards:
        mine = [view for view in views if session.board_of(view) == name]
        _check_layout(session, name, {view: sized[view.number] for view in mine})
    detected = {view: searched.found for view, searched in sized.items()}
    detected |= usable_corners(session, given, resolution)
    results = [detected[view.number] for view in among if view.number in detected]
    return Detections(
        {corners.view: corners for corners in results if isinstance(corners, Corners)},
        tuple(corners for corners in results if isinstance(corners, Rejection)),
        resolution,
        other_sizes,
        found,
    )


def _no_size(session: Session, found: Mapping[int, Searched]) -> DataError:
    """The error where neither images nor the session show the size of images."""
    reasons = [
        f"view {view}: {searched.found.reason}"
        for view, searched in found.items()
        if isinstance(searched.found, Rejection)
    ]
    name = f"session {session.name!r}"
    if reasons:
        words, step = f"none of its {len(found)} images can be read.", f"First: {reasons[0]}."
        return DataError(f"{name}: {words}", culprits=reasons, next_step=step)
    return DataError(
        f"{name}: the camera's resolution is missing, and no image that is searched shows it.",
        culprits=["session.toml: camera.resolution"],
        next_step="Add resolution = [width, height] to [camera]: the size of the images in which "
        "the corners were found.",
    )


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


def image_of(session: Session, view: View) -> Image | Rejection:
    """Reads a view's (h, w) grey image; a rejection where there is none."""
    if absence := session.images.absence(view.image):
        return Rejection(view.number, f"{view.image} {absence}")
    return _decoded(view, session.images.read(view.image))


def _decoded(view: View, data: bytes) -> Image | Rejection:
    image = decode_image(data)
    return Rejection(view.number, f"{view.image} is {image}") if isinstance(image, str) else image


def _search(session: Session, view: View, stated: Size | None, *, picture: bool) -> Searched:
    """Searches the image of one view, or takes what was found in it before."""
    name = session.board_of(view)
    earlier = session.images.search_of(view.image, name)
    if earlier is not None:
        return replace(earlier, found=replace(earlier.found, view=view.number))
    if absence := session.images.absence(view.image):
        return Searched(Rejection(view.number, f"{view.image} {absence}"), None)
    target, data = session.boards[name], session.images.read(view.image)
    size = claimed_size(data) or (0, 0)
    pixels = size[0] * size[1]
    if stated not in (None, size) and 0 < pixels <= MOST_PIXELS:
        # It is refused in any case, and need not be searched.
        return Searched(Rejection(view.number, f"{view.image} is of another size"), size)
    is_large = pixels > _LARGE * kind_of(target).most_pixels
    with _ALONE if is_large else nullcontext():
        image = _decoded(view, data)
        if isinstance(image, Rejection):
            return Searched(image, None)
        found, misfit = find_corners(image, target, view.number, name=name)
        faint = faint_jpeg(image) if picture else None
    return Searched(found, (image.shape[1], image.shape[0]), misfit, faint)


def corners_in(image: Image, target: Target, view: int = 0) -> Corners | NotFound:
    """Finds a target's corners in an (h, w) grey image, with their blur; see `find_target`."""
    seen = find_target(image, target)
    if isinstance(seen, NotFound):
        return seen
    blur = blur_at_corners(image, seen.px) if seen.blur_px is None else seen.blur_px
    return Corners(view, seen.ids, seen.px, blur, seen.weights)


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
    positions = corner_positions(target)
    needed, count = min(kind_of(target).fewest, len(positions)), len(seen.ids)
    if count < needed:
        reason = f"too few corners: {count} of {len(positions)}, needs {needed}"
    elif not determines_pose(positions[seen.ids]):
        reason = f"corners on one line: all {count}, or all but one, lie in one row of the board"
    elif seen.blur_px > MAX_BLUR_PX:
        reason = f"blurred: edges are {seen.blur_px:.1f} px wide (limit {MAX_BLUR_PX:.1f})"
    else:
        return seen, False
    return Rejection(view, reason), False


def _check_layout(session: Session, name: str, searches: Mapping[View, Searched]) -> None:
    """Refuses a board whose markers have another layout than declared in most views of it."""
    target = session.boards[name]
    misfits = {
        view: search.found.reason
        for view, search in searches.items()
        if search.misfit and isinstance(search.found, Rejection)
    }
    shown = sum(isinstance(search.found, Corners) for search in searches.values())
    if len(misfits) <= shown:
        return
    seen = f"target {target.name!r}: in {len(misfits)} of {len(misfits) + shown} views"
    if not kind_of(target).marks_squares:
        reasons = [*misfits.values()]
        usual = max(set(reasons), key=reasons.count)
        message = f"{seen} another board is seen: {usual}."
        step = "Mend the target's .toml, or name another: visioncal target check IMAGE says what "
        step = free_tags_step(target) if usual.startswith(LACKS_SQUARES) else f"{step}is printed."
    else:
        message = (
            f"{seen} the markers do not lie as on a ChArUco board of {target.columns} x "
            f"{target.rows} squares with legacy = {str(target.legacy).lower()}"
        )
        images = (image_of(session, view) for view in [*misfits][:_LAYOUT_SAMPLE])
        first, *rest = (
            kind_of(target).variants(image, target)
            for image in images
            if not isinstance(image, Rejection)
        )
        best = next((layout for layout in first if all(layout in others for others in rest)), None)
        if best is None:
            message += ", nor with columns and rows exchanged or in the other layout."
            step = "Count the squares on the print and check the dictionary."
        else:
            changes = ", ".join(
                f"{key} = {str(getattr(best, key)).lower()}"
                for key in ("columns", "rows", "legacy")
                if getattr(best, key) != getattr(target, key)
            )
            message += f"; they fit {changes}."
            step = f"Set {changes} in the target's .toml."
    raise DataError(message, culprits=[f"view {view.number}" for view in misfits], next_step=step)
