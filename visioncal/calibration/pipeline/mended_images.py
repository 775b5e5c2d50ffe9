"""A session's images as its camera took them: mirrored and turned back, positive, of one size."""

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import PurePath

import cv2
import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES, run_stages
from visioncal.calibration.stages.detect import is_scaled
from visioncal.calibration.stages.other_board import spread
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.number_format import ranges
from visioncal.core.transforms import rotation_angle
from visioncal.core.types import Image, Progress
from visioncal.session import MemoryImages, Session
from visioncal.vision.boards.identify import identify
from visioncal.vision.boards.imaging import decode_image, encode_png, exif_turn, grey_of

# A half turn about the optical axis.
_HALF = np.diag([-1.0, -1.0, 1.0])
# Views whose angles to the others show a half turn, at least, and how much better they fit then.
_FEWEST, _CLEARLY = 4, 3.0


def mend_images(session: Session, progress: Progress | None = None) -> Session:
    """A session with its images mended as sizes, EXIF, markers and robot show; it notes how.

    Changed images are stored as PNG, without loss; all others stay as they are.

    Args:
        session: The session; images of views with rows in corners.csv are left alone.
        progress: Called with the progress of long work.

    Raises:
        DataError: There is nothing to mend, or it has depth pictures, which would have to follow.
    """
    views = [view for view in session.views if view.image and not view.has_corners]
    present = [view for view in views if session.images.exists(view.image)]
    files = {view.image: session.images.read(view.image) for view in present}
    read = {name: decode_image(data, colour=True) for name, data in files.items()}
    images = {name: image for name, image in read.items() if not isinstance(image, str)}
    done = {name: list[str]() for name in images}
    usual = _usual_size(session, images)
    for name, image in images.items():
        images[name], how = _sized(image, usual, files[name])
        done[name] += how
    for board, target in session.boards.items():
        mine = [view for view in present if session.board_of(view) == board]
        some = [images[view.image] for view in spread(mine) if view.image in images]
        shown = None
        with suppress(DataError):
            shown = identify([*map(grey_of, some)], target) if some else None
        for name in {view.image for view in mine if shown is not None} & images.keys():
            if shown is not None and shown.is_mirrored:
                images[name] = np.ascontiguousarray(images[name][:, ::-1])
                done[name].append("mirrored back")
            if shown is not None and shown.is_negative:
                images[name] = np.asarray(cv2.bitwise_not(images[name]), np.uint8)
                done[name].append("turned from negatives")
    mended = _with(session, images, done)
    upside_down = _half_turned(mended, progress)
    for view in (view for view in present if view.number in upside_down):
        images[view.image] = np.ascontiguousarray(images[view.image][::-1, ::-1])
        done[view.image].append("turned by a half")
    if not any(done.values()):
        raise DataError(
            f"session {session.name!r}: nothing was written, as no image is mirrored, turned, a "
            "negative or of another size.",
            next_step="visioncal doctor says what else is wrong.",
        )
    if any(view.text.get("depth") for view in present if done.get(view.image)):
        raise DataError(
            f"session {session.name!r} has depth pictures beside images that are to be changed.",
            next_step="Record it again, with color and depth of one orientation and size.",
        )
    return _with(session, images, done)


def _usual_size(session: Session, images: Mapping[str, Image]) -> tuple[int, int]:
    """The stated (width, height) of the only camera, where an image has it, or the usual one."""
    sizes = Counter((image.shape[1], image.shape[0]) for image in images.values())
    stated = [table.size for table in session.cameras.values()]
    if len(stated) == 1 and stated[0] is not None and stated[0] in sizes:
        return stated[0]
    return max(sizes, key=lambda size: (sizes[size], size), default=(0, 0))


def _sized(image: Image, usual: tuple[int, int], data: bytes) -> tuple[Image, list[str]]:
    """An image of the usual (width, height) [px], turned or scaled, and what was done to it."""
    size = (image.shape[1], image.shape[0])
    if size != usual and size == usual[::-1]:
        turn = exif_turn(data)
        turn = cv2.ROTATE_90_CLOCKWISE if turn is None else turn
        return np.asarray(cv2.rotate(image, turn), np.uint8), ["turned by a quarter"]
    if size != usual and is_scaled(size, usual):
        way = cv2.INTER_AREA if size[0] > usual[0] else cv2.INTER_CUBIC
        scaled = np.asarray(cv2.resize(image, usual, interpolation=way), np.uint8)
        return scaled, [f"scaled from {size[0]} x {size[1]} px"]
    return image, []


def _with(session: Session, images: Mapping[str, Image], done: Mapping[str, list[str]]) -> Session:
    """The session with changed images, and a note of what was done to which views."""
    names = {name: str(PurePath(name).with_suffix(".png")) for name in done if done[name]}
    kept = {view.image for view in session.views} - names.keys()
    if kept & {*names.values()} or len({*names.values()}) < len(names):
        names = {name: f"{PurePath(name).with_suffix('')}-mended.png" for name in names}
    files = {name: session.images.read(name) for name in kept if session.images.exists(name)}
    files |= {new: encode_png(images[old]) for old, new in names.items()}
    cells = [
        [names.get(view.image, view.cell(key)) if key == "image" else view.cell(key)
         for key in session.columns]
        for view in session.views
    ]  # fmt: skip
    shown = [view for view in session.views if view.image in names]
    ways = {view.number: ", ".join(done[view.image]) for view in shown}
    notes = [
        f"the images of view {ranges([view for view in ways if ways[view] == way])} were {way}"
        for way in dict.fromkeys(ways.values())
    ]
    corrected = [*session.declaration.corrected, *notes]
    document = {**session.document, "corrected": corrected} if notes else session.document
    return session.with_content(document=document, cells=cells, images=MemoryImages(files))


def _half_turned(session: Session, progress: Progress | None) -> set[int]:
    """Views whose images are upside down beside the others', by how far the robot turned.

    Between two views camera and robot turn by the same angle, whatever the unknown frames are.
    """
    names = {"robot", "detect", "intrinsics", "pnp"}
    try:
        state = RunState(session, progress)
        state = run_stages(state, [stage for stage in STAGES if stage.name in names])
    except VisioncalError:
        return set()
    shown = [view for view in state.poses_of_one_board if view in state.base_from_flange]
    if len(shown) < _FEWEST or state.mount is None:
        return set()
    robot = np.array([state.base_from_flange[view][:3, :3] for view in shown])
    camera = np.array([state.poses[view].cam_from_target[0, :3, :3] for view in shown])
    by_robot = rotation_angle(np.swapaxes(robot, 1, 2)[:, None] @ robot[None])
    away = [
        np.abs(by_robot - rotation_angle(camera[:, None] @ np.swapaxes(turned, 1, 2)[None]))
        for turned in (camera, _HALF @ camera)
    ]
    # One view shows which of the others are turned relative to it; most are upright.
    rows = np.minimum(*away)
    best = int(np.argmin(np.median(rows, axis=1)))
    is_turned = away[1][best] < away[0][best]
    if is_turned.sum() > len(shown) / 2:
        is_turned = ~is_turned
    as_is = np.where(is_turned[:, None] == is_turned[None], away[0], away[1])
    if not is_turned.any():
        return set()
    before = np.median(away[0][is_turned][:, ~is_turned])
    clear = _CLEARLY * np.median(as_is) < before
    return {view for view, at in zip(shown, is_turned.tolist(), strict=True) if at and clear}
