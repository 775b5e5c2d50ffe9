"""Multi-threaded target detection in images, with a reason for each view that is rejected.

Corners that another detector found (corners.csv) are used as they are.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from threading import Condition

import cv2
import numpy as np

from visioncal.calibration.stages.corner_numbers import (
    OTHER_NUMBERS,
    check_axes,
    check_extent,
    check_numbers,
)
from visioncal.calibration.stages.image_size import other_size_step
from visioncal.core.errors import DataError
from visioncal.core.limits import MAX_BLUR_PX
from visioncal.core.threads import SharedSetting
from visioncal.core.types import Corners, Image, IntArray, Progress, Rejection, Searched, Target
from visioncal.estimation.poses import determines_pose
from visioncal.session import Session, View
from visioncal.session.kinds import name_of
from visioncal.vision.boards import DetectedCorners, NotFound, find_target, kind_of
from visioncal.vision.boards.aprilgrid import LACKS_SQUARES, free_tags_step
from visioncal.vision.boards.identify import identify
from visioncal.vision.boards.imaging import (
    MOST_PIXELS,
    blur_at_corners,
    claimed_size,
    decode_image,
    faint_jpeg,
    poor_image_reason,
)
from visioncal.vision.targets import corner_positions, point_numbers

# Fewest corners of corners.csv: a homography takes four points.
_FEWEST_GIVEN = 4
# Share of the image's size by which corners of corners.csv may lie outside of it.
_OUTSIDE = 0.1
# Number of images with corners that show the printed layout, or how they were turned; and the
# number of images searched for them.
_LAYOUT_SAMPLE, _MOST_SEARCHED = 3, 12


@dataclass(frozen=True, eq=False)
class Detections:
    """Detected corners by view, in the session's order, and rejected views."""

    corners: Mapping[int, Corners]
    rejections: tuple[Rejection, ...]
    resolution: tuple[int, int]  # The camera's (width, height) [px].
    # The (width, height) of images of another size, by view [px].
    other_sizes: Mapping[int, tuple[int, int]]
    searches: Mapping[int, Searched]  # What was found in each image, by view.


class _MemoryBudget:
    """Limit on the image data that threads hold at once, in shares of the largest image."""

    def __init__(self) -> None:
        self._left = 1.0
        self._changed = Condition()

    @contextmanager
    def taken(self, share: float) -> Iterator[None]:
        """Takes a share once it is free; one above all of the budget waits to be alone."""
        share = min(max(share, 0.0), 1.0)
        with self._changed:
            # Shares add up to one but for rounding.
            self._changed.wait_for(lambda: self._left >= share - 1e-9)
            self._left -= share
        try:
            yield
        finally:
            with self._changed:
                self._left += share
                self._changed.notify_all()


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
    stated = _stated_resolution(session, among)
    searches: list[Searched] = []
    others = {board for board in session.boards if _shows_another(session, board, views)}
    budget = _MemoryBudget()
    with ONE_OPENCV_THREAD.held(), ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:

        def search_view(view: View) -> Searched:
            quick = session.board_of(view) in others
            return _search(session, view, stated, budget, quick=quick, picture=pictures)

        for search in pool.map(search_view, views):
            searches.append(search)
            if progress is not None:
                progress("detect", len(searches), len(views))
    found = {view.number: search for view, search in zip(views, searches, strict=True)}
    given = [view for view in among if view.has_corners]
    resolution = _common_resolution(session, views, searches, given, stated)
    sizes = {view.number: search.size for view, search in zip(views, searches, strict=True)}
    pairs = zip(searches, views, strict=True)
    searches = [_checked_size(search, view, resolution) for search, view in pairs]
    for name in session.boards:
        _check_layout(session, name, views, searches)
    detected = {view.number: search.found for view, search in zip(views, searches, strict=True)}
    check_axes(
        [(session.corners[view.number], session.boards[session.board_of(view)]) for view in given],
        resolution,
    )
    check_extent(
        [session.corners[view.number] for view in given],
        resolution,
        _size_of_first(session, given),
        [camera.size for camera in session.cameras.values() if camera.size is not None],
    )
    imported = {view.number: _imported(session, view, resolution) for view in given}
    for name, target in session.boards.items():
        mine = [imported[view.number] for view in given if session.board_of(view) == name]
        several = name if len(session.boards) > 1 else ""
        wrong = check_numbers(
            [corners for corners in mine if isinstance(corners, Corners)], target, several
        )
        imported |= {view: Rejection(view, OTHER_NUMBERS) for view in wrong}
    detected |= imported
    results = [detected[view.number] for view in among if view.number in detected]
    return Detections(
        {corners.view: corners for corners in results if isinstance(corners, Corners)},
        tuple(corners for corners in results if isinstance(corners, Rejection)),
        resolution,
        {view: size for view, size in sizes.items() if size not in (None, resolution)},
        found,
    )


