"""Documents on stdout."""

import os
import sys

import typer

from visioncal.errors import DataError


def write_stdout(document: str) -> None:
    """Writes a document to stdout, which may be a file on a full disk.

    Raises:
        DataError: It cannot be written. A closed pipe is left to the caller: its reader has had
            enough.
    """
    try:
        typer.echo(document, nl=False)
    except BrokenPipeError:
        raise
    except OSError as error:
        # What is left in the buffer would fail once more, without a word, when Python ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise DataError(
            f"stdout cannot be written: {error.strerror or error}.",
            culprits=["stdout"],
            next_step="Name a file with -o, where there is room.",
        ) from error
