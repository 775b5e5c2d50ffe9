"""Targets by shipped name, file, or a one-word description."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from visioncal.core.documents.structured import read_yaml
from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable
from visioncal.core.types import Target
from visioncal.vision.targets import metres, read_target, target_from_document, target_names


def _millimetres(text: str) -> float:
    return metres(float(text))


_COUNTS = "(?P<columns>[0-9]{1,3})x(?P<rows>[0-9]{1,3})"
_MM = r"[0-9]{1,5}(?:\.[0-9]{1,9})?"
_KINDS = {
    "charuco": rf"{_COUNTS}_(?P<square_m>{_MM})mm_(?P<marker_m>{_MM})mm_(?P<dictionary>DICT_\w+?)"
    "(?P<legacy>_legacy)?",
    "checkerboard": rf"{_COUNTS}_(?P<square_m>{_MM})mm",
    "aprilgrid": rf"{_COUNTS}_(?P<size_m>{_MM})mm_(?P<spacing>0\.[0-9]{{1,9}}|1)",
    "marker": rf"(?P<dictionary>DICT_\w+)_(?P<id>[0-9]{{1,5}})_(?P<size_m>{_MM})mm",
}
_READ: Mapping[str, Callable[[str], object]] = {
    **dict.fromkeys(("columns", "rows", "id"), int),
    **dict.fromkeys(("square_m", "marker_m", "size_m"), _millimetres),
    "dictionary": str,
    "spacing": float,
    "legacy": bool,
}
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
    matches = {kind: re.fullmatch(f"{kind}_{form}", words) for kind, form in _KINDS.items()}
    document = _of_kalibr(Path(words)) if kalibrs else None
    for kind, match in matches.items():
        if match is not None:
            groups = match.groupdict().items()
            document = {"kind": kind, **{name: _READ[name](text) for name, text in groups}}
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


def target_name(document: Mapping[str, Any]) -> str | None:
    """Name of the shipped target with this content; None where there is none."""
    shipped = ((name, read_target(name, None)[1]) for name in target_names())
    return next((name for name, content in shipped if content == document), None)