def _shows_another(session: Session, name: str, views: Sequence[View]) -> bool:
    """Whether images clearly show another board than the declared checkerboard."""
    # A thorough search for an absent board takes seconds an image, and is skipped where all images
    # of a sample show another board.
    target = session.boards[name]
    if kind_of(target).symmetric != "squares":
        return False
    mine = [view for view in views if session.board_of(view) == name]
    sample = mine[:: max(len(mine) // _LAYOUT_SAMPLE, 1)][:_LAYOUT_SAMPLE]
    for view in sample:
        image = image_of(session, view)
        if isinstance(image, Rejection):
            return False
        if isinstance(find_target(image, target, quick=True), DetectedCorners):
            return False
        miscounted = kind_of(target).miscounted(image, target)
        if miscounted is None and not _shows_markers_alone(image, target):
            return False
    return bool(sample)


def _shows_markers_alone(image: Image, target: Target) -> bool:
    """Whether an image shows a board with markers, and not the declared one beside it."""
    try:
        identity = identify(image)
    except DataError:
        return False
    is_marked = not identity.is_single and identity.corners_seen > 0
    return is_marked and isinstance(find_target(image, target), NotFound)


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
    if not session.images.exists(view.image):
        return Rejection(view.number, f"{view.image} {session.images.absence(view.image)}")
    return _decoded(view, session.images.read(view.image))


def _decoded(view: View, data: bytes) -> Image | Rejection:
    image = decode_image(data)
    return Rejection(view.number, f"{view.image} is {image}") if isinstance(image, str) else image


def _search(
    session: Session,
    view: View,
    stated: tuple[int, int] | None,
    budget: _MemoryBudget,
    *,
    quick: bool,
    picture: bool,
) -> Searched:
    """Searches the image of one view, or takes what was found in it before."""
    name = session.board_of(view)
    earlier = session.images.search_of(view.image, name)
    if earlier is not None:
        return replace(earlier, found=replace(earlier.found, view=view.number))
    absence = session.images.absence(view.image)
    if absence:
        return Searched(Rejection(view.number, f"{view.image} {absence}"), None)
    target = session.boards[name]
    data = session.images.read(view.image)
    size = claimed_size(data) or (0, 0)
    pixels = size[0] * size[1]
    if stated not in (None, size) and 0 < pixels <= MOST_PIXELS:
        # It is refused in any case, and need not be searched.
        return Searched(Rejection(view.number, f"{view.image} is of another size"), size)
    with budget.taken(pixels / kind_of(target).most_pixels):
        image = _decoded(view, data)
        if isinstance(image, Rejection):
            return Searched(image, None)
        found, misfit = find_corners(image, target, view.number, quick=quick, name=name)
        faint = faint_jpeg(image) if picture else None
    return Searched(found, (image.shape[1], image.shape[0]), misfit, faint)


def corners_in(
    image: Image, target: Target, view: int = 0, *, quick: bool = False
) -> Corners | NotFound:
    """Finds a target's corners in an (h, w) grey image, with their blur; see `find_target`."""
    seen = find_target(image, target, quick=quick)
    if isinstance(seen, NotFound):
        return seen
    blur = blur_at_corners(image, seen.px) if seen.blur_px is None else seen.blur_px
    return Corners(view, seen.ids, seen.px, blur, seen.weights)


def find_corners(
    image: Image, target: Target, view: int, *, quick: bool = False, name: str = ""
) -> tuple[Corners | Rejection, bool]:
    """Finds a target in one image.

    Args:
        image: (h, w) grey image.
        target: The target.
        view: The view's number.
        quick: Whether to stop where a first, quick search fails.
        name: Name of the target in the session, where it has several.

    Returns:
        The corners, or why the view is rejected; and whether markers were seen in another layout
        than the target's.
    """
    seen = corners_in(image, target, view, quick=quick)
    if isinstance(seen, NotFound):
        cause = poor_image_reason(image, MAX_BLUR_PX)
        reason = f"{seen.reason}; {cause}" if cause else seen.reason
        reason = f"{reason} (looked for target {name})" if name else reason
        return Rejection(view, reason), seen.misfit
    reason = _why_unusable(target, seen.ids, seen.blur_px)
    return (Rejection(view, reason) if reason else seen), False


def _imported(session: Session, view: View, resolution: tuple[int, int]) -> Corners | Rejection:
    """A view's corners of corners.csv, or why they are not usable."""
    corners, target = session.corners[view.number], session.boards[session.board_of(view)]
    positions = corner_positions(target)
    size = np.array(resolution)
    outside = np.any((corners.px < -_OUTSIDE * size) | (corners.px > (1 + _OUTSIDE) * size), axis=1)
    reason = ""
    if outside.any():
        at = int(np.argmax(outside))
        u_px, v_px = corners.px[at].tolist()
        reason = (
            f"corners.csv: point {point_numbers(target)[corners.ids[at]]} at ({u_px:g}, "
            f"{v_px:g}) px lies far outside the image of {size[0]} x {size[1]} px"
        )
    elif len(corners.ids) < _FEWEST_GIVEN:
        reason = (
            f"too few corners: corners.csv has {len(corners.ids)} of {len(positions)}, needs "
            f"{_FEWEST_GIVEN}"
        )
    elif not determines_pose(positions[corners.ids]):
        reason = f"corners on one line: all {len(corners.ids)} of corners.csv, or all but one"
    return Rejection(view.number, reason) if reason else corners


def _why_unusable(target: Target, ids: IntArray, blur_px: float) -> str:
    positions = corner_positions(target)
    needed = min(kind_of(target).fewest, len(positions))
    if len(ids) < needed:
        return f"too few corners: {len(ids)} of {len(positions)}, needs {needed}"
    if not determines_pose(positions[ids]):
        return f"corners on one line: all {len(ids)}, or all but one, lie in one row of the board"
    if blur_px > MAX_BLUR_PX:
        return f"blurred: edges are {blur_px:.1f} px wide (limit {MAX_BLUR_PX:.1f})"
    return ""


def _common_resolution(
    session: Session,
    views: Sequence[View],
    searches: Sequence[Searched],
    given: Sequence[View],
    stated: tuple[int, int] | None,
) -> tuple[int, int]:
    """Stated or most common size of the images; checks that more than half of them have it."""
    sizes = [search.size for search in searches if search.size is not None]
    if not sizes and given:
        if stated is None:
            raise DataError(
                f"session {session.name!r}: the camera's resolution is missing, and no image that "
                "is searched shows it.",
                culprits=["session.toml: camera.resolution"],
                next_step="Add resolution = [width, height] to [camera]: the size of the images "
                "in which the corners were found.",
            )
        return stated
    if not sizes:
        rejections = _rejections(searches)
        reasons = [f"view {rejection.view}: {rejection.reason}" for rejection in rejections]
        raise DataError(
            f"session {session.name!r}: none of its {len(views)} images can be read.",
            culprits=reasons,
            next_step=f"First: {reasons[0]}." if reasons else "Give the views images.",
        )
    wanted = stated or max(set(sizes), key=sizes.count)
    line_of = {view.number: line for line, view in enumerate(session.views, start=2)}
    culprits = [
        f"views.csv line {line_of[view.number]}, column image: {view.image} is "
        f"{search.size[0]} x {search.size[1]} px"
        for view, search in zip(views, searches, strict=True)
        if search.size is not None and search.size != wanted
    ]
    if len(culprits) == len(sizes) and len(set(sizes)) == 1:
        raise _other_size_error(session, views, sizes[0], wanted, culprits)
    if 2 * len(culprits) >= len(sizes):
        source = "the camera's resolution is" if stated else "most other images are"
        raise DataError(
            f"{culprits[0]}, but {source} {wanted[0]} x {wanted[1]} px"
            + (f" ({len(culprits)} images in all)." if len(culprits) > 1 else "."),
            culprits=culprits,
            next_step="Correct [camera] resolution in session.toml, or take out these views.",
        )
    return wanted


def _checked_size(search: Searched, view: View, resolution: tuple[int, int]) -> Searched:
    """The search of an image; a rejection where it has another size than the camera's."""
    if search.size in (None, resolution):
        return search
    (width, height), (wide, high) = search.size, resolution
    words = f"{view.image} is {width} x {height} px, and the camera's images are {wide} x {high}"
    return Searched(Rejection(view.number, words), None)


def _other_size_error(
    session: Session,
    views: Sequence[View],
    size: tuple[int, int],
    stated: tuple[int, int],
    culprits: Sequence[str],
) -> DataError:
    """Error where all images have one other size than the camera's."""
    mine = name_of(session.declaration, "camera", views[0])
    camera = session.cameras[mine]
    words, step = "", f"In session.toml, write resolution = [{size[0]}, {size[1]}]"
    other = next((name for name, at in session.cameras.items() if at.size == size), None)
    if other is not None:
        words = f"that is the size of camera {other}'s"
        step = (
            f"Where {mine} and {other} are exchanged in the column camera of views.csv, exchange "
            f"them there; where they are not, write resolution = [{size[0]}, {size[1]}] of {mine} "
            "in session.toml"
        )
    elif camera.stated is not None:
        name = session.board_of(views[0])
        seen = _sample(session, views, name) if size == stated[::-1] else {}
        words, step = other_size_step(camera.stated, size, seen, session.boards[name])
    return DataError(
        f"All {len(culprits)} images are {size[0]} x {size[1]} px, but session.toml has "
        f"resolution = [{stated[0]}, {stated[1]}]{words and f': {words}'}.",
        culprits=culprits,
        next_step=f"{step}.",
    )


def _sample(session: Session, views: Sequence[View], name: str) -> dict[int, Corners]:
    """The corners of a few views that show a board."""
    sample: dict[int, Corners] = {}
    for view in [view for view in views if session.board_of(view) == name][:_MOST_SEARCHED]:
        image = image_of(session, view)
        if isinstance(image, Rejection):
            continue
        corners, _ = find_corners(image, session.boards[name], view.number)
        if isinstance(corners, Corners):
            sample[view.number] = corners
        if len(sample) == _LAYOUT_SAMPLE:
            break
    return sample


def _size_of_first(session: Session, views: Sequence[View]) -> tuple[int, int] | None:
    """Width and height of the first image of some views; None without one."""
    for view in views:
        if view.image and session.images.exists(view.image):
            return claimed_size(session.images.read(view.image))
    return None


def _stated_resolution(session: Session, views: Sequence[View]) -> tuple[int, int] | None:
    """Stated size of the images of some views; None without one."""
    names = {name_of(session.declaration, "camera", view) for view in views}
    sizes = {session.cameras[name].size for name in names & session.cameras.keys()} - {None}
    return sizes.pop() if len(sizes) == 1 else None


def _rejections(searches: Sequence[Searched]) -> list[Rejection]:
    return [search.found for search in searches if isinstance(search.found, Rejection)]


def _check_layout(
    session: Session, name: str, views: Sequence[View], searches: Sequence[Searched]
) -> None:
    """Refuses a board whose markers have another layout than declared in most views of it."""
    target, board_of = session.boards[name], session.board_of
    mine = [pair for pair in zip(views, searches, strict=True) if board_of(pair[0]) == name]
    misfits = [view for view, search in mine if search.misfit]
    shown = sum(isinstance(search.found, Corners) for _, search in mine)
    if not misfits or len(misfits) <= shown:
        return
    culprits = [f"view {misfit.number}" for misfit in misfits]
    if not kind_of(target).marks_squares:
        wrong = _rejections([search for _, search in mine if search.misfit])
        reasons = [rejection.reason for rejection in wrong]
        usual = max(set(reasons), key=reasons.count)
        raise DataError(
            f"target {target.name!r}: in {len(misfits)} of {len(misfits) + shown} views another "
            f"board is seen: {usual}.",
            culprits=culprits,
            next_step=free_tags_step(target)
            if usual.startswith(LACKS_SQUARES)
            else "Mend the target's .toml, or name another: visioncal target check IMAGE says what "
            "is printed.",
        )
    images = [
        decode_image(session.images.read(misfit.image)) for misfit in misfits[:_LAYOUT_SAMPLE]
    ]
    layouts = kind_of(target).variants
    fitting = [layouts(image, target) for image in images if not isinstance(image, str)]
    common = [layout for layout in fitting[0] if all(layout in others for others in fitting)]
    seen = (
        f"target {target.name!r}: in {len(misfits)} of {len(misfits) + shown} views the markers do "
        f"not lie as on a ChArUco board of {target.columns} x {target.rows} squares with "
        f"legacy = {str(target.legacy).lower()}"
    )
    if not common:
        raise DataError(
            f"{seen}, nor with columns and rows exchanged or in the other layout.",
            culprits=culprits,
            next_step="Count the squares on the print and check the dictionary.",
        )
    best = common[0]
    changes = [
        f"{name} = {str(value).lower()}"
        for name, value in (("columns", best.columns), ("rows", best.rows), ("legacy", best.legacy))
        if value != getattr(target, name)
    ]
    raise DataError(
        f"{seen}; they fit {', '.join(changes)}.",
        culprits=culprits,
        next_step=f"Set {', '.join(changes)} in the target's .toml.",
    )
