"""Exceptions of visioncal, one class for each possible reaction of a caller."""

from collections.abc import Sequence
from typing import Self

# Greatest length of a line of a message, which may quote input.
_LEAST_LETTERS = 300


class VisioncalError(Exception):
    """Base of all errors that visioncal raises on purpose.

    Attributes:
        message: What is wrong: the value found and the value needed.
        culprits: The files, rows, views, columns or directions to look at.
        next_step: What the user can do about it; empty where the message says it.
    """

    def __init__(self, message: str, *, culprits: Sequence[str] = (), next_step: str = "") -> None:
        lines = message.split("\n")
        # Messages quote input, which may be a whole file: their greatest length.
        most = max(2000 // len(lines), _LEAST_LETTERS)
        message = "\n".join(_shortened(line, most) for line in lines)
        super().__init__(message)
        self.message = message
        self.culprits = tuple(_shortened(culprit, _LEAST_LETTERS) for culprit in culprits)
        self.next_step = next_step

    def with_culprits(self, more: Sequence[str]) -> Self:
        """The same error with more culprits."""
        return self.but(culprits=(*self.culprits, *more))

    def but(
        self, message: str = "", culprits: Sequence[str] | None = None, next_step: str | None = None
    ) -> Self:
        """The same error with other parts."""
        other = type(self)(
            message or self.message,
            culprits=self.culprits if culprits is None else culprits,
            next_step=self.next_step if next_step is None else next_step,
        )
        other.__dict__ = vars(self) | vars(other)
        return other

    def within(self, label: str) -> Self:
        """The same error with its message prefixed by a file, once."""
        return self.but("" if self.message.startswith(label) else f"{label}: {self.message}")

    def __str__(self) -> str:
        return f"{self.message} {self.next_step}".strip()


def _shortened(line: str, most: int) -> str:
    """The line without its middle, where it is too long."""
    half = most // 2
    return line if len(line) <= most else f"{line[:half]} ... {line[-half:]}"


class DataError(VisioncalError):
    """The input is wrong or missing: correct the file or row that is named."""


class DegenerateError(VisioncalError):
    """The input is valid but does not determine the result: add the views that are named."""


class ConvergenceError(VisioncalError):
    """An iteration did not converge on valid data: report it with the session."""


class VerdictError(VisioncalError):
    """A result exists, but its verdict is bad: find the cause, or use it knowingly (--force)."""


class DriverError(VisioncalError):
    """A device is absent or fails: check the cable or install the extra that is named."""


def check_names(*names: str) -> None:
    """Refuses names of files that are no text: results and pages in UTF-8 could not hold them.

    Raises:
        DataError: A name holds bytes of another encoding.
    """
    for name in names:
        try:
            name.encode()
        except UnicodeEncodeError as error:
            raise DataError(
                f"{name!r} holds bytes that are no UTF-8.",
                culprits=[ascii(name)],
                next_step="Rename the file or folder; an archive of another system has such names.",
            ) from error
