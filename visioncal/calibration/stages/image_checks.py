"""Checks of a session's rows, images and board before any fit, and what to type."""

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from visioncal.calibration.stages.observed import Observed
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.finding_kinds import EMPTY_ROWS, MISSING
from visioncal.core.limits import MAX_BLUR_PX, CalibrationLimits
from visioncal.core.number_format import counted, some_of
from visioncal.core.types import Image, Target
from visioncal.core.verdict import LEAST_NEED_MM, Finding, Remedy
from visioncal.session import Session, View
from visioncal.session.images import IMAGE_ENDINGS, FolderImages
from visioncal.session.kinds import is_camera_observation, is_instrument_reading
from visioncal.session.selecting import is_whole_cell
from visioncal.vision.boards import DetectedCorners, kind_of
from visioncal.vision.boards.checkerboard import CHECKERBOARD
from visioncal.vision.boards.identify import describe, identify
from visioncal.vision.boards.identity import Identity
from visioncal.vision.boards.imaging import blur_of_edges, decode_image, poor_image_reason
from visioncal.vision.targets import board_words, load_target, target_names

# Names that are listed, and images that are searched for any board.
_LISTED, _LOOKED_AT = 6, 3
# Properties of a board that an image shows, beside its markers' dictionary.
_COMPARED = ("kind", "columns", "rows", "legacy", "marker_id")
# Least share of a board's corners in an image that identifies it.
_LEAST_CORNERS = 0.2
# Largest blur (sigma) of a lens in focus [px].
_SHARP_PX = 1.2
# Relative difference of square sizes by rounding.
_SAME_SIZE = 0.01
_FOCUS = "Focus the lens, expose for a shorter time with more light, and record again."


def _searched(session: Session) -> list[View]:
    return [view for view in session.views if view.image and not view.has_corners]


def pairing(session: Session) -> Iterator[Finding]:
    """Reports rows without image or any observation, and rows that share an image."""
    yield from _missing_images(session)
    yield from _empty_rows(session)
    yield from _shared_images(session)


def unnamed_images(session: Session) -> Iterator[Finding]:
    """Reports images beside those of the session that no row names."""
    if unnamed := _unnamed_paths(session):
        yield Finding(
            "unnamed_images",
            f"{counted(len(unnamed), 'image', ('has', 'have'))} no row in views.csv: "
            f"{some_of(unnamed, _LISTED)}.",
            Remedy("Add a row for each, with the robot's pose, or take them out of the folder."),
            until_mm=0.0,
        )


def _missing_images(session: Session) -> Iterator[Finding]:
    with_image = _searched(session)
    missing = [view for view in with_image if session.images.absence(view.image) == "is missing"]
    if not missing:
        return
    names = [view.image for view in missing]
    words = f"{len(missing)} of {len(with_image)} images are missing: {some_of(names, _LISTED)}"
    elsewhere, step = _renamed(session, names)
    if elsewhere:
        words += f"; there is {elsewhere} instead"
    else:
        rows = ", ".join(str(view.number) for view in missing)
        step = f"Copy them there; or in views.csv, delete the rows of view {rows}."
    views = tuple(view.number for view in missing)
    yield Finding(MISSING, f"{words}.", Remedy(step), views, until_mm=0.0)


def _renamed(session: Session, names: Sequence[str]) -> tuple[str, str]:
    """Where the first image is, and what to replace so that all are found; empty for nothing."""
    store = session.images
    if not isinstance(store, FolderImages):
        return "", ""
    first = Path(names[0])
    pairs = [(first.suffix, item) for item in (*IMAGE_ENDINGS, *map(str.upper, IMAGE_ENDINGS))]
    others = sorted(f"{path.name}/" for path in store.folder.iterdir() if path.is_dir())
    folder = "" if first.parent == Path() else f"{first.parent.as_posix()}/"
    for old, new in [*pairs, *((folder, other) for other in (*others, ""))]:
        changed = [name.replace(old, new) if old else f"{new}{name}" for name in names]
        if old != new and all(store.exists(name) for name in changed):
            step = f"replace {old} by {new}" if old else f"write {new} before the images' names"
            return changed[0], f"In views.csv, {step}."
    return "", ""


