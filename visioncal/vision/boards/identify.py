"""Identification of an unknown board in a photograph, by the ids and positions of its markers.

A checkerboard or a grid of circles has no markers, and has to be described.
"""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import one_line
from visioncal.core.types import Image
from visioncal.vision.boards import KINDS, kind_of
from visioncal.vision.boards.identity import FAMILIES, LEAST_MARKERS, Identity, decoded
from visioncal.vision.boards.imaging import check_grey, poor_image_reason
from visioncal.vision.boards.marker import genuine, single_marker

# Wider edges hide the bits of small markers [px].
_MAX_BLUR_PX = 6.0
# Images with at least twice these sides are also searched at this size.
_USUAL_PIXELS, _MUCH_LARGER = 2e6, 0.5

# What to type for a board that its picture does not identify.
DESCRIBE_IT = (
    "Where the board is a checkerboard, write board.toml with its own figures for kind = "
    '"checkerboard", columns = 9, rows = 6 (inner corners), square_m = 0.025 (measured); where it '
    'is a grid of circles, kind = "circles", columns = 4, rows = 11, square_m = 0.02 (between '
    'rows), diameter_m = 0.015, asymmetric = true; and target = "board.toml" in session.toml.'
)


@typed
def identify(image: Image) -> Identity:
    """Identifies the target in an image by its markers: ChArUco, AprilGrid or a single marker.

    Args:
        image: (h, w) grey image.

    Returns:
        The target with the most corners; its notes list other visible ones.

    Raises:
        DataError: No markers are seen, as of checkerboards and circles, or the image is not grey.
    """
    check_grey(image, "image")
    identity = _identity(image)
    if identity is not None:
        return identity
    # In images much larger than the detectors are made for, details hide the board.
    scale = (_USUAL_PIXELS / image.size) ** 0.5
    if scale < _MUCH_LARGER:
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        identity = _identity(np.asarray(small, np.uint8))
        if identity is not None:
            note = f"It is found only in the picture reduced to {small.shape[1]} pixels in width."
            return replace(identity, notes=(note, *identity.notes))
    why = poor_image_reason(image, _MAX_BLUR_PX)
    height, width = image.shape
    raise DataError(
        f"No marker is read in this image of {width} x {height} pixels"
        + (f": {why}." if why else ".")
        + " A board is identified by its markers: one of OpenCV's ArUco and AprilTag dictionaries, "
        f"or {LEAST_MARKERS} of a ChArUco board or an AprilGrid; {len(decoded(image))} patterns "
        "looked like a marker. A checkerboard or a grid of circles has none, and must be stated.",
        culprits=["image"],
        next_step=f"{DESCRIBE_IT} Where it has markers, take a sharp picture of the whole board, "
        "with white around it, evenly lit, nearer, and tilted by less than 60 degrees.",
    )


def _identity(image: Image) -> Identity | None:
    """The target with the most corners; None if there is none."""
    markers = decoded(image)
    boards = [board for kind in KINDS.values() for board in kind.identify(image, markers)]
    taken = [(board.board.dictionary, *board.larger) for board in boards]
    single = single_marker(
        [
            marker
            for marker in genuine(markers)
            if not any({*names} & {*FAMILIES[marker.family]} for names in taken)
        ]
    )
    if not boards:
        return single
    best = max(boards, key=lambda candidate: candidate.corners_seen)
    # A grid's tags are not single markers.
    if single is None or best.board.spacing:
        return best
    note = f"Beside it, marker {single.marker_ids[0]} of {single.board.dictionary} is seen."
    return replace(best, notes=(*best.notes, note))


def to_document(identity: Identity, square_m: float | None) -> dict[str, Any]:
    """An identity as the content of a JSON document, without fields that do not apply.

    With a measured side of a square, or of a single marker [m], it has the target's description
    too.
    """
    kind, board = kind_of(identity.board), identity.board
    document: dict[str, Any] = {
        "kind": board.kind,
        "corners_seen": identity.corners_seen,
        "corners": identity.corners,
        "notes": list(identity.notes),
    }
    described = kind.document(board)
    if "columns" in described:
        document |= {"columns": board.columns, "rows": board.rows, "whole": identity.whole}
    document |= {
        "dictionary": board.dictionary,
        "same_markers": list(identity.larger),
        "marker_ids": list(identity.marker_ids),
    }
    if "marker_m" in described:
        document |= {
            "legacy": board.legacy,
            "marker_over_square": identity.marker_share,
            "marker_over_square_sigma": identity.marker_share_sigma,
        }
    document |= {key: described[key] for key in ("spacing", "border") if key in described}
    if square_m is not None:
        document["target"] = {
            "kind": board.kind,
            **kind.document(identity.target("board", square_m)),
        }
    return document


def to_toml(identity: Identity, square_m: float | None, source: str) -> str:
    """An identity as a target's description; `source` names the image in its first line.

    Without a measured side of a square, or of a single marker [m], sizes become comments on what to
    measure.
    """
    kind = kind_of(identity.board)
    size, what = kind.size_key, kind.side
    where = "measured" if identity.is_single else "measured over many of them"
    lines = [f"# Seen in {one_line(source)}: {describe(identity)}."]
    lines += [f"# {note}" for note in identity.notes]
    if square_m is None:
        lines.append(
            f"# Fill in what a picture cannot show, the {what}, and remove the # before it."
        )
    # An unknown size is arbitrary here: its lines are replaced below.
    board = identity.target("board", 1.0 if square_m is None else square_m)
    document = {"kind": board.kind, **kind.document(board)}
    sized = {size, "square_sigma_m", "marker_m"}
    for key, value in document.items():
        if key not in sized or square_m is not None:
            lines.append(f"{key} = {_literal(value)}{_remark(identity, key)}")
        elif key == size:
            lines.append(f"# {size} =  # the {what} [m], {where}")
        elif key == "marker_m":
            lines.append(f"# {key} ={_remark(identity, key)}")
    return "\n".join(lines) + "\n"


def describe(identity: Identity) -> str:
    """The target in a few words."""
    board = identity.board
    least = "" if identity.whole else "at least "
    details = [kind_of(board).words(board, f"{least}{board.columns} x {board.rows}")]
    if not identity.is_single:
        if board.spacing:
            details.append(f"{board.spacing:g} of a tag apart")
        if board.marker_m:
            details.append(f"markers of {identity.marker_share:.3f} of a square")
        details.append(f"{identity.corners_seen} of {identity.corners} corners seen")
    return ", ".join(details)


def _remark(identity: Identity, key: str) -> str:
    if key == "square_sigma_m":
        return "  # 0.1 %, as printers keep their size: replace it by how well you measured"
    if key != "marker_m":
        return ""
    share, sigma = identity.marker_share, identity.marker_share_sigma
    return f"  # {share:.3f} of square_m, to {sigma:.1g}, by the image; measure it to be sure"


def _literal(value: object) -> str:
    match value:
        case bool():
            return str(value).lower()
        case str():
            return f'"{value}"'
        case float():
            # Nine digits keep a nanometre, and 0.03 stays 0.03.
            return f"{value:.9g}"
        case _:
            return str(value)
