"""Output folders of `calibrate`, `verify`, `plan` and `dynamics`."""

import shlex
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from visioncal.core.choices import DYNAMICS_FILE
from visioncal.core.errors import DataError
from visioncal.core.files import check_own, json_text, write_atomically
from visioncal.core.generations import write_generation

# Imported late, so that writing one kind of result does not import all the others.
if TYPE_CHECKING:
    from visioncal.calibration.run import Run as Calibrated
    from visioncal.core.choices import ImagesKept, PoseForm
    from visioncal.core.verdict import Verdict
    from visioncal.dynamics.plan_files import MotionPlan
    from visioncal.dynamics.run import Run
    from visioncal.planning.plan import Plan
    from visioncal.session import Session
    from visioncal.verification import Check, Trigger
    from visioncal.verification.iso9283 import Performance

CALIBRATION, REPORT, RECORDING = "calibration.json", "report.html", "recording.rrd"
VERIFY, PERFORMANCE = "verify.json", "iso9283.json"
STOPS, PLAN, PROGRAM, PREVIEW = "stops.csv", "plan.json", "plan.script", "plan.rrd"
BOARD = "board.toml"
# Files of these endings name visioncal.
_SIGNED = (".html", ".rrd", CALIBRATION, PLAN)

_Writer: TypeAlias = Callable[[Path], None]


def review_command(recording: Path) -> str:
    """The command that opens a recording, named by its folder."""
    named = recording.parent if recording.name == RECORDING else recording
    return f"visioncal show {shlex.quote(str(named))} --viewer"


@dataclass(frozen=True)
class FailedDrawing:
    """A file whose drawing failed: a bug, which does not invalidate the result."""

    file: Path  # The file; one of an earlier result was removed.
    cause: str  # The error and its place in the code.


@dataclass(frozen=True)
class Written:
    """Files written into a folder."""

    files: tuple[Path, ...]  # The files, the result first.
    failed_drawings: tuple[FailedDrawing, ...] = ()


def write_outputs(
    folder: Path,
    session: "Session | None",
    run: "Calibrated",
    note: str = "",
    *,
    without: Collection[str] = (),
    images: "ImagesKept" = "thumbnail",
) -> Written:
    """Writes the files of a result into a folder, atomically even if it is killed.

    Several threads may call it at once; their figures are drawn one at a time.

    Args:
        folder: The folder; created where there is none.
        session: The calibrated session; None where it was not kept, which leaves the recording out.
        run: The result and its evidence.
        note: A note on the report itself.
        without: Files to leave out, `REPORT` or `RECORDING`; those of an earlier result are
            removed.
        images: How the recording keeps the images, besides their digests and what was found in
            them; whole where the run does not say that.

    Returns:
        The files that were written: the result even where drawing the report or recording failed.

    Raises:
        DataError: The folder cannot be written; the files in it are unchanged.
    """

    def report(path: Path) -> None:
        # Plots and the recording's codec take half a second to import, which --help need not wait
        # for.
        from visioncal.present.report.page import write_report

        kept = session is not None and RECORDING not in without
        review = review_command(folder / RECORDING) if kept else ""
        write_report(path, run.calibration, session, run.evidence, note, review)

    drawings: dict[str, _Writer] = {REPORT: report}
    if session is not None:

        def record(path: Path) -> None:
            from visioncal.present.recording import write_recording
            from visioncal.present.viewer import blueprint

            layout = blueprint(session, run.calibration)
            write_recording(
                path, session, run.calibration, run.evidence, layout, images, run.searches
            )

        drawings[RECORDING] = record
    results: dict[str, _Writer] = {CALIBRATION: run.calibration.save}
    return _write(folder, results, drawings, without=without)


def write_check(
    folder: Path, check: "Check", triggers: "Sequence[Trigger]", verdict: "Verdict", document: str
) -> Written:
    """Writes a check's page, recording and JSON into a folder; see `write_outputs`."""

    def page(path: Path) -> None:
        from visioncal.present.report.check import render_check

        write_atomically(path, render_check(check, triggers, verdict))

    def record(path: Path) -> None:
        from visioncal.present.recording.timeline import record_check

        record_check(path, check, verdict)

    return _write(folder, {VERIFY: _text(document)}, {REPORT: page, RECORDING: record})


def write_performance(folder: Path, tested: "Performance", name: str, against: str) -> Written:
    """Writes an arm's performance by ISO 9283, and its page; see `write_outputs`."""
    document = tested.document()

    def page(path: Path) -> None:
        from visioncal.present.report.performance import render_performance

        write_atomically(path, render_performance(name, against, document, tested.sentences()))

    text = {PERFORMANCE: _text(json_text(document))}
    return _write(folder, text, {Path(PERFORMANCE).with_suffix(".html").name: page})


