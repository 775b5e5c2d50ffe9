"""Picks: how often the stated 95 % region holds the true point, and how near the place is.

Simulated cells are calibrated from their corners on (no images are rendered), and each then looks
at points whose true place is known: with new noise of the robot's pose at the stop and of the
pixels, by a declared plane and by a target. Nothing is told the noise.

    PYTHONPATH=tests python tests/benchmarks/locate.py [CELLS]
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing import Pool

import numpy as np
from results import first, wished, write_section
from support.picks import Pick, calibration_of, pick_by_plane, pick_by_target

from visioncal.core.errors import VisioncalError
from visioncal.core.types import Target
from visioncal.simulation import BOARDS, CellOptions, fine_camera, simulate, wide_camera

CELLS = 200
# Picks of one cell share its calibration; five keep their mean nearly as good as five cells'.
PICKS = 5
IN_HAND, TO_HAND = "eye-in-hand", "eye-to-hand"
GOOD, COARSE = (3e-5, 5e-5), (3e-4, 5e-4)
# Known to 0.02 %: at the 0.1 % of office printers, nothing else of the chain would show.
BOARD = replace(BOARDS["charuco"], square_sigma_m=6e-6)
MARKER = Target("marker", "marker", 1, 1, 0.06, 1.2e-5, dictionary="DICT_5X5_100", marker_id=3)


@dataclass(frozen=True)
class World:
    """One row of the tables."""

    words: str
    options: CellOptions


def world(words: str, camera, pixel_px: float, robot, given: bool, mount, **more) -> World:
    return World(
        words,
        CellOptions(
            mount=mount,
            camera=camera,
            state_intrinsics=given,
            robot_sigma_m=robot[0],
            robot_sigma_rad=robot[1],
            pixel_sigma_px=pixel_px,
            **more,
        ),
    )


WORLDS = (
    world("5 MP, good robot, lens given, in hand", fine_camera(), 0.1, GOOD, True, IN_HAND),
    world("1.0 MP, good robot, lens estimated, in hand", wide_camera(), 0.1, GOOD, False, IN_HAND),
    world("1.0 MP, coarse robot, lens estimated, in hand", wide_camera(), 0.1, COARSE, False,
          IN_HAND),
    world("1.0 MP, coarse robot, lens given, in hand, 8 views", wide_camera(), 0.1, COARSE, True,
          IN_HAND, views=8),
    world("1.0 MP, good robot, lens given, to hand", wide_camera(), 0.1, GOOD, True, TO_HAND),
    world("1.0 MP, coarse robot, lens estimated, to hand", wide_camera(), 0.2, COARSE, False,
          TO_HAND),
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """One pick: whether region and ball hold the true point, and its error [mm]."""

    in_region: bool
    in_ball: bool
    error_mm: float
    radius95_mm: float
    taken_s: float


def outcome(pick: Pick, taken_s: float) -> Outcome:
    error_mm = 1e3 * float(np.linalg.norm(pick.truth - pick.located.p_base))
    radius = pick.located.radius95_mm
    return Outcome(pick.located.holds(pick.truth), error_mm <= radius, error_mm, radius, taken_s)


def of_one_cell(task: tuple[World, int]) -> dict[str, list[Outcome]] | None:
    """Calibrates one cell and picks with it; None where its session is refused."""
    row, seed = task
    rng = np.random.default_rng([seed, 99])
    board = row.options.target
    # The board of the calibration, too, differs from its description by what that is known to.
    scale = 1.0 + board.square_sigma_m / board.square_m * float(rng.standard_normal())
    cell = simulate(replace(row.options, seed=seed, board_scale=scale))
    try:
        calibration = calibration_of(cell)
    except VisioncalError:
        return None
    ways = {
        "plane": lambda: pick_by_plane(cell, calibration, rng),
        "board": lambda: pick_by_target(cell, calibration, BOARD, rng),
        "marker": lambda: pick_by_target(cell, calibration, MARKER, rng),
    }
    found: dict[str, list[Outcome]] = {name: [] for name in ways}
    for name, way in ways.items():
        for _ in range(PICKS):
            pick = way()
            found[name].append(outcome(pick, pick.taken_s))
    return found


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in lines)


def main(cells: int) -> None:
    """Prints the table and keeps it."""
    head = ("world", "by", "picks", "held by the region", "by the ball", "error [mm]",
            "ball's radius [mm]", "a call takes [ms]", "cells refused")  # fmt: skip
    rows, everything = [], []
    with Pool() as pool:
        for row in first(WORLDS):
            kept = pool.map(of_one_cell, [(row, seed) for seed in range(cells)], chunksize=2)
            found = [mapping for mapping in kept if mapping is not None]
            for way in ("plane", "board", "marker"):
                picks = [item for cell in found for item in cell[way]]
                everything += picks
                rows.append((row.words, way, str(len(picks)), *figures(picks),
                             str(len(kept) - len(found))))  # fmt: skip
    share = 100 * np.mean([item.in_region for item in everything])
    text = f"""Simulated UR10e cells of 20 views and {PICKS} picks each, at a new stop, with new
noise of robot and pixels. A good robot has noise of 0.03 mm and 0.05 mrad per stop, a coarse one of
0.3 mm and 0.5 mrad. Planes are tilted by about 30 degrees against the viewing direction, and half
of them are known to 0.2 mm only; targets are a 9 x 6 ChArUco board of 30 mm squares and a marker of
60 mm, both printed to 0.02 % of their size; the calibration's board has a stated sigma of 0.1 % and
a true scale error of that size. The region is the 95 % ellipsoid, the ball is that of
`radius95_mm`; errors, radii and times are medians.

{table(head, rows)}

Of all {len(everything)} picks, the region contains {share:.1f} %.
"""
    print(text)
    write_section("Picks", "PYTHONPATH=tests python tests/benchmarks/locate.py", text)


def figures(picks: Sequence[Outcome]) -> tuple[str, ...]:
    return (
        f"{100 * np.mean([pick.in_region for pick in picks]):.1f} %",
        f"{100 * np.mean([pick.in_ball for pick in picks]):.1f} %",
        f"{np.median([pick.error_mm for pick in picks]):.2f}",
        f"{np.median([pick.radius95_mm for pick in picks]):.2f}",
        f"{1e3 * np.median([pick.taken_s for pick in picks]):.1f}",
    )


if __name__ == "__main__":
    started = time.perf_counter()
    main(wished(CELLS))
    print(f"{time.perf_counter() - started:.0f} s")