def _empty_rows(session: Session) -> Iterator[Finding]:
    """Reports rows of one camera and one robot that observe nothing, where others do."""
    # In a whole cell, a row may state only where a robot was.
    empty = [
        view
        for view in session.views
        if not (is_camera_observation(view) or is_instrument_reading(view))
    ]
    if is_whole_cell(session) or len(empty) in (0, len(session.views)):
        return
    views, count = tuple(view.number for view in empty), len(session.views)
    verb = "observe" if views[1:] else "observes"
    words = f"{len(views)} of {count} rows of views.csv {verb} nothing: view "
    words += some_of([*map(str, views)], _LISTED)
    step = "In views.csv, fill in column image of these rows, or delete them."
    if any(view.has_corners for view in session.views):
        words += "; without an image, a view needs rows in corners.csv"
        last = session.views[count - len(empty) - 1]
        if empty == list(session.views[count - len(empty) :]):
            words += f", which ends with view {last.number}, as if it was cut off"
        step = "Write corners.csv again, as a whole; or in views.csv, delete these rows."
    kind = "lost_rows" if len(views) > CalibrationLimits().lost_share[0] * count else EMPTY_ROWS
    yield Finding(kind, f"{words}.", Remedy(step), views, until_mm=0.0)


def _shared_images(session: Session) -> Iterator[Finding]:
    first: dict[tuple[str, str], View] = {}
    for view in session.views:
        # One image may show several targets, in a row for each.
        earlier = first.setdefault((view.image, view.text.get("target", "")), view)
        if view.image and earlier is not view:
            unnamed = _unnamed_paths(session)
            words = f"Views {earlier.number} and {view.number} share the same image {view.image}"
            do = "give each row its own image"
            if len(unnamed) == 1:
                words += f", and {unnamed[0]} has no row"
                do = f"write {unnamed[0]} into the row of view {view.number}, column image"
            yield Finding(
                "shared_image",
                f"{words}.",
                Remedy(f"In views.csv, {do}; or delete the row of view {view.number}."),
                (earlier.number, view.number),
                until_mm=LEAST_NEED_MM,
            )


def _unnamed_paths(session: Session) -> list[str]:
    """Paths of images, in the folders of those that rows name, that no row names."""
    store = session.images
    if not isinstance(store, FolderImages):
        return []
    named = {view.image for view in session.views if view.image}
    folders = {Path(name).parent for name in named} - {Path()}
    files = (file for folder in folders for file in (store.folder / folder).glob("*"))
    paths = (
        path.relative_to(store.folder).as_posix() for path in files if path.suffix in IMAGE_ENDINGS
    )
    return sorted(set(paths) - named)


def unseen_cause(observed: Observed) -> Finding | None:
    """Finds why most images show nothing after the search, if known: files or another board."""
    session = observed.session
    with_image = _searched(session)
    with_target = observed.poses.keys() | observed.corners.keys()
    unseen = [view for view in with_image if view.number not in with_target]
    if not with_image or 3 * len(unseen) < len(with_image):
        return None
    missing = next(_missing_images(session), None)
    if missing is not None and 2 * len(missing.views) > len(unseen):
        return missing
    return other_board(session, unseen)


def because(error: VisioncalError, cause: Finding) -> VisioncalError:
    """The same error with its cause first."""
    message = f"{cause.words} {error.message}"
    return type(error)(message, culprits=error.culprits, next_step=str(cause.do or ""))


