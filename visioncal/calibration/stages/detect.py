"""Finds the target in every image, on threads, with a reason where it cannot be used.

Where another detector has found the corners of a view (corners.csv), these are taken.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Condition

import cv2
import numpy as np

from visioncal.calibration.stages.corner_numbers import OTHER_NUMBERS, check_axes, check_numbers
from visioncal.calibration.stages.image_size import other_size_step
from visioncal.calibration.stages.kept_corners import KeptCorners, Searched
from visioncal.core.errors import DataError
from visioncal.core.limits import MAX_BLUR_PX
from visioncal.core.threads import SharedSetting
from visioncal.core.types import Corners, Image, IntArray, Progress, Rejection, Target
from visioncal.estimation.poses import determines_pose
from visioncal.session import Session, View
from visioncal.session.kinds import name_of
from visioncal.vision.finders import DetectedCorners, NotFound, find_target, fitting_layouts
from visioncal.vision.finders.aprilgrid import LACKS_SQUARES, free_tags_step
from visioncal.vision.finders.checkerboard import MOST_PIXELS as MOST_CHECKERBOARD_PIXELS
from visioncal.vision.finders.headers import MOST_PIXELS, claimed_size
from visioncal.vision.finders.identify_checkerboard import find_squares
from visioncal.vision.finders.imaging import blur_at_corners, decode_image, why_hard_to_see
from visioncal.vision.targets import corner_positions, point_numbers

# A homography takes four points.
_FEWEST_GIVEN = 4
# Fewest corners of a board that is found in an image, or all that it has: a homography needs four,
# the rest are its check.
_FEWEST_FOUND = 6
# Corners that others have found may lie outside the image by this share of it.
_OUTSIDE = 0.1
# Images with corners that show which layout was printed, or how they were turned; of so many.
_LAYOUT_SAMPLE, _MOST_LOOKED_AT = 3, 12


@dataclass(frozen=True, eq=False)
class Detections:
    """The corners by view, in the session's order, and the views without.

    Attributes:
        corners: The corners.
        rejections: Why views have none.
        resolution: The camera's (width, height) [px].
        other_sizes: The (width, height) of images that have another one, by view [px].
    """

    corners: Mapping[int, Corners]
    rejections: tuple[Rejection, ...]
    resolution: tuple[int, int]
    other_sizes: Mapping[int, tuple[int, int]]


class _Room:
    """Bounds what threads work on at once, in shares of the largest image that is looked at."""

    def __init__(self) -> None:
        self._left = 1.0
        self._changed = Condition()

    @contextmanager
    def taken(self, share: float) -> Iterator[None]:
        """Waits until there is room for a share; one beyond all of it waits to be alone."""
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
    keeps: bool = False,
) -> Detections:
    """Finds in each image of a session the target that its row is said to show.

    Args:
        session: A session with a target; its views without images or corners are passed over.
        progress: Told after each image.
        among: Those of its views to look at; all where None.
        threads: How many images are worked on at a time; 0 for one a core.
        keeps: Whether what is found is kept beside the session, for the next search.

    Returns:
        The corners and the rejected views.

    Raises:
        DataError: No view shows the target, half of the images or more have another size than the
            camera, the size of the images is not known, or the board that was printed has another
            layout than the one declared.
    """
    if not session.boards:
        raise DataError("session: images need a target.", next_step="Name one in session.toml.")
    among = session.views if among is None else among
    views = [view for view in among if view.image and not view.has_corners]
    stated = _stated_resolution(session, among)
    looks: list[Searched] = []
    others = {board for board in session.boards if _shows_another(session, board, views)}
    room, kept = _Room(), KeptCorners.beside(session, grows=keeps)
    with (
        _ONE_OPENCV_THREAD.held(),
        ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool,
    ):

        def look_at(view: View) -> Searched:
            quick = session.board_of(view) in others
            return _look(session, view, stated, room, kept, quick=quick)

        for look in pool.map(look_at, views):
            looks.append(look)
            if progress is not None:
                progress("detect", len(looks), len(views))
    kept.save()
    given = [view for view in among if view.has_corners]
    resolution = _common_resolution(session, views, looks, given, stated)
    sizes = {view.number: look.size for view, look in zip(views, looks, strict=True)}
    looks = [_of_size(look, view, resolution) for look, view in zip(looks, views, strict=True)]
    for name in session.boards:
        _check_layout(session, name, views, looks)
    own = {view.number: look.found for view, look in zip(views, looks, strict=True)}
    check_axes(
        [(session.corners[view.number], session.boards[session.board_of(view)]) for view in given],
        resolution,
    )
    elsewhere = {view.number: _given(session, view, resolution) for view in given}
    for name, target in session.boards.items():
        mine = [elsewhere[view.number] for view in given if session.board_of(view) == name]
        several = name if len(session.boards) > 1 else ""
        wrong = check_numbers(
            [corners for corners in mine if isinstance(corners, Corners)], target, several
        )
        elsewhere |= {index: Rejection(index, OTHER_NUMBERS) for index in wrong}
    own |= elsewhere
    found = [own[view.number] for view in among if view.number in own]
    return Detections(
        {corners.view: corners for corners in found if isinstance(corners, Corners)},
        tuple(corners for corners in found if isinstance(corners, Rejection)),
        resolution,
        {view: size for view, size in sizes.items() if size not in (None, resolution)},
    )


def _shows_another(session: Session, name: str, views: Sequence[View]) -> bool:
    """Whether images clearly show a checkerboard of another size than the declared one."""
    # A thorough search for what is not there takes seconds an image, and is spared where all of a
    # few images show another board.
    target = session.boards[name]
    if target.kind != "checkerboard":
        return False
    mine = [view for view in views if session.board_of(view) == name]
    sample = mine[:: max(len(mine) // _LAYOUT_SAMPLE, 1)][:_LAYOUT_SAMPLE]
    for view in sample:
        image = image_of(session, view)
        if isinstance(image, Rejection):
            return False
        if isinstance(find_target(image, target, quick=True), DetectedCorners):
            return False
        seen = find_squares(image)
        if seen is None or not seen.found or seen.cut:
            return False
        if {seen.columns, seen.rows} == {target.columns, target.rows}:
            return False
    return bool(sample)


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


# OpenCV's threads inside ours slow both down.
_ONE_OPENCV_THREAD = SharedSetting(_one_opencv_thread)


def image_of(session: Session, view: View) -> Image | Rejection:
    """Reads a view's (h, w) grey image; or says why there is none."""
    if not session.images.exists(view.image):
        return Rejection(view.number, f"{view.image} {session.images.absence(view.image)}")
    return _decoded(view, session.images.read(view.image))


