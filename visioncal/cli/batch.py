"""`visioncal batch`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from visioncal.cli.console import EXIT_BAD, EXIT_NO_RESULT, answers
from visioncal.cli.options import NeedOptions
from visioncal.cli.progress import shown_progress
from visioncal.core.errors import DataError
from visioncal.interchange.outputs import RECORDING, REPORT

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.interchange.batch import Batch

_MOST_NAMED = 5


def batch_command(
    out: Annotated[
        Path,
        typer.Option(
            "-o", "--out", file_okay=False, help="Folder for the results, one in each session's."
        ),
    ],
    need: NeedOptions,
    sessions: Annotated[
        list[str] | None,
        typer.Argument(help="Sessions, recordings, folders with some below them, or globs."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, help="Number of parallel workers, on one core each; by default one a core."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="A Dask scheduler, as tcp://HOST:8786, whose workers see the same files; needs "
            "the extra cluster.",
        ),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(help="An earlier batch: which results changed by more than their sigmas."),
    ] = None,
    level: Annotated[
        str, typer.Option(metavar="auto|hand-eye|offsets|...", help="As for calibrate.")
    ] = "auto",
    no_report: Annotated[
        bool, typer.Option("--no-report", help=f"Leave each {REPORT} out.")
    ] = False,
    recordings: Annotated[
        bool, typer.Option("--recordings", help="Also write each recording, with all images.")
    ] = False,
) -> None:
    """Calibrate many sessions at once, and report which stand out of their fleet.

    Each result goes into a folder of its own; batch.parquet has a row a session, index.html shows
    them, outliers among robots of the same model first. Existing results are kept: started again,
    an interrupted batch continues. Exit status 0: there are results, none of them bad; 3: one is
    bad; 2: there is none.
    """
    from visioncal.interchange.batch import batch

    wanted = {REPORT: not no_report, RECORDING: recordings}
    with shown_progress(quiet=False) as progress:
        found = batch(
            sessions or (),
            out,
            workers=workers,
            scheduler=scheduler,
            level=level,
            need_mm=need.need_mm,
            need_deg=need.need_deg,
            without=[name for name, is_wanted in wanted.items() if not is_wanted],
            against=against,
            progress=progress,
        )
    _report(found)
    if found.is_cut_short:
        done = sum(row.state != "failed" for row in found.rows)
        raise DataError(
            f"the scheduler at {scheduler} went away; {done} of {len(found.rows)} sessions have "
            "their result.",
            culprits=["--scheduler"],
            next_step="Start it and the same command again: what is finished is kept.",
        )
    if all(row.state == "failed" for row in found.rows):
        raise typer.Exit(EXIT_NO_RESULT)
    if any(row.verdict == "bad" for row in found.rows):
        raise typer.Exit(EXIT_BAD)


def _report(results: "Batch") -> None:
    console, counts = answers(), results.counts
    named = ("good", "check", "bad", "failed", "kept", "changed", "standing out")
    words = ", ".join(f"{counts[name]} {name}" for name in named if counts[name])
    console.print(f"{len(results.rows)} sessions: {words}")
    lines = [f"{row.name}: {row.stands_out}" for row in results.rows if row.score > 0.0][
        :_MOST_NAMED
    ]
    lines += [f"{row.name}: {row.change}" for row in results.rows if row.changed][:_MOST_NAMED]
    failed = [
        f"{row.name}: {row.words} {row.next_step}".rstrip()
        for row in results.rows
        if row.state == "failed"
    ]
    for line in [*lines, *failed[:_MOST_NAMED]]:
        console.print(escape(f"  {line}"))
    console.print(escape(f"written: {results.page}, {results.table}"))
