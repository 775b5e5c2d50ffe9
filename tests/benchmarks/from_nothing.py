"""From a fresh virtual environment to a report, and what doctor takes of large images.

The commands are those of the front page, typed for a folder of pictures and a table of poses in
millimetres, whose unit nobody said; what the refusal prints is typed next.

    PYTHONPATH=tests python tests/benchmarks/from_nothing.py [--quick]
"""

import csv
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from results import QUICK, few, write_section
from scipy.spatial.transform import Rotation

import visioncal
from visioncal.simulation import CellOptions, simulate, write_session
from visioncal.simulation.layout import fine_camera

_COMMAND = "PYTHONPATH=tests python tests/benchmarks/from_nothing.py"
_ROOT = Path(__file__).parents[2]
_CONVERT = "visioncal convert log.csv my-session --images pictures"
_TYPED = (
    "python3 -m venv venv && . venv/bin/activate",
    f"pip install --quiet {_ROOT}",
    f"{_CONVERT} --target charuco_9x6_30mm --mount eye-in-hand",
    "visioncal calibrate my-session -o out",
)


def _stripped(place: Path) -> None:
    """Leaves of a simulated session what a user has: pictures, and a table of poses."""
    session = write_session(simulate(replace(CellOptions(), views=15, seed=3)), place / "session")
    shutil.copytree(session / "images", place / "pictures")
    with (session / "views.csv").open() as source, (place / "log.csv").open("w") as table:
        writer = csv.writer(table)
        writer.writerow(["file", "X", "Y", "Z", "RX", "RY", "RZ"])
        for row in csv.DictReader(source):
            turn = Rotation.from_quat([float(row[name]) for name in ("qx", "qy", "qz", "qw")])
            mm = [f"{1e3 * float(row[name]):.2f}" for name in ("x_m", "y_m", "z_m")]
            vector = [f"{value:.4f}" for value in turn.as_rotvec()]
            writer.writerow([Path(row["image"]).name, *mm, *vector])
    shutil.rmtree(session)


def _walked(place: Path) -> list[str]:
    """Types the commands in one shell's environment, and those that are printed: rows of times."""
    outside = {key: name for key, name in os.environ.items() if key != "PYTHONPATH"}
    environment = outside | {"PATH": f"{place / 'venv/bin'}:{os.environ['PATH']}"}
    rows, todo = [], [*_TYPED]
    while todo:
        line = todo.pop(0)
        begun = time.perf_counter()
        done = subprocess.run(
            ["bash", "-c", line],
            check=False,
            cwd=place,
            env=environment,
            capture_output=True,
            text=True,
        )
        seconds = time.perf_counter() - begun
        shown = line.replace(str(_ROOT), ".")
        rows.append(f"| `{shown}` | {done.returncode} | {seconds:.0f} |")
        print(rows[-1], flush=True)
        if not todo and (said := re.search(r"visioncal convert .* && .*", done.stderr)):
            todo = said[0].split(" && ")
    return rows


def _doctored(place: Path) -> str:
    views, camera = few((40, fine_camera()), (8, CellOptions().camera))
    cell = replace(CellOptions(), views=views, seed=7, camera=camera)
    session = write_session(simulate(cell), place / "large")
    before = time.perf_counter(), time.process_time(), time.thread_time()
    found = visioncal.doctor(session)
    after = time.perf_counter(), time.process_time(), time.thread_time()
    wall, used, alone = (b - a for a, b in zip(before, after, strict=True))
    width, height = camera.resolution
    return (
        f"`doctor` on {views} images of {width} x {height} px takes {used:.1f} s of processor "
        f"time: {used - alone:.1f} s on one thread a core, {alone:.1f} s on one alone, "
        f"{(used - alone) / 4 + alone:.1f} s in all where four cores are free. By the clock it was "
        f"{wall:.1f} s, at a load average of {os.getloadavg()[0]:.0f} on four cores "
        f"({len(found.findings)} findings)."
    )


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        _stripped(place)
        rows = [] if QUICK else _walked(place)
        doctored = _doctored(place)
        print(doctored)
        if not QUICK and not (place / "out/report.html").is_file():
            sys.exit("There is no report.")
    load = f"{os.getloadavg()[0]:.0f}"
    text = [
        f"From your own pictures and a table to a report in {len(rows)} commands; the refusal of "
        f"the fourth prints the last two (load average {load}, on 4 cores):",
        "",
        "| typed | exit status | s |",
        "| --- | ---: | ---: |",
        *rows,
        "",
        doctored,
    ]
    write_section("From nothing to a report", _COMMAND, "\n".join(text))


if __name__ == "__main__":
    main()
