"""Placing of frames by `tcp` and `fixture`: options, touches or images, destination, report."""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from visioncal.cli.console import answer, exit_status, print_json, report_written, say
from visioncal.cli.convert import import_options
from visioncal.cli.frame_options import FixtureOptions, FrameOptions, TcpOptions
from visioncal.cli.history import enter
from visioncal.cli.progress import shown_progress
from visioncal.cli.summary import print_verdict
from visioncal.core.conventions import POSE_FORMS
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure, listed, mm_and_deg
from visioncal.core.parsing import refuse_given
from visioncal.core.transforms import pose_difference
from visioncal.frames.fixture import touched_fixture
from visioncal.frames.frame_from_images import seen_frame
from visioncal.frames.naming import FrameKind, transform_name
from visioncal.frames.tcp import touched_tool
from visioncal.frames.touches import NO_TOOL, Tool, TouchRows
from visioncal.interchange.formats.touches import (
    is_session,
    read_nominal,
    read_point_pairs,
    read_touches,
    robots_of,
)
from visioncal.interchange.outputs import RECORDING, Written
from visioncal.interchange.result_files import load_result, load_result_or_frames, rewrite_result
from visioncal.results import Calibration, Frame, FrameFile
from visioncal.results.frame import frames_document
from visioncal.results.history import entry_of_frame
from visioncal.results.selecting import transform_name_in_cell
from visioncal.robot import Robot, load_robot
from visioncal.session import Session
from visioncal.session.selecting import ARM, EYE, Choice, Part, has_several, select


@dataclass(frozen=True)
class _Place:
    """Destination of a frame."""

    name: str
    # The result of the camera and robot in question; None where none is named.
    calibration: Calibration | None
    result: Calibration | None  # The result from which it was extracted, of a cell or itself.
    folder: Path | None  # The output folder that the frame joins; None where it does not.
    file: Path | None  # The file of frames that it joins; None where it does not.
    frames: Mapping[str, Frame]  # Those that are there.


def _place(
    options: FrameOptions,
    kind: FrameKind,
    choice: Choice,
    needs: Sequence[Part],
    touched_by: str | None = None,
) -> _Place:
    """Resolves the calibration and the frame's destination, before anything is computed."""
    name, path, file = transform_name(kind, options.name), options.calibration, options.out
    result = calibration = folder = None
    frames: Mapping[str, Frame] = {}
    if path is not None:
        result = load_result(path)
        if result.cell and choice.robot is None and touched_by in result.cell.robots:
            choice = replace(choice, robot=touched_by)
        calibration = result.chosen(choice, needs)
        name, frames = transform_name_in_cell(result, choice, needs, name), result.frames
    if file is not None:
        frames = FrameFile.load(file).frames if file.exists() else {}
    elif path is not None:
        folder = path if path.is_dir() else path.parent
        if path.suffix.lower() == ".rrd" or not (folder / "calibration.json").is_file():
            raise DataError(
                f"{path} must be an output folder, which the frame joins.",
                culprits=[str(path)],
                next_step="Name the folder that calibrate wrote, or a file for the frame with -o.",
            )
    child, another = name.partition("_from_")[2], "give this one another name with --name."
    for other in frames:
        if other != name and other.partition("_from_")[2] == child:
            raise DataError(
                f"{child!r} is taken: {other} already exists.",
                culprits=[other],
                next_step=another.capitalize(),
            )
    if name in frames and (file or folder) and not options.force:
        raise DataError(
            f"{file or folder} already has {name}, and nothing is overwritten.",
            culprits=[name],
            next_step=f"Replace it with --force, or {another}",
        )
    return _Place(name, calibration, result, folder, file, frames)