def _decoded(view: View, data: bytes) -> Image | Rejection:
    image = decode_image(data)
    return Rejection(view.number, f"{view.image} is {image}") if isinstance(image, str) else image


def _look(
    session: Session,
    view: View,
    stated: tuple[int, int] | None,
    room: _Room,
    kept: KeptCorners,
    *,
    quick: bool,
) -> Searched:
    absence = session.images.absence(view.image)
    if absence:
        return Searched(Rejection(view.number, f"{view.image} {absence}"), None)
    name = session.board_of(view)
    target = session.boards[name]
    data = session.images.read(view.image)
    size = claimed_size(data) or (0, 0)
    pixels = size[0] * size[1]
    if stated not in (None, size) and 0 < pixels <= MOST_PIXELS:
        # Refused in any case: what another size shows need not be looked at.
        return Searched(Rejection(view.number, f"{view.image} is of another size"), size)
    # Digests of images take time, too.
    key = kept.key(data, target, name) if kept.entries or kept.grows else ""
    before = kept.get(key, view.number)
    if before is not None:
        return before
    most = MOST_CHECKERBOARD_PIXELS if target.kind == "checkerboard" else MOST_PIXELS
    with room.taken(pixels / most):
        image = _decoded(view, data)
        if isinstance(image, Rejection):
            return Searched(image, None)
        found, misfit = look_for(image, target, view.number, quick=quick, name=name)
    searched = Searched(found, (image.shape[1], image.shape[0]), misfit)
    if not quick:
        kept.put(key, searched)
    return searched


def look_for(
    image: Image, target: Target, view: int, *, quick: bool = False, name: str = ""
) -> tuple[Corners | Rejection, bool]:
    """Looks for a target in one image, as `detect` does in those of a session.

    Args:
        image: (h, w) grey image.
        target: What to look for.
        view: The view's number.
        quick: Whether nothing more is searched where a first, quick search fails.
        name: What the session calls the target, where it has several.

    Returns:
        The corners, or why the view cannot be used; and whether markers were seen that lie
        otherwise than on this target.
    """
    seen = find_target(image, target, quick=quick)
    if isinstance(seen, NotFound):
        cause = why_hard_to_see(image, MAX_BLUR_PX)
        reason = f"{seen.reason}; {cause}" if cause else seen.reason
        reason = f"{reason} (looked for target {name})" if name else reason
        return Rejection(view, reason), seen.misfit
    blur = blur_at_corners(image, seen.px) if seen.blur_px is None else seen.blur_px
    trouble = _trouble(target, seen.ids, blur)
    if trouble:
        return Rejection(view, trouble), False
    return Corners(view, seen.ids, seen.px, blur, seen.weights), False


