"""Speed of a whole calibration against detection alone with OpenCV, on the same files.

Both sides read the same 40 five-megapixel images in one warm process on the same number of
threads. The peer reads each file and calls OpenCV's ChArUco detector; visioncal does the whole
way from `Session.load` to a validated result, without report and recording.

    python tests/benchmarks/calibrate.py
"""

import os
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
from results import few, first, write_section

import visioncal
from visioncal.simulation import CellOptions, fine_camera, simulate, write_session
from visioncal.vision.targets import charuco_board

VIEWS, REPEATS = few((40, 5), (6, 1))
THREADS = os.cpu_count() or 1


def opencv_alone(files: list[Path], board: cv2.aruco.CharucoBoard) -> int:
    """Detects in all files with OpenCV and nothing else; returns the number of corners."""

    def corners(file: Path) -> int:
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        ids = cv2.aruco.CharucoDetector(board).detectBoard(image)[1]
        return 0 if ids is None else len(ids)

    cv2.setNumThreads(1)
    with ThreadPoolExecutor(THREADS) as pool:
        return sum(pool.map(corners, files))


def seconds(work: Callable[[], object]) -> float:
    """Times one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def measured(ending: str, jpeg_quality: int | None, *, given: bool) -> list[str]:
    """One row of the table: medians over interleaved repetitions."""
    options = CellOptions(
        views=VIEWS,
        camera=fine_camera(),
        jpeg_quality=jpeg_quality,
        state_intrinsics=given,
        cut_views=0.0,
        seed=1,
    )
    with tempfile.TemporaryDirectory() as name:
        folder = write_session(simulate(options), Path(name) / "session")
        files = sorted((folder / "images").iterdir())
        board = charuco_board(options.target)

        def ours() -> object:
            return visioncal.calibrate(visioncal.Session.load(folder))

        def theirs() -> object:
            return opencv_alone(files, board)

        ours(), theirs()
        pairs = [(seconds(ours), seconds(theirs)) for _ in range(REPEATS)]
    mine, other = (statistics.median(column) for column in zip(*pairs, strict=True))
    lens = "given" if given else "estimated"
    return [ending, lens, f"{mine:.2f}", f"{other:.2f}", f"{mine / other:.2f}"]


def main() -> None:
    """Prints the table and keeps it."""
    kinds = [(*it, given) for it in (("png", None), ("jpg", 95)) for given in (True, False)]
    rows = [measured(ending, quality, given=given) for ending, quality, given in first(kinds)]
    head = ["files", "intrinsics", "visioncal [s]", "OpenCV detection [s]", "ratio"]
    lines = [head, ["---"] * len(head), *rows]
    table = "\n".join("| " + " | ".join(row) + " |" for row in lines)
    text = (
        f"{VIEWS} views of 2448 x 2048 of a 9 x 6 ChArUco board, {THREADS} threads on both sides, "
        f"median of {REPEATS} interleaved runs. visioncal: load, detect, intrinsics, poses, eight "
        "hand-eye solvers, validation, verdict. OpenCV: read and detect, no more. The aim is a "
        f"ratio of 1.3 at most.\n\n{table}\n"
    )
    print(text)
    write_section("A whole calibration", "python tests/benchmarks/calibrate.py", text)


if __name__ == "__main__":
    main()