def _keep_and_report(place: _Place, frame: Frame, source: Path, options: FrameOptions) -> None:
    """Writes a frame to its destination, and prints it for people, or as JSON."""
    # The suggested command runs again, and has a frame to replace then.
    again = [*sys.argv, *([] if "--force" in sys.argv else ["--force"])]
    destination = place.file or place.folder
    verdict = frame.verdict.with_paths(source, destination or "", ["visioncal", *again[1:]])
    frame, written = replace(frame, verdict=verdict), Written(())
    frames = {**place.frames, place.name: frame}
    # A bad one joins no result.
    if place.file is not None:
        FrameFile(frames).save(place.file)
        written = Written((place.file,))
    elif place.folder is not None and place.result is not None and verdict.status != "bad":
        written = rewrite_result(place.folder, replace(place.result, frames=frames))
    if destination is not None:
        # A bad one is in no folder from which it could be added later.
        kept = destination if written.files else ""
        enter(options, source, [entry_of_frame(place.name, frame, place.result)], kept)
    if options.as_json:
        print_json(frames_document({place.name: frame}))
        report_written(written, quiet=True, status=exit_status(verdict))
        return
    print_verdict(verdict, place.name)
    edge, form = frame.edge, POSE_FORMS.get(options.robot_form or "")
    form = place.calibration.controller() if form is None and place.calibration else form
    rotation = edge.rotation_words(form)
    rotation += f", sigma {figure(edge.sigma_deg)} deg" if frame.oriented else ""
    answer(f"{place.name}: {edge.place_words(3)}, sigma {figure(edge.sigma_mm)} mm; {rotation}")
    noise = f"noise {figure(frame.noise_mm)} mm per axis"
    is_explained = frame.noise_mm < 0.01 * frame.rms_mm
    fit = f"rms {figure(frame.rms_mm)} mm, {'as the arm repeats' if is_explained else noise}"
    answer(f"{frame.method}: {fit}")
    before = None if place.result is None else place.result.frames.get(place.name)
    if written.files and before is not None:
        mm, deg = pose_difference(before.edge.matrix, edge.matrix)
        say(f"it replaces the one of {before.created}, {mm_and_deg(mm, deg)} away")
    undrawn = [undrawn.file for undrawn in written.failed_drawings]
    recording = None if place.folder is None else place.folder / RECORDING
    if destination is None:
        say("nothing was written: -c joins it to a calibration, -o puts it into a file")
    elif not written.files:
        say(f"nothing was written: a bad {place.name} does not join {place.folder}")
    elif recording is not None and recording not in (*written.files, *undrawn):
        say(f"{recording} was not renewed: it is missing or of another result")
    report_written(written, status=exit_status(verdict))


def place_frame(
    kind: FrameKind,
    request: FrameOptions,
    by_touches: Callable[[Path, Calibration | None], Frame],
    cad: Path | None = None,
    tool: str | None = None,
) -> None:
    """Places a tool or a fixture by touches or by a session's images, and keeps and reports it.

    Args:
        kind: Whether it is a tool or a fixture.
        request: The options.
        by_touches: Places it by the touches of a file, given the calibration if there is one.
        cad: Table of a drawing's points; None where none is given.
        tool: The tool that touched a fixture, as typed.

    Raises:
        DataError: The source cannot be read or does not show what is needed, or options contradict
            each other.
    """
    source = request.touches
    if request.remove:
        refuse_given({"TOUCHES": source}, "--remove places nothing")
        _remove(request, kind)
        return
    if source is None:
        command = "tcp" if kind == "tool" else "fixture"
        raise DataError(
            f"{command} needs touches of it, or a session that shows it.",
            culprits=["TOUCHES"],
            next_step=f"Name them: visioncal {command} TOUCHES -c OUT"
            f"{' --cad DRAWING --tool NAME' * (kind != 'tool')}; visioncal {command} --example "
            "prints touches that work.",
        )
    _check_paths(request, cad, kind == "fixture" and tool is None)
    # A file or folder that is both has points of a robot and of a camera.
    are_pairs = cad == source
    session = (
        None
        if are_pairs
        else _image_session(source, {"--cad": cad, "--tool": tool, **request.for_touches()})
    )
    if session is None:
        origin = "the tool's point" if kind == "tool" else "the fixture's origin"
        refuse_given({"--point-mm": request.point}, f"touches say where {origin} is")
        unneeded = {"--camera": request.camera, "--target": request.target}
        refuse_given(unneeded, "touches need no camera")
        robots = () if are_pairs else robots_of(source)
        if request.calibration is None and not robots and tool in (None, "none"):
            named = {"--robot": request.robot}
            refuse_given(named, "neither touches nor a calibration name robots")
        touched_by = robots[0] if len(robots) == 1 else None
        place = _place(request, kind, Choice(robot=request.robot), ARM, touched_by)
        frame = by_touches(source, place.calibration)
    else:
        place = _place(request, kind, replace(request, target=None), EYE)
        if place.calibration is None:
            raise DataError(
                f"session {session.name!r} has images, and the camera's calibration (-c) is needed "
                "to place what they show.",
                culprits=["-c"],
                next_step="Name the output folder of visioncal calibrate.",
            )
        if has_several(session):
            session = select(session, request, robot_between=False)
        point_m = np.array(request.point or np.zeros(3))
        with shown_progress(quiet=request.as_json) as progress:
            frame = seen_frame(session, place.calibration, kind, point_m, progress=progress)
    _keep_and_report(place, frame, source, request)


def _remove(request: FrameOptions, kind: FrameKind) -> None:
    """Takes a tool or a fixture out of its calibration or file; raises DataError."""
    place = _place(replace(request, force=True), kind, Choice(robot=request.robot), ARM)
    destination = place.file or place.folder
    left = {name: frame for name, frame in place.frames.items() if name != place.name}
    if destination is None or len(left) == len(place.frames):
        kept = f"It has {listed([*left])}." if left else "Name where it is with -c or -o."
        raise DataError(
            f"{destination or 'Nothing that was named'} has no {place.name}.",
            culprits=[place.name],
            next_step=f"{kept} --name is the part after _from_.",
        )
    if place.file is not None:
        FrameFile(left).save(place.file)
    elif place.folder is not None and place.result is not None:
        report_written(rewrite_result(place.folder, replace(place.result, frames=left)), quiet=True)
    answer(f"{place.name} is no longer in {destination}")