def refuse_calibration(folder: Path) -> None:
    """Refuses a folder whose report is a calibration's; raises DataError."""
    if (folder / CALIBRATION).exists():
        raise DataError(
            f"{folder} holds a calibration, whose {REPORT} the check's would replace.",
            culprits=[str(folder)],
            next_step="Name another folder with -o.",
        )


def write_plan(
    folder: Path, plan: "Plan", document: Mapping[str, Any], form: "PoseForm | None" = None
) -> Written:
    """Writes a plan's table, program, preview and JSON into a folder; see `write_outputs`.

    The table has poses in the robot's `form`, too. Robots that are not programmed like a UR get no
    program, and that of an earlier plan is removed.
    """

    def draw(path: Path) -> None:
        from visioncal.planning.preview import preview_of
        from visioncal.present.recording.preview import write_preview
        from visioncal.present.viewer.layout import plan_blueprint

        preview = preview_of(plan, f"plan for {plan.cell.robot.name}, {plan.cell.target.name}")
        write_preview(path, preview, plan_blueprint(preview))

    from visioncal.planning.plan_file import program_of, stops_table

    texts = {PLAN: json_text(document), STOPS: stops_table(plan, form)}
    if program := program_of(plan):
        texts[PROGRAM] = program
    results = {name: _text(text) for name, text in texts.items()}
    return _write(folder, results, {PREVIEW: draw}, (PROGRAM,))


def write_stops(folder: Path, table: str, others: Mapping[str, str | bytes]) -> Written:
    """Writes a plan without a preview: its table, and its board or other files; see `write_plan`.

    Those of an earlier plan that this one lacks are removed.
    """
    texts = {STOPS: table, **others}
    results = {name: _text(text) for name, text in texts.items()}
    return _write(folder, results, {}, (PLAN, PROGRAM, PREVIEW, BOARD))


def write_motions(
    folder: Path, plan: "MotionPlan", rate_hz: float, document: Mapping[str, Any]
) -> Written:
    """Writes planned motions as tables, preview and JSON; see `write_outputs`.

    Files of an earlier plan that this one lacks are removed.
    """

    def draw(path: Path) -> None:
        from visioncal.planning.preview import motion_preview
        from visioncal.present.recording.preview import write_motion_preview
        from visioncal.present.viewer.layout import motion_blueprint

        preview = motion_preview(plan)
        write_motion_preview(path, preview, motion_blueprint(preview))

    from visioncal.dynamics.plan_files import MOTION_FILES, motion_files

    texts = {PLAN: json_text(document), **motion_files(plan, rate_hz)}
    results = {name: _text(text) for name, text in texts.items()}
    return _write(folder, results, {PREVIEW: draw}, MOTION_FILES)


def write_dynamics(folder: Path, run: "Run") -> Written:
    """Writes identified dynamics and their report; see `write_outputs`."""

    def report(path: Path) -> None:
        from visioncal.present.report.dynamics import render_dynamics

        write_atomically(path, render_dynamics(run))

    return _write(folder, {DYNAMICS_FILE: run.identified.save}, {REPORT: report}, (RECORDING,))


def check_replaceable(folder: Path, names: Collection[str]) -> None:
    """Checks that what is written to a folder replaces no file of others; raises DataError."""
    for name in names:
        if name.endswith(_SIGNED):
            check_own(folder / name)


def _write(
    folder: Path,
    results: Mapping[str, _Writer],
    drawings: Mapping[str, _Writer],
    others: Sequence[str] = (),
    without: Collection[str] = (),
) -> Written:
    """Writes results and drawings as one generation; a drawing that fails is left out."""
    drawings = {name: draw for name, draw in drawings.items() if name not in without}
    undrawn: list[FailedDrawing] = []

    def write(staging: Path) -> None:
        for name, save in results.items():
            save(staging / name)
        for name, draw in drawings.items():
            try:
                draw(staging / name)
            except Exception as error:
                # A full disk is no bug, and is reported like a result that cannot be written.
                if isinstance(error, OSError) or isinstance(error.__cause__, OSError):
                    raise
                place = traceback.extract_tb(error.__traceback__)[-1]
                where = f"{Path(place.filename).name}:{place.lineno}"
                cause = f"{type(error).__name__} at {where}: {error}"
                undrawn.append(FailedDrawing(folder / name, cause))

    # The result last: the other files belong to it.
    written = [*results, *drawings]
    names = [*(other for other in (*others, *without) if other not in written), *reversed(written)]
    check_replaceable(folder, names)
    return Written(write_generation(folder, names, write), tuple(undrawn))


def _text(content: str | bytes) -> _Writer:
    return lambda path: write_atomically(path, content)
