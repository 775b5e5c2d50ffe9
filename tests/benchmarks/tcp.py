"""Touches of a tool: error over the Cramer-Rao bound, honesty of the covariance, wrong touches.

Beside the pivot of touches stands the textbook's linear least squares.

PYTHONPATH=tests python tests/benchmarks/tcp.py
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from results import few, write_section
from support.touched import TURN, Job, Made, bound, error_of, slipped, touched, turned

from visioncal.core.transforms import compose
from visioncal.estimation.pivot import fit_pivot
from visioncal.estimation.problem_parts import Noise

SEEDS, SLIP_SEEDS, WORKERS = *few((1000, 300), (3, 3)), 2
ROBOT = Noise.of_robot(5e-5, 3e-5)
JOBS = {
    "10 of a point": Job(),
    "10 of a point, robot's noise": Job(noise=ROBOT),
    "10 of a point, 2 z, 2 xz": Job(axes=2),
    "10 of a point, 2 z, 2 xz, robot's noise": Job(axes=2, noise=ROBOT),
    "4 of a point": Job(tips=4),
}
SLIPS = {
    "none": None,
    "slip of 1 mm": lambda made, way: slipped(made.touches, 3, 1e-3 * way),
    "slip of 2 mm": lambda made, way: slipped(made.touches, 3, 2e-3 * way),
    "slip of 5 mm": lambda made, way: slipped(made.touches, 3, 5e-3 * way),
    "flange turned by 1 deg": lambda made, way: turned(made.touches, 3, np.deg2rad(1.0) * way),
}


@dataclass(frozen=True)
class Outcome:
    """Squared errors of rotation and tip, their bounds, the linear tip's, and squared surprise."""

    turn: float
    least_turn: float
    tip: float
    least_tip: float
    linear: float
    mahalanobis_sq: float
    lost: int


def fitted(task: tuple[Job, int]) -> Outcome:
    job, seed = task
    made = touched(job, seed)
    fit, least = fit_pivot(made.touches, job.noise), bound(made)
    free = np.arange(0 if job.axes else 3, 6)
    # Without a rotation of its own, the tool's frame is turned as the flange's.
    answer = fit.flange_from_tool.copy()
    to_tool = np.eye(6)
    if not job.axes:
        answer[:3, :3] = TURN.as_matrix()
        to_tool[3:, 3:] = TURN.as_matrix().T
    error, linear = error_of(answer), error_of(compose(TURN.as_matrix(), linear_tip(made)))
    covariance = (to_tool @ fit.covariance @ to_tool.T)[np.ix_(free, free)]
    return Outcome(
        float(error[:3] @ error[:3]),
        float(np.trace(least[:3, :3])),
        float(error[3:] @ error[3:]),
        float(np.trace(least[3:, 3:])),
        float(linear[3:] @ linear[3:]),
        float(error[free] @ np.linalg.solve(covariance, error[free])),
        int(np.sum(~fit.agreement.mask)),
    )


def linear_tip(made: Made) -> np.ndarray:
    """The textbook's: tip and point by linear least squares over the touches of kind `point`."""
    poses = made.touches.base_from_flange[: made.job.tips]
    system = np.concatenate([np.hstack([pose[:3, :3], -np.eye(3)]) for pose in poses])
    return np.linalg.lstsq(system, -poses[:, :3, 3].ravel(), rcond=None)[0][:3]


def named(task: tuple[Job, str, int]) -> tuple[bool, int]:
    """Whether the wrong touch was left out, and how many sound ones were."""
    job, slip, seed = task
    made = touched(job, seed)
    way = np.random.default_rng(seed + 10**6).standard_normal(3)
    spoil = SLIPS[slip]
    touches = made.touches if spoil is None else spoil(made, way / np.linalg.norm(way))
    wrong = np.zeros(len(touches), dtype=bool)
    wrong[3] = spoil is not None
    agrees = fit_pivot(touches, job.noise).agreement.mask
    return bool(np.all(~agrees[wrong])), int(np.sum(~agrees & ~wrong))


def accuracy(run: Callable[..., Iterator[Outcome]]) -> list[str]:
    rows = []
    for name, job in JOBS.items():
        done = list(run(fitted, [(job, seed) for seed in range(SEEDS)]))
        tip, least, linear, turn, least_turn = (
            np.sqrt(np.mean([getattr(outcome, part) for outcome in done]))
            for part in ("tip", "least_tip", "linear", "turn", "least_turn")
        )
        rotation = f"{np.rad2deg(turn):.4f} | {turn / least_turn:.3f}" if job.axes else "- | -"
        size = 6 if job.axes else 3
        lost = sum(outcome.lost > 0 for outcome in done)
        squares = [outcome.mahalanobis_sq for outcome in done if not outcome.lost]
        rows.append(
            f"| {name} | {1e3 * tip:.4f} | {tip / least:.3f} | {linear / least:.3f} | {rotation} | "
            f"{np.mean(squares) / size:.2f} | {lost} |"
        )
    return rows


def wrong_touches(run: Callable[..., Iterator[tuple[bool, int]]]) -> list[str]:
    rows = []
    for slip in SLIPS:
        done = list(run(named, [(Job(noise=ROBOT), slip, seed) for seed in range(SLIP_SEEDS)]))
        found = "-" if SLIPS[slip] is None else f"{100 * np.mean([flag for flag, _ in done]):.1f} %"
        rows.append(f"| {slip} | {found} | {sum(lost > 0 for _, lost in done)} |")
    return rows


def main() -> None:
    """Prints the tables and keeps them."""
    with ProcessPoolExecutor(WORKERS) as pool:

        def run(function, tasks):
            return pool.map(function, tasks, chunksize=20)

        text = "\n".join(
            (
                f"{SEEDS} seeds a row; flange tilted by up to 45 degrees, contact noise 0.1 mm per "
                "axis; the robot's noise, if any, is 0.03 mm and 0.05 mrad per axis. "
                "RMS errors; the Cramer-Rao bound is computed by independent code; the linear "
                "fit is plain least squares over the touches of kind `point`. The squared "
                "error over its covariance is one if the covariance is right and the noise "
                "known; with noise estimated with f degrees of freedom, f / (f - 2) is "
                "expected: 1.09 for ten "
                "touches of a point, 1.08 with four of the axes, 1.5 for four touches. It is "
                "computed from the sets that lost no touch.\n",
                "| touches | tip [mm] | over its bound | linear fit over bound | rotation [deg] | "
                "over its bound | squared error over covariance | sets that lost a sound touch |",
                "| --- | --- | --- | --- | --- | --- | --- | --- |",
                *accuracy(run),
                f"\nOne wrong touch in ten, with the robot's noise, {SLIP_SEEDS} seeds a row:\n",
                "| the fourth touch | named | sets that lost a sound touch |",
                "| --- | --- | --- |",
                *wrong_touches(run),
            )
        )
    print(text)
    command = "PYTHONPATH=tests python tests/benchmarks/tcp.py"
    write_section("Touches of a tool", command, text)


if __name__ == "__main__":
    main()
