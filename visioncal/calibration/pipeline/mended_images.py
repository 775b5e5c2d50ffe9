"""A session's images as its camera took them: mirrored and turned back, positive, of one size."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import PurePath

import cv2
import numpy as np

from visioncal.calibration.pipeline.guess_inputs import guess_from_camera_poses, of_pair
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES, run_stages
from visioncal.calibration.stages.cameras import exchanged_columns, shows_print
from visioncal.calibration.stages.corner_numbers import EXCHANGE_COLUMNS
from visioncal.calibration.stages.corner_sizes import scaled_px
from visioncal.calibration.stages.detect import is_scaled
from visioncal.calibration.stages.other_board import OtherBoardError, spread
from visioncal.calibration.stages.robots import pairs_of
from visioncal.calibration.suspects.undoing import likeliest, undone
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.number_format import ranges
from visioncal.core.types import Image, Progress
from visioncal.session import MemoryImages, Session, View
from visioncal.session.corners import CornerTable
from visioncal.vision.boards.identify import LOOKED_AT_LAST, identify
from visioncal.vision.boards.imaging import decode_image, encode_png, exif_turn, grey_of

# Note that is not followed by a mirroring: that would undo half of it.
_EXCHANGED = "u_px and v_px of the corners"
# Turns back by quarters, counterclockwise, in words.
_TURNED = {1: "turned back by a quarter", 2: "turned by a half", 3: "turned on by a quarter"}


def mend_images(session: Session, progress: Progress | None = None) -> Session:
    """A session with its images mended as sizes, EXIF, markers and robot show; it notes how.

    Changed images are stored as PNG, without loss; all others stay as they are.

    Args:
        session: The session; images of views with rows in corners.csv are left alone, unless the
            robot's motion shows that all are mirrored, and the corners with them. Corners whose
            columns are exchanged, or that are of pictures of another size, come first.
        progress: Called with the progress of long work.

    Raises:
        DataError: There is nothing to mend, or it has depth pictures, which would have to follow.
    """
    if (mended := _with_mended_corners(session)) is not None:
        return mended
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
        board_views = [view for view in present if session.board_of(view) == board]
        some = [
            images[view.image]
            for view in spread(board_views, LOOKED_AT_LAST)
            if view.image in images
        ]
        shown = None
        with suppress(DataError):
            shown = identify([*map(grey_of, some)], target) if some else None
        for name in {view.image for view in board_views if shown is not None} & images.keys():
            if shown is not None and shown.is_mirrored:
                images[name] = np.ascontiguousarray(images[name][:, ::-1])
                done[name].append("mirrored back")
            if shown is not None and shown.is_negative:
                images[name] = np.asarray(cv2.bitwise_not(images[name]), np.uint8)
                done[name].append("turned from negatives")
    located = _located(_with(session, images, done), progress)
    for name, quarters in _turned(located, present).items():
        images[name] = np.ascontiguousarray(np.rot90(images[name], quarters))
        done[name].append(_TURNED[quarters])
    if not any(done.values()):
        if (mended := _by_motion(session, located)) is not None:
            return mended
        raise DataError(
            f"session {session.name!r}: nothing was written, as no image is mirrored, turned, a "
            "negative or of another size.",
            next_step="visioncal doctor says what else is wrong.",
        )
    return _with(session, images, done)


def with_turned_images(session: Session, views: Sequence[View], quarters: int) -> Session:
    """A session with the images of some views turned back by quarters; itself where none has any.

    Raises:
        DataError: It has depth pictures, which would have to follow.
    """
    files = {view.image: session.images.read(view.image) for view in views if view.image}
    read = {name: decode_image(data, colour=True) for name, data in files.items()}
    turned = {
        name: np.ascontiguousarray(np.rot90(image, quarters))
        for name, image in read.items()
        if not isinstance(image, str)
    }
    done = {name: [_TURNED[quarters]] for name in turned}
    return _with(session, turned, done) if turned else session


def _located(session: Session, progress: Progress | None) -> RunState | None:
    """The run with the target's pose in each image; None where it comes to none."""
    names = {"robot", "detect", "intrinsics", "pnp"}
    with suppress(VisioncalError):
        stages = [stage for stage in STAGES if stage.name in names]
        return run_stages(RunState(session, progress), stages)
    return None


def _turned(state: RunState | None, views: Sequence[View]) -> dict[str, int]:
    """Images that the robot's motion shows turned beside others, and by how many quarters."""
    found = dict[int, int]()
    with suppress(VisioncalError):
        while state and (mistake := likeliest(state)) is not None and not state.misread:
            found |= dict.fromkeys(mistake.found.views, mistake.quarters)
            state = undone(state, mistake)
    return {view.image: found[view.number] for view in views if found.get(view.number)}


def _is_mirrored(state: RunState | None) -> bool:
    """Whether robot and camera agree only with one of them mirrored."""
    if (
        state is None
        or shows_print(state)
        or any(note.startswith(_EXCHANGED) for note in state.session.declaration.corrected)
    ):
        return False
    with suppress(VisioncalError):
        if state.session.has_one_pair:
            guess = guess_from_camera_poses(state)
            return guess.stands_out and guess.best.hypothesis.robot.mirrored
    return False


