"""Time of a whole calibration against detection alone with OpenCV, and against its own whole.

Both sides work on the same 40 five-megapixel images with the same number of threads, one after the
other in turns. The peer reads each file and calls OpenCV's ChArUco detector. visioncal is the
command with report and recording, started anew; and its API without outputs in a warm process.
OpenCV's own whole reads, detects, and calibrates lens and hand-eye in a program that starts anew.
Processor time counts all threads, and other programs on the machine move it less than wall time.

    PYTHONPATH=tests python tests/benchmarks/calibrate.py [REPEATS] [--quick]
"""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from results import few, wished, write_section

import visioncal
from visioncal.simulation import CAMERAS, CellOptions, SimulatedCell, simulate, write_session
from visioncal.vision.boards.charuco import charuco_board

VIEWS = few(40, 5)
# As many as are wished on the command line.
REPEATS = wished(3)
THREADS = [name for name in (1, 2, 4) if name <= (os.cpu_count() or 1)]
PEER = Path(__file__).with_name("opencv_whole.py")
COMMAND = [sys.executable, "-m", "visioncal"]


def opencv_alone(files: list[Path], board: cv2.aruco.CharucoBoard, threads: int) -> int:
    """Detects in all files with OpenCV and nothing else; returns the number of corners."""

    def corners(file: Path) -> int:
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        ids = cv2.aruco.CharucoDetector(board).detectBoard(image)[1]
        return 0 if ids is None else len(ids)

    cv2.setNumThreads(1)
    with ThreadPoolExecutor(threads) as pool:
        return sum(pool.map(corners, files))


def corners_of(simulated: SimulatedCell, folder: Path) -> Path:
    """Writes a session of corners without images."""
    session = write_session(simulated, folder)
    shutil.rmtree(session / "images")
    table = (session / "views.csv").read_text(encoding="utf-8").splitlines()
    rows = (line.split(",") for line in table)
    text = "\n".join(",".join([first, image if first == "view" else "", *others])
                     for first, image, *others in rows)  # fmt: skip
    (session / "views.csv").write_text(text, encoding="utf-8")
    lines = ["view,point,u_px,v_px"]
    for at in simulated.corners:
        lines += [f"{at.view},{point},{u},{v}" for point, (u, v) in zip(at.ids, at.px, strict=True)]
    (session / "corners.csv").write_text("\n".join(lines), encoding="utf-8")
    return session


def wholes(folder: Path) -> list[list[str]]:
    """Rows of the whole command beside OpenCV's whole, and of corners alone without outputs."""
    rows = []
    kinds = {"1280 x 800, png": ("wide", None, VIEWS), "2448 x 2048, jpg": ("fine", 95, VIEWS)}
    for name, (camera, quality, views) in kinds.items():
        options = CellOptions(views=views, camera=CAMERAS[camera], jpeg_quality=quality, seed=1)
        session = write_session(simulate(options), folder / camera)
        ours = [*COMMAND, "calibrate", str(session), "-o", str(folder / "out")]
        peer = [sys.executable, str(PEER), str(session)]
        times = medians(partial(of_program, ours), partial(of_program, peer))[:, 1]
        rows.append([name, *(f"{one:.2f}" for one in (*times, times[0] / times[1]))])
    options = CellOptions(views=22, seed=2)
    session = corners_of(simulate(options), folder / "corners")
    ours = [*COMMAND, "calibrate", str(session), "-o", str(folder / "out"), "--no-report"]
    time_s = medians(partial(of_program, [*ours, "--no-recording"]))[0, 1]
    return [*rows, ["22 views of corners, no outputs", f"{time_s:.2f}", "", ""]]


def seconds(work: Callable[[], object]) -> np.ndarray:
    """Wall and processor time of one call, (2,)."""
    start = time.perf_counter(), time.process_time()
    work()
    return np.subtract((time.perf_counter(), time.process_time()), start)


def of_program(command: list[str]) -> np.ndarray:
    """Wall and processor time of a program, (2,)."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - start
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return np.array([wall, used])


def medians(*works: Callable[[], np.ndarray]) -> np.ndarray:
    """The medians of each over interleaved repetitions, after one that is not counted, (n, 2)."""
    warm = few(1, 0)
    rounds = [[work() for work in works] for _ in range(REPEATS + warm)][warm:]
    return np.median(rounds, axis=0)


def rows_of(ending: str, quality: int | None, level: str, folder: Path) -> list[list[str]]:
    """The rows of one kind of session, by the number of threads."""
    options = CellOptions(
        views=VIEWS, camera=CAMERAS["fine"], jpeg_quality=quality, cut_views=0.0, seed=1
    )
    if level == "arm":
        options = replace(options, dh_sigma_m=3e-4, dh_sigma_rad=3e-4, branches=True)
    session = write_session(simulate(options), folder / f"{ending}_{level}")
    files, board = sorted((session / "images").iterdir()), charuco_board(options.target)
    requested = "hand-eye" if level == "hand-eye" else "auto"
    rows = []
    for threads in few(THREADS, THREADS[:1]):
        command = [*COMMAND, "calibrate", str(session), "-o", str(folder / "out")]
        command += ["--threads", str(threads), "--level", requested]
        times = medians(
            lambda command=command: of_program(command),
            lambda threads=threads: seconds(
                lambda: visioncal.calibrate(session, level=requested, threads=threads)
            ),
            lambda threads=threads: seconds(lambda: opencv_alone(files, board, threads)),
        )
        ratios = times[:2] / times[2]
        rows.append([ending, level, str(threads), *(f"{number:.2f}" for number in times[:, 1]),
                     *(f"{ratio:.2f}" for ratio in ratios[:, 1]),
                     *(f"{ratio:.2f}" for ratio in ratios[:, 0])])  # fmt: skip
    return rows


def main() -> None:
    """Prints the tables and keeps them."""
    kinds = [
        (*pair, level) for pair in (("png", None), ("jpg", 95)) for level in ("hand-eye", "arm")
    ]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = [row for kind in few(kinds, kinds[:1]) for row in rows_of(*kind, folder)]
        text = (
            f"{VIEWS} views of 2448 x 2048 of a 9 x 6 ChArUco board, median of {REPEATS} "
            "interleaved runs, processor time of all threads together. The command includes "
            "process start, report and recording; the API is warm and writes nothing; "
            "OpenCV only reads and detects. "
            f"Load average meanwhile: {os.getloadavg()[2]:.0f} on {os.cpu_count()} cores."
        )
        head = ["files", "level", "threads", "command [s]", "API [s]", "OpenCV detection [s]",
                "command / OpenCV", "API / OpenCV", "command / OpenCV, wall",
                "API / OpenCV, wall"]  # fmt: skip
        heads = ["whole", "command [s]", "OpenCV's whole [s]", "ratio"]
        table = [heads, ["---"] * len(heads), *wholes(folder)]
        text += "\n\n" + "".join("| " + " | ".join(row) + " |\n" for row in table)
        lines = ("| " + " | ".join(row) + " |\n" for row in (head, ["---"] * len(head), *rows))
        text += "\n\n" + "".join(lines)
    print(text)
    write_section(
        "A whole calibration", "PYTHONPATH=tests python tests/benchmarks/calibrate.py", text
    )


if __name__ == "__main__":
    main()
