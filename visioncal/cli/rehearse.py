"""`visioncal rehearse`."""

import json
import platform
import shutil
import time
from contextlib import closing
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import typer
from rich.markup import escape

from visioncal.cli.against_truth import truth_table
from visioncal.cli.console import answers, messages, report_written
from visioncal.cli.options import AsJson, OutFolder, Seed, View
from visioncal.cli.rehearsed import TAKING, Recorded, calibrated, planned, recorded, touched
from visioncal.cli.summary import print_summary
from visioncal.core.errors import DataError
from visioncal.core.files import write_atomically
from visioncal.core.types import CameraMount
from visioncal.core.version import __version__
from visioncal.frames.touch_test import finding_of
from visioncal.interchange.outputs import Written
from visioncal.live.drivers.extras import refuse_without
from visioncal.live.rehearsal.bench import Bench
from visioncal.live.rehearsal.cell import RehearsalOptions, RehearsedCell, rehearsed_cell
from visioncal.live.rehearsal.compared import Explained, edge_errors, explained
from visioncal.live.rehearsal.fault_injection import Faults
from visioncal.live.rehearsal.witness import Pace, Witness, pace_of
from visioncal.results import Calibration
from visioncal.results.arm import NOMINAL
from visioncal.results.sections import TouchTest

# A check said no: the result is there, and it is farther from the truth than it says.
EXIT_WRONG = 3
_NEAR_RAD = 2e-3
_SUMMARY = "rehearsal.json"
_PACKAGES = ("ur-rtde", "depthai", "numpy", "opencv-contrib-python-headless")


def rehearse_command(
    out: OutFolder = Path("rehearsal"),
    robot: Annotated[
        Literal["ur3e", "ur5e", "ur10e"], typer.Option(help="The simulated arm.")
    ] = "ur5e",
    mount: Annotated[CameraMount, typer.Option(help="Where the camera is.")] = "eye-in-hand",
    views: Annotated[int, typer.Option(min=5, max=200, help="Number of planned stops.")] = 16,
    seed: Seed = 0,
    fault: Annotated[
        Faults | None,
        typer.Option(
            metavar="FAULT",
            help=f"Let this happen half way: {', '.join(get_args(Faults))}.",
            show_default=False,
        ),
    ] = None,
    view: View = False,
    as_json: AsJson = False,
) -> None:
    """Plan, record and calibrate a simulated cell by the real client libraries.

    The controller is a process on this machine that speaks a UR's protocols, with an arm that is
    not quite as it should be; the camera draws what that arm sees. Nothing real moves. Exit status
    0: the result is as near to the truth as it says; 3: it is not.
    """
    # Without depthai, pictures come straight from the simulated camera.
    refuse_without("ur", {"ur": "rtde_control", "oak": "depthai"})
    _make_place(out)
    whole = _rehearse(RehearsalOptions(robot, mount, views, seed), out, fault, view=view)
    document = whole.document()
    write_atomically(out / _SUMMARY, json.dumps(document, indent=2, allow_nan=False) + "\n")
    if as_json:
        typer.echo(json.dumps(document, indent=2, allow_nan=False))
    else:
        whole.report()
    messages().print(escape(f"wrote {out / _SUMMARY}; look: visioncal review {out / 'result'}"))
    report_written(whole.written, quiet=True, status=0 if whole.error.passed else EXIT_WRONG)


def _rehearse(
    options: RehearsalOptions, out: Path, fault: Faults | None, *, view: bool
) -> "_Rehearsal":
    """Plans, records and calibrates."""
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
    return _Rehearsal(
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
class _Rehearsal:
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
    error: Explained
    taken: Recorded
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
                name: asdict(it) for name, it in edge_errors(self.calibration, truth).items()
            },
            "arm_level": NOMINAL if self.calibration.arm is None else self.calibration.arm.level,
            "noise": dict(self.calibration.noise),
            "verdict": self.calibration.verdict.status,
            "views": len(self.away_mm),
            "most_away_at_exposure_mm": max(self.away_mm),
            "times_s": self.times_s,
            "truth": {name: it.tolist() for name, it in truth.items()},
        }
        if self.pace is not None:
            document["capture"] = asdict(self.pace)
        if self.touch_test is not None:
            document["touch_test"] = {
                "passed": self.touch_test.passed,
                "gaps_mm": [it.gap_mm for it in self.touch_test.points],
                "radius95_mm": [it.radius95_mm for it in self.touch_test.points],
            }
        if self.taken.fault is not None:
            suffered = asdict(self.taken.fault)
            document["fault"] = {key: it for key, it in suffered.items() if it is not None}
        return document

    def report(self) -> None:
        """Says it in words."""
        say, times = answers().print, self.times_s
        print_summary(self.calibration, verbose=False)
        truth = self.cell.truth
        say(truth_table(self.calibration, truth.transforms, truth.options.camera))
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
    messages().print(f"simulated controller at {host}, driven by ur-rtde {version('ur-rtde')}")
    if bench.through_depthai:
        messages().print(f"pictures through the pipeline of depthai {version('depthai')}")
        return
    messages().print(
        "depthai is not installed, so pictures are taken without its pipeline: "
        "pip install 'depthai>=3.12,<4'"
    )


def _make_place(out: Path) -> None:
    """Makes room in the place of an earlier rehearsal; nothing else is ever removed.

    Raises:
        DataError: There is a session that is not a rehearsal's.
    """
    mark, session = out / _SUMMARY, out / "session"
    if session.exists():
        if not mark.is_file():
            raise DataError(
                f"{session} is not of a rehearsal.",
                culprits=[str(session)],
                next_step="Choose another folder with -o.",
            )
        shutil.rmtree(session)
    out.mkdir(parents=True, exist_ok=True)
    # Until it is over there is no more to say; an interrupted one is replaced by the next.
    write_atomically(mark, json.dumps({"schema": 1, "visioncal": __version__}) + "\n")


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
