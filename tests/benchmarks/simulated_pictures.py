"""What the printed boards that `simulate` renders give, kind by kind and in both mounts.

Every session is made and calibrated by the commands, from its images, as a new user would.

    PYTHONPATH=tests python tests/benchmarks/simulated_pictures.py [SEEDS]
"""

import json
import tempfile
from collections import Counter
from itertools import product
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from results import few, wished, write_section
from support.commands import visioncal as run

from visioncal.core.transforms import invert, log

SEEDS, WORKERS = wished(20), 2
BOARDS = few(
    ("charuco", "checkerboard", "aprilgrid", "circles", "symmetric-circles", "tags"), ("charuco",)
)
MOUNTS = few(("eye-in-hand", "eye-to-hand"), ("eye-in-hand",))
VIEWS = few("20", "8")


def calibrated(task: tuple[str, str, int]) -> tuple[str, list[tuple[float, float]]]:
    """The verdict of one session; of each transform NEES per degree of freedom and error [mm]."""
    board, mount, seed = task
    with tempfile.TemporaryDirectory() as folder:
        session, out = Path(folder) / "s", str(Path(folder) / "out")
        options = ("--board", board, "--mount", mount, "--seed", str(seed), "--views", VIEWS)
        for words in (
            ("simulate", str(session), *options),
            ("calibrate", str(session), "-o", out, "--no-report", "--no-recording"),
        ):
            # A bad result, status 3, is one of those that are counted.
            if (ended := run(*words)).status not in (0, 3):
                raise RuntimeError(f"visioncal {' '.join(words)}: {ended.said}")
        result = json.loads((Path(out) / "calibration.json").read_text(encoding="utf-8"))
        truth = json.loads(session.with_name("s.truth.json").read_text(encoding="utf-8"))
    found = []
    for name, edge in result["transforms"].items():
        error = log(invert(np.array(edge["matrix"])) @ np.array(truth["transforms"][name]))
        nees = error @ np.linalg.solve(np.array(edge["covariance"]), error) / 6
        found.append((float(nees), 1e3 * float(np.linalg.norm(error[3:]))))
    return result["verdict"]["status"], found


def main() -> None:
    """Prints the table and keeps it."""
    lines = [
        "| board | mount | camera: NEES, mm | board: NEES, mm | verdicts |",
        "| --- | --- | ---: | ---: | --- |",
    ]
    with Pool(WORKERS) as pool:
        for board, mount in product(BOARDS, MOUNTS):
            tasks = [(board, mount, seed) for seed in range(1, SEEDS + 1)]
            verdicts, found = zip(*pool.imap(calibrated, tasks), strict=True)
            cells = [
                f"{np.mean(nees):.2f}, {np.sqrt(np.mean(np.square(mm))):.3f}"
                for nees, mm in np.transpose(found, (1, 2, 0))
            ]
            words = ", ".join(f"{count} {key}" for key, count in Counter(verdicts).items())
            lines.append(f"| {board} | {mount} | {' | '.join(cells)} | {words} |")
            print(lines[-1], flush=True)
    text = (
        f"{SEEDS} sessions a row, as `simulate` makes them. NEES is the mean of squared error over "
        "covariance, per degree of freedom: one is expected; mm are rms of the error's "
        "translation.\n\n" + "\n".join(lines)
    )
    command = "PYTHONPATH=tests python tests/benchmarks/simulated_pictures.py"
    write_section("Simulated pictures", command, text)


if __name__ == "__main__":
    main()
