"""`visioncal plan`."""

import json
from pathlib import Path

import numpy as np
import typer
from rich.markup import escape

from visioncal.cli import plan_options as options
from visioncal.cli.console import messages, tell_written
from visioncal.cli.numbers import numbers_in
from visioncal.cli.planned_cell import (
    CellWords,
    Source,
    begun_session,
    box_of,
    cell_of,
    chosen_part,
    find_source,
    floor_of,
)
from visioncal.cli.progress import shown_progress
from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.core.types import FloatArray, Progress
from visioncal.interchange.outputs import write_plan
from visioncal.live.planning.accuracy import Wish
from visioncal.live.planning.cell import Limits, PlanCell
from visioncal.live.planning.messages import accuracy_words, looks_note, summary_of
from visioncal.live.planning.plan import Plan, Request, make_plan
from visioncal.live.planning.purposes import purpose_of
from visioncal.live.planning.recorded import Begun
from visioncal.live.planning.written import plan_document

_SHOWN = 12
# The cosine of a board's z to the base's, from which on only a camera below would see it.
_FACE_DOWN = 0.7


def plan_command(
    source: options.Source,
    out: options.Out = Path("plan"),
    add: options.Add = None,
    purpose: options.For = "hand-eye",
    stops: options.Stops = None,
    criterion: options.CriterionOption = "I",
    wish_mm: options.WishMm = None,
    wish_deg: options.WishDeg = None,
    workspace: options.Workspace = None,
    start_joints: options.StartJoints = None,
    candidates: options.CandidatesOption = 1500,
    seed: options.Seed = 0,
    robot: options.RobotOption = None,
    target: options.TargetOption = None,
    camera: options.CameraOption = None,
    resolution: options.Resolution = None,
    mount: options.MountOption = None,
    cam: options.CamOption = None,
    board: options.BoardOption = None,
    guess_mm: options.GuessMm = 20.0,
    guess_deg: options.GuessDeg = 5.0,
    noise_px: options.NoisePx = None,
    noise_mm: options.NoiseMm = None,
    noise_deg: options.NoiseDeg = None,
    boxes: options.BoxOption = None,
    floor: options.Floor = "0",
    clearance_mm: options.Clearance = 30.0,
    margin_deg: options.Margin = 3.0,
    tilt_deg: options.Tilt = 50.0,
    edge_px: options.Edge = 20.0,
    distance_mm: options.Distance = None,
    focus_mm: options.Focus = None,
    as_json: options.AsJson = False,
) -> None:
    """Propose the robot stops that tell most, or those to add to a session.

    Writes stops.csv, plan.json, plan.rrd to look at, and plan.script for a UR. Nothing is sent to
    a robot. Exit status 2: the cell or the session allows no plan, for the reason given.
    """
    limits = Limits(
        float(np.deg2rad(margin_deg)),
        _span(distance_mm, "--distance-mm"),
        _span(focus_mm, "--focus-mm"),
        float(np.deg2rad(tilt_deg)),
        edge_px,
        1e-3 * clearance_mm,
        floor_of(floor),
    )
    words = CellWords(
        robot,
        target,
        camera,
        resolution,
        mount,
        cam,
        board,
        guess_mm,
        guess_deg,
        noise_px,
        noise_mm,
        noise_deg,
        limits,
        tuple(box_of(it) for it in boxes or ()),
    )
    wanted = purpose_of(purpose, "--for")
    start, words = chosen_part(find_source(source), words)
    wish = None if wish_mm is None and wish_deg is None else Wish(wish_mm, wish_deg)
    with shown_progress(quiet=as_json) as told:
        cell, begun = _begin(start, words, add, stops, told)
        if board is not None and cell.mount == "eye-in-hand" and cell.z[2, 2] > _FACE_DOWN:
            messages().print(
                "[bold yellow]warning:[/] this --board lies face down: its z points into the "
                "paper, and a board that lies face up ends in 180 0 0"
            )
        request = Request(
            wanted,
            add or stops or wanted.stops,
            criterion,
            wish,
            candidates,
            None if workspace is None else box_of(f"workspace:{workspace}", "--workspace"),
            _start(start_joints, cell),
            seed,
        )
        plan = make_plan(cell, request, begun=begun, progress=told)
        told("write", 0, 1)
        document = plan_document(plan, {"kind": start.words})
        written = write_plan(out, plan, document)
    if as_json:
        typer.echo(json.dumps(document, indent=2, allow_nan=False))
    else:
        _tell(plan)
    tell_written(written, quiet=as_json)


def _begin(
    source: Source, words: CellWords, add: int | None, stops: int | None, told: Progress
) -> tuple[PlanCell, Begun | None]:
    """The cell, and what was recorded of it where stops are added to that."""
    if add is not None and stops is not None:
        raise DataError(
            "--add and --stops exclude each other: stops are added to what was recorded, or "
            "planned without it.",
            culprits=["--add", "--stops"],
            next_step="Leave one out.",
        )
    if add is None and (source.session is None or source.calibration is not None):
        return cell_of(source, words), None
    begun = begun_session(source, words, told)
    return begun.cell, begun if add is not None else None


def _tell(plan: Plan) -> None:
    console = messages()
    console.print(escape(f"{plan.request.purpose.name}: {summary_of(plan)}"))
    if plan.begun is not None and plan.begun.refusal:
        console.print(escape(f"  so far: {plan.begun.refusal}"))
    for stop in sorted(plan.stops, key=lambda it: it.rank)[:_SHOWN]:
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
        after = accuracy_words(plan.design.predicted)
        console.print(escape(f"that meets the wish, with {len(plan.stops)} stops: {after}"))
    if plan.request.start_q is None:
        console.print(
            "the way from where the arm stands to the first stop was not looked at; --start-joints "
            "says where that is"
        )


def _start(words: str | None, cell: PlanCell) -> FloatArray | None:
    if words is None:
        return None
    form = ",".join(f"q{it + 1}" for it in range(cell.robot.joint_count))
    return np.array(numbers_in(words, "--start-joints", form))


def _span(words: str | None, option: str) -> tuple[float, float] | None:
    if words is None:
        return None
    near, far = numbers_in(words, option, "near,far")
    return 1e-3 * near, 1e-3 * far
