"""What recording costs beyond motion and settling, what it says of faults, and what kills lose.

Recorded is a simulated cell, through the UR's own client library; run from the repository's root:
`PYTHONPATH=tests python tests/benchmarks/capture.py`. It takes five minutes, mostly on the way.
"""

import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from results import few, first, need, write_section
from support.killed import kill_and_resume
from support.planned import true_cell

from visioncal.core.errors import VisioncalError
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.gate import Consent
from visioncal.live.capture.journal import CaptureFacts, Journal
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.recording import CaptureEvent, Watcher, record
from visioncal.live.capture.take import TakenView
from visioncal.live.drivers.ur import UrArm
from visioncal.live.planning.plan import PlanRequest, make_plan
from visioncal.live.planning.plan_file import PlanFile, Stop
from visioncal.live.planning.purposes import purpose_of
from visioncal.live.simulated.cell import SimulatedCamera
from visioncal.live.simulated.controller import ControllerOptions, SimulatedController, spawn
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate
from visioncal.simulation.arms import ArmErrors

# More than this beside motion and settling is too much [s].
ALLOWED_S = 0.5
STOPS, KILLS = few((30, 20), (3, 1))
# The told pose is compared with the true one, so that the arm has no errors but its repeatability.
CONTROLLER = ControllerOptions(errors=ArmErrors())
CELL = CellOptions(robot="ur10e", views=1)
TAKING = CaptureOptions(speed=1.0, acceleration=1.5)
FAULTS = ("link-lost", "silent", "protective-stop", "emergency-stop", "remote-off", "power-off")
# A fault comes so long after the first view, on the way to the second [s].
ON_THE_WAY_S = 1.5


@dataclass
class Compared:
    """Compares the pose of each view with the truth at its exposure."""

    truth: SimulatedController
    off_m: list[float] = field(default_factory=list)

    def stepped(self, step: CaptureEvent) -> None:
        """Compares one."""
        if isinstance(step.found, TakenView):
            there = self.truth.state([step.found.frame.stamp_s]).base_from_flange[0]
            off = there[:3, 3] - step.found.state.base_from_flange[:3, 3]
            self.off_m.append(float(np.linalg.norm(off)))


@dataclass
class Faulty:
    """Lets a fault happen on the way to the second view."""

    fault: str
    truth: SimulatedController
    camera: SimulatedCamera
    began_s: float = 0.0

    def stepped(self, step: CaptureEvent) -> None:
        """Sets the fault's clock."""
        if step.place == 1:
            threading.Timer(ON_THE_WAY_S, self._happen).start()

    def _happen(self) -> None:
        self.began_s = time.monotonic()
        if self.fault == "unplugged":
            self.camera.fault = "unplugged"
        else:
            self.truth.inject(self.fault)


@contextmanager
def live_cell() -> Iterator[tuple[LiveCell, SimulatedCamera, SimulatedController]]:
    """A simulated cell at work: its devices, and its controller."""
    with spawn(CONTROLLER) as controller, closing(UrArm(controller.host)) as arm:
        camera = SimulatedCamera(simulate(CELL), lambda at: controller.state(at.tolist()).q)
        yield LiveCell(arm, (camera,)), camera, controller


def planned(stops: int) -> PlanFile:
    """A plan of the cell, as it would be read back."""
    cell = replace(true_cell(CELL), sigma_rad=0.01, sigma_m=0.005)
    start_q = np.array(CONTROLLER.q)
    request = PlanRequest(purpose_of("hand-eye"), stops, start_q=start_q, candidates=200)
    found = tuple(
        Stop(stop.view, stop.q, stop.via, stop.words) for stop in make_plan(cell, request).stops
    )
    return PlanFile(cell, request.purpose, found, start_q, "0" * 64)


def recorded(live: LiveCell, plan: PlanFile, folder: Path, watcher: Watcher) -> list[CaptureEvent]:
    """Records a plan into a folder."""
    camera, cell = live.camera, plan.cell
    facts = CaptureFacts(
        "live",
        cell.mount,
        cell.target,
        cell.robot,
        live.arm.name,
        camera.name,
        camera.resolution,
        camera.factory,
        camera.settings,
        plan.digest,
    )
    journal = Journal.begin(folder, facts, live.clock.unix_offset_s(), len(plan.stops))
    return record(live, plan, journal, TAKING, Consent(None), [watcher])


def times_of_views(folder: Path) -> str:
    """Records planned views, and says what each took and how true its pose is."""
    plan = planned(STOPS)
    with live_cell() as (live, _, truth):
        compared, begun = Compared(truth), time.perf_counter()
        steps = recorded(live, plan, folder / "views", compared)
        took_s = time.perf_counter() - begun
    worked = np.array([step.worked_s for step in steps])
    moved_s = sum(step.moved_s for step in steps)
    settled_s = sum(step.settled_s for step in steps)
    rest_s = (took_s - moved_s - settled_s) / len(steps)
    repeats = CONTROLLER.repeatability_rad
    return (
        f"{len(steps)} planned views took {took_s:.0f} s: {moved_s:.0f} s on the way, "
        f"{settled_s:.0f} s settling, and {rest_s:.2f} s a view for everything else (limit "
        f"{ALLOWED_S}; frames, finding, writing: {np.median(worked):.2f} median, "
        f"{worked.max():.2f} at most). The recorded pose differs by at most "
        f"{1e3 * max(compared.off_m):.3f} mm from the flange's pose at the exposure; each joint "
        f"repeats to {repeats:g} rad."
    )


def time_of_fault(fault: str, plan: PlanFile, folder: Path) -> str:
    """Lets a fault happen, and says how long it took until it was told, and what was."""
    with live_cell() as (live, camera, truth):
        faulty = Faulty(fault, truth, camera)
        try:
            recorded(live, plan, folder / fault, faulty)
        except VisioncalError as error:
            took_s = time.monotonic() - faulty.began_s
            views = len(Session.load(folder / fault).views)
            words = error.message.replace(str(folder / fault), "SESSION").replace(
                truth.host, "HOST"
            )
            return f"| {fault} | {took_s:.2f} | {views} | {words} |"
    raise AssertionError(f"{fault} was not noticed")


def losses_of_kills(folder: Path) -> str:
    """Kills recordings, and says what was lost."""
    stops = 3 * KILLS
    ends = kill_and_resume(folder / "killed", stops=stops, kills=KILLS, seed=1, most_s=2.5)
    killed = sum(not end.done for end in ends)
    return (
        f"{killed} kills at random moments of one recording of {stops} views, resumed each time: "
        "after every kill the session contained every acknowledged view, and in the end all "
        "views."
    )


def main() -> None:
    """Measures, and writes the section."""
    with tempfile.TemporaryDirectory() as name:
        folder, plan = Path(name), planned(4)
        rows = [time_of_fault(name, plan, folder) for name in first((*FAULTS, "unplugged"))]
        table = [
            "| fault on the way | told after [s] | views | words |",
            "| --- | ---: | ---: | --- |",
        ]
        parts = [times_of_views(folder), losses_of_kills(folder), "\n".join([*table, *rows])]
    text = "\n\n".join(parts)
    print(text)
    command = "PYTHONPATH=tests python tests/benchmarks/capture.py"
    write_section("Recording a live cell", command, text)


if __name__ == "__main__":
    need("rtde_control", "-e .[ur]")
    main()
