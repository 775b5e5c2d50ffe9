"""`visioncal plan`."""

import math
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import tomli_w

from visioncal.cli.console import answer, print_json, report_written, say, warn
from visioncal.cli.plan_source import Kept, Source, chosen_part, find_source, pose_of, robot_of
from visioncal.cli.progress import shown_progress
from visioncal.cli.session_options import MOST_FOR_NEED, ClearanceOptions, PlanOptions
from visioncal.core.codec import wrong_value
from visioncal.core.conventions import controller_form
from visioncal.core.errors import DataError
from visioncal.core.limits import CheckLimits
from visioncal.core.number_format import listed, percent, some_of
from visioncal.core.parsing import numbers_in, refuse_given
from visioncal.core.transforms import compose
from visioncal.core.types import Camera, Need, Progress
from visioncal.estimation.problem_parts import Noise
from visioncal.interchange.formats.intrinsics import read_intrinsics, target_named
from visioncal.interchange.outputs import BOARD, write_plan, write_stops
from visioncal.interchange.result_files import content_of, load_calibration
from visioncal.planning.cell import (
    TYPICAL_NOISE,
    TYPICAL_PX,
    Box,
    Limits,
    PlanCell,
    cell_of_calibration,
)
from visioncal.planning.messages import summary_of
from visioncal.planning.pick_probability import words_of
from visioncal.planning.plan import Plan, PlanRequest, make_plan
from visioncal.planning.plan_file import plan_document
from visioncal.planning.purposes import purpose_of
from visioncal.planning.recorded import SessionStart, calibrate_partially, start_from_session
from visioncal.planning.repeated import stops_to_repeat
from visioncal.results import Calibration
from visioncal.robot import load_robot
from visioncal.robot.conversion import has_ur_axes
from visioncal.session import Session
from visioncal.session.selecting import ANY, LENS
from visioncal.vision.targets import stored_target, target_from_document

_SHOWN = 12  # Stops that are named.
_USUAL = "hand-eye"  # Purpose of a camera's stops.
# Options without which a cell is not known.
_NEEDED = ("target", "camera", "cam", "board")


def plan_command(options: PlanOptions, session: Path | None = None) -> str:
    """Runs `visioncal plan`.

    Args:
        options: The options.
        session: Where a recovery records the stops, for which new ones are better than no way.

    Returns:
        The command that records stops of a calibration.
    """
    limits = Limits(
        math.radians(options.margin_deg),
        options.distance_m,
        options.focus_m,
        math.radians(options.tilt_deg),
        options.edge_px,
        1e-3 * options.clearance_mm,
        floor_of(options),
    )
    kept = (limits, boxes_of(options))
    purpose_of(options.purpose or _USUAL, "--for")
    start, words = chosen_part(find_source(options.source), options)
    if options.standard is not None:
        return _plan_cube(options, start, limits)
    # Few plans are for instruments.
    from visioncal.cli import plan_instrument

    if plan_instrument.is_for_instrument(words, start):
        return plan_instrument.plan_instrument(words, start, kept)
    if options.to_verify:
        return _plan_to_verify(options, start, words, kept, session)
    if words.add is not None and words.stops is not None:
        raise DataError(
            "--add and --stops exclude each other: stops are added to what was recorded, or "
            "planned without it.",
            culprits=["--add", "--stops"],
            next_step="Leave one out.",
        )
    with shown_progress(quiet=options.as_json) as progress:
        begun = None
        if words.add is not None or (start.session is not None and start.calibration is None):
            begun = begun_session(start, words, kept, progress)
        cell = cell_of(start, words, kept) if begun is None else begun.cell
        # Cosine between the z axes of board and base.
        if words.board is not None and cell.mount == "eye-in-hand" and cell.z[2, 2] > 0.7:
            warn(
                "this --board lies face down: its z points into the "
                "paper, and a board that lies face up ends in 180 0 0"
            )
        # Without --add, only the cell is the recorded one.
        added_to = None if words.add is None else begun
        plan = make_plan(cell, _request(options, cell), begun=added_to, progress=progress)
        progress("write", 0, 1)
        document = plan_document(plan, {"kind": start.words})
        form = start.form or controller_form(cell.robot.name)
        written = write_plan(options.out, plan, document, form)
    if options.as_json:
        print_json(document)
    else:
        _report(plan)
        shown = "joints_deg" + (f" and pose_{form.name} ({form.words})" if form else "")
        say(f"stops.csv has metres and radians, and {shown} as a pendant shows them")
    report_written(written, quiet=options.as_json)
    return ""


