"""JSON, with doubled keys, depth and size checked."""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from visioncal.core.documents.bounds import MAX_VALUES, read_plain_text, too_deep, too_many
from visioncal.core.documents.values import check_bounds
from visioncal.core.errors import DataError

# Longer whole numbers are measurements at best; Python's own reading of them takes quadratic time.
_MAX_DIGITS = 18


def read_json(path: Path) -> object:
    """Reads a JSON file; NaN and Infinity, which Python writes, become such numbers.

    Raises:
        DataError: It is missing, no JSON, holds a key twice, or is too large or too deep.
    """
    return parse_json(read_plain_text(path), str(path))


def parse_json(text: str, where: str) -> object:
    """Parses JSON; `where` names its origin in errors.

    Raises:
        DataError: As `read_json`.
    """
    # Every value but the last of its list is followed by a comma, every list begins with a bracket.
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
