"""Checks of a session's rows, images and board before any fit, and what to type."""

import shlex
from collections.abc import Sequence
from pathlib import PurePath

from visioncal.calibration.stages.observed import Observed
from visioncal.core.errors import DataError
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import some_of
from visioncal.core.types import Image, Target
from visioncal.core.verdict import Finding, Remedy
from visioncal.session import Session, View
from visioncal.session.images import IMAGE_ENDINGS, FolderImages
from visioncal.session.kinds import declared_targets, is_camera_observation, is_instrument_reading
from visioncal.session.selecting import is_whole_cell
from visioncal.vision.boards import kind_of
from visioncal.vision.boards.identify import describe, identify
from visioncal.vision.boards.identity import Identity
from visioncal.vision.boards.imaging import decode_image
from visioncal.vision.targets import board_words, target_names

# Images that are searched for any board.
_LOOKED_AT = 3
# Properties of a board that an image shows, beside its markers' dictionary.
_COMPARED = ("kind", "columns", "rows", "legacy", "marker_id")
# Least share of a board's corners in an image that identifies it.
_LEAST_CORNERS = 0.2


def missing_images(session: Session) -> Finding | None:
    """Finding on images that rows name and that are not there."""
    searched = [view for view in session.views if view.image and not view.has_corners]
    missing = [view for view in searched if session.images.absence(view.image) == "is missing"]
    if not missing:
        return None
    images = some_of([view.image for view in missing])
    views = tuple(view.number for view in missing)
    listed = ", ".join(map(str, views))
    do = f"Copy them there; or in views.csv, delete the rows of view {listed}."
    if len(missing) == len(searched):
        do = "Copy them there; or in views.csv, correct their folder and names."
        if other := _namesake(session, missing[0]):
            do = f"In views.csv, write {other} for {missing[0].image}, and the others alike."
    return Finding(
        "missing_images",
        f"{len(missing)} of {len(searched)} images are missing: {images}.",
        Remedy(do),
        views,
        until_mm=0.0,
    )


def _namesake(session: Session, view: View) -> str:
    """Path of the only image named as a missing one, in another folder or format, if any."""
    if not isinstance(session.images, FolderImages):
        return ""
    folder, stem = session.images.folder, PurePath(view.image).stem.lower()
    found = {
        file.relative_to(folder).as_posix()
        for file in (*folder.glob("*"), *folder.glob("*/*"))
        if file.stem.lower() == stem and file.suffix.lower() in IMAGE_ENDINGS
    } - {view.text.get("depth")}
    return found.pop() if len(found) == 1 else ""


def empty_rows(session: Session) -> Finding | None:
    """Finding on rows of one camera and one robot that observe nothing, where these are many."""
    views = tuple(
        view.number
        for view in session.views
        if not (is_camera_observation(view) or is_instrument_reading(view))
    )
    count = len(session.views)
    # In a whole cell, a row may state only where a robot was.
    is_many = CalibrationLimits().lost_share[0] * count < len(views) < count
    if is_whole_cell(session) or not is_many:
        return None
    return Finding(
        "lost_views",
        f"{len(views)} of {count} rows of views.csv have neither an image nor rows in corners.csv: "
        f"view {some_of([*map(str, views)])}.",
        Remedy(
            "Write corners.csv again, as a whole; or in views.csv, fill in column image of these "
            "rows, or delete them."
        ),
        views,
        until_mm=0.0,
    )


def unseen_cause(observed: Observed) -> Finding | None:
    """Finds why most images show nothing after the search, if known: files or another board."""
    with_target = observed.poses.keys() | observed.corners.keys()
    searched = [view for view in observed.session.views if view.image and not view.has_corners]
    unseen = [view for view in searched if view.number not in with_target]
    if not searched or 3 * len(unseen) < len(searched):
        return None
    missing = missing_images(observed.session)
    if missing is not None and 2 * len(missing.views) > len(unseen):
        return missing
    return _other_board(observed.session, unseen)


def board_correction(session: Session | None, board: str, figures: str) -> tuple[str, str]:
    """How figures such as `square_m = 0.03` are written into the description of a board.

    Returns:
        A part of a sentence, and the command that it takes: one for a board that ships with
        visioncal, of which a session's folder has no file.
    """
    shipped = ""
    if session is not None and isinstance(session.images, FolderImages):
        shipped = declared_targets(session.declaration).get(board, "")
    if shipped not in target_names():
        return f"write {figures} in the board's .toml", ""
    return (
        f'write target = "{shipped}.toml" in session.toml, and {figures} in that file, which the '
        "command makes",
        f"visioncal target make {shipped} -o SESSION",
    )


def _other_board(session: Session, unseen: Sequence[View]) -> Finding | None:
    """Identifies the board in images without the declared target; None where none is seen."""
    declared = session.target
    if declared is None or session.targets:
        return None
    existing = [view for view in unseen if session.images.exists(view.image)]
    found = list[tuple[View, Identity]]()
    # A few views from all over the session.
    for view in existing[:: max(len(existing) // _LOOKED_AT, 1)][:_LOOKED_AT]:
        image = decode_image(session.images.read(view.image))
        identity = None if isinstance(image, str) else _identified(image, declared)
        if identity is not None:
            found.append((view, identity))
    if not found:
        return None
    view, identity = max(found, key=lambda pair: pair[1].corners_seen)
    board, dictionaries = identity.board, ("", identity.board.dictionary, *identity.larger)
    is_same = all(getattr(board, name) == getattr(declared, name) for name in _COMPARED)
    if is_same and declared.dictionary in dictionaries:
        return None
    counts = f"columns = {board.columns} and rows = {board.rows}"
    words, command = board_correction(session, "", counts)
    step = Remedy(f"{words[0].upper()}{words[1:]}, or name another target.", command)
    if board.dictionary:
        side, mm = kind_of(board).side, f"{1e3 * declared.square_m:g}"
        step = Remedy(
            f"Measure the {side}, and where it is not {mm} mm as declared, change the figure in "
            'the command. In session.toml, write target = "seen.toml", which it makes.',
            f"visioncal target check SESSION/{shlex.quote(view.image)} --square-mm {mm} "
            "-o SESSION/seen.toml",
        )
    seen, stated = describe(identity), board_words(declared)
    return Finding(
        "other_board",
        f"The images show another board than declared: {seen} (view {view.number}), and "
        f"{declared.name} is {stated}.",
        step,
        (view.number,),
    )


def _identified(image: Image, declared: Target) -> Identity | None:
    """The board of an image by its markers, or a checkerboard whose squares were miscounted.

    None where few of its corners are seen, as where it is blurred.
    """
    try:
        identity = identify(image)
    except DataError:
        board = kind_of(declared).miscounted(image, declared)
        if board is None:
            return None
        corners = board.columns * board.rows
        return Identity(board, corners, corners)
    dictionaries = (identity.board.dictionary, *identity.larger)
    # A single marker is no evidence against a declared board of several: its finder says what that
    # lacks.
    several = declared.columns * declared.rows > 1
    if identity.is_single and several and declared.dictionary in dictionaries:
        return None
    return identity if identity.corners_seen >= _LEAST_CORNERS * identity.corners else None
