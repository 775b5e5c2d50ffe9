"""Checks of a session's images and board before any fit, and what to type."""

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from visioncal.calibration.stages.observed import Observed
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.limits import MAX_BLUR_PX, CalibrationLimits
from visioncal.core.number_format import some_of
from visioncal.core.types import Image, Target
from visioncal.core.verdict import EMPTY_ROWS, LEAST_NEED_MM, MISSING, Finding, Remedy
from visioncal.session import Session, View
from visioncal.session.images import IMAGE_ENDINGS, FolderImages
from visioncal.session.kinds import is_camera_observation, is_instrument_reading
from visioncal.session.selecting import is_whole_cell
from visioncal.vision.boards import DetectedCorners, kind_of
from visioncal.vision.boards.checkerboard import CHECKERBOARD
from visioncal.vision.boards.identify import DESCRIBE_IT, describe, identify
from visioncal.vision.boards.identity import Identity
from visioncal.vision.boards.imaging import blur_of_edges, decode_image, poor_image_reason
from visioncal.vision.boards.kind import marker_cells
from visioncal.vision.targets import board_words, load_target, target_names

# Names that are listed, and images that are searched for any board.
_LISTED, _LOOKED_AT = 6, 3
# Properties of a board that an image shows, beside its markers' dictionary.
_COMPARED = ("kind", "columns", "rows", "legacy", "marker_id")
# Least share of a board's corners in an image that identifies it.
_LEAST_CORNERS = 0.2
_UNREAD, _MIRRORED = "unread_markers", "mirrored_images"
# Blur (sigma) up to which markers are read [modules], and the largest of a lens in focus [px].
_READ, _SHARP_PX = 0.4, 1.2
# Relative difference of square sizes by rounding.
_SAME_SIZE = 0.01
# Stands in a command for a size that has to be measured first.
_MEASURED = "MEASURED"


def pairing(session: Session) -> Iterator[Finding]:
    """Reports rows without image or any observation, and rows that share an image."""
    yield from _missing_images(session)
    yield from _empty_rows(session)
    yield from _shared_images(session)


def searched_images(session: Session) -> Iterator[str]:
    """States whose images are searched, where corners.csv has rows of other views alone."""
    searched = [view.number for view in session.views if view.image and not view.has_corners]
    if searched and any(view.has_corners for view in session.views):
        yield (
            f"corners.csv has no rows of view {some_of([*map(str, searched)], _LISTED)}: their "
            "images were searched."
        )


def unnamed_images(session: Session) -> Iterator[Finding]:
    """Reports images beside those of the session that no row names."""
    unnamed = _unnamed_paths(session)
    if unnamed:
        count = "1 image has" if len(unnamed) == 1 else f"{len(unnamed)} images have"
        yield Finding(
            "unnamed_images",
            f"{count} no row in views.csv: {some_of(unnamed, _LISTED)}.",
            Remedy("Add a row for each, with the robot's pose, or take them out of the folder."),
            until_mm=0.0,
        )


def _missing_images(session: Session) -> Iterator[Finding]:
    with_image = [view for view in session.views if view.image and not view.has_corners]
    missing = [view for view in with_image if session.images.absence(view.image) == "is missing"]
    if not missing:
        return
    names = [view.image for view in missing]
    verb = "image is" if len(with_image) == 1 else "images are"
    words = f"{len(missing)} of {len(with_image)} {verb} missing: {some_of(names, _LISTED)}"
    elsewhere, renaming = _renamed(session, names)
    if elsewhere:
        words = f"{words}; there is {elsewhere} instead."
        step = Remedy(renaming)
    else:
        words = f"{words}."
        rows = ", ".join(str(view.number) for view in missing)
        step = Remedy(
            f"Copy the image{'s' if len(names) > 1 else ''} there; or in views.csv, delete the "
            f"row{'s' if len(names) > 1 else ''} of view {rows}."
        )
    views = tuple(view.number for view in missing)
    yield Finding(MISSING, words, step, views, until_mm=0.0)


