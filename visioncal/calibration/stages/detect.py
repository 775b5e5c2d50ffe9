"""Detection of targets in images by several threads, with a reason for each rejected view.

Corners that another detector found (corners.csv) are used as they are.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import cv2
import numpy as np

from visioncal.calibration.stages.corner_numbers import usable_corners
from visioncal.calibration.stages.other_board import (
    MADE_ALIKE,
    OtherBoardError,
    board_correction,
    other_board,
    spread,
)
from visioncal.core.errors import DataError
from visioncal.core.number_format import ranges
from visioncal.core.types import Corners, Image, Progress, Rejection, Searched, Target
from visioncal.core.verdict import Finding, Remedy
from visioncal.session import Session, View
from visioncal.session.kinds import name_of
from visioncal.vision.boards import NotFound, kind_of
from visioncal.vision.boards.checkerboard import Checkerboard
from visioncal.vision.boards.identify import LOOKED_AT, LOOKED_AT_LAST
from visioncal.vision.boards.imaging import decode_image, faint_jpeg
from visioncal.vision.detection import ONE_OPENCV_THREAD, find_corners
from visioncal.vision.targets import corner_positions

Size = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Detections:
    """Detected corners by view, in the session's order, and rejected views."""

    corners: Mapping[int, Corners]
    rejections: tuple[Rejection, ...]
    resolution: Size  # The camera's (width, height) [px].
    searches: Mapping[int, Searched]  # Corners found in each image, by view.


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
        OtherBoardError: Images that are looked at, first or where none shows the target, show
            another board, or are mirrored.
        DataError: No view shows the target, more images have some other size than the camera's,
            the size of the images is unknown, or the printed board has another layout than the
            declared one.
    """
    if not session.boards:
        raise DataError("session: images need a target.", next_step="Name one in session.toml.")
    among = session.views if among is None else among
    views = [view for view in among if view.image and not view.has_corners]
    given = [view for view in among if view.has_corners]
    found = dict[int, Searched]()
    # Imported here, as it loads the library of logs, too.
    from concurrent.futures import ThreadPoolExecutor

    def search(view: View) -> Searched:
        return _search(session, view, picture=pictures)

    with ONE_OPENCV_THREAD.held(), ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        first = _looked_at_first(session, views, lambda some: [*pool.map(search, some)])
        rest = [view for view in views if view.number not in first]
        searches = chain(first.values(), pool.map(search, rest))
        order = [view for view in views if view.number in first] + rest
        for view, searched in zip(order, searches, strict=True):
            found[view.number] = searched
            if progress is not None:
                progress("detect", len(found), len(views))
    # A board without markers is identified only where all of it is in the picture: by more images.
    seen = {
        session.board_of(view) for view in views if isinstance(found[view.number].found, Corners)
    }
    for name in () if seen else session.boards:
        unseen = [view for view in views if session.board_of(view) == name]
        if len(unseen) > LOOKED_AT:
            _refuse_another(session, name, spread(unseen, LOOKED_AT_LAST))
    resolution = _resolution(session, among, found)
    sized = {view.number: _of_size(view, found[view.number], resolution) for view in views}
    for name in session.boards:
        board_views = [view for view in views if session.board_of(view) == name]
        _check_layout(
            session.boards[name], {view.number: sized[view.number] for view in board_views}
        )
    detected = {view: searched.found for view, searched in sized.items()}
    detected |= usable_corners(session, given, resolution)
    results = [detected[view.number] for view in among if view.number in detected]
    return Detections(
        {corners.view: corners for corners in results if isinstance(corners, Corners)},
        tuple(corners for corners in results if isinstance(corners, Rejection)),
        resolution,
        found,
    )


def _looked_at_first(
    session: Session, views: Sequence[View], search: Callable[[Sequence[View]], list[Searched]]
) -> dict[int, Searched]:
    """Searches a few images of each board, and refuses where they show another one."""
    first = dict[int, Searched]()
    for name in session.boards:
        some = spread([view for view in views if session.board_of(view) == name])
        _refuse_other_counts(session, name, some)
        seen = search(some)
        first |= {view.number: searched for view, searched in zip(some, seen, strict=True)}
        if any(isinstance(searched.found, Corners) for searched in seen):
            continue
        _refuse_another(session, name, some)
    return {view.number: first[view.number] for view in views if view.number in first}


def _refuse_other_counts(session: Session, name: str, views: Sequence[View]) -> None:
    """Refuses images of a checkerboard of other counts before they are searched at length.

    A search takes seconds for each image that does not show the declared board.
    """
    board, kind = session.boards[name], kind_of(session.boards[name])
    if isinstance(kind, Checkerboard) and len(session.boards) == 1 and views:
        image = image_of(session, views[0])
        if isinstance(image, np.ndarray) and isinstance(
            kind.search(image, board, quick=True), NotFound
        ):
            _refuse_another(session, name, views, plain=True)


def _refuse_another(
    session: Session, name: str, views: Sequence[View], *, plain: bool = False
) -> None:
    """Refuses images of another board than one of the session's that none of them shows."""
    present = [view for view in views if session.images.exists(view.image)]
    images = [(view, image_of(session, view)) for view in present]
    shown = [(view, image) for view, image in images if not isinstance(image, Rejection)]
    if shown and (finding := other_board(session, name, shown, plain=plain)):
        raise OtherBoardError.of(finding)


