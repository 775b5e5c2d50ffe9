"""A rehearsal from plan to result, with its report as JSON and in words."""

import platform
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape

from visioncal.calibration.pipeline import Run, run
from visioncal.cli.console import answers, report_error, report_written, say
from visioncal.cli.progress import shown_progress
from visioncal.cli.recorded_cell import (
    RecordedSetup,
    ViewLines,
    facts_of,
    record_driven,
    scene_of,
    shown_in,
)
from visioncal.cli.summary import print_summary, truth_table
from visioncal.core.choices import Faults
from visioncal.core.errors import DataError, DriverError, VisioncalError
from visioncal.core.interrupts import signals_as_interrupts
from visioncal.core.types import FloatArray
from visioncal.core.version import __version__
from visioncal.frames.touch_test import evaluate_gaps, touch_points, touch_test_finding
from visioncal.interchange.outputs import Written, write_outputs, write_plan
from visioncal.live.capture.core import CaptureEvent, Watcher, missed_stops
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.take import TakenView
from visioncal.live.planning.messages import summary_of
from visioncal.live.planning.plan import PlanRequest, make_plan
from visioncal.live.planning.purposes import purpose_of
from visioncal.live.planning.written import plan_document
from visioncal.live.rehearsal.bench import Bench, FaultInjection
from visioncal.live.rehearsal.cell import RehearsalOptions, RehearsedCell, rehearsed_cell
from visioncal.live.rehearsal.witness import EdgeCheck, Pace, Witness, check_edges, pace_of
from visioncal.results import Calibration
from visioncal.results.arm import NOMINAL
from visioncal.results.compare import edge_errors
from visioncal.results.sections import TouchTest
from visioncal.session import Session

_NEAR_RAD = 2e-3
_PACKAGES = ("ur-rtde", "depthai", "numpy", "opencv-contrib-python-headless")

# The default speed of a UR's program; nobody stands beside this one.
TAKING = CaptureOptions(speed=1.05, acceleration=1.4)


# Fewer candidates than for a real plan, as a rehearsal should be short.
_CANDIDATES = 600


def simulated_touch_test(
    folder: Path, calibration: Calibration, base_from_target: FloatArray
) -> TouchTest:
    """Simulated touch test of located points, with the board's true (4, 4) pose [m]."""
    points = touch_points(Session.load(folder), calibration)
    true_points = [
        base_from_target[:3, :3] @ point.board_m + base_from_target[:3, 3] for point in points
    ]
    gaps = [
        1e3 * float(np.linalg.norm(point.base_m - true))
        for point, true in zip(points, true_points, strict=True)
    ]
    return evaluate_gaps(points, gaps)


@dataclass(frozen=True, eq=False)
class RehearsedRecording:
    """Recorded views, and the effect of a fault.

    Attributes:
        steps: Outcome of each stop; with a fault, the views before and after it.
        fault: Effect of the fault; None without one.
    """

    steps: tuple[CaptureEvent, ...]
    fault: "FaultEffect | None"


@dataclass(frozen=True)
class FaultEffect:
    """Effect of a fault on a recording.

    Attributes:
        message: The error message.
        next_step: The remedy in it.
        told_after_s: Delay of the message after the fault [s].
        stood_after_s: Delay of the arm's standstill after it [s]; None where unknown, or where it
            continues.
        views_kept: Number of views in the session then, including every acknowledged one.
    """

    name: str
    message: str
    next_step: str
    told_after_s: float
    stood_after_s: float | None
    views_kept: int


