"""Rolling shutters: how near the readout comes, and what it costs to ignore it.

Simulated robots sweep through a few postures before a board while a camera takes 30 frames a
second, every corner projected at the time of its row by finite motion (no images are rendered).

    PYTHONPATH=tests python tests/benchmarks/shutter.py [SWEEPS]
"""

from dataclasses import dataclass, replace
from multiprocessing import Pool

import numpy as np
from results import few, first, wished, write_section
from support.cells import calibrated_sweep

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages import clock_sweep
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.simulation import CellOptions, SimulatedCell, SweepOptions, sweep

SWEEPS = 20
# So many of them are calibrated without a look at the rows, too: that takes much longer.
IGNORED = 5


@dataclass(frozen=True)
class World:
    """One row of the table."""

    words: str
    cell: CellOptions
    readout_s: float


GOOD = CellOptions(pixel_sigma_px=0.1)
HAND = replace(GOOD, mount="eye-to-hand")
# An arm that is not as its model has it, and a lens that is stated half a pixel off.
OFF = replace(GOOD, dh_sigma_m=3e-4, dh_sigma_rad=3e-4, lens_mismatch_px=0.5)
WORLDS = (
    World("12.4 ms, in hand", GOOD, 0.0124),
    World("12.4 ms, to hand", HAND, 0.0124),
    World("30 ms, in hand", GOOD, 0.030),
    World("12.4 ms, real arm, lens 0.5 px off", OFF, 0.0124),
    World("global, in hand", GOOD, 0.0),
    World("global, real arm, lens 0.5 px off", OFF, 0.0),
)


@dataclass(frozen=True)
class Outcome:
    """One sweep: the readout's error and sigma [s], and the camera's place.

    `away_mm` is how far it is off, `ignoring_mm` where the readout is ignored, both beside the
    sigma that it has where it is not; `mahalanobis_sq` the squared error in units of its
    covariance.
    """

    error_s: float
    sigma_s: float
    is_found: bool
    away_mm: float
    sigma_mm: float
    ignoring_mm: float
    mahalanobis_sq: float


def of_one_sweep(task: tuple[World, int]) -> Outcome:
    """Sweeps, calibrates, and calibrates once more without a look at the rows."""
    world, seed = task
    how = SweepOptions(stops=8, readout_s=world.readout_s, camera_minus_robot_s=0.037)
    moved = sweep(replace(world.cell, seed=seed), how)
    known = calibrated_sweep(moved)
    (found,) = next(iter(known.clocks.values())).clock.delays
    error, covariance = x_error(moved, known), known.assessment.covariance[:6, :6]
    ignoring = np.full(6, np.nan)
    if seed < IGNORED:
        look, clock_sweep.find_delays = clock_sweep.find_delays, lambda *_: (None, ())
        ignoring = x_error(moved, calibrated_sweep(moved))
        clock_sweep.find_delays = look
    return Outcome(
        found.time_s - world.readout_s,
        found.sigma_s,
        found.is_clear,
        1e3 * float(np.linalg.norm(error[3:])),
        1e3 * float(np.sqrt(np.trace(covariance[3:, 3:]))),
        1e3 * float(np.linalg.norm(ignoring[3:])),
        float(error @ np.linalg.solve(covariance, error)) / 6.0,
    )


def x_error(moved: SimulatedCell, known: RunState) -> FloatArray:
    """(6,) right perturbation of the camera's edge, true to estimated."""
    return log(invert(next(iter(moved.transforms.values()))) @ known.assessment.state.edges[0])


def row(world: World, found: list[Outcome]) -> str:
    errors_ms = 1e3 * np.array([outcome.error_s for outcome in found])
    sigmas_ms = 1e3 * np.array([outcome.sigma_s for outcome in found])
    cells = (
        world.words,
        f"{sum(outcome.is_found for outcome in found)} of {len(found)}",
        f"{errors_ms.mean():+.3f}",
        f"{np.abs(errors_ms).max():.3f}",
        f"{np.median(sigmas_ms):.3f}",
        f"{np.sqrt(np.mean((errors_ms / sigmas_ms) ** 2)):.2f}",
        f"{np.median([outcome.away_mm for outcome in found]):.3f}",
        f"{np.median([outcome.sigma_mm for outcome in found]):.3f}",
        f"{np.mean([outcome.mahalanobis_sq for outcome in found]):.2f}",
        f"{np.nanmedian([outcome.ignoring_mm for outcome in found]):.3f}",
        f"{np.nanmedian([outcome.ignoring_mm / outcome.sigma_mm for outcome in found]):.1f}",
    )
    return "| " + " | ".join(cells) + " |"


def main(sweeps: int) -> None:
    """Prints the table and keeps it."""
    rows = []
    with Pool(few(2, 1)) as pool:
        for world in first(WORLDS):
            tasks = [(world, seed) for seed in range(sweeps)]
            rows.append(row(world, pool.map(of_one_sweep, tasks, chunksize=1)))
            print(rows[-1], flush=True)
    head = ("sweep", "found", "mean [ms]", "worst [ms]", "sigma [ms]", "rms over sigma",
            "camera's place [mm]", "its sigma [mm]", "chi2 / 6", "ignored [mm]",
            "in sigmas")  # fmt: skip
    table = "\n".join(["| " + " | ".join(head) + " |", "| --- " * len(head) + "|", *rows])
    text = f"""Simulated UR10e cells, {sweeps} sweeps a row: 8 postures, 1.7 s from one to the next,
without stopping; 30 frames a second with corners of 0.1 px, each at the time of its row, and the
robot's poses at 125 Hz; the clocks are 37 ms apart. Errors are of `clock.shutter.readout_s` against
the truth; its sigma is a median. The camera's position error and its sigma are medians, and chi2
/ 6 is 1 if the covariance of its transform is right. The last two columns are the error if the row
times are ignored (in {IGNORED} sweeps), and that error in sigmas of the result with row times.

{table}
"""
    write_section("Rolling shutters", "PYTHONPATH=tests python tests/benchmarks/shutter.py", text)


if __name__ == "__main__":
    main(wished(SWEEPS))
