"""JSON with checks of repeated keys, depth and size, and with named fields for visioncal's own."""

import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from visioncal.core.documents.values import (
    MAX_VALUES,
    check_bounds,
    read_plain_text,
    shown,
    too_deep,
    too_many,
)
from visioncal.core.errors import DataError
from visioncal.core.files import decode_text

# Longer integers are read as floats: Python parses them in quadratic time.
_MAX_DIGITS = 18
# Names of fields that hold numbers: quantities carry their unit.
_UNITS = r"mm|m|deg|rad|mrad|px|s|c|nm|kg|a|n|k|m_s2|rad_s2|kg_m2|sigma"
_NUMBERS = re.compile(
    rf".+_({_UNITS})|.+_per_.+|mm|deg|px|sigma|matrix|quaternion_xyzw|covariance|edge_covariance"
    "|view|corners|resolution|distortion|spectrum|inflation|likelihood_ratio|condition|unknowns"
    "|median|most|p95|value|nominal|change|misfit|correlation|placement|o[1-5]|bow_[xy]+|aspect|shear"
)
# Tables with keys chosen by users.
_NAMED = ("frames", "robots", "tree")
# Suffixes of files of other kinds, and number of characters of them in a message.
_OTHER_KINDS, _SHOWN = (".csv", ".toml", ".txt", ".png", ".urdf", ".xml", ".html", ".rrd"), 40
# Squares and products of larger numbers may overflow.
_LARGEST = 1e60


def read_json(path: Path) -> object:
    """Reads a JSON file; NaN and Infinity, as Python writes them, are accepted.

    Raises:
        DataError: It is missing, no JSON, holds a key twice, or is too large or too deep.
    """
    return parse_json(read_plain_text(path), str(path))


def parse_json(text: str, where: str) -> object:
    """Parses JSON as `read_json` does; `where` names its origin in errors."""
    # An upper bound of the number of values: every value follows a comma or a bracket.
    if text.count(",") + text.count("[") + text.count("{") > MAX_VALUES:
        raise too_many(where)
    try:
        value: object = json.loads(
            text,
            object_pairs_hook=lambda pairs: _unique(pairs, where),
            parse_int=lambda digits: int(digits) if len(digits) <= _MAX_DIGITS else float(digits),
        )
    except json.JSONDecodeError as error:
        raise DataError(
            f"{where}, line {error.lineno}, column {error.colno} is no JSON: {error.msg}.",
            culprits=[where],
        ) from error
    except RecursionError as error:
        raise too_deep(where) from error
    check_bounds(value, where)
    return value


def _unique(pairs: Sequence[tuple[str, Any]], where: str) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        ((twice, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise DataError(
            f"{where}: the key {twice[:60]!r} is there twice; once is needed.", culprits=[where]
        )
    return content


class StoredTable(dict[str, Any]):
    """A table of a document whose missing fields raise errors with their paths."""

    def __init__(self, content: dict[str, Any], path: str) -> None:
        super().__init__(content)
        self.path = path

    def __missing__(self, key: str) -> object:
        """Raises the error for a missing field."""
        raise DataError(f"{self.path}{key} is missing.", culprits=[f"{self.path}{key}"])


def parse_stored(text: bytes | str, label: str) -> StoredTable:
    """Parses a document that visioncal wrote.

    Returns:
        Its content, which raises DataError on access to a missing field.

    Raises:
        DataError: It is no JSON, no table, too large or too deep, or a field does not hold the
            number that its name, such as `rms_mm`, announces; the message has its path.
    """
    text = decode_text(text, label) if isinstance(text, bytes) else text
    begins = text.lstrip()[:_SHOWN].partition("\n")[0]
    if Path(label).suffix in _OTHER_KINDS and not begins.startswith("{"):
        raise DataError(
            f"{label} begins with {shown(begins)}; a JSON document that visioncal wrote is needed "
            "here.",
            culprits=[label],
            next_step="Name its file, as calibration.json, or its folder. This one is of another "
            "kind; nothing need be changed in it.",
        )
    table = _checked(parse_json(text, label), f"{label}: ", "")
    if not isinstance(table, StoredTable):
        raise DataError(f"{label} is {shown(table)}; a table is needed.", culprits=[label])
    return table


def _checked(value: Any, path: str, key: str) -> Any:  # noqa: ANN401 - what JSON may hold
    needed = _needed(value, key)
    if needed:
        place = path.rstrip(".")
        raise DataError(f"{place} is {shown(value)}; {needed} is needed.", culprits=[place])
    if isinstance(value, dict):
        return StoredTable(
            {
                name: _checked(item, f"{path}{name}.", "" if key in _NAMED else name)
                for name, item in value.items()
            },
            path,
        )
    if isinstance(value, list):
        stem = path.rstrip(".")
        return [_checked(item, f"{stem}[{index}].", key) for index, item in enumerate(value)]
    return value


def _needed(value: object, key: str) -> str:
    """The needed content of a field, by its name, that it lacks; empty where it is right."""
    if _NUMBERS.fullmatch(key) and isinstance(value, str | bool):
        return "a number"
    if isinstance(value, float) and not abs(value) <= _LARGEST:
        return "a number that a cell has"
    return ""
