"""A rehearsal from its plan to its result, as JSON and in words."""

import platform
import time
from contextlib import closing
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from rich.markup import escape

from visioncal.cli.console import answers, say
from visioncal.cli.rehearsed import (
    TAKING,
    RehearsedRecording,
    calibrated,
    planned,
    recorded,
    touched,
)
from visioncal.cli.summary import print_summary, truth_table
from visioncal.core.choices import Faults
from visioncal.core.version import __version__
from visioncal.frames.touch_test import finding_of
from visioncal.interchange.outputs import Written
from visioncal.live.rehearsal.bench import Bench
from visioncal.live.rehearsal.cell import RehearsalOptions, RehearsedCell, rehearsed_cell
from visioncal.live.rehearsal.witness import (
    EdgeCheck,
    Pace,
    Witness,
    explained,
    pace_of,
)
from visioncal.results import Calibration
from visioncal.results.arm import NOMINAL
from visioncal.results.compare import edge_errors
from visioncal.results.sections import TouchTest

_NEAR_RAD = 2e-3
_PACKAGES = ("ur-rtde", "depthai", "numpy", "opencv-contrib-python-headless")


def rehearse(
    options: RehearsalOptions, out: Path, fault: Faults | None, *, view: bool
) -> "Rehearsal":
    """Plans, records and calibrates.

    Args:
        options: What is rehearsed.
        out: The folder for the plan, the session and the result, each in one of its own.
        fault: What is to happen half way; None for nothing.
        view: Whether the viewer shows it as it goes.

    Raises:
        DriverError: A device failed without being asked to.
        DataError: The views cannot be written, or are not enough for a result.
    """
    begun = time.monotonic()
    cell = rehearsed_cell(options)
    scene = planned(cell, options, out / "plan")
    plan_ready = time.monotonic()
    # Led there by hand, as an operator would, and not quite exactly.
    start_q = scene.planned.stops[0].q + _NEAR_RAD
    with closing(Bench(cell, start_q)) as bench:
        witness = Witness(bench)
        _report_devices(bench)
        taken = recorded(bench, scene, out / "session", [witness], fault, view=view)
    captured = time.monotonic()
    run, written = calibrated(out / "session", out / "result")
    found = run.calibration
    board = cell.truth.transforms.get("base_from_target")
    test = None if board is None else touched(out / "session", found, board)
    ended = time.monotonic()
    return Rehearsal(
        options,
        cell,
        found,
        written,
        explained(found, cell.truth.transforms),
        taken,
        None if fault else pace_of(taken.steps, scene.planned, start_q, TAKING),
        tuple(witness.away_mm),
        {
            "plan": plan_ready - begun,
            "capture": captured - plan_ready,
            "calibrate": ended - captured,
            "all": ended - begun,
        },
        bench.through_depthai,
        test,
    )


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """A rehearsal that came to its end.

    Attributes:
        options: What was asked for.
        cell: The cell.
        calibration: The result.
        written: Where it is.
        error: Its error, weighed.
        taken: What was recorded.
        pace: How long the views took; None where a fault came between.
        away_mm: For each view, how far the flange was from what was recorded [mm].
        times_s: How long each part took [s].
        through_depthai: Whether the pictures went through depthai's pipeline.
        touch_test: Points of the board that a tip touched; None for a board on the flange.
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
    through_depthai: bool
    touch_test: TouchTest | None = None

    def document(self) -> dict[str, Any]:
        """The content of rehearsal.json; what does not apply is absent."""
        truth = self.cell.truth.transforms
        document: dict[str, Any] = {
            "schema": 1,
            "visioncal": __version__,
            "versions": _versions(),
            "through_depthai": self.through_depthai,
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
        """Says it in words."""
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
            say(escape(finding_of(self.touch_test).words))
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
    if bench.through_depthai:
        say(f"pictures through the pipeline of depthai {version('depthai')}")
        return
    say(
        "depthai is not installed, so pictures are taken without its pipeline: "
        "pip install 'depthai>=3.12,<4'"
    )


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
