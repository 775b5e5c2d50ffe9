"""`visioncal export`."""

from dataclasses import fields
from pathlib import Path

import typer

from visioncal.cli.console import check_usable, say, with_run_paths
from visioncal.cli.result_options import ExportOptions
from visioncal.core.errors import DataError
from visioncal.core.files import check_free, read_text, write_atomically
from visioncal.interchange.exports import Load, Selection, document
from visioncal.interchange.result_files import load_exportable


def export_command(options: ExportOptions) -> None:
    """Runs `visioncal export`."""
    if (options.mass_kg is None) != (options.cog_mm is None):
        raise DataError(
            "A load is a mass and where its centre is.",
            culprits=["--mass-kg", "--cog-mm"],
            next_step="Give both --mass-kg and --cog-mm, or neither.",
        )
    load = None
    if options.mass_kg is not None and options.cog_mm is not None:
        load = Load(options.mass_kg, options.cog_mm)
    onto = None if options.onto is None else read_text(options.onto)
    given = {**vars(options), "load": load, "onto": onto}
    selection = Selection(**{field.name: given[field.name] for field in fields(Selection)})
    with with_run_paths(options.source, options.source):
        written = document(load_exportable(options.source), options.to, selection)
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
