"""How often `visioncal diff` tells calibrations of one cell apart, with and without a change.

Each pair is one simulated cell of 40 views split in two, so that truth is shared and poses and
noise are not; corners are simulated, not rendered. Then the second half's camera is moved, which
moves its result alike.

    python tests/benchmarks/told_apart.py
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from results import few, first, write_section

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS), str(TESTS.parent)]

from support.pairs import calibrated_cell, halves, with_moved_result  # noqa: E402

from visioncal.core.types import FloatArray, Mount  # noqa: E402
from visioncal.results.compare import EdgeChange, compare  # noqa: E402
from visioncal.simulation import CellOptions, simulate  # noqa: E402

PAIRS, SIGMAS = few(200, 1), 5.0
MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
# Repeatability of the robot [mm and mrad].
NOISES = ((0.03, 0.05), (0.3, 0.5))


@dataclass(frozen=True)
class Outcome:
    """What one pair showed: whether unchanged halves differ, and which moves were found."""

    false_alarm: bool
    shift: bool
    worst_shift: bool
    turn: bool
    camera_alone: bool


def outcome(options: CellOptions) -> Outcome:
    """Compares the halves of one cell as they are, and with the camera of one moved."""
    first, second = halves(simulate(options))
    one, other = calibrated_cell(first), calibrated_cell(second)
    same = compare(one, other)
    shift, worst_shift, turn = (
        compare(one, with_moved_result(other, second, twist)).edges
        for twist in _moves(same.edges[0], options.seed)
    )
    return Outcome(
        same.is_change,
        shift[0].is_change,
        worst_shift[0].is_change,
        turn[0].is_change,
        shift[0].is_change and not shift[1].is_change,
    )


def _moves(edge: EdgeChange, seed: int) -> Iterator[FloatArray]:
    """Moves of five sigma: a shift to anywhere, one along the worst direction, and a turn."""
    anywhere = np.random.default_rng(seed).normal(size=3)
    anywhere /= np.linalg.norm(anywhere)
    worst = np.linalg.eigh(edge.covariance[3:, 3:])[1][:, -1]
    shift_m = 1e-3 * SIGMAS * edge.sigma_mm
    yield np.concatenate([np.zeros(3), shift_m * anywhere])
    yield np.concatenate([np.zeros(3), shift_m * worst])
    yield np.concatenate([np.deg2rad(SIGMAS * edge.sigma_deg) * anywhere, np.zeros(3)])


def measured(mount: Mount, noise: tuple[float, float], *, given: bool) -> list[str]:
    """One row of the table."""
    options = CellOptions(
        mount=mount,
        views=40,
        state_intrinsics=given,
        robot_sigma_m=1e-3 * noise[0],
        robot_sigma_rad=1e-3 * noise[1],
    )
    found = [outcome(replace(options, seed=seed)) for seed in range(PAIRS)]
    counts = [
        sum(getattr(item, name) for item in found)
        for name in ("false_alarm", "shift", "worst_shift", "turn", "camera_alone")
    ]
    lens = "given" if given else "estimated"
    return [mount, lens, f"{noise[0]:g}, {noise[1]:g}", *map(str, counts)]


def main() -> None:
    """Prints the table and keeps it."""
    rows = [
        measured(mount, noise, given=given)
        for mount, given, noise in first(tuple(product(MOUNTS, (True, False), NOISES)))
    ]
    head = ["mount", "intrinsics", "robot [mm, mrad]", "unchanged, but told apart"]
    head += ["shift found", "worst shift found", "turn found", "board left out of it"]
    lines = [head, ["---"] * 3 + ["---:"] * 5, *rows]
    table = "\n".join("| " + " | ".join(row) + " |" for row in lines)
    text = (
        f"Of {PAIRS} pairs of calibrations of 20 views, corner noise 0.05 px. At most 5 % of "
        "unchanged pairs may be reported as changed. Then the camera of the second "
        "calibration is moved: shifted by "
        f"{SIGMAS:g} times the `sigma_mm` of the difference (the root of its covariance's trace) "
        "in a random direction; by the same in the worst-determined direction; rotated by "
        f"{SIGMAS:g} times its `sigma_deg`. The last column counts random shifts that were "
        f"attributed to the camera's transform and not to the board's.\n\n{table}\n"
    )
    print(text)
    write_section("Telling a change from noise", "python tests/benchmarks/told_apart.py", text)


if __name__ == "__main__":
    main()
