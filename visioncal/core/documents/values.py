"""Values of parsed documents: bounded, and turned into numbers with a word on what is wrong."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from visioncal.core.documents.bounds import MAX_DEPTH, MAX_VALUES, too_deep, too_many
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray

_SHOWN = 60  # characters of a value in a message


def check_bounds(value: object, where: str) -> None:
    """Checks depth and size of a document without recursion.

    Raises:
        DataError: It is nested too deep or has too many values.
    """
    pending: list[tuple[object, int]] = [(value, 1)]
    count = 0
    while pending:
        item, depth = pending.pop()
        count += 1
        if count > MAX_VALUES:
            raise too_many(where)
        if depth > MAX_DEPTH:
            raise too_deep(where)
        if isinstance(item, Mapping):
            pending += [(it, depth + 1) for it in item.values()]
        elif isinstance(item, list):
            pending += [(it, depth + 1) for it in item]


def shown(value: object) -> str:
    """Words a value for a message, cut short."""
    if isinstance(value, Mapping):
        return f"a mapping of {', '.join(map(str, list(value)[:8]))}"[:_SHOWN]
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def as_numbers(value: object, where: str) -> FloatArray:
    """Reads a number or regular nested lists of numbers; null counts as NaN.

    Raises:
        DataError: There is text, a mapping, or lists of several lengths among them.
    """
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        return np.asarray(value, dtype=float)
    if isinstance(value, int | float | list) and not isinstance(value, bool):
        try:
            return np.array(value, dtype=float)
        except (ValueError, TypeError, OverflowError):
            pass
    raise DataError(f"{where} is {shown(value)}; numbers are needed.", culprits=[where])


def number(value: object, where: str) -> float:
    """Reads one finite number.

    Raises:
        DataError: It is something else.
    """
    numbers = as_numbers(value, where)
    if numbers.size != 1 or not np.isfinite(numbers).all():
        raise DataError(
            f"{where} is {shown(value)}; one finite number is needed.", culprits=[where]
        )
    return float(numbers.reshape(-1)[0])


def mapping(value: object, where: str) -> Mapping[str, Any]:
    """Checks that a value is a mapping.

    Raises:
        DataError: It is something else.
    """
    if not isinstance(value, Mapping):
        raise DataError(
            f"{where} is {shown(value)}; keys with values are needed.", culprits=[where]
        )
    return value
