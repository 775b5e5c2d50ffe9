"""What is wrong with a session's images and its board, and what to type: before any fit."""

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
from visioncal.session.images import FolderImages
from visioncal.session.kinds import is_read, is_seen
from visioncal.session.selecting import is_whole_cell
from visioncal.vision.finders.identify import Identity, identify
from visioncal.vision.finders.identify_text import describe
from visioncal.vision.finders.imaging import blur_of_edges, decode_image, why_hard_to_see
from visioncal.vision.targets import board_words, load_target, marker_cells, target_names

# So many names are listed, and so many images are searched for whatever board they show.
_LISTED, _LOOKED_AT = 6, 3
_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
# What a photograph shows of a board, beside the dictionary of its markers.
_SEEN = ("kind", "columns", "rows", "legacy", "marker_id", "asymmetric")
# A board is named by an image that shows so much of it.
_CLEARLY = 0.2
_UNREAD, _MIRRORED = "unread_markers", "mirrored_images"
# Markers are read up to a blur (sigma) of 0.4 of their modules, and from 1.2 on leave light squares
# plain. From 0.9 on, dark squares pass for circles as wide as their rows are apart.
_READ, _PLAIN, _ROUND, _WIDE = 0.4, 1.2, 0.9, 0.9
# No lens in focus is worse [px].
_SHARP_PX = 1.2
# Sizes of squares that are the same but for rounding.
_SAME_SIZE = 0.01


def pairing(session: Session) -> Iterator[Finding]:
    """Says which rows have no image or show nothing at all, and which share an image."""
    yield from _missing(session)
    yield from _empty_rows(session)
    yield from _shared(session)


def searched_images(session: Session) -> Iterator[str]:
    """Says whose images are searched, where corners.csv has rows of other views alone."""
    searched = [view.number for view in session.views if view.image and not view.has_corners]
    if searched and any(view.has_corners for view in session.views):
        yield (
            f"corners.csv has no rows of view {some_of([*map(str, searched)], _LISTED)}: their "
            "images were searched."
        )


def unnamed_images(session: Session) -> Iterator[Finding]:
    """Says which images beside those of the session no row names."""
    more = _unnamed(session)
    if more:
        have = "1 image has" if len(more) == 1 else f"{len(more)} images have"
        yield Finding(
            "unnamed_images",
            f"{have} no row in views.csv: {some_of(more, _LISTED)}.",
            Remedy("Add a row for each, with the robot's pose, or take them out of the folder."),
            until_mm=0.0,
        )


def _missing(session: Session) -> Iterator[Finding]:
    with_image = [view for view in session.views if view.image and not view.has_corners]
    missing = [view for view in with_image if session.images.absence(view.image) == "is missing"]
    if not missing:
        return
    names = [view.image for view in missing]
    are = "image is" if len(with_image) == 1 else "images are"
    words = f"{len(missing)} of {len(with_image)} {are} missing: {some_of(names, _LISTED)}"
    there, renaming = _renamed(session, names)
    if there:
        words = f"{words}; there is {there} instead."
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
    """Says which rows of one camera and one robot observe nothing, where others do."""
    # In a whole cell, a row may state where a robot was, and no more.
    shown = [is_seen(view) or is_read(view) for view in session.views]
    if is_whole_cell(session) or all(shown) or not any(shown):
        return
    empty = [view for view, is_shown in zip(session.views, shown, strict=True) if not is_shown]
    views, last = tuple(view.number for view in empty), len(shown) - len(empty) - 1
    named, these = some_of([*map(str, views)], _LISTED), "these rows" if views[1:] else "this row"
    words = f"{len(views)} of {len(shown)} rows of views.csv observe nothing: view {named}"
    step = Remedy(f"In views.csv, fill in column image of {these}, or delete {these}.")
    if any(view.has_corners for view in session.views):
        words = f"{words}; without an image, a view needs rows in corners.csv"
        if all(shown[: last + 1]):
            words = (
                f"{words}, which ends with view {session.views[last].number}, as if it was cut off"
            )
        step = Remedy(f"Write corners.csv again, as a whole; or in views.csv, delete {these}.")
    many = len(views) > CalibrationLimits().lost_share[0] * len(shown)
    yield Finding("lost_rows" if many else EMPTY_ROWS, f"{words}.", step, views, until_mm=0.0)


