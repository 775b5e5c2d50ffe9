"""Numbers, comments and YAML as every reader understands them."""

from collections.abc import Iterable
from typing import Any

import yaml

from visioncal.core.files import one_line
from visioncal.core.types import FloatArray


def numbers(values: FloatArray) -> list[float]:
    """Turns an array into plain floats, whose text reads back as the same doubles."""
    # A negative zero would only raise questions.
    return [float(it) + 0.0 for it in values.ravel()]


def rows(matrix: FloatArray) -> list[list[float]]:
    """Turns (n, m) numbers into n lists of plain floats."""
    return [numbers(row) for row in matrix]


def fixed(value: float, decimals: int) -> str:
    """Writes a number without an exponent, which not every robot's language reads."""
    text = f"{value:.{decimals}f}"
    return text[1:] if text.startswith("-") and not text.strip("-0.") else text


def comments(mark: str, lines: Iterable[str]) -> str:
    """Writes lines as comments, each behind `mark`; no text can end its comment early."""
    return "".join(f"{mark} {one_line(it)}\n" for it in lines)


def yaml_text(document: dict[str, Any], *, short_lists: bool = False) -> str:
    """Writes YAML in the order given; `short_lists` puts lists of numbers on one line."""
    style = None if short_lists else False
    return yaml.safe_dump(
        document, sort_keys=False, default_flow_style=style, width=float("inf"), allow_unicode=True
    )