def _by_motion(session: Session, located: RunState | None) -> Session | None:
    """The session with images or corners mirrored back, as the motion shows, if it does."""
    if _is_mirrored(located):
        return _mirrored_back(session, located)
    exchanged = _exchanged_in_cell(located)
    return _exchanged_back(session, exchanged) if exchanged else None


def _exchanged_in_cell(state: RunState | None) -> list[int]:
    """Views of those cameras of a whole cell whose lenses show u and v of corners exchanged."""
    if state is None or state.session.has_one_pair:
        return []
    pairs = ((robot, pair) for robot in state.session.robots for pair in pairs_of(state, robot))
    cameras = {
        pair.camera for robot, pair in pairs if exchanged_columns(of_pair(state, robot, pair))
    }
    rows = state.session.observations
    return [row.view.number for row in rows if row.seer in cameras and row.view.has_corners]


def _with_mended_corners(session: Session) -> Session | None:
    """The session with corners of one kind; None where all are, or their columns are as known."""
    table = session.corner_table
    if table is None:
        return None
    try:
        names = {"detect", "intrinsics", "pnp"}
        found = run_stages(RunState(session), [each for each in STAGES if each.name in names])
    except OtherBoardError as error:
        finding = error.finding
        is_exchanged = finding is not None and finding.do == EXCHANGE_COLUMNS
        return _exchanged_back(session, finding.views) if finding and is_exchanged else None
    except VisioncalError:
        return None
    px, notes = table.px.copy(), list[str]()
    sigmas_px = None if table.sigmas_px is None else table.sigmas_px.copy()
    for share in dict.fromkeys(found.shares.values()):
        views = [view for view, of in found.shares.items() if of == share]
        in_views = np.isin(table.views, views)
        px[in_views] = scaled_px(px[in_views], 1.0 / share)
        if sigmas_px is not None:
            sigmas_px[in_views] /= share
        notes.append(f"the corners of view {ranges(views)} were scaled by {1.0 / share:g}")
    mended = replace(table, px=px, sigmas_px=sigmas_px)
    return _with_corners(session, mended, notes) if notes else None


def _exchanged_back(session: Session, views: Collection[int]) -> Session:
    """The session with u and v of the corners of some views exchanged."""
    corners = session.corner_table
    if corners is not None:
        in_views = np.isin(corners.views, [*views])
        px = np.where(in_views[:, None], corners.px[:, ::-1], corners.px)
        corners = replace(corners, px=px)
    notes = [f"{_EXCHANGED} of view {ranges(views)} were exchanged"]
    return _with_corners(session, corners, notes)


def _with_corners(session: Session, corners: CornerTable | None, notes: Sequence[str]) -> Session:
    """The session with other corners, which notes why in `corrected`."""
    cells = [[view.cell(key) for key in session.columns] for view in session.views]
    corrected = [*session.declaration.corrected, *notes]
    document = {**session.document, "corrected": corrected}
    return session.with_content(document=document, cells=cells, corners=corners)


def _mirrored_back(session: Session, state: RunState | None) -> Session:
    """The session of one camera with all images and corners mirrored left to right.

    Or with u and v of its corners exchanged, where the lens of a run shows that.

    Raises:
        DataError: It has corners of pictures of unknown width.
    """
    if state is not None and exchanged_columns(state):
        return _exchanged_back(session, [view.number for view in session.views if view.has_corners])
    corners = session.corner_table
    if corners is None and not any(view.image for view in session.views):
        raise DataError(
            f"session {session.name!r} has neither images nor corners to be mirrored back.",
            next_step="Mirror the target's poses in the program that measured them.",
        )
    if corners is not None:
        (size,) = (camera.resolution for camera in session.cameras.values())
        if size is None:
            raise DataError(
                f"session {session.name!r} states no resolution, within which corners mirror.",
                culprits=["resolution"],
                next_step="Write resolution = [width, height] in [camera].",
            )
        corners = replace(corners, px=corners.px * [-1.0, 1.0] + [size[0] - 1.0, 0.0])
        session = _with_corners(session, corners, ["the corners of all views were mirrored back"])
    names = {view.image for view in session.views if view.image}
    files = {name: session.images.read(name) for name in names if session.images.exists(name)}
    read = {name: decode_image(data, colour=True) for name, data in files.items()}
    images = {
        name: np.ascontiguousarray(image[:, ::-1])
        for name, image in read.items()
        if not isinstance(image, str)
    }
    return _with(session, images, {name: ["mirrored back"] for name in images})


def _usual_size(session: Session, images: Mapping[str, Image]) -> tuple[int, int]:
    """The stated (width, height) of the only camera, where an image has it, or the usual one."""
    sizes = Counter((image.shape[1], image.shape[0]) for image in images.values())
    stated = [table.resolution for table in session.cameras.values()]
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
    """The session with changed images, and a note of what was done to which views.

    Raises DataError with depth pictures, which would have to follow.
    """
    if any(view.text.get("depth") for view in session.views if done.get(view.image)):
        raise DataError(
            f"session {session.name!r} has depth pictures beside images that are to be changed.",
            next_step="Record it again, with color and depth of one orientation and size.",
        )
    names = {name: str(PurePath(name).with_suffix(".png")) for name in done if done[name]}
    kept = {view.image for view in session.views if view.image} - names.keys()
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