def _plan_cube(options: PlanOptions, source: Source, limits: Limits) -> str:
    """Plans the cycles of ISO 9283 for an arm, and writes their table."""
    # Few plans are by the standard.
    from visioncal.planning.cube import largest_cube

    found = source.calibration
    robot = robot_of(options, source, found, "cube cannot be found")
    cube, cycles = largest_cube(robot, limits), options.stops or 30
    mount = options.mount or (found and found.mount) or "instrument"
    written = write_stops(options.out, cube.table(cycles, mount=mount), {})
    if options.as_json:
        print_json(
            {"centre_m": cube.centre_m.tolist(), "side_m": cube.side_m, "q": cube.q.tolist()}
        )
    else:
        place = ", ".join(f"{1e3 * number:.0f}" for number in cube.centre_m)
        answer(
            f"ISO 9283: a cube of {1e3 * cube.side_m:.0f} mm about ({place}) mm in the base, five "
            f"poses in {cycles} cycles; look at the way between them before you drive it"
        )
    report_written(written, quiet=options.as_json)
    return ""


def _plan_to_verify(
    options: PlanOptions, start: Source, words: PlanOptions, kept: Kept, session: Path | None
) -> str:
    """Plans to stand again at stops of a calibration; their table alone if no way is known."""
    calibration = start.calibration
    if calibration is None:
        raise DataError(
            f"--verify: {start.words} must be a calibration, whose stops are repeated.",
            culprits=["--verify"],
            next_step="Name an output folder of calibrate.",
        )
    count = options.stops or CheckLimits.stops
    spread = stops_to_repeat(calibration, start.session, count)
    fit, plan = calibration.joint_fit, None
    targets = {} if fit is None else fit.targets
    if spread.q is not None and calibration.robot and (words.target or "" in targets):
        # Not all candidates have a free way to each other.
        more = stops_to_repeat(calibration, start.session, 4 * count)
        for postures in (more.q,) if session is None else (more.q, None):
            try:
                with shown_progress(quiet=options.as_json) as progress:
                    cell = cell_of(start, words, kept)
                    request = replace(_request(options, cell), count=count)
                    plan = make_plan(cell, request, postures=postures, progress=progress)
                break
            except DataError as error:
                warn(f"the way between calibrated stops is not planned: {error.message}")
    if plan is None:
        board = words.target or "BOARD"
        boards: dict[str, str | bytes] = {}
        if known := targets.get(words.target or ""):
            content, tables = stored_target(known, Path(BOARD).stem)
            boards = {BOARD: tomli_w.dumps(content), **tables}
            board = quote(str(options.out / BOARD))
        record = f"--arm manual --target {board}"
        if board == "BOARD":
            say("In the command, BOARD stands for the target's name, or the path of its .toml.")
        document: dict[str, Any] = {"views": spread.views, "poses": spread.poses.tolist()}
        written = write_stops(options.out, spread.table(start.form), boards)
    else:
        arm = "ur:HOST" if has_ur_axes(plan.cell.robot) else "manual"
        record = f"--arm {arm} --plan {options.out}"
        document = plan_document(plan, {"kind": start.words})
        written = write_plan(options.out, plan, document, start.form)
    record = f"visioncal record {record} --camera uvc:0 -o {quote(str(session or 'monday'))}"
    if options.as_json:
        print_json(document)
    elif session is None:
        of_views = "" if plan else f", of views {listed([*map(str, spread.views)])}"
        answer(f"{count} stops at postures of {calibration.session_name}{of_views}:")
        answer(f"  {record}")
        answer(f"  visioncal verify monday --against {options.source}")
    report_written(written, quiet=options.as_json)
    return record


