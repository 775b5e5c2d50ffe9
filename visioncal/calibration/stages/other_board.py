"""The board that images show, where it is another than declared or the images are mirrored."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import cv2
import numpy as np
import tomli_w

from visioncal.core.errors import DataError
from visioncal.core.types import Image, Target
from visioncal.core.verdict import CALIBRATE_FIXED, Finding, Remedy
from visioncal.session import Session, View
from visioncal.session.images import FolderImages
from visioncal.session.kinds import declared_targets
from visioncal.vision.boards import NotFound, find_target, kind_of
from visioncal.vision.boards.checkerboard import RIM, Checkerboard
from visioncal.vision.boards.identify import (
    LOOKED_AT,
    Identity,
    describe,
    identify,
    identify_plain,
    with_article,
)
from visioncal.vision.targets import board_words, corner_positions, extent_m, outline, target_names

# Command that writes a copy with the images as they should be, and calibrates it.
MEND_IMAGES = f"visioncal convert SESSION FIXED --mend-images && {CALIBRATE_FIXED}"
# Remedy where some images are turned or scaled.
MADE_ALIKE = Remedy("Write a copy of the session in which all are alike.", MEND_IMAGES)


class OtherBoardError(DataError):
    """The images show another board than declared, or mirror images of it."""

    finding: Finding | None = None

    @classmethod
    def of(cls, finding: Finding) -> Self:
        """The error of a finding."""
        error = cls(finding.words, next_step=str(finding.do or ""))
        error.finding = finding
        return error


def spread(views: Sequence[View], count: int = LOOKED_AT) -> Sequence[View]:
    """A few views from all over a session."""
    return views[:: max(len(views) // count, 1)][:count]


def other_board(
    session: Session, name: str, looked: Sequence[tuple[View, Image]], *, plain: bool = False
) -> Finding | None:
    """Identifies the board in images in which the declared one is not found.

    Args:
        session: The session.
        name: The board's name in the session's `boards`.
        looked: Views of it and their (h, w) grey images.
        plain: Whether only boards without markers are looked for, which is quick.

    Returns:
        The finding; None where the images may show the declared board.
    """
    declared = session.boards[name]
    images = [image for _, image in looked]
    try:
        identity = identify_plain(images) if plain else identify(images, declared)
    except DataError:
        return None
    if identity is None or (plain and _is_beside(images, identity.board, declared)):
        return None
    found = _differences(declared, identity)
    # One image of several may show something else, or a part.
    is_sure = identity.shown >= min(2, len(looked))
    if _is_part(identity, declared):
        # A sound one may be covered in part: its paper ends there.
        rims = [rim for image in images if (rim := _has_rim(image, identity.board)) is not None]
        is_sure &= sum(rims) > len(rims) / 2
    if not is_sure or not identity.is_shown:
        return None
    numbers = tuple(view.number for view, _ in looked)
    # Of many images, some may not show it.
    where = f" (view {numbers[0]})" if len(looked) <= LOOKED_AT else ""
    if identity.is_mirrored:
        return Finding(
            "mirrored_images",
            f"The images are mirrored: {with_article(identity)}{where}, is seen only "
            "where they are mirrored back.",
            Remedy(
                "Write a copy of the session with its images mirrored back, and calibrate it; "
                "then turn the flip off in the camera's driver.",
                MEND_IMAGES,
            ),
            numbers,
        )
    if identity.is_negative and not found:
        return Finding(
            "negative_images",
            "The board is printed in white on black, or the images are negatives: "
            f"{with_article(identity)}{where}.",
            Remedy(
                "Write a copy of the session with light and dark exchanged, and calibrate it; "
                "where the print is as it should be, turn the negative off in the camera's driver.",
                MEND_IMAGES,
            ),
            numbers,
        )
    if not found:
        return None
    stated = board_words(declared)
    if "spacing" in found:
        stated += f" with spacing = {declared.spacing:g}"
        metres = identity.board.spacing * declared.square_m
        if abs(declared.spacing - metres) < 0.2 * metres:
            stated += ", which looks like metres: spacing is a share of the side"
    return Finding(
        "other_board",
        f"The images show another board than declared: {describe(identity)}{where}, "
        f"and {declared.name} is {stated}{_counted_squares(declared, identity)}.",
        _remedy(session, name, identity, found, looked),
        numbers,
    )


def _is_beside(images: Sequence[Image], other: Target, declared: Target) -> bool:
    """Whether images show the declared checkerboard, too: the other one stands behind it."""
    kind = kind_of(declared)
    if not isinstance(kind, Checkerboard):
        return False
    painted = (kind.without(image, other) for image in images)
    searched = (kind.search(image, declared, quick=True) for image in painted)
    return any(not isinstance(found, NotFound) for found in searched)


def _counted_squares(declared: Target, identity: Identity) -> str:
    """The words where a checkerboard's squares were counted in place of its inner corners."""
    counts = {identity.board.columns + 1, identity.board.rows + 1}
    is_checkered = declared.kind == identity.board.kind == "checkerboard"
    if is_checkered and counts == {declared.columns, declared.rows}:
        return ": its squares, of which there is one more than inner corners each way"
    return ""


