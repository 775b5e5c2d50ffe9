"""Checked conversion of parsed values to numbers, OpenCV's matrices included, within bounds."""

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.core.codec import wrong_value
from visioncal.core.errors import DataError
from visioncal.core.files import UTF16_MARKS, read_bytes, save_as_utf8
from visioncal.core.types import FloatArray

# A number as others write it; also `1.`, `.5` and `1e-3`.
DECIMAL = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
# The same with a decimal comma.
DECIMAL_COMMA = r"[+-]?[0-9]+,[0-9]+(?:[eE][+-]?[0-9]+)?"

# Two of the usual characters of GBK on end: in Windows-1252 four letters with accents.
_HAN = re.compile(rb"(?:[\xb0-\xd7][\xa1-\xfe]){2}")


def read_plain_text(path: Path) -> str:
    """Reads a bounded text file in UTF-8, UTF-16 with its mark, GBK, or otherwise Windows-1252.

    Numbers read the same in Windows-1252 and similar encodings of spreadsheets. Raises DataError.
    """
    data = read_bytes(path)
    if data.startswith(UTF16_MARKS):
        return data.decode("utf-16", "replace")
    if b"\0" in data:
        line = data.count(b"\n", 0, data.index(b"\0")) + 1
        raise DataError(
            f"{path}, line {line}: a NUL byte; the file must be text in UTF-8.",
            culprits=[str(path)],
            next_step=save_as_utf8("UTF-16"),
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        with suppress(UnicodeDecodeError):
            if _HAN.search(data):
                return data.decode("gb18030")
        return data.decode("cp1252", "replace")


def as_numbers(value: object, where: str) -> FloatArray:
    """Reads a number or regular nested lists of numbers, null as NaN; raises DataError."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        return np.asarray(value, dtype=float)
    if isinstance(value, int | float | list) and not isinstance(value, bool):
        try:
            return np.array(value, dtype=float)
        except (ValueError, TypeError, OverflowError):
            pass
    raise wrong_value(value, "numbers", where)


def number(value: object, where: str) -> float:
    """Reads one finite number; raises DataError."""
    numbers = as_numbers(value, where)
    if numbers.size != 1 or not np.isfinite(numbers).all():
        raise wrong_value(value, "one finite number", where)
    return float(numbers.reshape(-1)[0])


def mapping(value: object, where: str) -> Mapping[str, Any]:
    """Checks that a value is a mapping; raises DataError."""
    if not isinstance(value, Mapping):
        raise wrong_value(value, "keys with values", where)
    return value


def matrix_from(value: object, where: str) -> FloatArray:
    """(rows, cols) or (rows, cols, channels) of OpenCV's rows, cols, dt and data; or DataError."""
    content = mapping(value, where)
    data = as_numbers(content.get("data"), f"{where}: data").reshape(-1)
    kind = re.fullmatch(r"([0-9]{0,3})[ucwsifdh]", str(content.get("dt", "d")))
    sides = [number(content.get(name), f"{where}: {name}") for name in ("rows", "cols")]
    sides += [float(kind[1])] if kind and kind[1] not in ("", "1") else []
    if kind is None or any(side % 1 or side < 0 for side in sides) or math.prod(sides) != len(data):
        words = " x ".join(f"{side:g}" for side in sides)
        raise DataError(
            f"{where}: {len(data)} numbers are no matrix of {words} of the type "
            f"{content.get('dt', 'd')!r}.",
            culprits=[where],
        )
    # A side of 0 hides others of any size.
    shape = [int(side) for side in sides] if len(data) else [0] * len(sides)
    return data.reshape(shape)
