"""`visioncal target make` and `visioncal target check`."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import typer
from rich.markup import escape

from visioncal.cli.console import answers, print_json, say
from visioncal.cli.lazy import PlainCommand, with_fields
from visioncal.cli.options import AsJson
from visioncal.core.errors import DataError
from visioncal.core.files import check_free, write_atomically

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.core.types import Target
    from visioncal.vision.printing import BoardRequest, Page

target_app = typer.Typer(
    help="Print a board at its exact size, or name the one in a photograph.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

# The options that describe a board, by its kind.
_Described: TypeAlias = Literal["charuco", "checkerboard", "aprilgrid", "circles", "marker"]
_USED: dict[_Described, str] = {
    "charuco": "--columns --rows --square-mm --marker-mm --dictionary --legacy --name",
    "checkerboard": "--columns --rows --square-mm --name",
    "aprilgrid": "--columns --rows --size-mm --spacing --border --dictionary --id --name",
    "circles": "--columns --rows --square-mm --diameter-mm --asymmetric --name",
    "marker": "--id --size-mm --dictionary --name",
}
# Page sizes to try in order where none is named.
_PAGES = ("A4", "A3", "A2", "A1", "A0")


@dataclass(frozen=True)
class BoardOptions:
    """Options that describe a board."""

    kind: Annotated[_Described | None, typer.Option(help="What to print.")] = None
    columns: Annotated[
        int | None,
        typer.Option(help="Squares along x; inner corners of a checkerboard, tags, circles."),
    ] = None
    rows: Annotated[int | None, typer.Option(help="The same along y.")] = None
    square_mm: Annotated[
        float | None,
        typer.Option(help="Side of a square, distance of rows of circles; left out: the largest."),
    ] = None
    marker_mm: Annotated[
        float | None, typer.Option(help="Side of the markers of a ChArUco board.")
    ] = None
    dictionary: Annotated[str, typer.Option(help="As DICT_5X5_100, DICT_APRILTAG_36h11.")] = ""
    legacy: Annotated[
        bool, typer.Option("--legacy", help="The ChArUco layout from before OpenCV 4.6.")
    ] = False
    marker_id: Annotated[
        int | None, typer.Option("--id", help="Id of a single marker; an AprilGrid's first.")
    ] = None
    size_mm: Annotated[
        float | None, typer.Option(help="Side of a single marker or a tag; left out: the largest.")
    ] = None
    spacing: Annotated[
        float | None,
        typer.Option(help="White between an AprilGrid's tags, as a share of their side: 0.3."),
    ] = None
    border: Annotated[
        int | None, typer.Option(help="Dark modules around their bits: 2, as Kalibr has it.")
    ] = None
    diameter_mm: Annotated[float | None, typer.Option(help="Diameter of circles.")] = None
    asymmetric: Annotated[
        bool, typer.Option("--asymmetric", help="Every second row of circles is shifted by half.")
    ] = False
    name: Annotated[str, typer.Option(help="Name of a board described by options.")] = ""

    @property
    def given(self) -> list[str]:
        """The options given to describe it."""
        chosen = [
            field.name for field in fields(self) if getattr(self, field.name) != field.default
        ]
        names = {"marker_id": "id"}
        return [f"--{names.get(name, name).replace('_', '-')}" for name in chosen if name != "kind"]

    def request(self, kind: _Described) -> "BoardRequest":
        """The request for the printer."""
        from visioncal.vision.printing import BoardRequest

        mine = {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name != "size_mm"
        }
        if self.size_mm is not None:
            mine["square_mm"] = self.size_mm
        return BoardRequest(**mine | {"kind": kind})


@target_app.command("make", cls=PlainCommand)
@with_fields
def make_command(
    target: Annotated[
        str | None,
        typer.Argument(
            help="A board that comes with visioncal, or the path of a .toml; or describe one by "
            "--kind and the options after it."
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option("-o", "--out", file_okay=False, help="Folder for the files.")
    ] = Path(),
    page: Annotated[
        str | None,
        typer.Option(
            help="A5 to A0, letter, legal, tabloid, or a size as 500x300 (width x height, mm). "
            "Left out: A4, or the smallest larger one for a board of given size."
        ),
    ] = None,
    landscape: Annotated[
        bool | None, typer.Option("--landscape/--portrait", help="Left out: as the board fits.")
    ] = None,
    dpi: Annotated[float, typer.Option(help="Resolution of the PNG, in pixels per inch.")] = 300.0,
    *,
    board: BoardOptions,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there.")] = False,
) -> None:
    """Draw a board as NAME.pdf, NAME.svg and NAME.png at its exact size, with its NAME.toml.

    Rulers along both axes show whether the printer kept the size. Exit status 0: all files are
    written; 2: none, because the board does not fit or files are there already.
    """
    from visioncal.vision.printing import arrange, requested_target, write_board
    from visioncal.vision.targets import load_target, target_names

    kind = board.kind
    if (target is None) == (kind is None):
        raise DataError(
            "Name a board, or describe one by --kind: one of both is needed.",
            next_step=f"The boards are {', '.join(target_names())}.",
        )
    _refuse_unused(kind, board.given)
    request = None if kind is None else board.request(kind)
    sized = request is None or request.square_mm is not None
    pages = _pages(page, landscape, larger=sized)
    chosen = requested_target(request, pages) if request else load_target(str(target))
    sheet = arrange(chosen, pages)
    files = write_board(out, sheet, dpi=dpi, force=force)
    for file in files:
        say(f"wrote {file}")
    description = files[0].with_name(f"{chosen.name}.toml")
    if description not in files:
        say(f"kept {description}, which describes this board already")
    say(f"Print it on {sheet.page} at 100 %, and check both rulers.")


def _refuse_unused(kind: _Described | None, given: list[str]) -> None:
    """Refuses options that have no effect."""
    used = _USED[kind].split() if kind is not None else []
    unused = [option for option in given if option not in used]
    if unused:
        what = f"--kind {kind} takes {', '.join(used)}" if used else "A named board is as it is"
        raise DataError(
            f"{what}; {', '.join(unused)} would change nothing.",
            culprits=unused,
            next_step="" if used else "Describe another board by --kind.",
        )


def _pages(page: str | None, landscape: bool | None, *, larger: bool) -> "tuple[Page, ...]":
    from visioncal.vision.printing import pages_named

    if page is not None:
        return pages_named(page, landscape)
    names = _PAGES if larger else _PAGES[:1]
    return tuple(item for name in names for item in pages_named(name, landscape))


@target_app.command("check", cls=PlainCommand)
def check_command(
    image: Annotated[
        Path, typer.Argument(help="A photograph of the board: png, jpg, tif, bmp or webp.")
    ],
    square_mm: Annotated[
        float | None,
        typer.Option(help="Measured side of a square; of a tag for an AprilGrid or a single one."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Write the description here.")
    ] = None,
    as_json: AsJson = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a description that is there.")
    ] = False,
) -> None:
    """Name the board in a photograph without further options, and print its description.

    Only the size of its squares cannot be seen. Exit status 0: it is named; 2: no board is seen.
    """
    from visioncal.vision.finders.identify import identify
    from visioncal.vision.finders.identify_text import describe, to_document, to_toml
    from visioncal.vision.finders.imaging import read_image
    from visioncal.vision.printing import side_metres

    square_m = None if square_mm is None else side_metres("--square-mm", square_mm)
    if out is not None and square_m is None:
        raise DataError(
            "A description needs the size of the squares, which a photograph does not show.",
            culprits=["--square-mm"],
            next_step="Measure over many squares and give --square-mm.",
        )
    if out is not None:
        check_free(out, force=force)
    identity = identify(read_image(image))
    if square_m is not None:
        _checked(identity.target(image.stem, square_m))
    description = to_toml(identity, square_m, image.name)
    if out is not None:
        write_atomically(out, description)
    if as_json:
        print_json(to_document(identity, square_m))
    elif out is None:
        typer.echo(description, nl=False)
    if out is not None:
        if not as_json:
            answers().print(escape(describe(identity)))
        for note in identity.notes:
            say(note)
        say(f"wrote {out}")


def _checked(target: "Target") -> None:
    """Refuses boards that no session could load, such as sizes in millimetres taken as metres."""
    from visioncal.vision.targets import target_document, target_from_document

    target_from_document(target_document(target), target.name)
