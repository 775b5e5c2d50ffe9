"""Kills programs that write an output folder, at random moments, and looks at what they leave.

Run from the repository's root: `PYTHONPATH=tests python tests/benchmarks/killed_writes.py`. It
takes five minutes; with --quick a tenth of the kills take half a minute.
"""

import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path

from results import write_section

from visioncal.core.files import write_atomically
from visioncal.core.output_generations import write_generation

FILES = RECORDING, REPORT, CALIBRATION = ("recording.rrd", "report.html", "calibration.json")
KILLS = {"drawn": 40, "ready": 160}
# The latest moment after the first generation [s]: one is drawn in a second, and takes the place of
# another in some milliseconds.
MOST_S = {"drawn": 2.0, "ready": 0.1}
# Megabytes, as an image or two in a recording.
PADDING = 1_000_000 * "."


def write_drawn(folder: Path, number: int) -> None:
    """Writes what a calibration writes; the number is in its time."""
    # A second to load, which the other kind need not wait for.
    from support.samples import made_up

    from visioncal.calibration.pipeline import Run
    from visioncal.interchange.outputs import write_outputs

    sample = made_up(5)
    created = f"2026-11-20T{number // 60:02}:{number % 60:02}:00+00:00"
    write_outputs(folder, sample.session, Run(replace(sample.calibration, created=created), ()))


def numbers_drawn(folder: Path) -> set[str]:
    """The generations that the files in a folder are of."""
    from visioncal.present.facts import readable_time
    from visioncal.present.recording import read_calibration
    from visioncal.results import Calibration

    created = Calibration.load(folder).created
    recorded = read_calibration(folder / RECORDING)
    found = {created, recorded.created if recorded else "no result"}
    report = (folder / REPORT).read_text(encoding="utf-8")
    return found | (set() if readable_time(created) in report else {"another report"})


def write_ready(folder: Path, number: int) -> None:
    """Writes texts that are ready."""

    def write(aside: Path) -> None:
        for name in FILES:
            write_atomically(aside / name, f"{number}{PADDING}")

    write_generation(folder, FILES, write)


def numbers_ready(folder: Path) -> set[str]:
    """The generations that the files in a folder are of."""
    return {(folder / name).read_text(encoding="utf-8") for name in FILES}


KINDS: dict[str, tuple[Callable[[Path, int], None], Callable[[Path], set[str]]]] = {
    "drawn": (write_drawn, numbers_drawn),
    "ready": (write_ready, numbers_ready),
}


def killed(kind: str, folder: Path, after_s: float) -> None:
    """Has generations written one after the other, until it is killed."""
    command = [sys.executable, __file__, "--write", kind, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        if not process.stdout or process.stdout.readline() != b"begun\n":
            raise AssertionError("the writer did not begin")
        time.sleep(after_s)
        process.send_signal(signal.SIGKILL)
    if process.returncode != -signal.SIGKILL:
        raise AssertionError(f"the writer ended with {process.returncode}")


def main(share: float) -> None:
    """Kills, looks, lets the next one write, and looks again."""
    rng, lines = random.Random(5), []
    for kind, (write, numbers) in KINDS.items():
        kills, found = round(share * KILLS[kind]), Counter[str]()
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            for _ in range(kills):
                killed(kind, folder, rng.uniform(0.0, MOST_S[kind]))
                hidden = [path.name for path in folder.iterdir() if path.name.startswith(".")]
                found["in a switch"] += ".visioncal-switch" in hidden
                found["leftovers"] += bool(hidden)
                found["mixed"] += len(numbers(folder)) != 1
                write(folder, 0)
                found["left after the next"] += sorted(FILES) != sorted(
                    path.name for path in folder.iterdir() if not path.is_symlink()
                )
        columns = ("in a switch", "leftovers", "mixed", "left after the next")
        lines.append(
            f"| {kind} | {kills} | {' | '.join(str(found[column]) for column in columns)} |"
        )
        print(lines[-1])
    if share == 1.0:
        table = [
            "| files | kills | within a switch | with something left aside | mixed generations | "
            "leftovers after the next run |",
            "| --- | ---: | ---: | ---: | ---: | ---: |",
            *lines,
        ]
        write_section(
            "Killed while an output folder is written",
            "PYTHONPATH=tests python tests/benchmarks/killed_writes.py",
            "\n".join(table),
        )


if __name__ == "__main__":
    if "--write" in sys.argv:
        _, _, wanted, where = sys.argv
        for generation in count(1):
            KINDS[wanted][0](Path(where), generation)
            if generation == 1:
                print("begun", flush=True)
    else:
        main(0.1 if "--quick" in sys.argv else 1.0)
