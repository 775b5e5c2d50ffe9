"""Advice that names a command, with the session that the user named."""

import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from visioncal.core.errors import VisioncalError
from visioncal.results import Calibration, Verdict

# How advice names the session in a command, where it does not know what the user calls it.
_COMMAND = re.compile(r"\b(visioncal \w+) SESSION\b")


@contextmanager
def naming(session: Path) -> Iterator[None]:
    """Puts a session's path into the commands that errors of the block point to."""
    try:
        yield
    except VisioncalError as error:
        raise type(error)(
            error.message, culprits=error.culprits, next_step=_named(error.next_step, session)
        ) from error


def told_of(calibration: Calibration, session: Path) -> Calibration:
    """A calibration whose reasons, to be printed, name the session by its path."""
    return replace(calibration, verdict=told_verdict(calibration.verdict, session))


def told_verdict(verdict: Verdict, session: Path) -> Verdict:
    """A verdict that, to be printed, names the session by its path."""
    reasons = tuple(_named(it, session) for it in verdict.reasons)
    causes = tuple(
        replace(it, sentence=_named(it.sentence, session), do=_named(it.do, session))
        for it in verdict.causes
    )
    return replace(verdict, reasons=reasons, causes=causes)


def _named(advice: str, session: Path) -> str:
    return _COMMAND.sub(lambda found: f"{found[1]} {shlex.quote(str(session))}", advice)
