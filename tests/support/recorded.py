"""Records fake cells; as a program, one that can be killed: `python recorded.py FOLDER STOPS`."""

import sys
from collections.abc import Callable
from pathlib import Path

from support.live_cell import FakeArm, FakeCamera, fake_devices, fake_plan

from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.gate import Consent
from visioncal.live.capture.journal import CaptureFacts, Journal
from visioncal.live.capture.options import CaptureOptions, Stillness
from visioncal.live.capture.recording import CaptureEvent, record
from visioncal.live.capture.take import TakenView
from visioncal.planning.plan_file import PlanFile

# A UR repeats to 0.03 to 0.05 mm; what stands within is where it was told to be.
REPEATABILITY_M = 5e-5
# The shortest rest that counts: fewer pictures have to be made.
QUICK = CaptureOptions(frames=1, still=Stillness(quiet_s=0.03))


def facts_of(plan: PlanFile, arm: FakeArm, camera: FakeCamera, name: str = "live") -> CaptureFacts:
    """What is written of a fake cell."""
    return CaptureFacts.of(LiveCell(arm, camera), name, plan.cell, plan)


def recorded(
    folder: Path,
    plan: PlanFile,
    arm: FakeArm,
    camera: FakeCamera,
    options: CaptureOptions = QUICK,
    watch: Callable[[CaptureEvent], None] = lambda _: None,
    *,
    resume: bool = False,
) -> list[CaptureEvent]:
    """Records the stops of a plan that have no view yet."""
    begin = Journal.resume if resume else Journal.begin
    facts = facts_of(plan, arm, camera)
    journal = begin(folder, facts, arm.clock.unix_offset_s(), len(plan.stops))
    cell = LiveCell(arm, camera, arm.clock)
    return record(cell, plan, journal, options, Consent(None), watch)


def _acknowledge(step: CaptureEvent) -> None:
    """Prints the number of a view that is on the disk."""
    if isinstance(step.found, TakenView):
        print(step.view, flush=True)


if __name__ == "__main__":
    planned = fake_plan(int(sys.argv[2]))
    recorded(Path(sys.argv[1]), planned, *fake_devices(planned), watch=_acknowledge, resume=True)
