"""The parts of a rehearsal, each as the command of its name does it."""

import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from visioncal.calibration.pipeline import Run, run
from visioncal.cli.console import report_error, report_written, say
from visioncal.cli.progress import shown_progress
from visioncal.cli.recorded import ViewLines, driven
from visioncal.cli.recorded_cell import RecordedSetup, facts_of, scene_of, shown_in
from visioncal.core.choices import Faults
from visioncal.core.errors import DataError, DriverError, VisioncalError
from visioncal.core.interrupts import ended_like_ctrl_c
from visioncal.core.types import FloatArray
from visioncal.frames.touch_test import judged, touch_points
from visioncal.interchange.outputs import Written, write_outputs, write_plan
from visioncal.live.capture.core import CaptureEvent, Watcher, missed
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.take import TakenView
from visioncal.live.planning.messages import summary_of
from visioncal.live.planning.plan import PlanRequest, make_plan
from visioncal.live.planning.purposes import purpose_of
from visioncal.live.planning.written import plan_document
from visioncal.live.rehearsal.bench import Bench
from visioncal.live.rehearsal.cell import RehearsalOptions, RehearsedCell
from visioncal.live.rehearsal.fault_injection import FaultInjection
from visioncal.results import Calibration
from visioncal.results.sections import TouchTest
from visioncal.session import Session

# The pace at which a UR moves where its program says nothing else; nobody stands beside this one.
TAKING = CaptureOptions(speed=1.05, acceleration=1.4)


# Fewer than a real plan is chosen from: it matters more that a rehearsal is short.
_CANDIDATES = 600


def touched(folder: Path, calibration: Calibration, base_from_target: FloatArray) -> TouchTest:
    """Touches what the camera located, with a tip that knows where the board really is.

    Args:
        folder: The session's.
        calibration: Its result.
        base_from_target: (4, 4) the truth.
    """
    points = touch_points(Session.load(folder), calibration)
    true = [base_from_target[:3, :3] @ point.board_m + base_from_target[:3, 3] for point in points]
    gaps = [
        1e3 * float(np.linalg.norm(point.base_m - at))
        for point, at in zip(points, true, strict=True)
    ]
    return judged(points, gaps)


@dataclass(frozen=True, eq=False)
class RehearsedRecording:
    """What was recorded.

    Attributes:
        steps: What became of each stop; of a recording with a fault, the views before and after it.
        fault: What the fault did; None without one.
    """

    steps: tuple[CaptureEvent, ...]
    fault: "Suffered | None"


@dataclass(frozen=True)
class Suffered:
    """How a recording took a fault.

    Attributes:
        name: The fault.
        message: What was said.
        next_step: And what to do.
        told_after_s: How long after the fault [s].
        stood_after_s: How long after it the arm stood [s]; None where that is not known, or
            where it goes on.
        views_kept: How many views the session had then, every acknowledged one among them.
    """

    name: str
    message: str
    next_step: str
    told_after_s: float
    stood_after_s: float | None
    views_kept: int


def planned(cell: RehearsedCell, options: RehearsalOptions, folder: Path) -> RecordedSetup:
    """Plans stops from the rough guesses, and reads them back as a recording does."""
    request = PlanRequest(
        purpose_of("hand-eye"), options.stops, candidates=_CANDIDATES, seed=options.seed
    )
    with shown_progress(quiet=False) as progress:
        plan = make_plan(cell.known, request, progress=progress)
        written = write_plan(folder, plan, plan_document(plan, {"kind": "rehearsal"}))
    report_written(written, quiet=True)
    say(f"plan: {summary_of(plan)}")
    return scene_of(folder)


def recorded(
    bench: Bench,
    scene: RecordedSetup,
    folder: Path,
    watchers: Sequence[Watcher],
    fault: Faults | None,
    *,
    view: bool,
    resume: bool = False,
) -> RehearsedRecording:
    """Records the plan's stops; where a fault is wanted, through it and on.

    Raises:
        DriverError: A device failed without being asked to.
        DataError: The views cannot be written.
    """
    if fault is None:
        steps = _drive(bench, scene, folder, watchers, resume=resume, view=view)
        return RehearsedRecording(tuple(steps), None)
    injection = FaultInjection(bench, fault, after=max(1, len(scene.planned.stops) // 2))
    kept = _Kept()
    every = (*watchers, kept, injection)
    try:
        _check_all_seen(_drive(bench, scene, folder, every, resume=False, view=view))
    except VisioncalError as error:
        reported_s = kept.missed_s or time.monotonic()
        if injection.injected_s is None:
            raise
        report_error(error, as_json=False)
        suffered = Suffered(
            fault,
            error.message,
            error.next_step,
            reported_s - injection.injected_s,
            injection.stood_after_s(),
            len(Session.load(folder).views),
        )
    else:
        raise DriverError(f"rehearse: {fault} did not happen before all views were taken.")
    say(f"  ({fault} is mended; on with --resume)")
    injection.mend()
    rest = _drive(bench, scene, folder, watchers, resume=True, view=view)
    return RehearsedRecording((*kept.steps, *rest), suffered)


def calibrated(folder: Path, out: Path) -> tuple[Run, Written]:
    """Calibrates what was recorded, and writes the result."""
    session = Session.load(folder)
    with shown_progress(quiet=not sys.stderr.isatty()) as progress:
        found = run(session, progress=progress)
        progress("write", 0, 1)
        return found, write_outputs(out, session, found)


def _drive(
    bench: Bench,
    scene: RecordedSetup,
    folder: Path,
    watchers: Sequence[Watcher],
    *,
    resume: bool,
    view: bool,
) -> list[CaptureEvent]:
    with ExitStack() as opened, ended_like_ctrl_c():
        cell = opened.enter_context(bench.connected())
        begin = Journal.resume if resume else Journal.begin
        facts = facts_of(scene, cell, folder.name)
        offset_s = cell.clock.unix_offset_s()
        journal = begin(folder, facts, offset_s, len(scene.planned.stops))
        shown = opened.enter_context(shown_in(scene, cell, wanted=view))
        every = [ViewLines(), *shown, *watchers]
        return driven(cell, scene, journal, TAKING, every, asks=False)


class _Kept:
    """Keeps the views of a recording that does not come to its end.

    Attributes:
        steps: Those that there are.
        missed_s: When the first stop without one was reported, on the monotonic clock [s].
    """

    def __init__(self) -> None:
        self.steps: list[CaptureEvent] = []
        self.missed_s: float | None = None

    def stepped(self, step: CaptureEvent) -> None:
        """Keeps it."""
        if isinstance(step.found, TakenView):
            self.steps.append(step)
        elif self.missed_s is None:
            self.missed_s = time.monotonic()


def _check_all_seen(steps: Sequence[CaptureEvent]) -> None:
    """Raises what a recording ends with where stops gave no view."""
    without = list(missed(steps))
    if without:
        view, reason = without[0]
        raise DataError(
            f"{len(without)} of {len(steps)} stops gave no view; view {view}: {reason}.",
            next_step="--resume tries them again.",
        )
