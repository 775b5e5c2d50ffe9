"""What a format is."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from visioncal.interchange.formats.foreign import Foreign
from visioncal.interchange.formats.import_options import ImportOptions
from visioncal.session import Session


@dataclass(frozen=True)
class OwnFormat:
    """A form in which sessions are stored.

    Attributes:
        words: What it is, for messages.
        suffix: How the name of a file of this form ends; empty for a folder.
        recognises: Whether a path that exists is of this form.
        read: Reads the session at a path.
        write: Writes a session to a path, whole or not at all.
    """

    words: str
    suffix: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path], Session]
    write: Callable[[Session, Path], None]


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
