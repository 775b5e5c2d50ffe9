"""The errors of visioncal: one class for each way in which a caller can react."""

from collections.abc import Sequence
from typing import Self

# What a file says stands in messages as it is, which may be all of a file.
_MOST_LETTERS = 2000


class VisioncalError(Exception):
    """Base of all errors that visioncal raises on purpose.

    Attributes:
        message: What is wrong: the value seen and the value needed.
        culprits: The files, rows, views, columns or directions to look at.
        next_step: What the user can do about it; empty where the message already says it.
    """

    def __init__(self, message: str, *, culprits: Sequence[str] = (), next_step: str = "") -> None:
        message = "\n".join(map(_shortened, message.split("\n")))
        super().__init__(message)
        self.message = message
        self.culprits = tuple(map(_shortened, culprits))
        self.next_step = next_step

    def with_culprits(self, more: Sequence[str]) -> Self:
        """Returns the same error with more places to look at."""
        culprits = (*self.culprits, *more)
        return type(self)(self.message, culprits=culprits, next_step=self.next_step)

    def within(self, label: str) -> Self:
        """Returns the same error with the file that it is in before its message, once."""
        message = self.message
        if not message.startswith(label):
            message = f"{label}: {message}"
        return type(self)(message, culprits=self.culprits, next_step=self.next_step)

    def __str__(self) -> str:
        return f"{self.message} {self.next_step}".strip()


def _shortened(line: str) -> str:
    """A line without the middle of what is longer than anybody reads."""
    half = _MOST_LETTERS // 2
    return line if len(line) <= _MOST_LETTERS else f"{line[:half]} ... {line[-half:]}"


class DataError(VisioncalError):
    """The input is wrong or missing: mend the file or the row that is named."""


class DegenerateError(VisioncalError):
    """The input is sound but cannot determine the answer: add the views that are named."""


class ConvergenceError(VisioncalError):
    """An iteration did not settle on data that should allow it: report it with the session."""


class DriverError(VisioncalError):
    """A device is absent or misbehaves: look at the cable or install the extra that is named."""