def _renamed(session: Session, names: Sequence[str]) -> tuple[str, str]:
    """Where the first image is, and what to replace so that all are there; empty if nothing."""
    store = session.images
    if not isinstance(store, FolderImages):
        return "", ""
    first = Path(names[0])
    pairs = [(first.suffix, item) for item in (*_ENDINGS, *(ending.upper() for ending in _ENDINGS))]
    others = sorted(f"{path.name}/" for path in store.folder.iterdir() if path.is_dir())
    folder = "" if first.parent == Path() else f"{first.parent.as_posix()}/"
    pairs += [(folder, other) for other in (*others, "")]
    for old, new in pairs:
        changed = [name.replace(old, new) if old else f"{new}{name}" for name in names]
        if old != new and all(store.exists(name) for name in changed):
            step = f"replace {old} by {new}" if old else f"write {new} before the images' names"
            return changed[0], f"In views.csv, {step}."
    return "", ""


def _shared(session: Session) -> Iterator[Finding]:
    first: dict[tuple[str, str], View] = {}
    for view in session.views:
        # One image may show several targets, in a row for each.
        key = (view.image, view.text.get("target", ""))
        before = first.setdefault(key, view)
        if view.image and before is not view:
            free = _unnamed(session)
            words = f"Views {before.number} and {view.number} share the same image {view.image}"
            do = "give each row its own image"
            if len(free) == 1:
                words = f"{words}, and {free[0]} has no row"
                do = f"write {free[0]} into the row of view {view.number}, column image"
            yield Finding(
                "shared_image",
                f"{words}.",
                Remedy(f"In views.csv, {do}; or delete the row of view {view.number}."),
                (before.number, view.number),
                until_mm=LEAST_NEED_MM,
            )


def _unnamed(session: Session) -> list[str]:
    """Images in the folders of those that rows name, by their paths, that no row names."""
    store = session.images
    if not isinstance(store, FolderImages):
        return []
    named = {view.image for view in session.views if view.image}
    folders = {Path(name).parent for name in named} - {Path()}
    found = (file for folder in folders for file in (store.folder / folder).glob("*"))
    paths = (path.relative_to(store.folder).as_posix() for path in found if path.suffix in _ENDINGS)
    return sorted(set(paths) - named)


def unseen_cause(seen: Observed) -> Finding | None:
    """Says why images show nothing, once they were looked at: missing files, or another board.

    Returns:
        It; None where the target is in most of the images, or nothing else is seen.
    """
    session = seen.session
    with_image = [view for view in session.views if view.image and not view.has_corners]
    there = seen.poses.keys() | seen.corners.keys()
    unseen = [view for view in with_image if view.number not in there]
    if not with_image or 3 * len(unseen) < len(with_image):
        return None
    missing = next((finding for finding in pairing(session) if finding.kind == MISSING), None)
    if missing is not None and 2 * len(missing.views) > len(unseen):
        return missing
    return other_board(session, unseen)


def because(error: VisioncalError, cause: Finding) -> VisioncalError:
    """The same refusal with its cause first."""
    message = f"{cause.words} {error.message}"
    return type(error)(message, culprits=error.culprits, next_step=str(cause.do or ""))


