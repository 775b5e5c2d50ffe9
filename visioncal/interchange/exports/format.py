"""What a format is."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

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