def _given(session: Session, view: View, resolution: tuple[int, int]) -> Corners | Rejection:
    """The corners that another detector has found in a view, or why they do not serve."""
    corners, target = session.corners[view.number], session.boards[session.board_of(view)]
    positions = corner_positions(target)
    size = np.array(resolution)
    beyond = np.any((corners.px < -_OUTSIDE * size) | (corners.px > (1 + _OUTSIDE) * size), axis=1)
    trouble = ""
    if beyond.any():
        at = int(np.argmax(beyond))
        u_px, v_px = corners.px[at].tolist()
        trouble = (
            f"corners.csv: point {point_numbers(target)[corners.ids[at]]} at ({u_px:g}, "
            f"{v_px:g}) px lies far outside the image of {size[0]} x {size[1]} px"
        )
    elif len(corners.ids) < _FEWEST_GIVEN:
        trouble = (
            f"too few corners: corners.csv has {len(corners.ids)} of {len(positions)}, needs "
            f"{_FEWEST_GIVEN}"
        )
    elif not determines_pose(positions[corners.ids]):
        trouble = f"corners on one line: all {len(corners.ids)} of corners.csv, or all but one"
    return Rejection(view.number, trouble) if trouble else corners


def _trouble(target: Target, ids: IntArray, blur_px: float) -> str:
    positions = corner_positions(target)
    needed = 4 if target.kind in ("marker", "points") else min(_FEWEST_FOUND, len(positions))
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
    looks: Sequence[Searched],
    given: Sequence[View],
    stated: tuple[int, int] | None,
) -> tuple[int, int]:
    """The camera's size, or that of most images; checks that more than half of them have it."""
    sizes = [look.size for look in looks if look.size is not None]
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
        reasons = [f"view {rejection.view}: {rejection.reason}" for rejection in _rejections(looks)]
        raise DataError(
            f"session {session.name!r}: none of its {len(views)} images can be read.",
            culprits=reasons,
            next_step=f"First: {reasons[0]}." if reasons else "Give the views images.",
        )
    wanted = stated or max(set(sizes), key=sizes.count)
    line_of = {view.number: line for line, view in enumerate(session.views, start=2)}
    culprits = [
        f"views.csv line {line_of[view.number]}, column image: {view.image} is "
        f"{look.size[0]} x {look.size[1]} px"
        for view, look in zip(views, looks, strict=True)
        if look.size is not None and look.size != wanted
    ]
    if len(culprits) == len(sizes) and len(set(sizes)) == 1:
        raise _other_size(session, views, sizes[0], wanted, culprits)
    if 2 * len(culprits) >= len(sizes):
        source = "the camera's resolution is" if stated else "most other images are"
        raise DataError(
            f"{culprits[0]}, but {source} {wanted[0]} x {wanted[1]} px"
            + (f" ({len(culprits)} images in all)." if len(culprits) > 1 else "."),
            culprits=culprits,
            next_step="Correct [camera] resolution in session.toml, or take out these views.",
        )
    return wanted


def _of_size(look: Searched, view: View, resolution: tuple[int, int]) -> Searched:
    """The look at an image; a rejection where it has another size than the camera's."""
    if look.size in (None, resolution):
        return look
    (width, height), (wide, high) = look.size, resolution
    words = f"{view.image} is {width} x {height} px, and the camera's images are {wide} x {high}"
    return Searched(Rejection(view.number, words), None)


def _other_size(
    session: Session,
    views: Sequence[View],
    size: tuple[int, int],
    stated: tuple[int, int],
    culprits: Sequence[str],
) -> DataError:
    """What to raise where all images are of one other size than the camera's."""
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
    found: dict[int, Corners] = {}
    for view in [view for view in views if session.board_of(view) == name][:_MOST_LOOKED_AT]:
        image = image_of(session, view)
        if isinstance(image, Rejection):
            continue
        seen, _ = look_for(image, session.boards[name], view.number)
        if isinstance(seen, Corners):
            found[view.number] = seen
        if len(found) == _LAYOUT_SAMPLE:
            break
    return found


def _stated_resolution(session: Session, views: Sequence[View]) -> tuple[int, int] | None:
    """The size of the images of the camera that took some views, if it is stated."""
    names = {name_of(session.declaration, "camera", view) for view in views}
    sizes = {session.cameras[name].size for name in names & session.cameras.keys()} - {None}
    return sizes.pop() if len(sizes) == 1 else None


def _rejections(looks: Sequence[Searched]) -> list[Rejection]:
    return [look.found for look in looks if isinstance(look.found, Rejection)]


def _check_layout(
    session: Session, name: str, views: Sequence[View], looks: Sequence[Searched]
) -> None:
    """Refuses a board whose markers lie otherwise than declared in most views that show it."""
    target, board_of = session.boards[name], session.board_of
    mine = [pair for pair in zip(views, looks, strict=True) if board_of(pair[0]) == name]
    misfits = [view for view, look in mine if look.misfit]
    shown = sum(isinstance(look.found, Corners) for _, look in mine)
    if not misfits or len(misfits) <= shown:
        return
    culprits = [f"view {misfit.number}" for misfit in misfits]
    if target.kind != "charuco":
        reasons = [
            rejection.reason for rejection in _rejections([look for _, look in mine if look.misfit])
        ]
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
    fitting = [fitting_layouts(image, target) for image in images if not isinstance(image, str)]
    common = [target for target in fitting[0] if all(target in others for others in fitting)]
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
