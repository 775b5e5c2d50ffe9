"""Identification of an unknown board in a photograph, by the ids and positions of its markers.

Checkerboards and grids of circles have no markers, and AprilGrids others: they are described.
"""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import tomli_w

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import one_line
from visioncal.core.types import Image
from visioncal.vision.boards import KINDS, kind_of
from visioncal.vision.boards.identity import FAMILIES, LEAST_MARKERS, Identity, decoded
from visioncal.vision.boards.imaging import check_grey, poor_image_reason
from visioncal.vision.boards.marker import genuine, single_marker
from visioncal.vision.targets import board_words, target_document

# What to type for a board that its picture does not identify.
DESCRIBE_IT = (
    "Where the board is a checkerboard, write board.toml with its own figures for kind = "
    '"checkerboard", columns = 9, rows = 6 (inner corners), square_m = 0.025 (measured); where it '
    'is a grid of circles, kind = "circles", columns = 4, rows = 11, square_m = 0.02 (between '
    'rows), diameter_m = 0.015, asymmetric = true; where it is Kalibr\'s, kind = "aprilgrid", '
    'columns = 6, rows = 6, size_m = 0.088, spacing = 0.3; and target = "board.toml" in '
    "session.toml."
)


@typed
def identify(image: Image) -> Identity:
    """Identifies the target in an image by its markers: a ChArUco board or a single marker.

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
    # Images of twice the usual sides are also searched at that size.
    scale = (2e6 / image.size) ** 0.5
    if scale < 0.5:
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        identity = _identity(np.asarray(small, np.uint8))
        if identity is not None:
            note = f"It is found only in the picture reduced to {small.shape[1]} pixels in width."
            return replace(identity, notes=(note, *identity.notes))
    # Wider edges hide the bits of small markers.
    why = poor_image_reason(image, 6.0)
    height, width = image.shape
    raise DataError(
        f"No marker is read in this image of {width} x {height} pixels"
        + (f": {why}." if why else ".")
        + " A board is identified by its markers: one of OpenCV's ArUco and AprilTag dictionaries, "
        f"or {LEAST_MARKERS} of a ChArUco board; {len(decoded(image))} patterns looked like a "
        "marker. A checkerboard or a grid of circles has none, an AprilGrid others: they must be "
        "stated.",
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
    if single is None:
        return best
    note = f"Beside it, marker {single.marker_ids[0]} of {single.board.dictionary} is seen."
    return replace(best, notes=(*best.notes, note))


def to_document(identity: Identity, square_m: float | None) -> dict[str, Any]:
    """An identity as the content of a JSON document.

    With a measured side of a square, or of a single marker [m], it has the target's description
    too.
    """
    kind, board = kind_of(identity.board), identity.board
    described = kind.document(board)
    sizes = {kind.size_key, "square_sigma_m", "marker_m"}
    document: dict[str, Any] = {
        "kind": board.kind,
        **{key: value for key, value in described.items() if key not in sizes},
        "corners_seen": identity.corners_seen,
        "corners": identity.corners,
        "same_markers": list(identity.larger),
        "marker_ids": list(identity.marker_ids),
        "notes": list(identity.notes),
    }
    if board.marker_m:
        document["marker_over_square"] = board.marker_m
    if square_m is not None:
        document["target"] = target_document(identity.target("board", square_m))
    return document


def to_toml(identity: Identity, square_m: float, source: str) -> str:
    """A target's description, with its measured side [m]; `source` names the image."""
    lines = [f"# Seen in {one_line(source)}: {describe(identity)}."]
    lines += [f"# {note}" for note in identity.notes]
    lines.append("# square_sigma_m is 0.1 %, as of printers: replace it by how well you measured.")
    target = identity.target("board", square_m)
    return "\n".join([*lines, tomli_w.dumps(target_document(target))])


def describe(identity: Identity) -> str:
    """The target in a few words."""
    board = identity.board
    details = [board_words(board)]
    if board.marker_m:
        details.append(f"markers of {board.marker_m:.3f} of a square")
    if not identity.is_single:
        details.append(f"{identity.corners_seen} of {identity.corners} corners seen")
    return ", ".join(details)