def _resolution(session: Session, views: Sequence[View], found: Mapping[int, Searched]) -> Size:
    """The stated (width, height) of one camera's images [px], else the most common one."""
    names = {name_of(session.declaration, "camera", view) for view in views}
    tables = [session.cameras[name] for name in names & session.cameras.keys()]
    of_cameras = {table.resolution for table in tables} - {None}
    stated = of_cameras.pop() if len(of_cameras) == 1 else None
    sizes = {view: searched.size for view, searched in found.items() if searched.size is not None}
    if stated is not None and not sizes:
        return stated
    if not sizes:
        searches = [searched.found for searched in found.values()]
        reasons = [f"view {at.view}: {at.reason}" for at in searches if isinstance(at, Rejection)]
        raise DataError(
            f"session {session.name!r}: the camera's resolution is missing, and none of "
            f"{len(found)} images shows it.",
            culprits=[*reasons, "session.toml: camera.resolution"],
            next_step="Add resolution = [width, height] to [camera]: the size of the images.",
        )
    counts = Counter(sizes.values())
    usual = max(counts, key=lambda size: (counts[size], size == stated, size))
    if stated is None or stated == usual:
        return usual
    images = {view.number: view.image for view in views}
    culprits = [
        f"view {view}: {images[view]} is {width} x {height} px"
        for view, (width, height) in sizes.items()
        if (width, height) != stated
    ]
    of_sizes = f"{culprits[0]}, and session.toml has {stated[0]} x {stated[1]} px."
    if stated in counts and all(
        _is_turned_or_scaled(size, stated) for size in {*counts} - {stated}
    ):
        raise DataError(
            f"{len(culprits)} of {len(sizes)} images are turned or scaled: {of_sizes}",
            culprits=culprits,
            next_step=str(MADE_ALIKE),
        )
    lens = (
        ""
        if all(table.matrix is None for table in tables)
        else (", and delete matrix and distortion: they are of other images")
    )
    raise DataError(
        f"{len(culprits)} of {len(sizes)} images are of another size: {of_sizes}",
        culprits=culprits,
        next_step=f"In session.toml, write resolution = [{usual[0]}, {usual[1]}]{lens}.",
    )


def other_sizes(detections: Detections) -> Iterator[Finding]:
    """The finding on images that are turned by a quarter or scaled against the camera's."""
    usual = detections.resolution
    sizes = {view: at.size for view, at in detections.searches.items() if at.size is not None}
    odd = [
        view for view, size in sizes.items() if size != usual and _is_turned_or_scaled(size, usual)
    ]
    if odd:
        width, height = sizes[odd[0]]
        yield Finding(
            "image_sizes",
            f"{len(odd)} of {len(sizes)} images are turned or scaled: view {ranges(odd)}, such as "
            f"{width} x {height} px, and the camera's are {usual[0]} x {usual[1]}.",
            MADE_ALIKE,
            tuple(odd),
        )


