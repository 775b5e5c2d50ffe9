"""Checked conversion of parsed values to numbers, OpenCV's matrices included, within bounds."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import MAX_VALUES, UTF16_MARKS, read_bytes, save_as_utf8
from visioncal.core.types import FloatArray

# A number as others write it; also `1.`, `.5` and `1e-3`.
DECIMAL = r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?"

_SHOWN = 60  # characters of a value in a message
_MOST_AXES = 8


def read_plain_text(path: Path) -> str:
    """Reads a bounded text file in UTF-8, UTF-16 with its mark, or otherwise Windows-1252.

    Numbers read the same in Windows-1252 and similar encodings of spreadsheets.

    Raises:
        DataError: As `read_bytes`, or it has NUL bytes, as binary files do.
    """
    data = read_bytes(path)
    if data.startswith(UTF16_MARKS):
        return data.decode("utf-16", "replace")
    if b"\0" in data:
        line = data.count(b"\n", 0, data.index(b"\0")) + 1
        raise DataError(
            f"{path}, line {line}: a NUL byte; it is no text file in UTF-8.",
            culprits=[str(path)],
            next_step=save_as_utf8("UTF-16"),
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def shown(value: object) -> str:
    """A value as text for a message, shortened."""
    if isinstance(value, Mapping):
        return f"a mapping of {', '.join(map(str, list(value)[:8]))}"[:_SHOWN]
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def as_numbers(value: object, where: str) -> FloatArray:
    """Reads a number or regular nested lists of numbers, null as NaN; raises DataError."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        return np.asarray(value, dtype=float)
    if isinstance(value, int | float | list) and not isinstance(value, bool):
        try:
            return np.array(value, dtype=float)
        except (ValueError, TypeError, OverflowError):
            pass
    raise DataError(f"{where} is {shown(value)}; numbers are needed.", culprits=[where])


def number(value: object, where: str) -> float:
    """Reads one finite number; raises DataError."""
    numbers = as_numbers(value, where)
    if numbers.size != 1 or not np.isfinite(numbers).all():
        raise DataError(
            f"{where} is {shown(value)}; one finite number is needed.", culprits=[where]
        )
    return float(numbers.reshape(-1)[0])


def mapping(value: object, where: str) -> Mapping[str, Any]:
    """Checks that a value is a mapping; raises DataError."""
    if not isinstance(value, Mapping):
        raise DataError(
            f"{where} is {shown(value)}; keys with values are needed.", culprits=[where]
        )
    return value


def matrix_from(value: object, where: str) -> FloatArray:
    """Builds a matrix from rows, cols (or sizes), dt and data.

    Args:
        value: The mapping; `data` is a list of numbers.
        where: Its location, for messages.

    Returns:
        (rows, cols) numbers, (rows, cols, channels) where dt names several channels, or an array
        of the stated sizes.

    Raises:
        DataError: A field is missing, or the number of data does not match the size.
    """
    content = mapping(value, where)
    data = as_numbers(content.get("data"), f"{where}: data").reshape(-1)
    if "sizes" in content:
        sides = as_numbers(content["sizes"], f"{where}: sizes").reshape(-1).tolist()
    else:
        sides = [number(content.get(name), f"{where}: {name}") for name in ("rows", "cols")]
    kind = re.fullmatch(r"([0-9]*)[ucwsifdh]", str(content.get("dt", "d")))
    if kind is None:
        raise DataError(
            f"{where}: dt is {content.get('dt')!r}; one of OpenCV's types is needed, such as d.",
            culprits=[where],
        )
    if kind[1] and int(kind[1][:3]) > 1:
        sides.append(float(kind[1][:3]))
    valid = len(sides) <= _MOST_AXES and all(
        0 <= side <= MAX_VALUES and side % 1 == 0 for side in sides
    )
    shape = [int(side) for side in sides] if valid else []
    # A side of 0 must not hide the others.
    if not valid or math.prod(max(index, 1) for index in shape) > MAX_VALUES:
        words = " x ".join(f"{side:g}" for side in sides[:_MOST_AXES])
        raise DataError(f"{where}: a matrix of {words} is none that is read.", culprits=[where])
    if math.prod(shape) != len(data):
        words = " x ".join(map(str, shape))
        raise DataError(
            f"{where}: the matrix has {len(data)} numbers; {words} are needed.", culprits=[where]
        )
    return data.reshape(shape)