def _check_paths(request: FrameOptions, cad: Path | None, needs_tool: bool) -> None:
    """Names all files that do not exist; raises DataError if there is one."""
    paths = (request.touches, cad, request.calibration)
    absent = [str(path) for path in paths if path is not None and not path.exists()]
    if not absent:
        return
    words, found = f"{listed(absent)} {'does' if len(absent) == 1 else 'do'} not exist", ""
    if needs_tool and request.calibration is not None and str(request.calibration) not in absent:
        frames = load_result_or_frames(request.calibration).frames
        if not any(name.startswith("flange_from_") for name in frames):
            words, found = f"{words}, and {request.calibration} has no tool", f" {NO_TOOL}"
    command = "fixture" if needs_tool or cad else "tcp"
    raise DataError(
        f"{words}.",
        culprits=absent,
        next_step=f"Check the paths and their spelling; visioncal {command} --example prints "
        f"touches that work.{found}",
    )


def _image_session(source: Path, for_touches: Mapping[str, object]) -> Session | None:
    """Loads a session whose images are to place something; None where it has none."""
    if not is_session(source):
        return None
    session = Session.load(source)
    shown = [view.number for view in session.views if view.image or view.has_corners]
    if not shown:
        return None
    touched = [view.number for view in session.views if view.text.keys() & {"kind", "point"}]
    if touched:
        raise DataError(
            f"session {session.name!r} has images (view {shown[0]}) and touches (kind or point in "
            f"view {touched[0]}): a frame is placed by one of them.",
            culprits=[f"view {index}" for index in touched],
            next_step="Put the touches into a table or a session of their own, without images.",
        )
    refuse_given(for_touches, f"session {session.name!r} has images, and this is for touches")
    return session


def tcp_command(options: TcpOptions) -> None:
    """Runs `visioncal tcp`."""

    def by_touches(source: Path, calibration: Calibration | None) -> Frame:
        rows = read_touches(source, import_options(options, calibration), options.robot)
        _say_notes(rows)
        model, noise_m = _model(options), options.noise_m
        return touched_tool(rows, calibration, model, touch_noise_m=noise_m)

    place_frame("tool", options, by_touches)


def fixture_command(options: FixtureOptions) -> None:
    """Runs `visioncal fixture`."""

    def by_touches(source: Path, calibration: Calibration | None) -> Frame:
        model, noise_m = _model(options), options.noise_m
        if options.cad == source and (pairs := read_point_pairs(source)) is not None:
            rows, seen = pairs
            return touched_fixture(rows, None, seen, calibration, model, touch_noise_m=noise_m)
        drawing = None if options.cad is None else read_nominal(options.cad, options.cad_unit)
        robot, reading_options = options.robot, import_options(options, calibration)
        if options.tool is None and calibration is None:
            named = drawing or any(
                read_touches(source, reading_options, robot, positions=True).kinds
            )
            others = "" if named else ", nor which points they are: by --cad, or a column kind"
            raise DataError(
                f"The tool that touched the points is not stated{others}.", next_step=NO_TOOL
            )
        tool = _tool(options.tool, calibration, robot)
        rows = read_touches(source, reading_options, robot, positions=tool is None)
        _say_notes(rows)
        return touched_fixture(rows, tool, drawing, calibration, model, touch_noise_m=noise_m)

    place_frame("fixture", options, by_touches, options.cad, options.tool)


def _say_notes(rows: TouchRows) -> None:
    for note in rows.notes:
        say(f"note: {note}")


def _model(options: FrameOptions) -> Robot | None:
    return None if options.robot_model is None else load_robot(options.robot_model)


def _tool(option: str | None, calibration: Calibration | None, robot: str | None) -> Tool | None:
    """Finds the tool that touched the points."""
    if option == "none":
        return None
    frames = {} if calibration is None else calibration.frames
    if option is None or option in frames or f"flange_from_{option}" in frames:
        return Tool.among(frames, "The calibration", option)
    path, _, name = option.rpartition(":")
    if Path(option).exists():
        return Tool.among(load_result_or_frames(Path(option), robot).frames, option, None)
    if path and Path(path).exists():
        return Tool.among(load_result_or_frames(Path(path), robot).frames, path, name)
    if frames:
        return Tool.among(frames, "The calibration", option)
    raise DataError(
        f"--tool {option} must be a file of frames, or a tool of the calibration (-c).",
        culprits=[option],
        next_step=NO_TOOL,
    )
