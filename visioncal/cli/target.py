"""`visioncal target make` and `visioncal target check`."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import tomli_w
import typer

from visioncal.cli.console import answer, print_json, say
from visioncal.cli.session_options import TargetCheckOptions, TargetMakeOptions
from visioncal.core.errors import DataError
from visioncal.core.files import check_free, one_line, write_atomically
from visioncal.core.number_format import known_name
from visioncal.core.types import Target
from visioncal.vision.board_request import BoardRequest
from visioncal.vision.boards import KINDS, kind_of
from visioncal.vision.boards.identify import Identity, describe, identify
from visioncal.vision.boards.imaging import read_image
from visioncal.vision.boards.kind import metres, side_metres
from visioncal.vision.boards.picture import kept_picture, unfit
from visioncal.vision.printing.files import write_board
from visioncal.vision.printing.page import arrange, pages_named, requested_target
from visioncal.vision.targets import (
    load_target,
    target_document,
    target_from_document,
    target_names,
)

# Page sizes to try in order where none is named.
_PAGES = ("A4", "A3", "A2", "A1", "A0")
# Files of pictures.
_PICTURES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"}


def target_make_command(options: TargetMakeOptions) -> None:
    """Runs `visioncal target make`."""
    kind = options.kind
    if (options.target is None) == (not kind):
        raise DataError(
            "Name a board, or describe one by --kind.",
            next_step=f"The boards are {', '.join(target_names())}.",
        )
    made = [name for name, at in KINDS.items() if at.options and name != "picture"]
    if kind:
        known_name("kind of board", kind, made, "--kind")
    picture = Path(options.target or "")
    is_picture = picture.suffix.lower() in _PICTURES
    _refuse_unused("picture" if is_picture else kind, options)
    sized = not kind or options.side_mm is not None
    names = [options.page] if options.page is not None else _PAGES if sized else _PAGES[:1]
    pages = tuple(page for name in names for page in pages_named(name, options.landscape))
    if is_picture:
        chosen = _pictured(picture, options.width_mm, options.name or picture.stem)
    else:
        chosen = requested_target(options, pages) if kind else load_target(str(options.target))
    sheet = arrange(chosen, pages)
    files = write_board(
        options.out, sheet, dpi=options.dpi, force=options.force, is_drawn=not options.toml_only
    )
    for file in files:
        say(f"wrote {file}")
    description = options.out / f"{chosen.name}.toml"
    if description not in files:
        say(f"kept {description}, which describes this board already")
    if not options.toml_only:
        say(f"Print it on {sheet.page} at 100 %, and check both rulers.")


def _pictured(file: Path, width_mm: float | None, name: str) -> Target:
    """The target that a file's picture is; raises DataError where no pose is known by it."""
    if width_mm is None:
        raise DataError(
            f"{file.name} does not say how wide it is printed.",
            culprits=["--width-mm"],
            next_step="Give --width-mm, from the picture's left edge to its right one.",
        )
    described = {"kind": "picture", "width_m": metres(width_mm), "image": kept_picture(file)}
    target = target_from_document(described, name)
    grey = kind_of(target).picture(target)
    if grey is not None and (lack := unfit(grey)):
        raise DataError(
            f"{file.name} {lack}.",
            culprits=[file.name],
            next_step="Take another picture, or put something of its own beside it: letters, a "
            "photograph.",
        )
    return target


def _refuse_unused(kind: str, board: BoardRequest) -> None:
    """Refuses options that have no effect."""
    used = KINDS[kind].options.split() if kind else []
    names = [field.name for field in fields(BoardRequest) if field.name != "kind"]
    given = [name for name in names if getattr(board, name) != getattr(BoardRequest, name)]
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
    identity = identify([read_image(path) for path in options.images])
    if square_m is not None:
        # Refuses what no session could load, such as a size in millimetres taken as metres.
        target = identity.target(options.images[0].stem, square_m)
        target_from_document(target_document(target), target.name)
    description = "" if square_m is None else to_toml(identity, square_m, options.images[0].name)
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


def to_document(identity: Identity, square_m: float | None) -> dict[str, Any]:
    """An identity as the content of a JSON document.

    With a measured side of a square, or of a single marker [m], it has the target's description
    too.
    """
    kind, board = kind_of(identity.board), identity.board
    described = kind.document(board)
    sizes = {kind.size_key, "square_sigma_m", "marker_m", "diameter_m"}
    document: dict[str, Any] = {
        "kind": board.kind,
        **{key: value for key, value in described.items() if key not in sizes},
        "corners_seen": identity.corners_seen,
        "corners": identity.corners,
        "same_markers": list(identity.larger),
        "marker_ids": list(identity.marker_ids),
        "mirrored": identity.is_mirrored,
        "negative": identity.is_negative,
        "notes": list(identity.notes),
    }
    if board.marker_m:
        document["marker_over_square"] = board.marker_m
    if square_m is not None:
        document["target"] = target_document(identity.target("board", square_m))
    return document


def to_toml(identity: Identity, square_m: float, source: str) -> str:
    """A target's description, with its measured side [m]; `source` names the image."""
    lines = [f"# Seen in {one_line(source)}: {describe(identity)}."]
    lines += [f"# {note}" for note in identity.notes]
    lines.append("# square_sigma_m is 0.1 %, as of printers: replace it by how well you measured.")
    target = identity.target("board", square_m)
    return "\n".join([*lines, tomli_w.dumps(target_document(target))])
