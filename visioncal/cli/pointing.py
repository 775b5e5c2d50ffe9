"""Advice that names a command, with the paths that the user typed."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from visioncal.core.errors import VisioncalError


@contextmanager
def naming(session: Path, out: Path | str = "") -> Iterator[None]:
    """Puts a run's paths into the commands that errors of the block point to."""
    try:
        yield
    except VisioncalError as error:
        # Help need not wait for it.
        from visioncal.core.verdict import with_paths

        raise type(error)(
            error.message,
            culprits=error.culprits,
            next_step=with_paths(error.next_step, session, out),
        ) from error
