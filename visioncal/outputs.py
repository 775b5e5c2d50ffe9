"""What `calibrate`, `align`, `verify`, `plan` and `dynamics` write into a folder."""

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from visioncal.calibration import Alignment
from visioncal.dynamics import FILE as DYNAMICS
from visioncal.dynamics import Run
from visioncal.dynamics.planned import MotionPlan
from visioncal.dynamics.written import MOTION_FILES, motion_files
from visioncal.errors import DataError
from visioncal.files import named_errors, write_atomically
from visioncal.pipeline import Run as Calibrated
from visioncal.planning.plan import Plan
from visioncal.planning.written import program_of, stops_table
from visioncal.session import Session
from visioncal.verification import Check, Outcome

CALIBRATION, REPORT, RECORDING = "calibration.json", "report.html", "recording.rrd"
VERIFY = "verify.json"
ALIGNMENT = "alignment.json"
STOPS, PLAN, PROGRAM, PREVIEW = "stops.csv", "plan.json", "plan.script", "plan.rrd"


def write_outputs(
    folder: Path, session: Session | None, run: Calibrated, note: str = ""
) -> tuple[Path, ...]:
    """Writes the three files into a folder.

    They are made aside first: where one of them fails, none appears, and files that an earlier
    calibration left there stay as they were.

    Args:
        folder: Where to; it is made where there is none.
        session: What was calibrated; None where it was not kept, which leaves the recording out.
        run: The result and its evidence.
        note: What the reader should know of the report itself.

    Returns:
        The files that were written.

    Raises:
        DataError: The folder cannot be written.
    """
    # Plots and the recording's codec take half a second to import, which help need not wait for.
    from visioncal.recording import write_recording
    from visioncal.report import write_report
    from visioncal.viewer import blueprint

    def write(aside: Path) -> None:
        run.calibration.save(aside / CALIBRATION)
        write_report(aside / REPORT, run.calibration, session, run.evidence, note)
        if session is not None:
            layout = blueprint(session, run.calibration)
            write_recording(aside / RECORDING, session, run.calibration, run.evidence, layout)

    # The result last: it is what the others are beside.
    files = (*([] if session is None else [RECORDING]), REPORT, CALIBRATION)
    return _write_together(folder, files, write)


def write_check(folder: Path, check: Check, triggers: Sequence[Outcome], document: str) -> None:
    """Writes a check's page and JSON into a folder, together or not at all.

    Args:
        folder: Where to; it is made where there is none.
        check: The check.
        triggers: What became of the policy's triggers.
        document: The content of verify.json.

    Raises:
        DataError: The folder cannot be written.
    """
    from visioncal.report.check import write_check as write_page
    from visioncal.verification.page import page_of

    def write(aside: Path) -> None:
        write_page(aside / REPORT, page_of(check, triggers))
        write_atomically(aside / VERIFY, document)

    _write_together(folder, (REPORT, VERIFY), write)


def refuse_calibration(folder: Path) -> None:
    """Refuses a folder whose report is a calibration's.

    Raises:
        DataError: It is one.
    """
    if (folder / CALIBRATION).exists():
        raise DataError(
            f"{folder} holds a calibration, whose {REPORT} the check's would replace.",
            culprits=[str(folder)],
            next_step="Name another folder with -o.",
        )


def write_alignment(folder: Path, session: Session, found: Alignment) -> tuple[Path, ...]:
    """Writes the alignment of a cell, its report and its recording into a folder, or none of them.

    Args:
        folder: Where to; it is made where there is none.
        session: What was aligned.
        found: The result.

    Returns:
        The files that were written.

    Raises:
        DataError: The folder cannot be written.
    """
    from visioncal.recording import write_cell_recording
    from visioncal.report.cells import write_cell_report
    from visioncal.viewer.cells import cell_blueprint

    def write(aside: Path) -> None:
        found.save(aside / ALIGNMENT)
        write_cell_report(aside / REPORT, found)
        layout = cell_blueprint(session, found)
        write_cell_recording(aside / RECORDING, session, found, layout)

    return _write_together(folder, (RECORDING, REPORT, ALIGNMENT), write)


