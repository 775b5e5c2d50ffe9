"""What a format is; and numbers, comments and YAML as every reader understands them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import yaml

from visioncal.core.files import one_line
from visioncal.core.types import FloatArray
from visioncal.interchange.exports.content import Content

# Any transform; the camera's alone, in its own direction; the lens alone; where something sits on
# the flange; or where something stands in the base.
Holds: TypeAlias = Literal["any edge", "hand-eye", "lens", "tool", "fixture"]
# What of a selection a format has a use for, beside the transform and its frames' names.
Takes: TypeAlias = Literal["number", "load", "convention", "hash", "onto"]


def _nothing_amiss(_: Content) -> str:
    return ""


@dataclass(frozen=True)
class ExportFormat:
    """A form in which others read a result.

    Attributes:
        name: As the command line has it.
        words: What it is and who reads it, with its units, in one line.
        write: Builds the document.
        holds: What of a result it can hold.
        frames: What its readers call our frames; ours keep their names where it says nothing.
        takes: Its further options.
        counterpart: The maker's format of fixtures, for one of tools; and the other way round.
        write_all: Builds the document of all transforms of a cell; None where it holds one.
        warn: Words what the user must still do before the document serves; empty for nothing.
    """

    name: str
    words: str
    write: Callable[[Content], str]
    holds: Holds = "any edge"
    frames: Mapping[str, str] = field(default_factory=dict)
    takes: frozenset[Takes] = frozenset()
    counterpart: str = ""
    write_all: Callable[[Sequence[Content]], str] | None = None
    warn: Callable[[Content], str] = _nothing_amiss


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
