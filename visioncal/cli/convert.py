"""`visioncal convert`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from visioncal.cli.console import messages
from visioncal.formats import convert


def convert_command(
    source: Annotated[Path, typer.Argument(help="A session's folder, or its .rrd recording.")],
    dest: Annotated[Path, typer.Argument(help="An .rrd, or the folder to write.")],
    force: Annotated[
        bool, typer.Option("--force", help="Replace a file that is there; never a folder.")
    ] = False,
) -> None:
    """Write a session as a folder or as a recording, without loss.

    Exit status 0: both hold the same facts, which their digests prove; 2: nothing was written, or
    a session's digest differs.
    """
    session = convert(source, dest, force=force)
    for warning in session.warnings:
        messages().print(escape(f"note: {warning}"))
    messages().print(escape(f"wrote {dest}\nsha256 {session.digest()}"))
