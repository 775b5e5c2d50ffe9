"""`visioncal export`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from visioncal.cli.console import messages
from visioncal.cli.stdout import write_stdout
from visioncal.exports import EXPORT_FORMATS, Selection, export
from visioncal.files import check_free, write_atomically
from visioncal.stored import load_calibration


def _show_formats(wanted: bool) -> None:
    if wanted:
        width = max(len(it.name) for it in EXPORT_FORMATS)
        for it in EXPORT_FORMATS:
            typer.echo(f"{it.name:<{width}}  {it.words}")
        raise typer.Exit


def export_command(
    calibration: Annotated[
        Path,
        typer.Argument(help="An output folder, its calibration.json, or a recording (.rrd)."),
    ],
    to: Annotated[str, typer.Option("--to", help="The format; --list shows them all.")],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="The file to write; otherwise, or as -, stdout."),
    ] = None,
    edge: Annotated[
        str | None,
        typer.Option("--edge", help="The transform; the camera's where none is named."),
    ] = None,
    inverse: Annotated[bool, typer.Option("--inverse", help="Write the inverse of it.")] = False,
    parent: Annotated[
        str | None,
        typer.Option("--parent", help="What to call the frame in which the pose is given."),
    ] = None,
    child: Annotated[
        str | None, typer.Option("--child", help="What to call the frame whose pose it is.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
    _list: Annotated[
        bool,
        typer.Option("--list", callback=_show_formats, is_eager=True, help="List the formats."),
    ] = False,
) -> None:
    """Write a result in another program's or a robot's format.

    The transform a_from_b is the pose of b in a: its parent is a, its child b. Exit status 2:
    nothing was written, for the reason given.
    """
    result = load_calibration(calibration)
    document = export(result, to, Selection(edge, inverse, parent, child))
    if result.verdict.status == "bad":
        messages().print(
            f"[bold red]warning:[/] the verdict on this calibration is bad. "
            f"{escape(' '.join(result.verdict.reasons))}"
        )
    if out is None or out == Path("-"):
        write_stdout(document)
        return
    check_free(out, force=force)
    write_atomically(out, document)
    messages().print(escape(f"wrote {out}"))