def planned(cell: RehearsedCell, options: RehearsalOptions, folder: Path) -> RecordedSetup:
    """Plans stops from the rough poses, and reads them back as a recording does."""
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
    """Records the plan's stops; with a fault, until it and on after it.

    Raises:
        DriverError: A device failed other than by the fault.
        DataError: The views cannot be written.
    """
    if fault is None:
        steps = _drive(bench, scene, folder, watchers, resume=resume, view=view)
        return RehearsedRecording(tuple(steps), None)
    injection = FaultInjection(bench, fault, after=max(1, len(scene.planned.stops) // 2))
    keeper = _KeptViews()
    all_watchers = (*watchers, keeper, injection)
    try:
        _check_all_seen(_drive(bench, scene, folder, all_watchers, resume=False, view=view))
    except VisioncalError as error:
        reported_s = keeper.missed_s or time.monotonic()
        if injection.injected_s is None:
            raise
        report_error(error, as_json=False)
        suffered = FaultEffect(
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
    injection.clear_fault()
    resumed_steps = _drive(bench, scene, folder, watchers, resume=True, view=view)
    return RehearsedRecording((*keeper.steps, *resumed_steps), suffered)


def calibrated(folder: Path, out: Path) -> tuple[Run, Written]:
    """Calibrates the recorded session, and writes the result."""
    session = Session.load(folder)
    with shown_progress(quiet=not sys.stderr.isatty()) as progress:
        result = run(session, progress=progress)
        progress("write", 0, 1)
        return result, write_outputs(out, session, result)


def _drive(
    bench: Bench,
    scene: RecordedSetup,
    folder: Path,
    watchers: Sequence[Watcher],
    *,
    resume: bool,
    view: bool,
) -> list[CaptureEvent]:
    with ExitStack() as opened, signals_as_interrupts():
        cell = opened.enter_context(bench.connected())
        begin = Journal.resume if resume else Journal.begin
        facts = facts_of(scene, cell, folder.name)
        journal = begin(folder, facts, cell.clock.unix_offset_s(), len(scene.planned.stops))
        shown = opened.enter_context(shown_in(scene, cell, wanted=view))
        all_watchers = [ViewLines(), *shown, *watchers]
        return record_driven(cell, scene, journal, TAKING, all_watchers, asks=False)


class _KeptViews:
    """A watcher that keeps the views of an interrupted recording.

    Attributes:
        steps: The views.
        missed_s: Time of the first report of a stop without a view, on the monotonic clock [s].
    """

    def __init__(self) -> None:
        self.steps: list[CaptureEvent] = []
        self.missed_s: float | None = None

    def stepped(self, step: CaptureEvent) -> None:
        """Keeps a view, or the time of the first missing one."""
        if isinstance(step.found, TakenView):
            self.steps.append(step)
        elif self.missed_s is None:
            self.missed_s = time.monotonic()


def _check_all_seen(steps: Sequence[CaptureEvent]) -> None:
    """Raises DataError where stops gave no view, as at the end of a recording."""
    missing = list(missed_stops(steps))
    if missing:
        view, reason = missing[0]
        raise DataError(
            f"{len(missing)} of {len(steps)} stops gave no view; view {view}: {reason}.",
            next_step="--resume tries them again.",
        )


def rehearse(
    options: RehearsalOptions, out: Path, fault: Faults | None, *, view: bool
) -> "Rehearsal":
    """Plans, records and calibrates, each into its own folder, with a fault half way if wanted.

    Raises:
        DriverError: A device failed other than by the fault.
        DataError: The views cannot be written, or are not enough for a result.
    """
    start = time.monotonic()
    cell = rehearsed_cell(options)
    scene = planned(cell, options, out / "plan")
    plan_ready = time.monotonic()
    # Approximately at the first stop, as if guided there by hand.
    start_q = scene.planned.stops[0].q + _NEAR_RAD
    with closing(Bench(cell, start_q)) as bench:
        witness = Witness(bench)
        _report_devices(bench)
        taken = recorded(bench, scene, out / "session", [witness], fault, view=view)
    captured = time.monotonic()
    run, written = calibrated(out / "session", out / "result")
    calibration = run.calibration
    board = cell.truth.transforms.get("base_from_target")
    test = None if board is None else simulated_touch_test(out / "session", calibration, board)
    ended = time.monotonic()
    return Rehearsal(
        options,
        cell,
        calibration,
        written,
        check_edges(calibration, cell.truth.transforms),
        taken,
        None if fault else pace_of(taken.steps, scene.planned, start_q, TAKING),
        tuple(witness.away_mm),
        {
            "plan": plan_ready - start,
            "capture": captured - plan_ready,
            "calibrate": ended - captured,
            "all": ended - start,
        },
        test,
    )


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """Result of a rehearsal.

    Attributes:
        error: Chi-square test of its error.
        pace: Durations of the views; None with a fault.
        away_mm: Distance of the flange from its recorded position, by view [mm].
    """

    options: RehearsalOptions
    cell: RehearsedCell
    calibration: Calibration
    written: Written
    error: EdgeCheck
    taken: RehearsedRecording
    pace: Pace | None
    away_mm: tuple[float, ...]
    times_s: dict[str, float]
    touch_test: TouchTest | None = None

    def document(self) -> dict[str, Any]:
        """The content of rehearsal.json; what does not apply is absent."""
        truth = self.cell.truth.transforms
        document: dict[str, Any] = {
            "schema": 1,
            "visioncal": __version__,
            "versions": _versions(),
            **asdict(self.options),
            "passed": self.error.passed,
            "chi_square": asdict(self.error),
            "errors": {
                name: asdict(error) for name, error in edge_errors(self.calibration, truth).items()
            },
            "arm_level": NOMINAL if self.calibration.arm is None else self.calibration.arm.level,
            "noise": dict(self.calibration.noise),
            "verdict": self.calibration.verdict.status,
            "views": len(self.away_mm),
            "most_away_at_exposure_mm": max(self.away_mm),
            "times_s": self.times_s,
            "truth": {name: array.tolist() for name, array in truth.items()},
        }
        if self.pace is not None:
            document["capture"] = asdict(self.pace)
        if self.touch_test is not None:
            document["touch_test"] = {
                "passed": self.touch_test.passed,
                "gaps_mm": [point.gap_mm for point in self.touch_test.points],
                "radius95_mm": [point.radius95_mm for point in self.touch_test.points],
            }
        if self.taken.fault is not None:
            suffered = asdict(self.taken.fault)
            document["fault"] = {key: value for key, value in suffered.items() if value is not None}
        return document

    def report(self) -> None:
        """Prints the result in words."""
        say, times = answers().print, self.times_s
        print_summary(self.calibration, verbose=False)
        truth = self.cell.truth
        say(truth_table(self.calibration, truth.transforms, truth.camera().camera))
        error = self.error
        verb = "is explained by" if error.passed else "is more than"
        say(
            f"the error {verb} the sigmas: chi-square {error.chi_square:.1f} of {error.freedom} "
            f"numbers, and up to {error.limit:.0f} is believed"
        )
        if self.touch_test is not None:
            say(escape(touch_test_finding(self.touch_test).words))
        if self.pace is not None:
            pace = self.pace
            say(
                f"each view: {pace.motion_s:.1f} s of motion and {pace.driving_s:.2f} s to begin "
                f"and end it, {pace.settling_s:.2f} s until all stood still, {pace.added_s:.2f} s "
                f"for the rest; where it was taken the flange was within "
                f"{1e3 * max(self.away_mm):.0f} um of what was recorded"
            )
        say(
            f"plan {times['plan']:.0f} s, capture {times['capture']:.0f} s, calibrate "
            f"{times['calibrate']:.0f} s; in all {times['all']:.0f} s"
        )


def _report_devices(bench: Bench) -> None:
    host = bench.controller.host
    say(f"simulated controller at {host}, driven by ur-rtde {version('ur-rtde')}")


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions
