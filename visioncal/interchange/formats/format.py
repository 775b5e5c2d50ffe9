"""What a format is."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from visioncal.interchange.formats.foreign import Foreign
from visioncal.interchange.formats.import_options import ImportOptions


@dataclass(frozen=True)
class ForeignFormat:
    """A form in which others store what they recorded; it is read and never written.

    Attributes:
        name: As the command line has it.
        words: What it is, for messages.
        recognises: Whether a path that exists looks like it; it never raises DataError.
        read: Reads the recording at a path; how its poses are written is already taken as the
            user says, so that whoever gets them need not ask.
    """

    name: str
    words: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, ImportOptions], Foreign]
