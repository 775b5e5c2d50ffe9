"""What a recording through the real client libraries stands, and what it costs.

Simulated: the controller, in a process of its own, and what the camera sees. Real: ur-rtde and
depthai's pipeline, the recorder and the files.

    PYTHONPATH=tests python tests/benchmarks/rehearsal.py pace faults knocks kills
"""

import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import get_args

import numpy as np
from results import WORDS, few, first, need, write_section
from support.killed import kill_and_resume

from visioncal.cli.recorded_cell import RecordedSetup, facts_of, scene_of
from visioncal.cli.rehearsal import TAKING, planned, recorded
from visioncal.core.choices import Faults
from visioncal.core.errors import DataError, DriverError
from visioncal.live.capture.core import CaptureEvent
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.live import LiveCell
from visioncal.live.capture.record import record
from visioncal.live.capture.take import TakenView
from visioncal.live.drivers.ur import UrArm
from visioncal.live.rehearsal.bench import Bench
from visioncal.live.rehearsal.camera import RehearsalCamera
from visioncal.live.rehearsal.cell import RehearsalOptions, RehearsedCell, rehearsed_cell
from visioncal.live.rehearsal.controller import spawn
from visioncal.live.rehearsal.machine import ControllerOptions
from visioncal.live.rehearsal.truth import TruthClient
from visioncal.live.rehearsal.witness import Witness, pace_of
from visioncal.session import Session

COMMAND = "PYTHONPATH=tests python tests/benchmarks/rehearsal.py"
SEED = 1
PACE_STOPS, FAULT_STOPS, KNOCK_STOPS, KILL_STOPS = few((30, 4, 12, 20), (2, 2, 2, 2))
# Room for the four views and little more.
DISK_BYTES = 6_000_000
KILLS, LATEST_KILL_S = few(20, 1), 6.0
# A knock turns every joint by so much, so fast [rad, rad/s]: a tenth of a second long.
KNOCK_RAD, KNOCK_SPEED = 1e-3, 0.01
_PROGRAM = Path(__file__)


class Knocks:
    """Knocks the arm again and again while it stands, from a thread."""

    def __init__(self, host: str) -> None:
        self.count = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(host,))
        self._thread.start()

    def end(self) -> None:
        """Ends them."""
        self._over.set()
        self._thread.join()

    def _run(self, host: str) -> None:
        rng = np.random.default_rng(0)
        with closing(TruthClient(host)) as truth:
            while not self._over.wait(rng.uniform(0.1, 1.5)):
                now = truth.state([time.monotonic()])
                if not now.dq.any():
                    aside = KNOCK_RAD * rng.choice([-1.0, 1.0], size=6)
                    truth.guide(now.q[0] + aside, speed=KNOCK_SPEED, acceleration=1.0)
                    self.count += 1


def stage(folder: Path, stops: int) -> tuple[RehearsedCell, RecordedSetup, Bench]:
    """A planned cell whose arm stands at the first stop."""
    options = RehearsalOptions(stops=stops, seed=SEED)
    cell = rehearsed_cell(options)
    scene = planned(cell, options, folder / "plan")
    return cell, scene, Bench(cell, scene.planned.stops[0].q + 2e-3)


def pace(folder: Path) -> str:
    """How long views take."""
    _, scene, bench = stage(folder, PACE_STOPS)
    witness = Witness(bench)
    with closing(bench):
        steps = recorded(bench, scene, folder / "session", [witness], None, view=False).steps
    found = pace_of(steps, scene.planned, scene.planned.stops[0].q, TAKING)
    return (
        f"{found.views} planned views of a {scene.planned.cell.robot.name}, 1280 x 800, three "
        "frames each at 30 Hz.\n\n"
        "| a view | mean [s] | worst [s] |\n|---|---:|---:|\n"
        f"| motion, by speed and acceleration | {found.motion_s:.2f} | |\n"
        f"| to begin and end each part of the way | {found.driving_s:.2f} | |\n"
        f"| until all stood still for 0.3 s | {found.settling_s:.2f} | |\n"
        f"| pictures, detection, checks, writing (aim 0.5) | {found.added_s:.2f} "
        f"| {found.most_added_s:.2f} |\n\n"
        "Where each was taken, the flange was within "
        f"{max(witness.away_mm):.3f} mm of what was recorded (a UR5e repeats to 0.03 mm).\n"
    )


def faults(folder: Path) -> str:
    """What each fault leads to."""
    lines = [
        "| fault | told after [s] | the arm stood after [s] | views kept | in the end | message |",
        "|---|---:|---:|---:|---:|---|",
    ]
    for fault in first(get_args(Faults)):
        place = folder / fault
        _, scene, bench = stage(place, FAULT_STOPS)
        with closing(bench):
            taken = recorded(bench, scene, place / "session", [], fault, view=False)
        suffered, views = (
            taken.fault,
            sum(isinstance(step.found, TakenView) for step in taken.steps),
        )
        stood = "" if suffered.stood_after_s is None else f"{suffered.stood_after_s:.2f}"
        message = suffered.message.replace(str(place), "...")
        lines.append(
            f"| {fault} | {suffered.told_after_s:.2f} | {stood} | {suffered.views_kept} | {views} "
            f"| {message} {suffered.next_step} |"
        )
    lines += [wrong_banner(), disk_full(folder)]
    return (
        f"{FAULT_STOPS} planned views; the fault comes after the second, while the arm moves, "
        "or, for the camera, at the stop. A covered lens is reported at each stop, and "
        "ends the recording at the third; all others are reported at once.\n\n"
        + "\n".join(lines)
        + "\n"
    )


