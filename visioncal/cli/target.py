"""`visioncal target make` and `visioncal target check`."""

from collections.abc import Mapping
from dataclasses import fields

import typer

from visioncal.cli.console import answer, print_json, say
from visioncal.cli.session_options import BoardOptions, TargetCheckOptions, TargetMakeOptions
from visioncal.core.errors import DataError
from visioncal.core.files import check_free, write_atomically
from visioncal.core.number_format import known_name
from visioncal.vision.boards import KINDS
from visioncal.vision.boards.identify import describe, identify, to_document, to_toml
from visioncal.vision.boards.imaging import read_image
from visioncal.vision.boards.kind import BoardRequest, side_metres
from visioncal.vision.printing.files import write_board
from visioncal.vision.printing.page import arrange, pages_named
from visioncal.vision.printing.request import requested_target
from visioncal.vision.targets import (
    load_target,
    target_document,
    target_from_document,
    target_names,
)

# Page sizes to try in order where none is named.
_PAGES = ("A4", "A3", "A2", "A1", "A0")


def target_make_command(options: TargetMakeOptions) -> None:
    """Runs `visioncal target make`."""
    kind = options.kind
    if (options.target is None) == (kind is None):
        raise DataError(
            "Name a board, or describe one by --kind: one of both is needed.",
            next_step=f"The boards are {', '.join(target_names())}.",
        )
    board = {field.name: getattr(options, field.name) for field in fields(BoardOptions)}
    _refuse_unused(kind, board)
    request = None
    if kind is not None:
        size_mm = board.pop("size_mm")
        board["square_mm"] = board["square_mm"] if size_mm is None else size_mm
        request = BoardRequest(**board)
    sized = request is None or request.square_mm is not None
    names = [options.page] if options.page is not None else _PAGES if sized else _PAGES[:1]
    pages = tuple(page for name in names for page in pages_named(name, options.landscape))
    chosen = requested_target(request, pages) if request else load_target(str(options.target))
    sheet = arrange(chosen, pages)
    files = write_board(options.out, sheet, dpi=options.dpi, force=options.force)
    for file in files:
        say(f"wrote {file}")
    description = files[0].with_name(f"{chosen.name}.toml")
    if description not in files:
        say(f"kept {description}, which describes this board already")
    say(f"Print it on {sheet.page} at 100 %, and check both rulers.")


def _refuse_unused(kind: str | None, board: Mapping[str, object]) -> None:
    """Refuses options that have no effect."""
    made = [name for name, board_kind in KINDS.items() if board_kind.options]
    if kind is not None:
        known_name("kind of board", kind, made, "--kind")
    used = KINDS[kind].options.split() if kind is not None else []
    default = vars(BoardOptions())
    given = [name for name, value in board.items() if value != default[name] and name != "kind"]
    options = ["--id" if name == "marker_id" else f"--{name.replace('_', '-')}" for name in given]
    unused = [option for option in options if option not in used]
    if unused:
        what = f"--kind {kind} takes {', '.join(used)}" if used else "A named board is as it is"
        raise DataError(
            f"{what}; {', '.join(unused)} would change nothing.",
            culprits=unused,
            next_step="" if used else "Describe another board by --kind.",
        )


def target_check_command(options: TargetCheckOptions) -> None:
    """Runs `visioncal target check`."""
    square_m = None if options.square_mm is None else side_metres("--square-mm", options.square_mm)
    if options.out is not None and square_m is None:
        raise DataError(
            "A description needs the size of the squares, which a photograph does not show.",
            culprits=["--square-mm"],
            next_step="Measure over many squares and give --square-mm.",
        )
    if options.out is not None:
        check_free(options.out, force=options.force)
    identity = identify(read_image(options.image))
    if square_m is not None:
        # Refuses what no session could load, such as a size in millimetres taken as metres.
        target = identity.target(options.image.stem, square_m)
        target_from_document(target_document(target), target.name)
    description = "" if square_m is None else to_toml(identity, square_m, options.image.name)
    if options.out is not None:
        write_atomically(options.out, description)
    if options.as_json:
        print_json(to_document(identity, square_m))
    elif options.out is None and description:
        typer.echo(description, nl=False)
    else:
        answer(describe(identity))
        for note in identity.notes:
            say(note)
    if options.out is not None:
        say(f"wrote {options.out}")