def _is_part(identity: Identity, declared: Target) -> bool:
    """Whether a board without markers has no more rows and columns than declared."""
    if declared.kind == "charuco":
        # Where markers cannot be read, it looks like a checkerboard.
        inner = (declared.columns - 1, declared.rows - 1)
        declared = replace(declared, kind="checkerboard", columns=inner[0], rows=inner[1])
    if identity.board.dictionary or identity.board.kind != declared.kind:
        return False
    # Shifted rows are shifted columns from the side: in steps of half a column they count alike.
    seen, stated = (
        sorted(((1 + one.asymmetric) * one.columns, one.rows)) for one in (identity.board, declared)
    )
    return all(few <= many for few, many in zip(seen, stated, strict=True))


def _has_rim(image: Image, board: Target) -> bool | None:
    """Whether an image shows paper all around a board, and in the light squares of it.

    None where it shows paper as far as it does not cut it off.
    """
    seen = find_target(image, board)
    if isinstance(seen, NotFound):
        return False
    places = corner_positions(board)[seen.ids, :2]
    flat = np.asarray(cv2.findHomography(places, seen.px)[0], float)
    if flat.shape != (3, 3):
        return False
    low, high = extent_m(board)
    along = np.linspace(0.0, 1.0, 40)[:, None]
    # Of sides of 1 m; the next circles' centres are a distance from the outermost ones.
    rim = 1.0 - board.diameter_m / 2 if board.kind == "circles" else RIM
    ends = outline(board)[:, :2] + rim * np.sign(outline(board)[:, :2] - (low + high) / 2)
    sides = [a + along * (b - a) for a, b in zip(ends, np.roll(ends, -1, axis=0), strict=True)]
    # Middles of squares; circles are seen between them too.
    step = 1.0 if board.kind == "checkerboard" else 0.25
    steps = [np.arange(start + 0.5, end, step) for start, end in zip(low, high, strict=True)]
    inside = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    grey = []
    for points in (*sides, inside):
        px = np.rint(cv2.perspectiveTransform(points[None], flat)[0]).astype(int)
        u, v = px[(px >= 0).all(axis=1) & (px < image.shape[::-1]).all(axis=1)].T
        grey.append(image[v, u])
    dark, light = np.percentile(grey[-1], [25, 75])
    # On the next squares of a longer board a half of a side is dark, on circles a quarter.
    paper = [float(np.percentile(side, 20)) for side in grey[:-1] if len(side)]
    # Contrast of squares over that of paper: markers that blur hides leave half of it.
    is_plain = board.kind == "circles" or light - dark > 0.75 * (np.median(paper) - dark)
    has_paper = min(paper, default=0.0) > (dark + light) / 2 and bool(is_plain)
    return None if has_paper and len(paper) < 4 else has_paper


