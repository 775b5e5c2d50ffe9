"""What recording costs beyond motion and settling, and whether kills lose views.

python tests/benchmarks/capture.py            30 planned views, through the UR's client library
python tests/benchmarks/capture.py --kills 20 recordings killed at random moments
"""

import argparse
import shutil
import tempfile
import time
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from killed import kill_and_resume
from planned import true_cell

from visioncal.capture.core import Step
from visioncal.capture.facts import Facts
from visioncal.capture.journal import Journal
from visioncal.capture.live import LiveCell
from visioncal.capture.options import CaptureOptions
from visioncal.capture.record import record
from visioncal.capture.take import Taken
from visioncal.drivers.ur import UrArm
from visioncal.planning.cell import PlanCell
from visioncal.planning.plan import Request, make_plan
from visioncal.planning.purposes import purpose_of
from visioncal.planning.read_back import PlanFile, Stop
from visioncal.rehearsal.camera import RehearsalCamera
from visioncal.rehearsal.controller import spawn
from visioncal.rehearsal.options import ControllerOptions
from visioncal.rehearsal.truth import TruthClient
from visioncal.simulation import CellOptions, simulate
from visioncal.simulation.arms import ArmErrors

# More than this beside motion and settling is too much [s].
ALLOWED_S = 0.5
EXACT = ArmErrors(0.0, 0.0, 0.0)


@dataclass
class _Printed:
    """Prints the times of each view, and compares its pose with the truth at its exposure."""

    truth: TruthClient
    off_m: list[float] = field(default_factory=list)

    def stepped(self, step: Step) -> None:
        """Prints them."""
        times, found = step.times, step.found
        if isinstance(found, Taken):
            there = self.truth.state([found.frame.stamp_s]).base_from_flange[0]
            off = there[:3, 3] - found.state.base_from_flange[:3, 3]
            self.off_m.append(float(np.linalg.norm(off)))
        print(
            f"  view {step.view}: moved {times.moved_s:.2f} s, settled {times.settled_s:.2f} s, "
            f"worked {times.worked_s:.3f} s",
            flush=True,
        )


def planned(cell: PlanCell, stops: int, start_q: tuple[float, ...]) -> PlanFile:
    """A plan of a cell, as it would be read back."""
    request = Request(purpose_of("hand-eye"), stops, start_q=np.array(start_q), candidates=200)
    plan = make_plan(cell, request)
    found = tuple(Stop(it.view, it.q, it.via, it.words) for it in plan.stops)
    return PlanFile(cell, request.purpose, found, request.start_q, "0" * 64)


def measure(stops: int) -> None:
    """Records planned views of a simulated cell, and says what each took."""
    options = CellOptions(robot="ur10e", views=1)
    controller_options = ControllerOptions(errors=EXACT)
    cell = replace(true_cell(options), sigma_rad=0.01, sigma_m=0.005)
    begun = time.perf_counter()
    plan = planned(cell, stops, controller_options.q)
    print(f"planned {len(plan.stops)} stops in {time.perf_counter() - begun:.1f} s", flush=True)
    folder = Path(tempfile.mkdtemp()) / "live"
    with spawn(controller_options) as controller, closing(UrArm(controller.host)) as arm:
        truth = controller.truth
        camera = RehearsalCamera(simulate(options), lambda at: truth.state(at.tolist()).q)
        live = LiveCell(arm, camera)
        facts = Facts(
            "live",
            cell.mount,
            cell.target,
            cell.robot,
            arm.name,
            camera.name,
            camera.resolution,
            camera.factory,
            camera.settings,
            plan.digest,
        )
        journal = Journal.begin(folder, facts, live.clock.unix_offset_s(), stops)
        taking = CaptureOptions(speed=1.0, acceleration=1.5)
        begun = time.perf_counter()
        printed = _Printed(truth)
        steps = record(live, plan, journal, taking, [printed], lens=camera.factory)
        took_s = time.perf_counter() - begun
    worked = np.array([it.times.worked_s for it in steps])
    moved_s, settled_s = (
        sum(getattr(it.times, name) for it in steps) for name in ("moved_s", "settled_s")
    )
    rest_s = (took_s - moved_s - settled_s) / len(steps)
    print(
        f"{len(steps)} views: worked {np.median(worked):.3f} s a view (median), "
        f"{worked.max():.3f} s at most; all of {took_s:.0f} s but {moved_s:.0f} s on the way and "
        f"{settled_s:.0f} s settling is {rest_s:.3f} s a view (allowed {ALLOWED_S} s)"
    )
    print(
        f"the told pose is {1e3 * max(printed.off_m):.4f} mm at most from where the flange was at "
        f"the exposure (joints repeat to {controller_options.repeatability_rad:g} rad)"
    )
    shutil.rmtree(folder.parent)


def main() -> None:
    """Runs one of both."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--stops", type=int, default=30)
    given = parser.parse_args()
    if not given.kills:
        measure(given.stops)
        return
    folder = Path(tempfile.mkdtemp()) / "live"
    ends = kill_and_resume(folder, stops=3 * given.kills, kills=given.kills, seed=1, most_s=2.5)
    for end in ends:
        print(f"  killed after {end.after_s:.2f} s: {end.acknowledged} views acknowledged by then")
    killed = sum(not it.done for it in ends)
    print(f"{killed} kills, none of {3 * given.kills} acknowledged views lost")
    shutil.rmtree(folder.parent)


if __name__ == "__main__":
    main()
