"""`visioncal plan`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from visioncal.cli.console import answers, print_json, report_written, warn
from visioncal.cli.options import AsJson, OutFolder
from visioncal.cli.plan_options import ClearanceOptions, PlanCellOptions, PlanOptions, SightOptions
from visioncal.cli.progress import shown_progress
from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.interchange.outputs import write_plan
from visioncal.live.planning.purposes import purpose_of

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.cli.planned_cell import Kept, Source
    from visioncal.core.types import Progress
    from visioncal.live.planning.cell import PlanCell
    from visioncal.live.planning.plan import Plan
    from visioncal.live.planning.recorded import SessionStart

_SHOWN = 12
# Cosine between the z axes of board and base above which only a camera below would see the board.
_FACE_DOWN = 0.7


def plan_command(
    source: Annotated[
        str,
        typer.Argument(
            help="A robot (a built-in name, a .urdf or .toml), a session, or an output folder of "
            "calibrate."
        ),
    ],
    wanted: PlanOptions,
    words: PlanCellOptions,
    kept: ClearanceOptions,
    sight: SightOptions,
    out: OutFolder = Path("plan"),
    as_json: AsJson = False,
) -> None:
    """Propose the most informative robot stops, or those to add to a session.

    Writes stops.csv, plan.json, plan.rrd to look at, and plan.script for a UR. Nothing is sent to
    a robot. Exit status 2: the cell or the session allows no plan, for the reason given.
    """
    from visioncal.cli.planned_cell import chosen_part, find_source
    from visioncal.live.planning.plan import make_plan
    from visioncal.live.planning.plan_file import plan_document

    limits, boxes = sight.limits(kept), kept.bodies
    purpose_of(wanted.purpose, "--for")
    start, words = chosen_part(find_source(source), words)
    with shown_progress(quiet=as_json) as progress:
        cell, begun = _begin(start, words, (limits, boxes), wanted, progress)
        if words.board is not None and cell.mount == "eye-in-hand" and cell.z[2, 2] > _FACE_DOWN:
            warn(
                "this --board lies face down: its z points into the "
                "paper, and a board that lies face up ends in 180 0 0"
            )
        plan = make_plan(cell, wanted.request(cell), begun=begun, progress=progress)
        progress("write", 0, 1)
        document = plan_document(plan, {"kind": start.words})
        written = write_plan(out, plan, document)
    if as_json:
        print_json(document)
    else:
        _report(plan)
    report_written(written, quiet=as_json)


def _begin(
    source: "Source",
    words: PlanCellOptions,
    kept: "Kept",
    wanted: PlanOptions,
    progress: "Progress",
) -> "tuple[PlanCell, SessionStart | None]":
    """The cell, and the recorded session where stops are added to one."""
    from visioncal.cli.planned_cell import begun_session, cell_of

    if wanted.add is not None and wanted.stops is not None:
        raise DataError(
            "--add and --stops exclude each other: stops are added to what was recorded, or "
            "planned without it.",
            culprits=["--add", "--stops"],
            next_step="Leave one out.",
        )
    if wanted.add is None and (source.session is None or source.calibration is not None):
        return cell_of(source, words, kept), None
    begun = begun_session(source, words, kept, progress)
    return begun.cell, begun if wanted.add is not None else None


def _report(plan: "Plan") -> None:
    from visioncal.live.planning.messages import looks_note, need_words, summary_of

    console = answers()
    console.print(escape(f"{plan.request.purpose.name}: {summary_of(plan)}"))
    if plan.start is not None and plan.start.refusal:
        console.print(escape(f"  so far: {plan.start.refusal}"))
    for stop in sorted(plan.stops, key=lambda value: value.rank)[:_SHOWN]:
        console.print(escape(f"  view {stop.view}: {stop.words}"))
    if len(plan.stops) > _SHOWN:
        console.print(f"  and {len(plan.stops) - _SHOWN} more, in plan.json and in the preview")
    if plan.in_the_way:
        count, obstacles = len(plan.in_the_way), some_of(list(dict.fromkeys(plan.in_the_way)))
        stops = "1 stop was" if count == 1 else f"{count} stops were"
        console.print(escape(f"{stops} exchanged for want of a safe way ({obstacles})"))
    if plan.shortfall:
        console.print(f"[bold yellow]warning:[/] {escape(plan.shortfall)}")
    elif note := looks_note(plan):
        console.print(escape(note))
    if plan.design.met:
        after = plan.design.predicted.words
        console.print(escape(f"that meets the wish, with {len(plan.stops)} stops: {after}"))
    if plan.need is not None and plan.need.met:
        console.print(f"that meets the need, with {len(plan.stops)} stops: {need_words(plan.need)}")
    if plan.request.start_q is None:
        console.print(
            "the way from where the arm stands to the first stop was not looked at; --start-joints "
            "says where that is"
        )
