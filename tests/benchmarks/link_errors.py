"""Sigmas of the transforms of arms whose links are off: `python tests/benchmarks/link_errors.py`.

Each cell draws the size of its arm's errors (0.1 to 0.5 mm, 0.1 to 1 mrad a link), the arm, the
mount, the number of stops and their postures; corners or measured poses, with joint angles. The
truth is the true mounting, in the flange and base of the simulated arm.
"""

import numpy as np
from results import few
from support.misfits import misfit

import visioncal
from visioncal.simulation import CellOptions, cell_session, simulate


def options(seed: int, *, exact: bool = False) -> CellOptions:
    """The cell of a seed; `exact` has the same one with an arm without errors."""
    rng = np.random.default_rng([7, seed])
    mm, mrad = np.exp(rng.uniform(np.log([0.1, 0.1]), np.log([0.5, 1.0])))
    return CellOptions(
        seed=9000 + seed,
        mount="eye-to-hand" if seed % 2 else "eye-in-hand",
        views=int(rng.integers(15, 41)),
        dh_sigma_m=0.0 if exact else 1e-3 * mm,
        dh_sigma_rad=0.0 if exact else 1e-3 * mrad,
        branches=bool(rng.integers(2)),
        robot=("ur10e", "ur5e", "generic-6r-1800")[seed % 3],
    )


def squares(seed: int, *, seen: str, exact: bool = False) -> list[float]:
    """Squared error over covariance, a degree of freedom, of both transforms; none unless good."""
    cell = simulate(options(seed, exact=exact))
    result = visioncal.calibrate(cell_session(cell, "cell", seen=seen))
    if result.verdict.status != "good":
        return []
    return [misfit(edge, cell.transforms[name]) / 6.0 for name, edge in result.edges.items()]


def main() -> None:
    """Prints the mean, and the share beyond 5 sigma, of all kinds of cells."""
    count = few(60, 6)
    for exact in (False, True):
        for seen in ("corners", "poses"):
            found = np.array(
                [each for seed in range(count) for each in squares(seed, seen=seen, exact=exact)]
            )
            far = np.mean(found > 25.0 / 6.0)
            arm = "exact arm" if exact else "arm with errors"
            print(
                f"{arm}, {seen}: {len(found)} transforms of {count} cells, squared error over "
                f"covariance {found.mean():.2f} (median {np.median(found):.2f}), beyond 5 sigma "
                f"{100 * far:.0f} %, worst {found.max():.1f}"
            )


if __name__ == "__main__":
    main()
