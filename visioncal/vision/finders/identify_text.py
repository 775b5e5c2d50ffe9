"""An identified target as a description to keep, as JSON, and in words."""

from collections.abc import Mapping
from typing import Any

from visioncal.core.files import one_line
from visioncal.core.types import TargetKind
from visioncal.vision.finders.identify import Identity
from visioncal.vision.targets import board_words, target_document

# The size that a picture cannot show, by kind.
SIDES: Mapping[TargetKind, str] = {
    "charuco": "side of a square",
    "checkerboard": "side of a square",
    "aprilgrid": "side of a tag",
    "marker": "side of the dark square",
}


def to_document(identity: Identity, square_m: float | None) -> dict[str, Any]:
    """An identity as the content of a JSON document, without fields that do not apply.

    With a measured side of a square, or of a single marker [m], it has the target's description
    too.
    """
    document: dict[str, Any] = {
        "kind": identity.kind,
        "corners_seen": identity.corners_seen,
        "corners": identity.corners,
        "notes": list(identity.notes),
    }
    if identity.kind != "marker":
        document |= {"columns": identity.columns, "rows": identity.rows, "whole": identity.whole}
    if identity.dictionary:
        document |= {
            "dictionary": identity.dictionary,
            "same_markers": list(identity.larger),
            "marker_ids": list(identity.marker_ids),
        }
    if identity.kind == "charuco":
        document |= {
            "legacy": identity.legacy,
            "marker_over_square": identity.marker_share,
            "marker_over_square_sigma": identity.marker_share_sigma,
        }
    if identity.kind == "aprilgrid":
        document |= {"spacing": identity.spacing, "border": identity.border}
    if square_m is not None:
        document["target"] = target_document(identity.target("board", square_m))
    return document


def to_toml(identity: Identity, square_m: float | None, source: str) -> str:
    """An identity as a target's description; `source` names the image in its first line.

    Without a measured side of a square, or of a single marker [m], sizes become comments on what to
    measure.
    """
    size = "size_m" if identity.kind in ("marker", "aprilgrid") else "square_m"
    what, where = SIDES[identity.kind], "measured"
    if identity.kind != "marker":
        where = "measured over many of them"
    lines = [f"# Seen in {one_line(source)}: {describe(identity)}."]
    lines += [f"# {note}" for note in identity.notes]
    if square_m is None:
        lines.append(
            f"# Fill in what a picture cannot show, the {what}, and remove the # before it."
        )
    # An unknown size is arbitrary here: its lines are replaced below.
    document = target_document(identity.target("board", 1.0 if square_m is None else square_m))
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
    words = board_words(identity.target("board", 1.0), "" if identity.whole else "at least ")
    if identity.kind == "marker":
        return words
    more = {
        "aprilgrid": f"{identity.spacing:g} of a tag apart",
        "charuco": f"markers of {identity.marker_share:.3f} of a square",
    }
    details = (more[identity.kind],) if identity.kind in more else ()
    seen = f"{identity.corners_seen} of {identity.corners} corners seen"
    return ", ".join([words, *details, seen])


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