def _request(stops: PlanOptions, cell: PlanCell) -> PlanRequest:
    """The request for the planner."""
    purpose = purpose_of(stops.purpose or _USUAL, "--for")
    form = ",".join(f"q{index + 1}" for index in range(cell.robot.joint_count))
    start = stops.start_joints and numbers_in(stops.start_joints, "--start-joints", form)
    has_no_need = stops.need_mm is None and stops.need_deg is None
    return PlanRequest(
        purpose,
        stops.add or stops.stops or (purpose.stops if has_no_need else MOST_FOR_NEED),
        stops.candidates,
        np.array(start) if start else None,
        stops.seed,
        None if has_no_need else Need(stops.need_mm, stops.need_deg),
        stops.criterion or "I",
    )


def boxes_of(kept: ClearanceOptions) -> tuple[Box, ...]:
    """Obstacles of NAME:x,y,z:sx,sy,sz, centre in the base and lengths [mm]; raises DataError."""
    boxes = []
    for words in kept.boxes or ():
        parts = words.split(":")
        if len(parts) != 3 or not parts[0].strip():
            needed = "NAME:X,Y,Z:SX,SY,SZ, with the centre in the base and the lengths in mm"
            step = "Such as --box name:500,0,300:400,400,400"
            raise wrong_value(words, needed, "--box", step)
        centre_m = 1e-3 * np.array(numbers_in(parts[1], "--box", "x,y,z"))
        size_m = 1e-3 * np.array(numbers_in(parts[2], "--box", "sx,sy,sz"))
        boxes.append(Box(parts[0].strip(), compose(np.eye(3), centre_m), size_m))
    return tuple(boxes)


def floor_of(kept: ClearanceOptions) -> float | None:
    """Height of the floor in the base [m]; None for no floor; raises DataError."""
    if kept.floor.strip().lower() == "none":
        return None
    return 1e-3 * numbers_in(kept.floor, "--floor", "z")[0]


def _report(plan: Plan) -> None:
    answer(f"{plan.request.purpose.name}: {summary_of(plan)}")
    if plan.start is not None and plan.start.refusal:
        answer(f"  so far: {plan.start.refusal}")
    for stop in sorted(plan.stops, key=lambda value: value.rank)[:_SHOWN]:
        answer(f"  view {stop.view}: {stop.words}")
    if len(plan.stops) > _SHOWN:
        answer(f"  and {len(plan.stops) - _SHOWN} more, in plan.json and in the preview")
    if plan.in_the_way:
        count, obstacles = len(plan.in_the_way), some_of(list(dict.fromkeys(plan.in_the_way)))
        stops = "1 stop was" if count == 1 else f"{count} stops were"
        answer(f"{stops} exchanged for want of a safe way ({obstacles})")
    if plan.need is not None and plan.need.limits:
        answer(plan.need.limits, "warning: ", "bold yellow")
    if plan.need is not None and plan.need.met:
        met = f"{percent(plan.need.probability)} of picks land within {words_of(plan.need.need)}"
        answer(f"that meets the need, with {len(plan.stops)} stops: {met}")
        if plan.need.condition:
            answer(plan.need.condition)
    if plan.request.start_q is None:
        answer(
            "the way from where the arm stands to the first stop was not checked; --start-joints "
            "states that place"
        )


def begun_session(
    source: Source, words: PlanOptions, kept: Kept, progress: Progress
) -> SessionStart:
    """The session to which stops are added; raises DataError."""
    session = source.session
    if session is None:
        raise DataError(
            f"--add: {source.words} holds no recorded session to which stops could be added.",
            culprits=["--add"],
            next_step="Name the session, or ask for a plan of its own with --stops.",
        )
    refuse_given(
        words.options("target", "camera", "resolution", "mount", "cam", "board"),
        "the session has its own",
    )
    if words.robot is not None:
        document = {
            **session.document,
            "robot": {**session.document.get("robot", {}), "model": words.robot},
        }
        model = load_robot(words.robot).document
        session = session.with_content(document=document, robot_document=model)
    run, refusal = calibrate_partially(session, progress=progress)
    begun = start_from_session(run, refusal, limits=kept[0], boxes=kept[1])
    return replace(begun, cell=_with_noise(begun.cell, words))


