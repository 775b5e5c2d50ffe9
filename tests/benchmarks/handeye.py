"""Errors of the hand-eye result against the truth, its stated covariance, and a closed form.

Simulated cells from their corners on (no images are rendered): the stages behind detection run as
in a calibration, without being told the noise. Each row is one world over the same seeds.

    PYTHONPATH=tests python tests/benchmarks/handeye.py
"""

import numpy as np
from cells import calibrated, error_of
from results import write_section

from visioncal.simulation import Cell, CellOptions, fine_camera, simulate, wide_camera
from visioncal.transforms import invert, log

SEEDS = 100
CAMERAS = {"1280 x 800": wide_camera(), "2448 x 2048": fine_camera()}
ROBOTS = {"0.03 / 0.05": (3e-5, 5e-5), "0.3 / 0.5": (3e-4, 5e-4)}
HEAD = (
    "camera",
    "mount",
    "lens",
    "robot [mm / mrad]",
    "error [mm]",
    "error [mrad]",
    "Park [mm]",
    "Park [mrad]",
    "squared error / covariance",
    "robot found [mm / mrad]",
)


def rms(values: list[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def park_error(cell: Cell, known) -> np.ndarray:
    """(6,) error of the camera's edge by Park's closed form from the same poses."""
    return log(invert(next(iter(cell.transforms.values()))) @ known.solved.solutions["park"].x)


def world(camera: str, mount: str, given: bool, robot: str) -> list[str]:
    """One row of the table."""
    sigma_m, sigma_rad = ROBOTS[robot]
    errors, others, surprises, noises = [], [], [], []
    for seed in range(SEEDS):
        cell = simulate(
            CellOptions(
                mount=mount,
                camera=CAMERAS[camera],
                state_intrinsics=given,
                robot_sigma_m=sigma_m,
                robot_sigma_rad=sigma_rad,
                pixel_sigma_px=0.1,
                seed=seed,
            )
        )
        known = calibrated(cell)
        error, spread = error_of(cell, known), known.solved.covariance[:12, :12]
        errors.append(error[:6])
        others.append(park_error(cell, known))
        surprises.append(error @ np.linalg.solve(spread, error) / 12)
        noises.append([known.solved.noise.sigma_m, known.solved.noise.sigma_rad])
    figures = [
        1e3 * rms([float(np.linalg.norm(it[part])) for it in group])
        for group in (errors, others)
        for part in (slice(3, 6), slice(0, 3))
    ]
    found_m, found_rad = 1e3 * np.sqrt(np.mean(np.square(noises), axis=0))
    return [
        camera,
        mount,
        "given" if given else "estimated",
        robot,
        *(f"{it:.3f}" for it in figures),
        f"{np.mean(surprises):.2f}",
        f"{found_m:.3f} / {found_rad:.3f}",
    ]


def main() -> None:
    """Prints the table and keeps it."""
    rows = [
        world(camera, mount, given, robot)
        for camera in CAMERAS
        for mount in ("eye-in-hand", "eye-to-hand")
        for given in (True, False)
        for robot in ROBOTS
    ]
    lines = [HEAD, ["---"] * len(HEAD), *rows]
    table = "\n".join("| " + " | ".join(row) + " |" for row in lines)
    text = (
        f"{SEEDS} simulated UR10e cells a row, 20 views of a 9 x 6 ChArUco board of 30 mm squares, "
        "corners with 0.1 px of noise. Errors are of the camera's transform against the truth, "
        "root mean square; Park is its closed form from the same poses. The squared error over the "
        "stated covariance of both edges, per degree of freedom, is 1 where the covariance tells "
        f"the truth (standard deviation of the mean: 0.04).\n\n{table}\n"
    )
    print(text)
    command = "PYTHONPATH=tests python tests/benchmarks/handeye.py"
    write_section("Hand-eye against the truth", command, text)


if __name__ == "__main__":
    main()
