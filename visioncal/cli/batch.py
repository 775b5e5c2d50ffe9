"""`visioncal batch`."""

from collections.abc import Iterator
from pathlib import Path

import typer

from visioncal.cli.console import EXIT_BAD, EXIT_NO_RESULT, answer, print_table
from visioncal.cli.history import enter
from visioncal.cli.progress import shown_progress
from visioncal.cli.result_options import BatchOptions
from visioncal.core.documents.tables import csv_text
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.files import write_atomically
from visioncal.core.number_format import counted, figure
from visioncal.interchange.batch import Batch, batch
from visioncal.interchange.outputs import RECORDING, REPORT
from visioncal.interchange.result_files import load_result
from visioncal.results import Calibration
from visioncal.results.compare import Comparison, compare


def batch_command(options: BatchOptions) -> None:
    """Runs `visioncal batch`."""
    reference = None if options.against is None else load_result(options.against)
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
    if reference is not None:
        _print_changes(reference, found, options.out)
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


_COLUMNS = (
    *("session", "verdict", "transform", "moved_mm", "sigma_mm", "by_chance_mm"),
    *("moved_deg", "sigma_deg", "by_chance_deg", "changed"),
)


def _print_changes(reference: Calibration, found: Batch, out: Path) -> None:
    """Prints what changed in each session against one result; all differences go into a table."""
    shown, cells = [], []
    done = (row for row in found.rows if row.entry is not None)
    for row in sorted(done, key=lambda row: row.name):
        try:
            comparison = compare(reference, load_result(out / row.name))
        except VisioncalError as error:
            shown.append((row.name, row.verdict, f"cannot be compared: {error.message}"))
            continue
        changes = "; ".join(_changes(comparison)) or "nothing beyond noise"
        shown.append((row.name, row.verdict, changes))
        for edge in comparison.edges:
            sides = (
                (edge.moved_mm, edge.sigma_mm, edge.translation.p_value),
                (edge.moved_deg, edge.sigma_deg, edge.rotation.p_value),
            )
            numbers = [f"{value:.6g}" for side in sides for value in side]
            changed = "yes" if edge.is_change else "no"
            cells.append((row.name, row.verdict, edge.name, *numbers, changed))
    print_table(("session", "verdict", "changed, with sigma"), shown)
    table = out / "against.csv"
    write_atomically(table, csv_text([_COLUMNS, *cells], inert=True))
    answer(f"written: {table}")


def _changes(comparison: Comparison) -> Iterator[str]:
    """The significant changes of a comparison, in words."""
    for edge in comparison.edges:
        sides = (
            (edge.translation, edge.moved_mm, edge.sigma_mm, "mm"),
            (edge.rotation, edge.moved_deg, edge.sigma_deg, "deg"),
        )
        said = [
            f"{figure(moved)} {unit} ({figure(sigma)})"
            for test, moved, sigma, unit in sides
            if test.is_change
        ]
        if said:
            yield f"{edge.name} by {' and '.join(said)}"
    if comparison.lens is not None and comparison.lens.is_change:
        yield "the lens"
    if missing := [*comparison.only_in_a, *comparison.only_in_b]:
        yield f"{', '.join(missing)} on one side only"
