"""`visioncal export`."""

from pathlib import Path

import typer

from visioncal.cli.console import check_usable, say, with_run_paths
from visioncal.cli.result_options import ExportOptions
from visioncal.core.files import check_free, write_atomically
from visioncal.interchange.exports import document
from visioncal.interchange.result_files import load_exportable


def export_command(options: ExportOptions) -> None:
    """Runs `visioncal export`."""
    with with_run_paths(options.source, options.source):
        written = document(load_exportable(options.source), options.to, options)
    bad = check_usable(written.verdict, "what is exported", force=options.force)
    for warning in (*bad, *written.warnings):
        say(warning, "warning: ", "bold red")
    for note in written.notes:
        say(f"note: {note}")
    if options.out is None or options.out == Path("-"):
        typer.echo(written.text, nl=False)
        return
    # A format without comments carries its verdict beside it.
    files = {options.out: written.text}
    if written.notes:
        heading = "\n".join((*written.notes, *written.warnings, ""))
        files = {options.out.with_name(f"{options.out.name}.txt"): heading} | files
    for file in files:
        check_free(file, force=options.force)
    for file, text in files.items():
        write_atomically(file, text)
        say(f"wrote {file}")