def write_plan(folder: Path, plan: Plan, document: Mapping[str, Any]) -> tuple[Path, ...]:
    """Writes a plan's table, program, preview and JSON into a folder, together or not at all.

    Args:
        folder: Where to; it is made where there is none.
        plan: The plan.
        document: The content of plan.json.

    Returns:
        The files that were written. Robots that are not programmed like a UR get no program, and
        one that an earlier plan left is taken away.

    Raises:
        DataError: The folder cannot be written.
    """
    from visioncal.planning.preview import preview_of
    from visioncal.recording.preview import write_preview
    from visioncal.viewer.planned import plan_blueprint

    program = program_of(plan)
    preview = preview_of(plan, f"plan for {plan.cell.robot.name}, {plan.cell.target.name}")

    def write(aside: Path) -> None:
        write_preview(aside / PREVIEW, preview, plan_blueprint(preview))
        write_atomically(aside / STOPS, stops_table(plan))
        if program:
            write_atomically(aside / PROGRAM, program)
        text = json.dumps(document, indent=2, allow_nan=False)
        write_atomically(aside / PLAN, f"{text}\n")

    files = (PREVIEW, *([PROGRAM] if program else []), STOPS, PLAN)
    written = _write_together(folder, files, write)
    if not program:
        with named_errors(folder / PROGRAM):
            (folder / PROGRAM).unlink(missing_ok=True)
    return written


def write_motions(
    folder: Path, plan: MotionPlan, rate_hz: float, document: Mapping[str, Any]
) -> tuple[Path, ...]:
    """Writes planned motions as tables, programs, preview and JSON, together or not at all.

    Args:
        folder: Where to; it is made where there is none.
        plan: The motions.
        rate_hz: Samples a second in the tables.
        document: The content of plan.json.

    Returns:
        The files that were written. Robots that are not programmed like a UR get no programs; what
        an earlier plan left and this one has not is taken away.

    Raises:
        DataError: The folder cannot be written.
    """
    from visioncal.planning.motion_preview import motion_preview
    from visioncal.recording.motions import write_motion_preview
    from visioncal.viewer.motions import motion_blueprint

    texts = motion_files(plan, rate_hz)
    preview = motion_preview(plan)

    def write(aside: Path) -> None:
        write_motion_preview(aside / PREVIEW, preview, motion_blueprint(preview))
        for name, text in texts.items():
            write_atomically(aside / name, text)
        write_atomically(aside / PLAN, json.dumps(document, indent=2, allow_nan=False) + "\n")

    written = _write_together(folder, (PREVIEW, *texts, PLAN), write)
    for name in MOTION_FILES:
        if name not in texts:
            with named_errors(folder / name):
                (folder / name).unlink(missing_ok=True)
    return written


def write_dynamics(folder: Path, run: Run) -> tuple[Path, ...]:
    """Writes identified dynamics, their report and recording into a folder, together or not at all.

    Args:
        folder: Where to; it is made where there is none.
        run: The result with its evidence.

    Returns:
        The files that were written.

    Raises:
        DataError: The folder cannot be written.
    """
    from visioncal.recording.dynamics import write_dynamics_recording
    from visioncal.report.dynamics import write_dynamics_report
    from visioncal.viewer.dynamics import dynamics_blueprint

    def write(aside: Path) -> None:
        run.identified.save(aside / DYNAMICS)
        write_dynamics_report(aside / REPORT, run)
        write_dynamics_recording(aside / RECORDING, run, dynamics_blueprint(run))

    return _write_together(folder, (RECORDING, REPORT, DYNAMICS), write)


def _write_together(
    folder: Path, files: Sequence[str], write: Callable[[Path], None]
) -> tuple[Path, ...]:
    """Has files written aside, and moves them into a folder once all are there."""
    taken = [folder / file for file in files if (folder / file).is_dir()]
    if taken:
        raise DataError(
            f"{taken[0]} is a folder, where a file is to be written.", culprits=[str(taken[0])]
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as name:
            aside = Path(name)
            write(aside)
            for file in files:
                (aside / file).replace(folder / file)
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be written: {error.strerror or error}.",
            culprits=[str(folder)],
            next_step="Make room in it, or choose another folder.",
        ) from error
    return tuple(folder / file for file in reversed(files))
