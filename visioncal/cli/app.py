"""The application: its commands, and the mapping of errors to exit statuses."""

import atexit
import gc
import os
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from errno import EACCES, ENAMETOOLONG
from io import StringIO, TextIOWrapper
from pathlib import Path
from typing import Annotated, Any, ClassVar, TextIO, cast

import typer

from visioncal.cli.lazy import LazyGroup
from visioncal.cli.libraries import SmallLibraries
from visioncal.core.errors import DataError, VerdictError, VisioncalError, check_names
from visioncal.core.version import __version__


def _group(name: str, words: str, records: str, *listed: str) -> typer.Typer:
    """A command with commands of its own, in the order of a typical workflow."""
    attributes = {
        "prefix": f"{name}_",
        "records": (f"visioncal.cli.{records}",),
        "listed": {"Commands": listed},
        "homes": dict.fromkeys(listed, name),
    }
    cls = type(name, (LazyGroup,), attributes)
    return typer.Typer(cls=cls, help=words, no_args_is_help=True, rich_markup_mode=None)


class _Commands(LazyGroup):
    """All commands, in the order of a typical workflow."""

    records = tuple(f"visioncal.cli.{kind}_options" for kind in ("session", "result", "frame"))
    homes: ClassVar = {"tcp": "framing", "fixture": "framing"}
    groups: ClassVar = {
        "target": _group(
            "target",
            "Print a board at its exact size, or name the one in a photograph.",
            "session_options",
            *("make", "check"),
        ),
        "dynamics": _group(
            "dynamics",
            "Identify an arm's inertias and friction, and weigh what it carries.",
            "dynamics_options",
            *("plan", "record", "identify", "validate", "payload", "gains"),
        ),
    }
    listed: ClassVar = {
        "Start": ("demo", "target", "record", "convert", "simulate"),
        "Calibrate": ("doctor", "calibrate", "show", "plan"),
        "Use the result": ("export", "touch-test", "locate", "tcp", "fixture", "correct"),
        "Keep it valid": ("verify", "guard", "audit", "recover", "diff", "history"),
        "More": ("batch", "dynamics"),
    }


app = typer.Typer(
    name="visioncal",
    cls=_Commands,
    help="Calibrates vision-guided robot cells with a printed board, and says how far the result "
    "can be trusted.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Options of the application itself."""


# Errors of the operating system at any path, and their next step.
_REFUSED = {
    ENAMETOOLONG: ("is longer than the name of any file", ""),
    EACCES: (
        "may not be read by this user",
        "Look at its rights and those of the folder around it: a folder needs x to be searched "
        "(chmod u+rwx).",
    ),
}


def main() -> None:
    """Runs the command line; an error ends with one message and status 2, a bad result with 3."""
    # Commands compute on one BLAS thread. Loaded by both numpy and scipy, BLAS would start one a
    # core, which takes as long as a small calibration's solve.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Whatever a command starts imports nothing from the folder in which it was typed.
    os.environ["PYTHONSAFEPATH"] = "1"
    # A thousand modules create many permanent objects: garbage collection at Python's default rate
    # takes a twentieth of a small calibration's time, and finds nothing.
    gc.set_threshold(20_000, 100)
    # The collection at exit would take as long again.
    atexit.register(gc.freeze)
    sys.stdin = sys.stdin or StringIO()
    for stream in (sys.stdin, sys.stdout, sys.stderr):
        # Letters that a terminal does not have, and bytes that are no text.
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    messages, results = _guarded(sys.stderr, lambda _: None), _guarded(sys.stdout, _end)
    with redirect_stderr(messages), redirect_stdout(results), SmallLibraries():
        try:
            with suppress(FileNotFoundError):
                check_names(*sys.argv, str(Path.cwd()))
            app()
        except VisioncalError as error:
            _refuse(error)
        except OSError as error:
            if error.errno not in _REFUSED:
                raise
            words, step = _REFUSED[error.errno]
            _refuse(DataError(f"{error.filename or 'A file'} {words}.", next_step=step))
        except KeyboardInterrupt:
            # Before a command has begun; see `PlainCommand.invoke`.
            sys.exit(128 + 2)


def _refuse(error: VisioncalError) -> None:
    # Importing a console takes longer than `--version` itself.
    from visioncal.cli.console import EXIT_BAD, EXIT_NO_RESULT, report_error

    report_error(error, as_json="--json" in sys.argv[1:])
    sys.exit(EXIT_BAD if isinstance(error, VerdictError) else EXIT_NO_RESULT)


def _end(error: OSError) -> None:
    if isinstance(error, BrokenPipeError):
        # As shells report a program ended by SIGPIPE.
        raise SystemExit(128 + 13) from error
    # Importing a console takes longer than `--version` itself.
    from visioncal.cli.console import EXIT_NO_RESULT, report_error

    failure = DataError(
        f"stdout cannot be written: {error.strerror or error}.",
        culprits=["stdout"],
        next_step="Write it to a file where there is room.",
    )
    report_error(failure, as_json=False)
    raise SystemExit(EXIT_NO_RESULT) from error


def _guarded(stream: TextIO | None, failed: Callable[[OSError], None]) -> TextIO | None:
    # None where it was closed before the program started.
    return None if stream is None else cast(TextIO, _Guarded(stream, failed))


class _Guarded:
    """A text stream that discards its output once it has failed."""

    def __init__(self, stream: TextIO, failed: Callable[[OSError], None]) -> None:
        self._stream = stream
        self._failed = failed

    def write(self, text: str) -> int:
        """Writes a text, or discards it after a failure."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._give_up(error)
            return len(text)

    def flush(self) -> None:
        """Flushes what was written."""
        try:
            self._stream.flush()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        # Buffered output would fail again, without a message, when Python exits.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)
        self._failed(error)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the stream has
        return getattr(self._stream, name)
