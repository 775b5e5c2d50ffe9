"""Writes a board's files."""

from pathlib import Path

import tomli_w

from visioncal.core.errors import DataError
from visioncal.core.files import check_free, named_errors, write_atomically
from visioncal.core.generations import write_generation
from visioncal.core.types import Target
from visioncal.vision.boards import kind_of
from visioncal.vision.printing.page import Sheet
from visioncal.vision.targets import read_target, stored_target, target_document

_LEAST_DPI = 50.0  # Half a millimetre a pixel.
# Names of this length stay below the 255 bytes of file systems in any script.
_LONGEST_NAME = 60


def write_board(
    folder: Path, sheet: Sheet, *, dpi: float, force: bool, is_drawn: bool = True
) -> tuple[Path, ...]:
    """Writes a board as TOML, and to be printed as PDF, SVG and PNG, named after the target.

    The files appear all at once. An existing `.toml` that describes the same target is kept, with
    its comments.

    Args:
        folder: Output folder; created if it does not exist.
        sheet: Arranged board.
        dpi: Pixels per inch of the PNG.
        force: Whether existing files may be replaced.
        is_drawn: Whether it is to be printed; else its description alone is written.

    Returns:
        The written files, a PDF first.

    Raises:
        DataError: A file exists, the folder cannot be written, or the PNG would be too large.
    """
    # matplotlib takes half a second to import, which help and error messages do not need.
    from visioncal.vision.printing.drawing import not_in_font, to_pdf, to_png, to_svg

    name = sheet.target.name
    _check_name(name, not_in_font(name))
    area_inch2 = sheet.page.width_mm * sheet.page.height_mm / 25.4**2
    # Larger pages take gigabytes of memory to draw.
    most = (2.5e8 / area_inch2) ** 0.5
    if not _LEAST_DPI <= dpi <= most:
        raise DataError(
            f"--dpi is {dpi:g}; {_LEAST_DPI:g} to {most:.0f} are possible on {sheet.page}.",
            culprits=["--dpi"],
            next_step="The PDF and the SVG are exact at any magnification.",
        )
    names = [f"{name}.{ending}" for ending in ("pdf", "svg", "png") if is_drawn]
    # The folder's name may be invalid for the file system.
    with named_errors(folder):
        described = {} if _describes(folder / f"{name}.toml", sheet.target) else _described(sheet)
        for file in (*names, *described):
            check_free(folder / file, force=force)
    drawings = (to_pdf(sheet), to_svg(sheet), to_png(sheet, dpi)) if is_drawn else ()
    drawn: dict[str, bytes | str] = {**dict(zip(names, drawings, strict=True)), **described}

    def write(aside: Path) -> None:
        for file, content in drawn.items():
            write_atomically(aside / file, content)

    write_generation(folder, list(drawn), write)
    return tuple(folder / file for file in drawn)


def _check_name(name: str, not_in_font: str) -> None:
    """Checks that a name is valid for files and printable with the sheet's font."""
    wrong = sorted({*not_in_font, *'/\\:*?"<>|'} & set(name))
    if not name.strip() or name.startswith(".") or wrong or len(name) > _LONGEST_NAME:
        raise DataError(
            f"{name[:_LONGEST_NAME]!r} cannot be the name of files and stand on the print"
            + (f": {' '.join(map(repr, wrong))} cannot." if wrong else "."),
            culprits=[name[:_LONGEST_NAME]],
            next_step=f"Use up to {_LONGEST_NAME} letters, digits, _ and -.",
        )


def _describes(path: Path, target: Target) -> bool:
    """Whether a file exists and describes the same target."""
    if not path.is_file():
        return False
    try:
        described = read_target(path.name, path.parent)[0]
    except DataError:
        return False
    return described == target


def _described(sheet: Sheet) -> dict[str, str | bytes]:
    """Texts of the board's `.toml` and of its tables, by name."""
    left, top, right, bottom = sheet.pattern.box
    page, name = sheet.page, sheet.target.name
    lying = "landscape" if page.width_mm > page.height_mm else "portrait"
    size = kind_of(sheet.target).size_key
    content, tables = stored_target(target_document(sheet.target), name)
    described = (
        f"# {1e3 * (right - left):g} x {1e3 * (bottom - top):g} mm, for {page.name}, {lying}.\n"
        f"# {size} is what was meant to be printed: replace it by what you measure on paper,\n"
        "# and square_sigma_m by how well you measured it.\n" + tomli_w.dumps(content)
    )
    return {f"{name}.toml": described, **tables}
