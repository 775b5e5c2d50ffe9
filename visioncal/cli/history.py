"""`visioncal history`, and the entries of the commands that calibrate, check and place."""

import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from visioncal.cli.console import answer, print_json, print_table, say, warn
from visioncal.cli.options import ActOptions
from visioncal.cli.result_options import HistoryOptions
from visioncal.core.choices import SITE_FILE
from visioncal.core.codec import write
from visioncal.core.errors import DataError
from visioncal.core.files import check_free, write_atomically
from visioncal.core.number_format import known_name
from visioncal.interchange.outputs import CALIBRATION, VERIFY
from visioncal.interchange.result_files import content_of, load_result_or_frames
from visioncal.results import Calibration
from visioncal.results.history import (
    Entry,
    History,
    entries_of,
    entry_of_check,
    entry_of_frame,
    table_of,
)


def enter(
    options: ActOptions, near: Path, entries: Iterable[Entry], out: Path | str = "", of: str = ""
) -> None:
    """Enters acts before their results are printed; where it fails, that costs a warning at most.

    Args:
        options: Which history and which cell are meant.
        near: The session or file that was read, by which the site is found.
        entries: The entries, whose cell and paths are filled in.
        out: The output, from which they can be added later; empty for none.
        of: Digest of the calibrated session whose cell they are of; else each entry says so.
    """
    history = History(options.history) if options.history else History.of_site(near)
    if history is None:
        return
    try:
        history.append(*_placed(history, options.cell, entries, out, near, of))
    except DataError as error:
        later = shlex.join(["visioncal", "history", str(history.path), "--add", str(out)])
        how = f"Then enter it: {later}" if out else "Then run the command once more."
        warn(f"This is not in the history: {error.message} {error.next_step} {how}")


def _placed(
    history: History,
    cell: str | None,
    entries: Iterable[Entry],
    out: Path | str,
    source: Path | None = None,
    of: str = "",
) -> Iterator[Entry]:
    """Entries with their paths and their cell: the one that was named, or that is known already."""
    place, origin = str(out and Path(out).absolute()), str(source.absolute()) if source else ""
    for entry in entries:
        session, known = of or entry.against or entry.sha256, tuple[Entry, ...]()
        if session and not cell and history.path.exists():
            known = history.entries(sha256=session)
        named = cell or (known[0].cell if known else entry.cell)
        yield replace(entry, cell=named, source=entry.source or origin, out=entry.out or place)


def history_command(options: HistoryOptions) -> None:
    """Runs `visioncal history`."""
    file = options.file or options.history
    history = History(file) if file else History.of_site(Path.cwd())
    if history is None:
        results = shlex.join(map(str, options.add or ("OUT",)))
        raise DataError(
            f"there is no {SITE_FILE} here or above.",
            culprits=["FILE"],
            next_step="Name the FILE of a history, or begin one where all sessions of the site are "
            f"below, with a result: visioncal history {SITE_FILE} --add {results}",
        )
    if options.add:
        found = [entry for out in options.add for entry in _stored(history, out, options.cell)]
        new = history.append(*found)
        say(f"{new} added, {len(found) - new} existed already")
        return
    if options.cell is not None:
        known = sorted({entry.cell for entry in history.entries()})
        known_name("cell", options.cell, known, "--cell")
    entries = history.entries(options.cell, options.kind, begin=options.show or "")
    if (out := options.recording or options.out) is not None:
        _write(out, entries, history.path, force=options.force)
    elif options.as_json:
        print_json([{"id": entry.id} | write(Entry, entry) for entry in entries])
    elif options.show is None:
        rows = [
            (
                entry.id[:8],
                f"{entry.time:%Y-%m-%d %H:%M}",
                entry.cell,
                entry.kind,
                entry.status,
                entry.reason,
            )
            for entry in entries
        ]
        print_table(("id", "time", "cell", "kind", "verdict", "first reason"), rows)
    elif len(entries) == 1:
        for name, value in entries[0].columns.items():
            if value not in ("", None):
                answer(f"{value}", f"{name}: ")
    else:
        raise DataError(
            f"{len(entries)} entries of {history.path} begin with {options.show!r}.",
            culprits=["--show"],
            next_step=f"visioncal history {shlex.quote(str(history.path))} lists them.",
        )


def _write(out: Path, entries: Sequence[Entry], source: Path, *, force: bool) -> None:
    check_free(out, force=force)
    site = source.absolute().parent.name
    if out.suffix.lower() == ".rrd":
        from visioncal.present.recording.timeline import record_years

        record_years(out, entries, site)
        say(f"wrote {out}")
        return
    if out.suffix.lower() == ".csv":
        text = table_of(entries)
    elif out.suffix.lower() == ".html":
        from visioncal.present.report.fleet import page_of_history

        text = page_of_history(entries, site, datetime.now(UTC))
    else:
        raise DataError(
            f"{out} is neither a page (.html) nor a table (.csv).",
            culprits=["-o"],
            next_step="Give it one of these endings.",
        )
    write_atomically(out, text)
    say(f"wrote {out}")


def _stored(history: History, out: Path, cell: str | None) -> Iterator[Entry]:
    """The entries of the results in a folder or below, of a result's file or of one of frames."""
    names = (CALIBRATION, VERIFY) if out.is_dir() else ()
    below = sorted({file.parent for name in names for file in out.rglob(name)})
    for place in below or [out]:
        check = content_of(place / VERIFY if place.is_dir() else place)
        entries: Iterable[Entry]
        if "triggers" in check:
            entries = [entry_of_check(check, str(place))]
        elif isinstance(result := load_result_or_frames(place), Calibration):
            entries = entries_of(result)
        else:
            entries = [entry_of_frame(*item, None) for item in result.frames.items()]
        yield from _placed(history, cell, entries, place)
