"""What a format is."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from visioncal.session import Session


@dataclass(frozen=True)
class Format:
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
