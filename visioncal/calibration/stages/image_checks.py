"""Checks of a session's rows, images and board before any fit, and what to type."""

import shlex
from collections.abc import Iterator, Sequence

from visioncal.calibration.stages.observed import Observed
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.finding_kinds import EMPTY_ROWS, MISSING
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import some_of
from visioncal.core.types import Image, Target
from visioncal.core.verdict import LEAST_NEED_MM, Finding, Remedy
from visioncal.session import Session, View
from visioncal.session.kinds import is_camera_observation, is_instrument_reading
from visioncal.session.selecting import is_whole_cell
from visioncal.vision.boards import kind_of
from visioncal.vision.boards.identify import describe, identify
from visioncal.vision.boards.identity import Identity
from visioncal.vision.boards.imaging import decode_image
from visioncal.vision.targets import board_words, load_target, target_names

# Names that are listed, and images that are searched for any board.
_LISTED, _LOOKED_AT = 6, 3
# Properties of a board that an image shows, beside its markers' dictionary.
_COMPARED = ("kind", "columns", "rows", "legacy", "marker_id")
# Least share of a board's corners in an image that identifies it.
_LEAST_CORNERS = 0.2


def pairing(session: Session) -> Iterator[Finding]:
    """Reports rows without image or any observation, and rows that share an image."""
    if (missing := _missing_images(session)) is not None:
        yield missing
    yield from _empty_rows(session)
    first: dict[tuple[str, str], View] = {}
    for view in session.views:
        # One image may show several targets, in a row for each.
        earlier = first.setdefault((view.image, view.text.get("target", "")), view)
        if view.image and earlier is not view:
            yield Finding(
                "shared_image",
                f"Views {earlier.number} and {view.number} share the same image {view.image}.",
                Remedy(
                    "In views.csv, give each row its own image; or delete the row of view "
                    f"{view.number}."
                ),
                (earlier.number, view.number),
                until_mm=LEAST_NEED_MM,
            )


def _missing_images(session: Session) -> Finding | None:
    searched = [view for view in session.views if view.image and not view.has_corners]
    missing = [view for view in searched if session.images.absence(view.image) == "is missing"]
    if not missing:
        return None
    images = some_of([view.image for view in missing], _LISTED)
    views = tuple(view.number for view in missing)
    return Finding(
        MISSING,
        f"{len(missing)} of {len(searched)} images are missing: {images}.",
        Remedy(
            "Copy them there; or in views.csv, correct their folder and names, or delete the rows "
            f"of view {', '.join(map(str, views))}."
        ),
        views,
        until_mm=0.0,
    )


def _empty_rows(session: Session) -> Iterator[Finding]:
    """Reports rows of one camera and one robot that observe nothing, where others do."""
    # In a whole cell, a row may state only where a robot was.
    views = tuple(
        view.number
        for view in session.views
        if not (is_camera_observation(view) or is_instrument_reading(view))
    )
    count = len(session.views)
    if is_whole_cell(session) or len(views) in (0, count):
        return
    rows = some_of([*map(str, views)], _LISTED)
    yield Finding(
        "lost_rows" if len(views) > CalibrationLimits().lost_share[0] * count else EMPTY_ROWS,
        f"{len(views)} of {count} rows of views.csv have neither an image nor rows in corners.csv: "
        f"view {rows}.",
        Remedy("In views.csv, fill in column image of these rows, or delete them."),
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
    missing = _missing_images(observed.session)
    if missing is not None and 2 * len(missing.views) > len(unseen):
        return missing
    return _other_board(observed.session, unseen)


def because(error: VisioncalError, cause: Finding) -> VisioncalError:
    """The same error with its cause first."""
    message = f"{cause.words} {error.message}"
    return type(error)(message, culprits=error.culprits, next_step=str(cause.do or ""))


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
    view, identity = max(found, key=lambda pair: (pair[1].whole, pair[1].corners_seen))
    if _matches(identity, declared):
        return None
    # The declared size is that of another board; only a print of the same squares confirms it.
    matching = min(
        (target for target in map(load_target, target_names()) if _matches(identity, target)),
        key=lambda target: abs(target.square_m - declared.square_m),
        default=None,
    )
    side = kind_of(identity.board).side
    if matching is not None:
        step = Remedy(
            f'In session.toml, write target = "{matching.name}", if the {side} is '
            f"{1e3 * matching.square_m:g} mm: measure it."
        )
    else:
        step = Remedy(
            f'Measure the {side}. In session.toml, write target = "seen.toml", which this command '
            "makes with the measured figure [mm] in the place of MEASURED.",
            f"visioncal target check SESSION/{shlex.quote(view.image)} --square-mm MEASURED "
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
        return Identity(board, True, corners, corners)
    dictionaries = (identity.board.dictionary, *identity.larger)
    # A single marker is no evidence against a declared board of several: its finder says what that
    # lacks.
    if identity.is_single and declared.kind != "marker" and declared.dictionary in dictionaries:
        return None
    return identity if identity.corners_seen >= _LEAST_CORNERS * identity.corners else None


def _matches(identity: Identity, target: Target) -> bool:
    """Whether the seen board is the target, except for its size."""
    is_same = all(getattr(identity.board, name) == getattr(target, name) for name in _COMPARED)
    return is_same and target.dictionary in ("", identity.board.dictionary, *identity.larger)
