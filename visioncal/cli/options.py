"""Options of commands, declared as fields of the records that they take; shared ones once."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import typer

from visioncal.core.choices import SITE_FILE, ImagesKept
from visioncal.core.options import REQUIRED, argument, flag, option
from visioncal.core.parsing import address_in, need_in
from visioncal.interchange.outputs import RECORDING, REPORT


def example_flag(name: str) -> Any:  # noqa: ANN401 - as `option`
    """The flag that prints a command's example, and ends."""

    def show(wanted: bool) -> None:
        if wanted:
            from visioncal.cli.examples import EXAMPLES

            typer.echo(EXAMPLES[name], nl=False)
            raise typer.Exit

    words = "Print a small table, or a line, that works."
    return flag(words, "--example", callback=show, is_eager=True)


session_argument = partial(argument, "A session's folder, or its .rrd recording.")
out_file = partial(option, "The file to write; otherwise, or as -, stdout.", "-o", "--out")
json_flag = partial(flag, "Print the result as JSON to stdout, without words.", "--json")
force_flag = partial(flag, "Replace what is there under the same name; never a folder.", "--force")
force_bad = partial(flag, "Use a result even if its verdict is bad.", "--force")
force_both = partial(flag, "Replace an existing file; and use a result that is bad.", "--force")
form_option = partial(
    option, "Form of poses; else the calibration's robot's.", "--robot-form", metavar="kuka|abb|..."
)
yes_flag = partial(flag, "Do not ask: the cell is clear, a hand on the stop button.", "--yes")
seed_option = partial(option, "Random seed.", "--seed", default=0, min=0)
against_option = partial(
    option, "The calibration: an output folder of calibrate, or its .rrd.", default=REQUIRED
)


def out_folder(words: str = "The folder to write into.", *names: str, **attributes: object) -> Any:  # noqa: ANN401
    """The option of a folder to write into; see `option`."""
    return option(words, *(names or ("-o", "--out")), file_okay=False, **attributes)


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """Whether a page in a browser asks and shows."""

    page: bool = flag("On a page in a browser (extra page), which also asks what is not given.")
    address: tuple[str, int] | None = option(
        "With --page: where it listens; else on 127.0.0.1:8321, for this machine alone.",
        parse=address_in,
        metavar="HOST:PORT",
        needs="page",
    )


@dataclass(frozen=True, kw_only=True)
class ActOptions:
    """Where an act on a cell is entered."""

    history: Path | None = option(
        f"History to enter this into; else the nearest {SITE_FILE} above the session."
    )
    cell: str | None = option("The cell's name there; else the calibration's, or the session's.")


@dataclass(frozen=True, kw_only=True)
class NeedOptions:
    """Required accuracy of the task."""

    need_mm: float | None = option(
        "Required accuracy of picks, in mm, in place of the session's.", parse=need_in, metavar="MM"
    )
    need_deg: float | None = option(
        "The same in rotation, in degrees.", parse=need_in, metavar="DEG"
    )


@dataclass(frozen=True, kw_only=True)
class WorkOptions:
    """How a session is processed, and which drawings are made."""

    threads: int | None = option("Images searched in parallel; else one per core.", min=1)
    no_report: bool = flag(f"Leave {REPORT} out, which takes a second to draw.")
    no_recording: bool = flag(f"Leave {RECORDING} out, for the viewer.")
    images: ImagesKept = option(
        f"Form in which {RECORDING} keeps them: faint copies to look at, all of them, or none. "
        "The corners found in them are kept in any case, and give the same result again.",
        default="thumbnail",
    )

    @property
    def left_out(self) -> tuple[str, ...]:
        """The files that are left out."""
        omissions = {REPORT: self.no_report, RECORDING: self.no_recording}
        return tuple(name for name, is_left_out in omissions.items() if is_left_out)
