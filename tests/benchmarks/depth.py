"""Depth by simulation: its model in its own sigmas, picks by it, and the time of a cloud.

Sensors that are 0.8 % too long with an offset of -2.5 mm, a bowl of 4 mm and ink 2 mm deeper, half
of them with a box before the board in half of the views, and sensors that are true; cameras on the
flange and beside.

    PYTHONPATH=tests python tests/benchmarks/depth.py
"""

import time

import numpy as np
from results import few, write_section
from support.depth_cells import TRUE, calibrated, deviations, picks

from visioncal.frames.locate import cloud_in_base
from visioncal.session.depth import ply_of, read_cloud
from visioncal.simulation import DepthOptions

SEEDS = few(20, 1)


def main() -> None:
    """Writes the section."""
    rows = []
    for mount in ("eye-in-hand", "eye-to-hand"):
        away, squares, accused, placed = [], [], 0, []
        for seed in range(SEEDS):
            false = DepthOptions(boxed=0.5 * (seed % 2))
            cell, _, result = calibrated(seed, mount, false)
            placed.append(picks(cell, result, false, np.random.default_rng(seed), 100))
            row, squared = deviations(result, false)
            away.append(row)
            squares.append(squared)
            _, _, result = calibrated(seed, mount, TRUE)
            kinds = [finding.kind for finding in result.calibration.verdict.findings]
            accused += "depth_scale" in kinds
            print(mount, seed, np.round(row, 2), f"{squared:.2f}", kinds, flush=True)
        within = np.sum(np.abs(away) < 2.0, axis=0)[[0, 1, 4]]
        error, raw, radius = np.concatenate(placed).T
        rms, before = (1e3 * np.sqrt(np.mean(at**2)) for at in (error, raw))
        rows.append(
            (
                mount,
                *(f"{count} of {SEEDS}" for count in within),
                f"{np.mean(squares):.2f}",
                f"{accused} of {SEEDS}",
                f"{100 * np.mean(error < radius):.1f}",
                f"{rms:.2f}",
                f"{before:.2f}",
            )
        )
    rng, fixed = np.random.default_rng(0), calibrated(0, "eye-to-hand", TRUE)[2].calibration
    stored = ply_of(rng.uniform([-0.4, -0.3, 0.6], [0.4, 0.3, 1.0], (1_000_000, 3)))
    start = time.process_time()
    ply_of(cloud_in_base(fixed, read_cloud(stored, "c.ply")))
    seconds = time.process_time() - start
    titles = (
        *("camera", "scale within 2 sigma", "offset", "bowl", "squared error over covariance"),
        *("true depth accused", "picks within radius95 [%]", "rms [mm]", "uncorrected [mm]"),
    )
    table = "\n".join("| " + " | ".join(cells) + " |" for cells in (titles, ("---",) * 9, *rows))
    write_section(
        "Depth",
        "PYTHONPATH=tests python tests/benchmarks/depth.py",
        f"{SEEDS} sensors each, of 15 views of 640 x 400, and 100 picks each at 0.3 to 1.2 m. A "
        f"cloud of a million points is read, placed in the base and written in {seconds:.2f} s of "
        f"processor time.\n\n{table}",
    )
    print(table)


if __name__ == "__main__":
    main()