def _remedy(
    session: Session,
    name: str,
    identity: Identity,
    found: dict[str, object],
    looked: Sequence[tuple[View, Image]],
) -> Remedy:
    """The lines to write into a board's description, or the command that describes the one seen."""
    declared, board = session.boards[name], identity.board
    share = declared.marker_m / declared.square_m
    side, mm = kind_of(board).side, f"{1e3 * declared.square_m:g}"
    # A board of other counts and other markers is another print, whose lengths are its own.
    is_other = "kind" in found or found.keys() >= {"columns", "dictionary"}
    if not is_other and abs(board.marker_m - share) < 0.06:
        figures = " and ".join(tomli_w.dumps(found).splitlines())
        words, command = board_correction(session, name, figures)
        words = f"{words[0].upper()}{words[1:]}, or name another target."
        if found.keys() & {"columns", "dictionary"}:
            words += f" Measure the {side}, and where it is not {mm} mm, write square_m"
            words += f", and {board.marker_m:.3g} times it as marker_m" * (board.marker_m > 0.0)
            words += "."
        return Remedy(words, command)
    images = " ".join(f"SESSION/{shlex.quote(view.image)}" for view, _ in looked)
    key = f"in [targets], {name}" if name else "target"
    markers = f", by which markers are {board.marker_m:.3g} of it" * (board.marker_m > 0.0)
    return Remedy(
        f"Measure the {side}, and where it is not {mm} mm as declared, change the figure in the "
        f'command{markers}. In session.toml, write {key} = "seen.toml", which it makes.',
        f"visioncal target check {images} --square-mm {mm} -o SESSION/seen.toml",
    )


def board_correction(session: Session, board: str, figures: str) -> tuple[str, str]:
    """How figures such as `square_m = 0.03` are written into the description of a board.

    Returns:
        A part of a sentence, and the command that it takes: one for a board that ships with
        visioncal, of which a session's folder has no file.
    """
    named = ""
    if isinstance(session.images, FolderImages):
        named = declared_targets(session.declaration).get(board, "")
    if named not in target_names():
        return f"write {figures} in the board's .toml", ""
    return (
        f'write target = "{named}.toml" in session.toml, and {figures} in that file, which the '
        "command makes",
        f"visioncal target make {named} -o SESSION --toml-only",
    )


def _differences(declared: Target, identity: Identity) -> dict[str, object]:
    """Differences of an identified board from a declared target, by the description's keys.

    Empty where the images may show the declared target: a part of it, or one that is not clear.
    """
    board = identity.board
    counts: dict[str, object] = {"columns": board.columns, "rows": board.rows}
    names = {board.dictionary, *identity.larger}
    # A single marker is no evidence against a board of several, whose finder says what it lacks:
    # one may be covered up to it, or 16 bits be read by chance in markers of more.
    is_chance = bool(declared.dictionary) and board.dictionary.startswith("DICT_4X4")
    is_no_evidence = is_chance or declared.dictionary in names
    if identity.is_single and declared.columns * declared.rows > 1 and is_no_evidence:
        return {}
    if board.kind != declared.kind:
        if {tag for tag, _ in declared.point_tags} & {*identity.marker_ids}:
            return {}
        return {"kind": board.kind, **counts}
    if board.kind in ("checkerboard", "circles"):
        seen = {**counts, "asymmetric": board.asymmetric}
        same = sorted((board.columns, board.rows)) == sorted((declared.columns, declared.rows))
        if same and board.asymmetric == declared.asymmetric:
            return {}
        return seen if board.kind == "circles" else counts
    return _other_markers(declared, identity)


def _other_markers(declared: Target, identity: Identity) -> dict[str, object]:
    board, found = identity.board, dict[str, object]()
    keys = kind_of(board).keys.split()
    if board.columns != declared.columns or board.rows > declared.rows:
        found |= {"columns": board.columns, "rows": board.rows}
    if declared.dictionary not in {board.dictionary, *identity.larger}:
        found["dictionary"] = board.dictionary
    first = max(board.marker_id, 0)
    if first != max(declared.marker_id, 0):
        found["id" if "id" in keys else "first_id"] = first
    # With an odd number of rows there is one layout.
    if (board.legacy and board.rows % 2 == 0) != (declared.legacy and declared.rows % 2 == 0):
        found["legacy"] = board.legacy
    # Gaps between markers that differ by less are the same [sides].
    if abs(board.spacing - declared.spacing) > 0.05:
        found["spacing"] = round(board.spacing, 2)
    if "border" in keys and board.border != declared.border:
        found["border"] = board.border
    return found