def _empty_rows(session: Session) -> Iterator[Finding]:
    """Reports rows of one camera and one robot that observe nothing, where others do."""
    # In a whole cell, a row may state only where a robot was.
    observes = [
        is_camera_observation(view) or is_instrument_reading(view) for view in session.views
    ]
    if is_whole_cell(session) or all(observes) or not any(observes):
        return
    empty = [view for view, seen in zip(session.views, observes, strict=True) if not seen]
    views, last = tuple(view.number for view in empty), len(observes) - len(empty) - 1
    named, these = some_of([*map(str, views)], _LISTED), "these rows" if views[1:] else "this row"
    verb = "observe" if views[1:] else "observes"
    words = f"{len(views)} of {len(observes)} rows of views.csv {verb} nothing: view {named}"
    step = Remedy(f"In views.csv, fill in column image of {these}, or delete {these}.")
    if any(view.has_corners for view in session.views):
        words = f"{words}; without an image, a view needs rows in corners.csv"
        if all(observes[: last + 1]):
            number = session.views[last].number
            words = f"{words}, which ends with view {number}, as if it was cut off"
        step = Remedy(f"Write corners.csv again, as a whole; or in views.csv, delete {these}.")
    many = len(views) > CalibrationLimits().lost_share[0] * len(observes)
    yield Finding("lost_rows" if many else EMPTY_ROWS, f"{words}.", step, views, until_mm=0.0)


def _renamed(session: Session, names: Sequence[str]) -> tuple[str, str]:
    """Where the first image is, and what to replace so that all are found; empty for nothing."""
    store = session.images
    if not isinstance(store, FolderImages):
        return "", ""
    first = Path(names[0])
    pairs = [(first.suffix, item) for item in (*IMAGE_ENDINGS, *map(str.upper, IMAGE_ENDINGS))]
    others = sorted(f"{path.name}/" for path in store.folder.iterdir() if path.is_dir())
    folder = "" if first.parent == Path() else f"{first.parent.as_posix()}/"
    pairs += [(folder, other) for other in (*others, "")]
    for old, new in pairs:
        changed = [name.replace(old, new) if old else f"{new}{name}" for name in names]
        if old != new and all(store.exists(name) for name in changed):
            step = f"replace {old} by {new}" if old else f"write {new} before the images' names"
            return changed[0], f"In views.csv, {step}."
    return "", ""


