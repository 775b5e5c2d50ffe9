"""`visioncal batch`."""

from pathlib import Path

import typer

from visioncal.cli.console import EXIT_BAD, EXIT_NO_RESULT, answer
from visioncal.cli.history import enter
from visioncal.cli.progress import shown_progress
from visioncal.cli.result_options import BatchOptions
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted
from visioncal.interchange.batch import batch
from visioncal.interchange.outputs import RECORDING, REPORT


def batch_command(options: BatchOptions) -> None:
    """Runs `visioncal batch`."""
    wanted = {REPORT: not options.no_report, RECORDING: options.recordings}
    with shown_progress(quiet=False) as progress:
        found = batch(
            options.sessions or (),
            options.out,
            workers=options.workers,
            scheduler=options.scheduler,
            level=options.level,
            need_mm=options.need_mm,
            need_deg=options.need_deg,
            without=[name for name, is_wanted in wanted.items() if not is_wanted],
            progress=progress,
        )
    entries = [row.entry for row in found.rows if row.entry is not None]
    enter(options, Path(found.rows[0].session), entries, options.out)
    counts = found.counts
    named = ("good", "check", "bad", "failed", "kept")
    words = ", ".join(f"{counts[name]} {name}" for name in named if counts[name])
    answer(f"{counted(len(found.rows), 'session')}: {words}")
    failed = [
        f"{row.name}: {row.words} {row.next_step}".rstrip()
        for row in found.rows
        if row.state == "failed"
    ]
    for line in failed[:5]:
        answer(f"  {line}")
    answer(f"written: {found.page}, {found.table}")
    if found.is_cut_short:
        done = sum(row.state != "failed" for row in found.rows)
        raise DataError(
            f"the scheduler at {options.scheduler} went away; {done} of {len(found.rows)} sessions "
            "have their result.",
            culprits=["--scheduler"],
            next_step="Start it and the same command again: what is finished is kept.",
        )
    if all(row.state == "failed" for row in found.rows):
        raise typer.Exit(EXIT_NO_RESULT)
    if any(row.verdict == "bad" for row in found.rows):
        raise typer.Exit(EXIT_BAD)