def other_board(session: Session, unseen: Sequence[View]) -> Finding | None:
    """Identifies the board in images of a session's views without the declared target.

    Returns:
        The finding; None where nothing else is seen either.
    """
    declared = session.target
    if declared is None or session.targets:
        return None
    existing = [view for view in unseen if view.image and session.images.exists(view.image)]
    found, unreadable = list[tuple[View, Identity]](), list[Finding]()
    # A few views from all over the session.
    for view in existing[:: max(len(existing) // _LOOKED_AT, 1)][:_LOOKED_AT]:
        image = decode_image(session.images.read(view.image))
        if isinstance(image, str):
            continue
        identity = _identified(image, declared)
        if identity is not None:
            found.append((view, identity))
            if identity.whole and identity.corners_seen == identity.corners:
                break
        elif _is_mirrored(image, declared):
            return _mirrored(view)
        elif (cause := _unread(view, image, declared, len(existing))) is not None:
            unreadable.append(cause)
    if not found:
        return unreadable[0] if unreadable else None
    view, identity = max(found, key=lambda pair: (pair[1].whole, pair[1].corners_seen))
    # A single tag of a grid or a rig identifies no board: the finder states what it lacks.
    is_own_tag = declared.kind != identity.board.kind and _is_its_tag(identity, declared)
    if is_own_tag or _matches(identity, declared):
        return None
    return _other_board_finding(view, identity, declared)


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
    # A single marker is no evidence against a declared ChArUco board.
    if kind_of(declared).marks_squares and _is_its_tag(identity, declared):
        return None
    return identity if identity.corners_seen >= _LEAST_CORNERS * identity.corners else None


def _is_its_tag(identity: Identity, declared: Target) -> bool:
    """Whether a single marker is of the declared board's dictionary."""
    dictionaries = (identity.board.dictionary, *identity.larger)
    return identity.is_single and declared.dictionary in dictionaries


def _matches(identity: Identity, target: Target) -> bool:
    """Whether the seen board is the target, except for its size."""
    is_same = all(getattr(identity.board, name) == getattr(target, name) for name in _COMPARED)
    return is_same and target.dictionary in ("", identity.board.dictionary, *identity.larger)


def _other_board_finding(view: View, identity: Identity, declared: Target) -> Finding:
    # The declared size is that of another board; only a print of the same squares confirms it.
    matching = min(
        (target for target in map(load_target, target_names()) if _matches(identity, target)),
        key=lambda target: abs(target.square_m - declared.square_m),
        default=None,
    )
    side = kind_of(identity.board).side
    if matching is not None:
        same = abs(matching.square_m / declared.square_m - 1.0) < _SAME_SIZE
        size = f", if the {side} is {1e3 * matching.square_m:g} mm: measure it"
        step = Remedy(f'In session.toml, write target = "{matching.name}"{"" if same else size}.')
    else:
        step = Remedy(
            f'Measure the {side}. In session.toml, write target = "seen.toml", which this command '
            "makes with the measured figure [mm] in the place of MEASURED.",
            f"visioncal target check SESSION/{shlex.quote(view.image)} --square-mm MEASURED "
            "-o SESSION/seen.toml",
        )
    seen, stated = (
        f"{'an' if words[0] in 'aA' else 'a'} {words}"
        for words in (describe(identity), board_words(declared))
    )
    words = (
        f"The images show another board than declared: {seen} (view {view.number}), and "
        f"{declared.name} is {stated}."
    )
    return Finding("other_board", words, step, (view.number,))


def _is_mirrored(image: Image, declared: Target) -> bool:
    """Whether a board is seen where left and right are exchanged; only markers show it."""
    mirrored = _identified(np.ascontiguousarray(image[:, ::-1]), declared)
    return (
        mirrored is not None
        and kind_of(mirrored.board).has_markers
        and (mirrored.board.kind == declared.kind or not kind_of(declared).marks_squares)
    )


def _mirrored(view: View) -> Finding:
    return Finding(
        "mirrored_images",
        f"The images are mirrored: the board is seen in view {view.number} only where left and "
        "right are exchanged.",
        Remedy(
            "Switch off mirroring (flip) in the camera's driver, and record again; or turn the "
            "images back.",
            f"mogrify -flop SESSION/{Path(view.image).parent.as_posix()}/*",
        ),
        (view.number,),
    )


def _unread(view: View, image: Image, declared: Target, unseen: int) -> Finding | None:
    """Finding for an image without a readable board, or with the declared one's squares alone."""
    if why := poor_image_reason(image, MAX_BLUR_PX):
        of_all = f" in {unseen} views" if unseen > 1 else ""
        words = f"No board can be read{of_all}: in view {view.number}, {why}."
        return Finding("blurred_images", words, Remedy(_FOCUS), (view.number,))
    blur_px = blur_of_edges(image)
    if not kind_of(declared).marks_squares:
        return None
    squares = CHECKERBOARD.search(image, CHECKERBOARD.inside(declared))
    if not isinstance(squares, DetectedCorners) and blur_px <= _SHARP_PX:
        return None
    return Finding(
        "unread_markers",
        f"The markers of {declared.name} cannot be read: they are too small, or blurred (sigma of "
        f"edges {blur_px:.1f} px, view {view.number}).",
        Remedy(f"Bring the board nearer, or use one of fewer and larger squares. {_FOCUS}"),
        (view.number,),
    )