def _shared_images(session: Session) -> Iterator[Finding]:
    first: dict[tuple[str, str], View] = {}
    for view in session.views:
        # One image may show several targets, in a row for each.
        key = (view.image, view.text.get("target", ""))
        earlier = first.setdefault(key, view)
        if view.image and earlier is not view:
            unnamed = _unnamed_paths(session)
            words = f"Views {earlier.number} and {view.number} share the same image {view.image}"
            do = "give each row its own image"
            if len(unnamed) == 1:
                words = f"{words}, and {unnamed[0]} has no row"
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
    with_image = [view for view in session.views if view.image and not view.has_corners]
    with_target = observed.poses.keys() | observed.corners.keys()
    unseen = [view for view in with_image if view.number not in with_target]
    if not with_image or 3 * len(unseen) < len(with_image):
        return None
    missing = next((finding for finding in pairing(session) if finding.kind == MISSING), None)
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
    best: tuple[View, Identity] | None = None
    unreadable: Finding | None = None
    # A few views from all over the session.
    for view in existing[:: max(len(existing) // _LOOKED_AT, 1)][:_LOOKED_AT]:
        image = decode_image(session.images.read(view.image))
        if isinstance(image, str):
            continue
        identity = _identified(image, declared)
        if identity is None:
            why = poor_image_reason(image, MAX_BLUR_PX)
            blurred = _blurred_finding(view, why, existing) if why else None
            cause = blurred or _unread(view, image, declared)
            if cause is not None and cause.kind == _MIRRORED:
                return cause
            unreadable = unreadable or cause
        elif best is None or _is_better(identity, best[1]):
            best = view, identity
            if identity.whole and identity.corners_seen == identity.corners:
                break
    if best is None:
        return unreadable
    view, identity = best
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


def _is_better(new: Identity, best: Identity) -> bool:
    return (new.whole, new.corners_seen) > (best.whole, best.corners_seen)


def _matches(identity: Identity, target: Target) -> bool:
    """Whether the seen board is the target, except for its size."""
    is_same = all(getattr(identity.board, name) == getattr(target, name) for name in _COMPARED)
    return is_same and target.dictionary in ("", identity.board.dictionary, *identity.larger)


def _other_board_finding(view: View, identity: Identity, declared: Target) -> Finding:
    shipped = (load_target(name) for name in target_names())
    matching = [target for target in shipped if _matches(identity, target)]
    # The declared size is that of another board; only a print of the same squares confirms it.
    matching.sort(key=lambda target: abs(target.square_m - declared.square_m))
    side = kind_of(identity.board).side
    if matching:
        same = abs(matching[0].square_m / declared.square_m - 1.0) < _SAME_SIZE
        size = f", if the {side} is {1e3 * matching[0].square_m:g} mm: measure it"
        step = Remedy(
            f'In session.toml, write target = "{matching[0].name}"{"" if same else size}.'
        )
    else:
        step = Remedy(
            f'Measure the {side}. In session.toml, write target = "seen.toml", which this command '
            f"makes with the measured figure [mm] in the place of {_MEASURED}.",
            _describe_command(view, _MEASURED),
        )
    words = (
        "The images show another board than declared: "
        f"{_article(describe(identity))} (view {view.number}), and {declared.name} is "
        f"{_article(board_words(declared))}.{_counting_mistake(identity, declared)}"
    )
    return Finding("other_board", words, step, (view.number,))


def _article(words: str) -> str:
    return f"{'an' if words[0] in 'aA' else 'a'} {words}"


def _counting_mistake(identity: Identity, declared: Target) -> str:
    """The likely mistake in counting inner corners, in words; empty for another difference."""
    if any(kind_of(target).symmetric != "squares" for target in (identity.board, declared)):
        return ""
    counts = (sorted((target.columns, target.rows)) for target in (declared, identity.board))
    differences = {stated - seen for stated, seen in zip(*counts, strict=True)}
    if differences == {1}:
        return " The squares were counted: columns and rows are of inner corners, one less each."
    if differences == {-1}:
        return " One was taken off twice: columns and rows are of inner corners themselves."
    return ""


def _unread(view: View, image: Image, declared: Target) -> Finding | None:
    """Finding for an image without a readable board, or with the declared one's squares alone."""
    mirrored = _identified(np.ascontiguousarray(image[:, ::-1]), declared)
    # Squares look alike mirrored: only readable markers show it.
    marks_squares = kind_of(declared).marks_squares
    if (
        mirrored is not None
        and kind_of(mirrored.board).has_markers
        and (mirrored.board.kind == declared.kind or not marks_squares)
    ):
        return _mirrored_finding(view)
    if not marks_squares:
        return None
    plain = CHECKERBOARD.inside(declared)
    squares = CHECKERBOARD.search(image, plain)
    blur_px = blur_of_edges(image)
    if isinstance(squares, DetectedCorners):
        grid = squares.px.reshape(plain.rows, plain.columns, 2)
        square_px = float(np.median(np.linalg.norm(np.diff(grid, axis=1), axis=2)))
        marker_px = square_px * declared.marker_m / declared.square_m
        module_px = marker_px / len(marker_cells(declared.dictionary, 0))
        width = f"and a marker's modules are {module_px:.1f} px wide"
        if blur_px <= max(_READ * module_px, _SHARP_PX):
            return Finding(
                _UNREAD,
                f"The images show the squares of {declared.name}, but its markers cannot be read: "
                f"they are {marker_px:.0f} px wide, {module_px:.1f} px a module (view "
                f"{view.number}).",
                Remedy(
                    "Bring the board nearer, focus, or use a board of fewer and larger squares. "
                    "Where all of it is in the images, it serves as a checkerboard: in board.toml "
                    f'write kind = "checkerboard", columns = {plain.columns}, rows = {plain.rows}, '
                    f"square_m = {declared.square_m:g}, and in session.toml target = "
                    '"board.toml".'
                ),
                (view.number,),
            )
    elif blur_px > _SHARP_PX:
        width = f"and markers are read where their modules are {blur_px / _READ:.1f} px or wider"
    else:
        return None
    return Finding(
        _UNREAD,
        f"The images are too blurred for the markers of {declared.name}: their edges have a blur "
        f"(sigma) of {blur_px:.1f} px, {width} (view {view.number}).",
        Remedy(
            "Focus the lens, expose for a shorter time with more light, or bring the board nearer; "
            "then record again."
            + ("" if isinstance(squares, DetectedCorners) else f" {DESCRIBE_IT}")
        ),
        (view.number,),
    )


def _describe_command(view: View, square_mm: str) -> str:
    """The command that describes the board in a view's image."""
    return (
        f"visioncal target check SESSION/{shlex.quote(view.image)} "
        f"--square-mm {square_mm} -o SESSION/seen.toml"
    )


def _mirrored_finding(view: View) -> Finding:
    return Finding(
        _MIRRORED,
        f"The images are mirrored: the board is seen in view {view.number} only where left and "
        "right are exchanged.",
        Remedy(
            "Switch off mirroring (flip) in the camera's driver, and record again; or turn the "
            "images back.",
            f"mogrify -flop SESSION/{Path(view.image).parent.as_posix()}/*",
        ),
        (view.number,),
    )


def _blurred_finding(view: View, why: str, views: Sequence[View]) -> Finding:
    of_all = f" in {len(views)} views" if len(views) > 1 else ""
    return Finding(
        "blurred_images",
        f"No board can be read{of_all}: in view {view.number}, {why}.",
        Remedy("Focus the lens, expose for a shorter time with more light, and record again."),
        tuple(other.number for other in views),
    )
