"""Targets by shipped name, file, or a one-word description."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from visioncal.core.documents.structured import read_yaml
from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable
from visioncal.core.types import Target
from visioncal.vision.targets import metres, read_target, target_from_document, target_names

_MM = r"([0-9]{1,5}(?:\.[0-9]{1,9})?)mm"
_CHARUCO = re.compile(rf"charuco_([0-9]{{1,3}})x([0-9]{{1,3}})_{_MM}_{_MM}_(DICT_\w+?)(_legacy)?")
_CHECKERBOARD = re.compile(rf"checkerboard_([0-9]{{1,3}})x([0-9]{{1,3}})_{_MM}")
_APRILGRID = re.compile(rf"aprilgrid_([0-9]{{1,3}})x([0-9]{{1,3}})_{_MM}_(0\.[0-9]{{1,9}}|1)")
_MARKER = re.compile(rf"marker_(DICT_\w+)_([0-9]{{1,5}})_{_MM}")

FORMS = (
    "charuco_5x7_36.2mm_18.3mm_DICT_6X6_250 (squares, side of a square and of a marker), "
    "checkerboard_9x6_23.6mm (inner corners), aprilgrid_6x6_88mm_0.3 (tags, their side, the white "
    "between them as a share of it), marker_DICT_APRILTAG_36h11_10_48mm (id)"
)


def read_target_description(words: str) -> Mapping[str, Any]:
    """Reads the description of a target.

    Args:
        words: A shipped name, the path of a `.toml` or of a Kalibr `.yaml`, or a one-word
            description as in `FORMS`.

    Returns:
        The content of its `.toml`.

    Raises:
        DataError: It is none of these, or describes no target.
    """
    kalibrs = words.lower().endswith((".yaml", ".yml"))
    document = _of_kalibr(Path(words)) if kalibrs else _in_one_word(words)
    if document is None:
        if not words.lower().endswith(".toml") and words not in target_names():
            raise DataError(
                f"There is no target {words[:80]!r}; a name is needed "
                f"({', '.join(target_names())}), the path of a .toml or of Kalibr's .yaml, or a "
                f"description: {FORMS}.",
                culprits=[words[:80]],
            )
        return read_target(words, None)[1]
    target_from_document(document, words)
    return document


def target_named(words: str, name: str = "") -> Target:
    """The target of `read_target_description`; its words are its name unless another is given."""
    return target_from_document(read_target_description(words), name or words)


def _of_kalibr(path: Path) -> dict[str, Any]:
    """Reads a target file of Kalibr: an AprilGrid, or a checkerboard of squares."""
    content = read_yaml(path)
    table = DocumentTable(content if isinstance(content, dict) else {}, path.name)
    if table.choice("target_type", ("aprilgrid", "checkerboard")) == "aprilgrid":
        names = {"columns": "tagCols", "rows": "tagRows", "size_m": "tagSize"}
        names["spacing"] = "tagSpacing"
        document: dict[str, Any] = {"kind": "aprilgrid"}
    else:
        names = {"columns": "targetCols", "rows": "targetRows", "square_m": "rowSpacingMeters"}
        across, down = (table.number(f"{name}SpacingMeters") for name in ("col", "row"))
        if across != down:
            raise table.refuse("colSpacingMeters", across, f"rowSpacingMeters, {down!r},")
        document = {"kind": "checkerboard"}
    return (
        document
        | {ours: table.number(theirs) for ours, theirs in names.items()}
        | {ours: table.integer(names[ours], 1, 100) for ours in ("columns", "rows")}
    )


def _in_one_word(words: str) -> dict[str, Any] | None:
    if match := _CHARUCO.fullmatch(words):
        return {
            "kind": "charuco",
            "columns": int(match[1]),
            "rows": int(match[2]),
            "square_m": metres(float(match[3])),
            "marker_m": metres(float(match[4])),
            "dictionary": match[5],
            "legacy": match[6] is not None,
        }
    if match := _CHECKERBOARD.fullmatch(words):
        return {
            "kind": "checkerboard",
            "columns": int(match[1]),
            "rows": int(match[2]),
            "square_m": metres(float(match[3])),
        }
    if match := _APRILGRID.fullmatch(words):
        return {
            "kind": "aprilgrid",
            "columns": int(match[1]),
            "rows": int(match[2]),
            "size_m": metres(float(match[3])),
            "spacing": float(match[4]),
        }
    if match := _MARKER.fullmatch(words):
        return {
            "kind": "marker",
            "dictionary": match[1],
            "id": int(match[2]),
            "size_m": metres(float(match[3])),
        }
    return None


def target_name(document: Mapping[str, Any]) -> str | None:
    """Name of the shipped target with this content; None where there is none."""
    shipped = ((name, read_target(name, None)[1]) for name in target_names())
    return next((name for name, content in shipped if content == document), None)
