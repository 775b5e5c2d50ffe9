"""Output shared by the commands: messages to stderr, results to stdout, and errors."""

import json
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from visioncal.core.errors import DataError, VerdictError, VisioncalError
from visioncal.core.files import MOST_TOML_BYTES, one_line

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from rich.console import Console

    from visioncal.core.verdict import Verdict
    from visioncal.interchange.outputs import Written

# 0: a result to use; 1: a bug of ours; 2: the input cannot give a result; 3: the result's verdict
# is bad, or a check failed (verify).
_EXIT_BUG, EXIT_NO_RESULT, EXIT_BAD = 1, 2, 3


def console(*, is_answer: bool = False) -> "Console":
    """The console for messages, stderr; or for results, stdout."""
    from rich.console import Console

    return Console(stderr=not is_answer, highlight=False, soft_wrap=True)


def is_terminal(*, is_answer: bool = False) -> bool:
    """Whether stderr, or stdout, shows styles, for which alone a library is loaded."""
    stream = sys.stdout if is_answer else sys.stderr
    # None where the stream was closed before the program started.
    return stream is not None and (stream.isatty() or "FORCE_COLOR" in os.environ)


def say(words: str, label: str = "", style: str = "bold", *, is_answer: bool = False) -> None:
    """Prints a message, or a line of the result, as it is, after a label in a style."""
    if not is_terminal(is_answer=is_answer):
        # As the stream encodes: a library's echo writes UTF-8 where that is ASCII.
        stream = sys.stdout if is_answer else sys.stderr
        if stream is not None:
            # Flushed, so that a stream that fails does so here, where it is met.
            print(plain(label) + plain(words), file=stream, flush=True)
        return
    from rich.text import Text

    # No markup: names and texts of files may have brackets.
    console(is_answer=is_answer).print(Text.assemble((plain(label), style), plain(words)))


def plain(words: str) -> str:
    """A text of several lines, in which nothing steers the terminal."""
    return "\n".join(map(one_line, words.split("\n")))


def warn(words: str) -> None:
    """Prints a warning about the result."""
    say(words, "warning: ", "bold yellow")


def answer(words: str, label: str = "", style: str = "bold") -> None:
    """Prints a line of the result; see `say`."""
    say(words, label, style, is_answer=True)


def print_json(document: object) -> None:
    """Prints a result as JSON."""
    typer.echo(json.dumps(document, indent=2))


def print_table(
    titles: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    caption: str = "",
    bold: int | None = None,
    is_message: bool = False,
) -> None:
    """Prints a table of plain texts without frames, one row in bold; numbers are not folded."""
    from rich.table import Column, Table
    from rich.text import Text

    # The widest column folds first; nothing is cut off.
    columns = (Column(Text(plain(title)), overflow="fold") for title in titles)
    table = Table(*columns, box=None, pad_edge=False, caption=caption, caption_justify="left")
    for at, cells in enumerate(rows):
        table.add_row(
            *(Text(plain(cell)) for cell in cells), style="bold green" if at == bold else ""
        )
    shown = console(is_answer=not is_message)
    # Names of cells' frames are long, and are not truncated.
    shown.width = max(shown.width, 110)
    shown.print(table)


def typed_line(question: str) -> str:
    """Asks on stderr, which keeps stdout for results, and returns the typed line.

    Raises:
        EOFError: The input has ended.
        DataError: The line does not end.
    """
    console().print(plain(question), markup=False, end="")
    line = sys.stdin.readline(MOST_TOML_BYTES)
    if len(line) == MOST_TOML_BYTES:
        raise DataError(
            f"stdin has a line of {len(line)} letters or more.",
            culprits=["stdin"],
            next_step="Type one answer or pose per line, each ended by Enter.",
        )
    if not line:
        raise EOFError
    return line.rstrip("\r\n")


def report_error(error: VisioncalError, *, as_json: bool) -> None:
    """Prints an error as one message to stderr, and with `as_json` as JSON to stdout, too."""
    next_step = error.next_step
    if not next_step and isinstance(error, DataError):
        # The message says what is needed.
        next_step = f"Correct {[*error.culprits, 'that'][0]}, and run the command again."
    if as_json:
        document = {
            "class": type(error).__name__,
            "message": error.message,
            "culprits": list(error.culprits),
            "next": next_step,
        }
        print_json({"error": document})
    say(error.message, "error: ", "bold red")
    said = f"{error.message} {next_step}"
    other_culprits = [culprit for culprit in error.culprits if culprit not in said]
    # Short ones share a line.
    if all(len(name) < 12 for name in other_culprits):
        other_culprits = [", ".join(other_culprits)] if other_culprits else []
    shown = other_culprits[:10]
    for culprit in shown:
        say(f"  - {culprit}")
    if more := len(other_culprits) - len(shown):
        say(f"  - and {more} more")
    if next_step:
        say(next_step)


def exit_status(verdict: "Verdict") -> int:
    """The exit status of a command that wrote a result with this verdict."""
    return EXIT_BAD if verdict.status == "bad" else 0


def check_usable(verdict: "Verdict", what: str, *, force: bool) -> tuple[str, ...]:
    """Refuses to carry a bad result on to a robot.

    Args:
        verdict: The verdict of what is to be used.
        what: What it is, such as `the calibration`.
        force: Whether the user takes it all the same.

    Returns:
        Warnings: that it is bad, where it is taken all the same.

    Raises:
        VerdictError: It is bad.
    """
    if verdict.status != "bad":
        return ()
    found = verdict.findings
    count = f" (all {len(found)} reasons are in its report)" if len(found) > 1 else ""
    words = f"The verdict of {what} is bad{count}:"
    if force:
        return (" ".join([words, *(finding.reason for finding in found[:1])]),)
    raise VerdictError(
        # The advice is the next step.
        " ".join([words, *(finding.words for finding in found[:1])]),
        culprits=[what],
        next_step=" ".join([*map(str, verdict.next_steps[:1]), "To use it as it is, say --force."]),
    )


def report_written(written: "Written", *, quiet: bool = False, status: int = 0) -> None:
    """Prints which files were written, and exits unless all is well.

    The exit status is `status`, or 1 where that is 0 and a file could not be drawn.

    Raises:
        typer.Exit: The status is not 0.
    """
    for file in () if quiet else written.files:
        say(f"wrote {file}")
    for undrawn in written.failed_drawings:
        say(
            f"{undrawn.file} could not be drawn ({undrawn.cause}).\nThe result is safe in "
            f"{written.files[0]}. Please report this, with the session if it can be given away.",
            "bug: ",
            "bold red",
        )
    if status or written.failed_drawings:
        raise typer.Exit(status or _EXIT_BUG)


@contextmanager
def with_run_paths(session: Path, out: Path | str = "") -> Iterator[None]:
    """Puts a run's paths into the suggested commands of errors raised in the block."""
    try:
        yield
    except VisioncalError as error:
        # Imported late, so that --help stays fast.
        from visioncal.core.verdict import with_paths

        again = ["visioncal", *sys.argv[1:]]
        step = with_paths(error.next_step, session, out, again)
        raise error.but(next_step=step) from error