def wrong_banner() -> str:
    """A controller whose dashboard tells no version."""
    with spawn(ControllerOptions(polyscope="no version")) as controller:
        begun = time.monotonic()
        try:
            UrArm(controller.host).close()
        except DriverError as error:
            told_s = time.monotonic() - begun
            return f"| wrong version banner | {told_s:.2f} | | | | {error} |"
    raise RuntimeError("it was taken for a controller")


def disk_full(folder: Path) -> str:
    """A disk that somebody else fills after the second view; needs the right to mount."""
    place = folder / "full"
    _, scene, bench = stage(place, FAULT_STOPS)
    disk = place / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(disk)]
    if subprocess.run(mount, check=False).returncode:
        bench.close()
        return "| disk full | | | | | (not measured: no right to mount a small disk) |"
    filling = _Filling(disk / "ballast")
    try:
        recorded(bench, scene, disk / "session", [filling], None, view=False)
    except DataError as error:
        told_s = time.monotonic() - filling.filled_s
        kept = len(Session.load(disk / "session").views)
        filling.ballast.unlink()
        rest = recorded(bench, scene, disk / "session", [], None, view=False, resume=True)
        message = str(error).replace(str(disk), "...")
        views = kept + len(rest.steps)
        return f"| disk full | {told_s:.2f} | | {kept} | {views} | {message} |"
    finally:
        bench.close()
        subprocess.run(["umount", str(disk)], check=True)
    raise RuntimeError("the disk was not full")


class _Filling:
    """Fills a disk after the second view."""

    def __init__(self, ballast: Path) -> None:
        self.ballast, self.filled_s = ballast, 0.0

    def stepped(self, step: CaptureEvent) -> None:
        """Fills it."""
        if step.place == FAULT_STOPS // 2:
            with suppress(OSError), self.ballast.open("wb", buffering=0) as file:
                while file.write(bytes(65536)):
                    pass
            self.filled_s = time.monotonic()


def knocks(folder: Path) -> str:
    """Whether an arm that is knocked gives views."""
    _, scene, bench = stage(folder, KNOCK_STOPS)
    witness = Witness(bench)
    with closing(bench):
        hand = Knocks(bench.controller.host)
        try:
            steps = recorded(bench, scene, folder / "session", [witness], None, view=False).steps
        finally:
            hand.end()
    return (
        f"{hand.count} knocks of {1e3 * KNOCK_RAD:g} mrad in every joint, up to 1.5 s apart, "
        "while the "
        f"arm was at rest at {len(steps)} stops. {len(witness.away_mm)} views were "
        "accepted; at each of them, the flange was within "
        f"{max(witness.away_mm, default=np.nan):.3f} mm of "
        "what was recorded "
        "(a UR5e repeats to 0.03 mm).\n"
    )


def kills(folder: Path) -> str:
    """Whether kills lose views."""
    _, _, bench = stage(folder, KILL_STOPS)
    with closing(bench):
        program = [sys.executable, str(_PROGRAM), "record", bench.controller.host]
        session = folder / "session"
        ends = kill_and_resume(session, KILL_STOPS, KILLS, SEED, LATEST_KILL_S, program)
    killed = [end for end in ends if not end.done]
    moments = ", ".join(f"{item.after_s:.1f} s ({item.acknowledged})" for item in killed)
    return (
        f"{len(killed)} recordings killed with SIGKILL, at random moments after their start "
        f"(views acknowledged by then): {moments}. After each the session opened with every "
        f"acknowledged view; the last --resume completed all {KILL_STOPS}. No view was lost.\n"
    )


class _Acknowledged:
    def stepped(self, step: CaptureEvent) -> None:
        if isinstance(step.found, TakenView):
            print(step.view, flush=True)


def record_beside(host: str, folder: Path, stops: int) -> None:
    """Goes on with a recording, at a controller that others started: what is killed."""
    cell = rehearsed_cell(RehearsalOptions(stops=stops, seed=SEED))
    scene = scene_of(folder.parent / "plan")
    eyes = TruthClient(host)
    camera = RehearsalCamera(cell.truth, lambda at: eyes.state(at.tolist()).q)
    with closing(UrArm(host)) as arm:
        live = LiveCell(arm, camera)
        facts = facts_of(scene, live, "session")
        print("begun", flush=True)
        journal = Journal.resume(folder, facts, live.clock.unix_offset_s(), stops)
        record(live, scene.planned, journal, TAKING, [_Acknowledged()], lens=camera.factory)
    print("done", flush=True)


PARTS: dict[str, tuple[str, Callable[[Path], str]]] = {
    "pace": ("Recording through the client libraries", pace),
    "faults": ("Faults on the way", faults),
    "knocks": ("An arm that is knocked", knocks),
    "kills": ("Recordings that are killed", kills),
}


def main() -> None:
    """Measures what is named, else all."""
    if WORDS[:1] == ("record",):
        host, folder, stops = WORDS[1:4]
        record_beside(host, Path(folder), int(stops))
        return
    for part in WORDS or PARTS:
        name, measure = PARTS[part]
        with tempfile.TemporaryDirectory() as folder:
            text = measure(Path(folder))
        print(text, flush=True)
        write_section(name, f"{COMMAND} {part}", text)


if __name__ == "__main__":
    need("rtde_control", "-e .[ur]")
    main()