def unshown_rows(session: Session, detections: Detections) -> Iterator[Finding]:
    """Findings on rows that a board may lack, where its frame would begin at another place.

    An AprilGrid's tags count from the lower left, and its frame begins at the upper left: with more
    rows described than printed, all of its tags are where they should be, and the frame is not.
    """
    for name, target in session.boards.items():
        views = [view.number for view in session.views if session.board_of(view) == name]
        searches = (detections.searches[view] for view in views if view in detections.searches)
        seen = [at.found for at in searches if isinstance(at.found, Corners)]
        places = corner_positions(target)
        last = max((int(at.ids.max()) for at in seen), default=len(places) - 1)
        missing = target.rows - -(-(last + 1) * target.rows // len(places))
        beyond = places[len(places) - missing * len(places) // max(target.rows, 1) :, :2]
        if not missing or beyond[:, 1].max() > places[: last + 1, 1].min():
            continue
        # The next row, with the squares around it.
        low, high = beyond.min(axis=0), beyond.max(axis=0)
        gap_m = target.spacing * target.square_m
        low[1] = high[1] - target.square_m
        (left, up), (right, down) = low - gap_m, high + gap_m
        outline = np.array([[[left, up], [right, up], [right, down], [left, down]]])
        in_view = []
        for at in seen:
            px_from_board = np.asarray(cv2.findHomography(places[at.ids, :2], at.px)[0], float)
            if px_from_board.shape != (3, 3):
                continue
            px = cv2.perspectiveTransform(outline, px_from_board)[0]
            if np.all((px > 0) & (px < np.array(detections.resolution) - 1.0)):
                in_view.append(at.view)
        if len(in_view) < LOOKED_AT:
            continue
        write, command = board_correction(session, name, f"rows = {target.rows - missing}")
        up_mm = 1e3 * missing * (target.square_m + gap_m)
        yield Finding(
            "unshown_rows",
            f"No image shows the upper {missing} of the {target.rows} rows of {target.name}, which "
            f"would lie within view {ranges(in_view)}: it may have {target.rows - missing}, and "
            f"its frame begins {up_mm:.4g} mm above these.",
            Remedy(f"Count the rows, and {write}; where they are covered, uncover them.", command),
            tuple(in_view),
        )


def _is_turned_or_scaled(size: Size, usual: Size) -> bool:
    return size == usual[::-1] or is_scaled(size, usual)


def is_scaled(size: Size, usual: Size) -> bool:
    """Whether an image is a smaller or larger one of the same view, by its (width, height) [px]."""
    return abs(size[0] * usual[1] - size[1] * usual[0]) <= max(usual)


def _of_size(view: View, searched: Searched, size: Size) -> Searched:
    """The corners found in an image; a rejection for one of another size than the camera's."""
    if searched.size in (None, size):
        return searched
    turned = ", turned by a quarter" if searched.size == size[::-1] else ""
    words = "its image is {} x {} px, and the camera's images are {} x {}"
    words = f"{words.format(*searched.size, *size)}{turned}"
    return Searched(Rejection(view.number, words), None)


def image_of(session: Session, view: View) -> Image | Rejection:
    """Reads a view's (h, w) grey image; a rejection where there is none."""
    if absence := session.images.absence(view.image):
        return Rejection(view.number, f"{view.image} {absence}")
    image = decode_image(session.images.read(view.image))
    return Rejection(view.number, f"{view.image} is {image}") if isinstance(image, str) else image


def _search(session: Session, view: View, *, picture: bool) -> Searched:
    """Searches the image of one view, or takes what was found in it before."""
    name = session.board_of(view)
    earlier = session.images.search_of(view.image, name)
    if earlier is not None:
        return replace(earlier, found=replace(earlier.found, view=view.number))
    image = image_of(session, view)
    if isinstance(image, Rejection):
        return Searched(image, None)
    found, misfit = find_corners(image, session.boards[name], view.number, name=name)
    faint = faint_jpeg(image) if picture else None
    return Searched(found, (image.shape[1], image.shape[0]), misfit, faint)


def _check_layout(target: Target, searches: Mapping[int, Searched]) -> None:
    """Refuses a board whose markers have another layout than declared in most views of it."""
    misfits = {
        view: search.found.reason
        for view, search in searches.items()
        if search.misfit and isinstance(search.found, Rejection)
    }
    shown = sum(isinstance(search.found, Corners) for search in searches.values())
    if len(misfits) <= shown:
        return
    reasons = [*misfits.values()]
    usual = max(set(reasons), key=reasons.count)
    raise DataError(
        f"target {target.name!r}: in {len(misfits)} of {len(misfits) + shown} views another board "
        f"is seen: {usual}.",
        culprits=[f"view {view}" for view in misfits],
        next_step="In the target's .toml, correct columns, rows, and legacy or spacing, or name "
        "another target: visioncal target check IMAGE says what is printed.",
    )
