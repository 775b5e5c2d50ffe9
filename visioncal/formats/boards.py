"""Targets, as a name, a file, or a description in one word."""

import re
from collections.abc import Mapping
from typing import Any

from visioncal.errors import DataError
from visioncal.targets import load_target, metres, target_from_document, target_names

_MM = r"([0-9]{1,5}(?:\.[0-9]{1,9})?)mm"
_CHARUCO = re.compile(rf"charuco_([0-9]{{1,3}})x([0-9]{{1,3}})_{_MM}_{_MM}_(DICT_\w+?)(_legacy)?")
_CHECKERBOARD = re.compile(rf"checkerboard_([0-9]{{1,3}})x([0-9]{{1,3}})_{_MM}")
_MARKER = re.compile(rf"marker_(DICT_\w+)_([0-9]{{1,5}})_{_MM}")

FORMS = (
    "charuco_5x7_36.2mm_18.3mm_DICT_6X6_250 (squares, side of a square and of a marker), "
    "checkerboard_9x6_23.6mm (inner corners), marker_DICT_APRILTAG_36h11_10_48mm (id)"
)


def described_target(words: str) -> Mapping[str, Any]:
    """Finds the description of a target.

    Args:
        words: A shipped name, the path of a `.toml`, or a description in one word as in `FORMS`.

    Returns:
        The content of its `.toml`.

    Raises:
        DataError: It is none of these, or describes no target.
    """
    document = _in_one_word(words)
    if document is None:
        if not words.lower().endswith(".toml") and words not in target_names():
            raise DataError(
                f"There is no target {words[:80]!r}; a name is needed "
                f"({', '.join(target_names())}), the path of a .toml, or a description: {FORMS}.",
                culprits=[words[:80]],
            )
        return load_target(words, None)[1]
    target_from_document(document, words)
    return document


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
    if match := _MARKER.fullmatch(words):
        return {
            "kind": "marker",
            "dictionary": match[1],
            "id": int(match[2]),
            "size_m": metres(float(match[3])),
        }
    return None


def target_name(document: Mapping[str, Any]) -> str | None:
    """Finds the shipped target with this content; None where there is none."""
    shipped = ((it, load_target(it, None)[1]) for it in target_names())
    return next((name for name, content in shipped if content == document), None)
