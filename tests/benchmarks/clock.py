"""The offset between two clocks: how near it comes, and whether its sigma says so.

Simulated robots sweep through a few postures before a board (no images are rendered: the camera's
poses have the noise of a PnP). The camera takes 30 frames a second, the controller tells its poses
125 times, and their clocks differ by up to a second.

    PYTHONPATH=tests python tests/benchmarks/clock.py [SWEEPS]
"""

import time
from dataclasses import dataclass, replace
from multiprocessing import Pool

import numpy as np
from results import few, wished, write_section

from visioncal.calibration.pipeline import calibrate
from visioncal.core.errors import VisioncalError
from visioncal.core.transforms import invert, log
from visioncal.simulation import CellOptions, SweepOptions, cell_session, sweep

SWEEPS = 20


@dataclass(frozen=True)
class World:
    """One row of the table."""

    words: str
    cell: CellOptions
    how: SweepOptions


GOOD = CellOptions(pixel_sigma_px=0.1)
COARSE = replace(GOOD, robot_sigma_m=3e-4, robot_sigma_rad=5e-4, pixel_sigma_px=0.3)
WORLDS = (
    World("20 s, in hand", GOOD, SweepOptions()),
    World("20 s, to hand", replace(GOOD, mount="eye-to-hand"), SweepOptions()),
    World("20 s, coarse robot, 0.3 px", COARSE, SweepOptions()),
    World("20 s, real arm (0.3 mm, 0.3 mrad)", replace(GOOD, dh_sigma_m=3e-4, dh_sigma_rad=3e-4),
          SweepOptions()),
    World("20 s, stamps jitter by 3 ms", GOOD, SweepOptions(jitter_s=3e-3)),
    World("7 s", GOOD, SweepOptions(stops=5)),
    World("20 s, robot at 50 Hz", GOOD, SweepOptions(robot_hz=50.0)),
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """One sweep: the offset's error and sigma [s], and those of the camera's transform [mm]."""

    error_s: float
    sigma_s: float
    away_mm: float
    mahalanobis_sq: float


def of_one_sweep(task: tuple[World, int]) -> Outcome | None:
    """Sweeps and calibrates; None where that is refused."""
    world, seed = task
    ahead_s = float(np.random.default_rng([seed, 77]).uniform(-1.0, 1.0))
    how = replace(world.how, camera_minus_robot_s=ahead_s)
    moved = sweep(replace(world.cell, seed=seed), how)
    try:
        result = calibrate(cell_session(moved, "sweep", seen="poses"))
    except VisioncalError:
        return None
    clock, name = result.clock, next(iter(moved.transforms))
    edge = result.edges[name]
    error = log(invert(moved.transforms[name]) @ edge.matrix)
    return Outcome(
        clock.camera_minus_robot_s - ahead_s,
        clock.sigma_s,
        1e3 * float(np.linalg.norm(error[3:])),
        float(error @ np.linalg.solve(edge.covariance, error)),
    )


def row(world: World, found: list[Outcome | None]) -> str:
    kept = [outcome for outcome in found if outcome is not None]
    errors_ms = 1e3 * np.array([outcome.error_s for outcome in kept])
    sigmas_ms = 1e3 * np.array([outcome.sigma_s for outcome in kept])
    over = float(np.sqrt(np.mean((errors_ms / sigmas_ms) ** 2)))
    cells = (
        world.words,
        f"{errors_ms.mean():+.3f}",
        f"{np.sqrt(np.mean(errors_ms**2)):.3f}",
        f"{np.abs(errors_ms).max():.3f}",
        f"{np.median(sigmas_ms):.3f}",
        f"{over:.2f}",
        f"{np.median([outcome.away_mm for outcome in kept]):.3f}",
        f"{np.mean([outcome.mahalanobis_sq for outcome in kept]) / 6:.2f}",
        str(len(found) - len(kept)),
    )
    return "| " + " | ".join(cells) + " |"


def main(sweeps: int) -> None:
    """Prints the table and keeps it."""
    rows = []
    with Pool() as pool:
        for world in few(WORLDS, [world for world in WORLDS if world.words == "7 s"]):
            tasks = [(world, seed) for seed in range(sweeps)]
            rows.append(row(world, pool.map(of_one_sweep, tasks, chunksize=1)))
            print(rows[-1], flush=True)
    head = ("sweep", "mean [ms]", "rms [ms]", "worst [ms]", "sigma [ms]", "rms over sigma",
            "camera's place [mm]", "chi2 / 6", "refused")  # fmt: skip
    table = "\n".join(["| " + " | ".join(head) + " |", "| --- " * len(head) + "|", *rows])
    text = f"""Simulated UR10e cells, {sweeps} sweeps a row: 12 postures, 1.7 s from one to the
next (5 postures in 7 s), without stopping; 30 frames a second whose poses have the noise of
corners of 0.1 px, and the robot's poses at 125 Hz. The clocks differ by up to a second, at random
in each sweep. Errors are of `clock.camera_minus_robot_s` against the truth; its sigma is a median.
The camera's position error is a median, and chi2 / 6 is 1 if the covariance of its transform is
right.

{table}
"""
    write_section("Two clocks", "PYTHONPATH=tests python tests/benchmarks/clock.py", text)


if __name__ == "__main__":
    started = time.perf_counter()
    main(wished(SWEEPS))
    print(f"{time.perf_counter() - started:.0f} s")
