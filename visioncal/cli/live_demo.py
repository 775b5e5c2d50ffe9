"""`visioncal demo --live`: plans and records a simulated cell by the real client library."""

from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np

from visioncal.cli.console import report_error, report_written, say
from visioncal.cli.progress import shown_progress
from visioncal.cli.recorded_cell import (
    RecordedSetup,
    ViewLines,
    check_all,
    facts_of,
    record_driven,
    scene_of,
)
from visioncal.core.choices import Faults
from visioncal.core.errors import DriverError, VisioncalError
from visioncal.core.interrupts import signals_as_interrupts
from visioncal.core.transforms import invert, pose_difference
from visioncal.core.types import FloatArray
from visioncal.interchange.outputs import write_plan
from visioncal.live.capture.core import CaptureEvent, Watcher
from visioncal.live.capture.gate import Consent
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.take import TakenView
from visioncal.live.planning.messages import summary_of
from visioncal.live.planning.plan import PlanRequest, make_plan
from visioncal.live.planning.purposes import purpose_of
from visioncal.live.planning.written import plan_document
from visioncal.live.simulated.bench import Bench, FaultAfter
from visioncal.live.simulated.cell import LiveSimulation, live_simulation
from visioncal.simulation.arms import forward
from visioncal.simulation.truth import truth_of, write_truth

# The default speed of a UR's program; nobody stands beside this one.
_TAKING = CaptureOptions(speed=1.05, acceleration=1.4)
# Fewer candidates than for a real plan, as a demonstration should be short.
_CANDIDATES = 600
# The arm begins so near to the first stop, as if guided there by hand [rad].
_NEAR_RAD = 2e-3


@dataclass(frozen=True, eq=False)
class _TruthOfViews:
    """Watcher that notes where the true flange was in the middle of each exposure."""

    bench: Bench
    simulation: LiveSimulation
    base_from_flange: list[FloatArray] = field(default_factory=list)
    away_mm: list[float] = field(default_factory=list)

    def stepped(self, step: CaptureEvent) -> None:
        """Notes a view, and how far from its joints' flange the true one was."""
        view = step.found
        if isinstance(view, TakenView) and view.state.q is not None:
            state = self.bench.controller.state([view.frame.stamp_s])
            recorded = forward(self.simulation.truth.robot.true_arm, view.state.q[None])[0]
            self.base_from_flange.append(state.base_from_flange[0])
            self.away_mm.append(pose_difference(recorded, state.base_from_flange[0])[0])


def record_simulated(
    session: Path, plan: Path, stops: int, seed: int, fault: Faults | None
) -> None:
    """Plans stops of a simulated cell and records them, with its truth beside the session.

    Args:
        session: Folder of the session, which does not exist.
        plan: Folder of the plan.
        stops: Number of planned stops.
        seed: Of everything random.
        fault: What happens half way; the recording then ends, is mended and resumed.

    Raises:
        DriverError: The client library is missing, or a device failed other than by the fault.
        DataError: The views cannot be written, or stops gave none.
    """
    simulation = live_simulation(seed)
    plan.parent.mkdir(parents=True, exist_ok=True)
    # From the begin, so that the next demonstration replaces one that was interrupted.
    write_truth(session, truth_of(simulation.truth))
    scene = _planned(simulation, stops, seed, plan)
    start_q = scene.planned.stops[0].q + _NEAR_RAD
    with closing(Bench(simulation, start_q)) as bench:
        host = bench.controller.host
        say(f"simulated controller at {host}, driven by ur-rtde {version('ur-rtde')}")
        truth = _TruthOfViews(bench, simulation)
        if fault is None:
            _drive(bench, scene, session, [truth], resume=False)
        else:
            _suffer(bench, scene, session, [truth], fault)
    flange = np.array(truth.base_from_flange)
    x, z = simulation.truth.transforms.values()
    poses = {"base_from_flange": flange, "cam_from_target": invert(flange @ x) @ z}
    write_truth(session, truth_of(simulation.truth) | poses)
    say(
        f"where views were taken the flange was within {1e3 * max(truth.away_mm):.0f} um of what "
        "was recorded"
    )


def _planned(simulation: LiveSimulation, stops: int, seed: int, folder: Path) -> RecordedSetup:
    """Plans stops from the rough poses, and reads them back as a recording does."""
    request = PlanRequest(purpose_of("hand-eye"), stops, candidates=_CANDIDATES, seed=seed)
    with shown_progress(quiet=False) as progress:
        plan = make_plan(simulation.known, request, progress=progress)
        written = write_plan(folder, plan, plan_document(plan, {"kind": "demo"}))
    report_written(written, quiet=True)
    say(f"plan: {summary_of(plan)}")
    return scene_of(folder)


def _suffer(
    bench: Bench, scene: RecordedSetup, session: Path, watchers: Sequence[Watcher], fault: Faults
) -> None:
    """Records until a fault, mends it, and records the rest."""
    after = FaultAfter(bench, fault, max(1, len(scene.planned.stops) // 2))
    try:
        _drive(bench, scene, session, [*watchers, after], resume=False)
    except VisioncalError as error:
        if "Ctrl-C" in error.culprits:
            raise
        report_error(error, as_json=False)
    else:
        raise DriverError(f"demo: {fault} did not happen before all views were taken.")
    say(f"  ({fault} is mended; on with --resume)")
    bench.mend(fault)
    _drive(bench, scene, session, watchers, resume=True)


def _drive(
    bench: Bench,
    scene: RecordedSetup,
    session: Path,
    watchers: Sequence[Watcher],
    *,
    resume: bool,
) -> None:
    with ExitStack() as opened, signals_as_interrupts():
        cell = opened.enter_context(bench.connected())
        begin = Journal.resume if resume else Journal.begin
        facts = facts_of(scene, cell, session.name)
        journal = begin(session, facts, cell.clock.unix_offset_s(), len(scene.planned.stops))
        steps = record_driven(
            cell, scene, journal, _TAKING, [ViewLines(), *watchers], Consent(None)
        )
        check_all(journal, steps)