def other_board(session: Session, unseen: Sequence[View]) -> Finding | None:
    """Says what images show in which the declared target is not seen.

    Args:
        session: The session; of one target.
        unseen: Its views without the target.

    Returns:
        It; None where nothing else is seen either.
    """
    declared = session.target
    if declared is None or session.targets:
        return None
    there = [view for view in unseen if view.image and session.images.exists(view.image)]
    shown: tuple[View, Identity] | None = None
    hard: Finding | None = None
    # A few views from all over the session.
    for view in there[:: max(len(there) // _LOOKED_AT, 1)][:_LOOKED_AT]:
        image = decode_image(session.images.read(view.image))
        if isinstance(image, str):
            continue
        why = why_hard_to_see(image, MAX_BLUR_PX)
        if why:
            hard = hard or _blurred(view, why, there)
            continue
        found = _identified(image, declared)
        cause = _unread(view, image, found, declared)
        if cause is not None and (found is not None or cause.kind == _MIRRORED):
            return cause
        hard = hard or cause
        if found is not None and (shown is None or _is_better(found, shown[1])):
            shown = view, found
            if found.whole and found.corners_seen == found.corners:
                break
    if shown is None or (hard and hard.kind == _UNREAD and _has_its_squares(shown[1], declared)):
        return hard
    view, found = shown
    # Of a grid or a rig of tags, one alone names no board: the finder says what it lacks.
    if declared.kind in ("aprilgrid", "points") and _is_its_tag(found, declared):
        return None
    return None if _is(found, declared) else _another(view, found, declared)


def _identified(image: Image, declared: Target) -> Identity | None:
    """The board of an image; None where few of its corners are seen, as where it is blurred."""
    # A single marker of a declared ChArUco board is none.
    try:
        found = identify(image)
    except DataError:
        return None
    if declared.kind == "charuco" and _is_its_tag(found, declared):
        return None
    if found.corners_seen >= _CLEARLY * found.corners:
        return found
    # Of a blurred board, squares may be counted where its corners are not found one by one.
    many = 2 * found.corners > (declared.columns - 1) * (declared.rows - 1)
    blurred = found.is_filled and many and _lacks_markers(image, found, declared)
    return found if blurred else None


def _is_its_tag(found: Identity, declared: Target) -> bool:
    """Whether a single marker is of the dictionary that a board is declared to have."""
    return found.kind == "marker" and declared.dictionary in (found.dictionary, *found.larger)


def _has_its_squares(found: Identity, declared: Target) -> bool:
    """Whether a checkerboard is as large as the one that a declared ChArUco board is made from."""
    inner = {declared.columns - 1, declared.rows - 1}
    is_pair = declared.kind == "charuco" and found.kind == "checkerboard"
    return is_pair and {found.columns, found.rows} == inner


def _module_px(found: Identity, declared: Target) -> float:
    """How wide the modules of a declared ChArUco board's markers are, by its squares [px]."""
    modules = len(marker_cells(declared.dictionary, 0))
    return found.square_px * declared.marker_m / declared.square_m / modules


def _lacks_markers(image: Image, found: Identity, declared: Target) -> bool:
    """Whether squares are seen that a declared ChArUco board has, but no markers in them."""
    if declared.kind != "charuco" or found.kind not in ("checkerboard", "circles"):
        return False
    blur = blur_of_edges(image) / _module_px(found, declared)
    if found.is_filled:
        return blur > _READ or _has_its_squares(found, declared)
    if found.kind == "circles":
        return found.asymmetric and found.diameter_share > _WIDE and blur > _ROUND
    return blur > _PLAIN and not _is_larger(found, declared)


def _is_larger(found: Identity, declared: Target) -> bool:
    """Whether a checkerboard has more squares along a side than a ChArUco board."""
    seen, inner = (sorted((identity.columns, identity.rows)) for identity in (found, declared))
    return any(one > other - 1 for one, other in zip(seen, inner, strict=True))


def _is_better(found: Identity, before: Identity) -> bool:
    return (found.whole, found.corners_seen) > (before.whole, before.corners_seen)


def _is(found: Identity, target: Target) -> bool:
    """Whether a board that was seen is a target, but for its size."""
    seen = found.target(target.name, target.square_m)
    same = all(getattr(seen, name) == getattr(target, name) for name in _SEEN)
    return same and target.dictionary in ("", found.dictionary, *found.larger)


def _another(view: View, found: Identity, declared: Target) -> Finding:
    shipped = (load_target(name) for name in target_names())
    mine = [
        target.name
        for target in shipped
        if _is(found, target) and abs(target.square_m / declared.square_m - 1.0) < _SAME_SIZE
    ]
    if mine:
        step = Remedy(f'In session.toml, write target = "{mine[0]}".')
    else:
        step = Remedy(
            'In session.toml, write target = "seen.toml", which this command makes; give it the '
            "measured side of a square.",
            _made_from(view, declared),
        )
    words = (
        "The images show another board than declared: "
        f"{_article(describe(found))} (view {view.number}), "
        f"and {declared.name} is {_article(board_words(declared))}.{_miscounted(found, declared)}"
    )
    return Finding("other_board", words, step, (view.number,))


def _article(words: str) -> str:
    return f"{'an' if words[0] in 'aA' else 'a'} {words}"


def _miscounted(found: Identity, declared: Target) -> str:
    """What was counted in the place of inner corners, in words; empty where that is not it."""
    if found.kind != "checkerboard" or declared.kind != "checkerboard":
        return ""
    one, other = (sorted((target.columns, target.rows)) for target in (declared, found))
    more = {a - b for a, b in zip(one, other, strict=True)}
    if more == {1}:
        return " The squares were counted: columns and rows are of inner corners, one less each."
    if more == {-1}:
        return " One was taken off twice: columns and rows are of inner corners themselves."
    return ""


def _unread(view: View, image: Image, found: Identity | None, declared: Target) -> Finding | None:
    """What an image shows in which nothing of a board is read, or its squares alone."""
    if found is not None and not _lacks_markers(image, found, declared):
        return None
    mirrored = _identified(np.ascontiguousarray(image[:, ::-1]), declared)
    # Squares look alike in a mirror: only what is read in it says that there is one.
    of_it = ("charuco",) if declared.kind == "charuco" else ("charuco", "aprilgrid", "marker")
    if mirrored is not None and mirrored.kind in of_it:
        return _mirrored(view)
    squares = found or mirrored
    if squares is None or not _lacks_markers(image, squares, declared):
        return None
    blur_px, module_px = blur_of_edges(image), _module_px(squares, declared)
    if blur_px > max(_READ * module_px, _SHARP_PX):
        return Finding(
            _UNREAD,
            f"The images are too blurred for the markers of {declared.name}: their edges have a "
            f"blur (sigma) of {blur_px:.1f} px, and a marker's modules are {module_px:.1f} px wide "
            f"(view {view.number}); up to {_READ * module_px:.1f} px are read.",
            Remedy(
                "Focus the lens, expose for a shorter time with more light, or bring the board "
                "nearer; then record again."
            ),
            (view.number,),
        )
    marker_px = squares.square_px * declared.marker_m / declared.square_m
    step = Remedy("Bring the board nearer, focus, or use a board of fewer and larger squares.")
    if found is not None:  # Where a few markers are read after all, it is no checkerboard.
        step = Remedy(
            f"{step.words} Where all of it is in the images, it serves as a checkerboard: write "
            'target = "seen.toml" in session.toml, which this command makes.',
            _made_from(view, declared),
        )
    return Finding(
        _UNREAD,
        f"The images show the squares of {declared.name}, but its markers cannot be read: they are "
        f"{marker_px:.0f} px wide, {module_px:.1f} px a module (view {view.number}).",
        step,
        (view.number,),
    )


def _made_from(view: View, declared: Target) -> str:
    """The command that describes the board of a view's image."""
    return (
        f"visioncal target check SESSION/{shlex.quote(view.image)} "
        f"--square-mm {1e3 * declared.square_m:g} -o SESSION/seen.toml"
    )


def _mirrored(view: View) -> Finding:
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


def _blurred(view: View, why: str, views: Sequence[View]) -> Finding:
    of_all = f" in {len(views)} views" if len(views) > 1 else ""
    return Finding(
        "blurred_images",
        f"No board can be read{of_all}: in view {view.number}, {why}.",
        Remedy("Focus the lens, expose for a shorter time with more light, and record again."),
        tuple(other.number for other in views),
    )
