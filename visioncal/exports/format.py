"""What a format is."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from visioncal.exports.content import Content

# Any transform of the calibration; the camera's alone, in its own direction; or the lens alone.
Holds: TypeAlias = Literal["any edge", "hand-eye", "lens"]


@dataclass(frozen=True)
class ExportFormat:
    """A form in which others read a result.

    Attributes:
        name: As the command line has it.
        words: What it is and who reads it, with its units, in one line.
        write: Builds the document.
        holds: What of a calibration it can hold.
        frames: What its readers call our frames; ours keep their names where it says nothing.
    """

    name: str
    words: str
    write: Callable[[Content], str]
    holds: Holds = "any edge"
    frames: Mapping[str, str] = field(default_factory=dict)