def cell_of(source: Source, words: PlanOptions, kept: Kept) -> PlanCell:
    """The cell of a new plan, from a calibration or from options; raises DataError."""
    if source.calibration is not None:
        refuse_given(words.options("camera", "resolution", "mount"), "the calibration has its own")
        return _with_noise(_calibrated(source.calibration, source.session, words, kept), words)
    missing = [f"--{name}" for name in _NEEDED if getattr(words, name) is None]
    if "," in (words.camera or "") and words.resolution is None:
        missing.append("--resolution")
    if missing or source.robot is None:
        raise DataError(
            f"{source.words}: {some_of(missing)} {'is' if len(missing) == 1 else 'are'} needed to "
            "know the cell.",
            culprits=missing,
            next_step="Give them, as visioncal plan --example does, or plan from a session or a "
            "calibration of the cell.",
        )
    refuse_given(words.options("robot"), f"{source.words} is named already")
    cell = PlanCell(
        words.mount or "eye-in-hand",
        source.robot,
        _camera(str(words.camera), words.resolution),
        target_named(str(words.target)),
        pose_of(str(words.cam), "--cam"),
        pose_of(str(words.board), "--board"),
        math.radians(words.guess_deg),
        1e-3 * words.guess_mm,
        TYPICAL_NOISE,
        TYPICAL_PX,
        *kept,
    )
    return _with_noise(cell, words)


def _calibrated(
    calibration: Calibration, session: Session | None, words: PlanOptions, kept: Kept
) -> PlanCell:
    if words.target is not None:
        target = target_named(words.target)
    elif session is not None and session.target is not None:
        target = session.target
    elif calibration.joint_fit is not None and "" in calibration.joint_fit.targets:
        target = target_from_document(calibration.joint_fit.targets[""], "target")
    else:
        raise DataError(
            f"calibration {calibration.session_name!r} does not say which board it was made with, "
            "and its recording is missing.",
            culprits=["--target"],
            next_step="Name the board with --target.",
        )
    robot = None if words.robot is None else load_robot(words.robot)
    cell = cell_of_calibration(calibration, target, *kept, robot=robot)
    if words.cam is not None:
        cell = replace(cell, x=pose_of(words.cam, "--cam"))
    if words.board is not None:
        cell = replace(cell, z=pose_of(words.board, "--board"))
    if words.cam is None and words.board is None:
        return cell
    return replace(
        cell, sigma_m=1e-3 * words.guess_mm, sigma_rad=float(np.deg2rad(words.guess_deg))
    )


def _with_noise(cell: PlanCell, words: PlanOptions) -> PlanCell:
    sigma_rad, sigma_m = cell.noise.robots[0].tolist()
    sigma_m = sigma_m if words.noise_mm is None else 1e-3 * words.noise_mm
    sigma_rad = sigma_rad if words.noise_deg is None else float(np.deg2rad(words.noise_deg))
    pixel_px = cell.pixel_px if words.noise_px is None else words.noise_px
    return replace(cell, noise=Noise.of_robot(sigma_rad, sigma_m), pixel_px=pixel_px)


def _camera(words: str, resolution: tuple[int, int] | None) -> Camera:
    path, lens = Path(words), dict[str, Any]()
    if "," in words and not path.exists():
        lens = {"model": "brown", "matrix": numbers_in(words, "--camera", "fx,fy,cx,cy")}
    elif path.is_dir() or path.suffix.lower() == ".rrd" or "transforms" in content_of(path):
        calibrated = load_calibration(path, ANY, LENS).camera
        if calibrated is None:
            raise DataError(
                f"--camera: {words} was made from measured poses and knows no camera.",
                culprits=["--camera"],
            )
        return calibrated.camera
    else:
        lens, _ = read_intrinsics(path)
    size = lens.get("resolution", resolution)
    if size is None:
        raise DataError(
            "This --camera needs --resolution: width and height of the images [px].",
            culprits=["--resolution"],
        )
    distortion = np.array(lens.get("distortion") or np.zeros(5), dtype=float)
    return Camera(lens["model"], (int(size[0]), int(size[1])), np.array(lens["matrix"]), distortion)
