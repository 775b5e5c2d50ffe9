"""`visioncal export`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer
from rich.markup import escape

from visioncal.cli.console import check_usable, messages, say
from visioncal.cli.options import ForceBoth, OutFile, PartOptions
from visioncal.core.choices import EXPORT_NAMES, Convention
from visioncal.core.errors import DataError
from visioncal.core.files import check_free, write_atomically

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.interchange.exports import Load


def _show_formats(wanted: bool) -> None:
    if wanted:
        from visioncal.interchange.exports import EXPORT_FORMATS

        width = max(len(export_format.name) for export_format in EXPORT_FORMATS)
        for export_format in EXPORT_FORMATS:
            typer.echo(f"{export_format.name:<{width}}  {export_format.words}")
        raise typer.Exit


def export_command(
    source: Annotated[
        Path,
        typer.Argument(
            help="An output folder, its calibration.json or dynamics.json, a recording (.rrd), or "
            "a file of frames."
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            metavar="FORMAT", help=f"{', '.join(EXPORT_NAMES)}; --list says what each is."
        ),
    ],
    part: PartOptions,
    out: OutFile = None,
    edge: Annotated[
        str | None,
        typer.Option(
            help="The transform; where none is named the camera's, the only tool or the only "
            "fixture, as the format has it. Of an aligned cell any frame from any other, or all."
        ),
    ] = None,
    inverse: Annotated[bool, typer.Option("--inverse", help="Write the inverse of it.")] = False,
    parent: Annotated[
        str | None, typer.Option(help="Exported name of the frame in which the pose is given.")
    ] = None,
    child: Annotated[
        str | None, typer.Option(help="Exported name of the frame whose pose it is.")
    ] = None,
    number: Annotated[
        int | None, typer.Option(help="Number of the controller's tool or base.")
    ] = None,
    mass_kg: Annotated[
        float | None, typer.Option(help="The tool's mass, for ABB's tooldata (kg).")
    ] = None,
    cog_mm: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Its centre of mass in the flange's frame: X Y Z (mm)."),
    ] = None,
    convention: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(get_args(Convention)),
            help="robot-dh: convention of its joint table; modified is Craig's.",
        ),
    ] = None,
    calibration_hash: Annotated[
        str | None,
        typer.Option("--hash", help="ur-kinematics: the hash that ur_calibration extracts."),
    ] = None,
    with_corrections: Annotated[
        bool,
        typer.Option(
            "--with-corrections",
            help="robot-urdf, robot-dh, ur-kinematics: links for use with the table of "
            "joint-corrections; without it, those that leave the least alone.",
        ),
    ] = False,
    lens: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The receiving program's own lens, as convert --intrinsics reads it: the "
            "camera's transform is written for that.",
        ),
    ] = None,
    force: ForceBoth = False,
    _list: Annotated[
        bool,
        typer.Option("--list", callback=_show_formats, is_eager=True, help="List the formats."),
    ] = False,
) -> None:
    """Write a result, or the calibrated arm, in another program's or robot's format.

    The transform a_from_b is the pose of b in a: its parent is a, its child b. Exit status 2:
    nothing was written, for the reason given; 3: nothing was, as the result's verdict is bad.
    """
    from visioncal.interchange.exports import Selection, document
    from visioncal.interchange.result_files import load_exportable

    load = _load(mass_kg, cog_mm)
    selection = Selection(
        edge,
        inverse,
        parent,
        child,
        number,
        load,
        convention,
        calibration_hash,
        part.camera,
        part.robot,
        part.target,
        with_corrections,
        lens,
    )
    written = document(load_exportable(source), to, selection)
    bad = check_usable(written.verdict, "what is exported", force=force)
    for warning in (*bad, *written.warnings):
        messages().print(f"[bold red]warning:[/] {escape(warning)}")
    if out is None or out == Path("-"):
        typer.echo(written.text, nl=False)
        return
    check_free(out, force=force)
    write_atomically(out, written.text)
    say(f"wrote {out}")


def _load(mass_kg: float | None, cog_mm: tuple[float, float, float] | None) -> "Load | None":
    from visioncal.interchange.exports import Load

    if mass_kg is None and cog_mm is None:
        return None
    if mass_kg is None or cog_mm is None:
        raise DataError(
            "A load is a mass and where its centre is.",
            culprits=["--mass-kg", "--cog-mm"],
            next_step="Give both --mass-kg and --cog-mm, or neither.",
        )
    return Load(mass_kg, cog_mm)
