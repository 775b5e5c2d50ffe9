"""Whole cells: how near the bases come to the bound, and how often what is wrong is named.

Two robots, two fixed cameras and three boards are simulated from their corners on (no images are
rendered) and aligned; nothing is told the noise. The bound is by code of its own.

    PYTHONPATH=tests python tests/benchmarks/network.py [CELLS]
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing import Pool

import numpy as np
from results import few, wished, write_section
from support.networkbound import network_bound

from visioncal.calibration.pipeline import calibrate
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.results import Calibration
from visioncal.simulation import SimulatedCell, simulate
from visioncal.simulation.layout import CameraAt, Moved, NetworkOptions
from visioncal.simulation.records import cell_session

CELLS = 50
STOPS = 30


def drawn(options: NetworkOptions, seed: int) -> NetworkOptions:
    """Options with boards that differ from their descriptions by what these are known to."""
    rng = np.random.default_rng([seed, 41])
    boards = tuple(
        replace(
            board,
            scale=1.0
            + board.target.square_sigma_m / board.target.square_m * float(rng.standard_normal()),
        )
        for board in options.boards
    )
    return replace(options, boards=boards, seed=seed)


def aligned(cell: SimulatedCell) -> Calibration:
    session = cell_session(cell, "network", seen="names")
    return calibrate(
        session, corners={view_corners.view: view_corners for view_corners in cell.corners}
    )


def away(cell: SimulatedCell, found: Calibration, frames: Sequence[str]) -> FloatArray:
    """(6 f,) by which frames are off, on their right."""
    parts = []
    for name in frames:
        truth = cell.mountings[name]
        if found.cell.tree[name] == "cell":
            truth = invert(cell.mountings[found.cell.reference]) @ truth
        parts.append(log(invert(truth) @ found.tree.edge_of(name).matrix))
    return np.concatenate(parts)


@dataclass(frozen=True, eq=False)
class Clean:
    """One clean cell: errors of base b (6,) and the bound's variances, and both chi-squares."""

    error: FloatArray
    bound: FloatArray
    nees: float
    nees_all: float
    taken_s: float


def clean(seed: int) -> Clean:
    cell = simulate(drawn(NetworkOptions(stops=STOPS), seed))
    begin = time.process_time()
    found = aligned(cell)
    taken = time.process_time() - begin
    bound = network_bound(cell)
    error, covariance = away(cell, found, ["base_b"]), found.tree.edge_of("base_b").covariance
    frames = [edge.partition("_from_")[2] for edge in found.edges]
    every = away(cell, found, frames)
    return Clean(
        error,
        np.diag(bound.of("base_b")),
        float(error @ np.linalg.solve(covariance, error)) / 6,
        float(every @ np.linalg.solve(found.joint_covariance, every)) / len(every),
        taken,
    )


@dataclass(frozen=True)
class Faulty:
    """One cell with faults: what of them was named, and errors of base b beside the clean [mm]."""

    board: bool
    camera: bool
    swap: bool
    strays: int
    false: int
    error_mm: float
    clean_mm: float


def faulty(seed: int) -> Faulty:
    rng = np.random.default_rng([seed, 42])
    board = str(rng.choice(["target_floor", "target_plate_a", "target_plate_b"]))
    camera = str(rng.choice(["cam_left", "cam_right"]))
    half = Moved(board, int(rng.integers(STOPS // 3, 2 * STOPS // 3)))
    bumped = Moved(camera, int(rng.integers(STOPS // 3, 2 * STOPS // 3)))
    options = drawn(NetworkOptions(stops=STOPS), seed)
    cell = simulate(replace(options, moved=(half, bumped), swapped_rows=1, stray_images=6))
    good = simulate(options)
    found, before = aligned(cell), aligned(good)
    told = [_tells(found, move) for move in (half, bumped)]
    reasons = {sight.view: sight.reason for sight in found.views if not sight.used}
    wrong = [view for view in cell.wrong_views if view in reasons]
    exchanged = [index for index in wrong if "exchanged" in reasons[index]]
    besides = len(found.cell.moved) - sum(told) + len(reasons) - len(wrong)
    return Faulty(
        *told,
        len(exchanged) >= 2,
        len(wrong) - 2,
        besides,
        _mm(cell, found),
        _mm(good, before),
    )


def _tells(found: Calibration, push: Moved) -> bool:
    """Whether a push is named, and between which stops it happened."""
    return any(
        move.frame == push.frame and move.last_stop < (push.from_stop or 0) <= move.first_stop
        for move in found.cell.moved
    )


def _mm(cell: SimulatedCell, found: Calibration) -> float:
    return 1e3 * float(np.linalg.norm(away(cell, found, ["base_b"])[3:]))


def four_cameras_s() -> float:
    """Seconds that four cameras at 40 stops take to align, corners being found; best of three."""
    names = ("one", "two", "three", "four")
    places = ((0.0, -1.0, 1.1), (0.15, 0.95, 1.25), (0.9, -0.6, 1.2), (-0.8, 0.7, 1.2))
    cameras = tuple(
        CameraAt(name, place_m=place) for name, place in zip(names, places, strict=True)
    )
    cell = simulate(NetworkOptions(cameras=cameras, stops=40))
    taken = []
    for _ in range(few(3, 1)):
        begin = time.process_time()
        aligned(cell)
        taken.append(time.process_time() - begin)
    return min(taken)


def report(cells: Sequence[Clean], faults: Sequence[Faulty], four_s: float) -> str:
    errors = np.array([cell.error for cell in cells])
    bound = np.array([cell.bound for cell in cells]).mean(axis=0)
    over = [
        float(np.sqrt(np.mean(np.sum(errors[:, at] ** 2, axis=1)) / bound[at].sum()))
        for at in (slice(3, 6), slice(0, 3))
    ]
    nees = [
        float(np.mean([getattr(cell, name) for cell in cells])) for name in ("nees", "nees_all")
    ]
    errors = ([fault.error_mm for fault in faults], [fault.clean_mm for fault in faults])
    rms = [float(np.sqrt(np.mean(np.square(group)))) for group in errors]

    def share(values: Sequence[bool]) -> str:
        return f"{sum(values)} of {len(values)}"

    return "\n".join(
        [
            f"{len(cells)} cells of two robots, two fixed cameras and three boards, {STOPS} stops;",
            "base b in base a, root mean square error over the bound, and the error over its own",
            "covariance (1 where that is right).",
            "",
            "| place | rotation | NEES of base b | NEES of all frames |",
            "| ---: | ---: | ---: | ---: |",
            f"| {over[0]:.2f} | {over[1]:.2f} | {nees[0]:.2f} | {nees[1]:.2f} |",
            "",
            f"{len(faults)} such cells in which one board moves and one camera is bumped during",
            "the recording, the images of two rows are exchanged and six images are from",
            "other stops:",
            "",
            "| named | cells |",
            "| --- | ---: |",
            f"| the board that moved, and when | {share([fault.board for fault in faults])} |",
            "| the camera that was bumped, and when "
            f"| {share([fault.camera for fault in faults])} |",
            f"| the two rows as exchanged | {share([fault.swap for fault in faults])} |",
            f"| all six images of other stops | {share([fault.strays == 6 for fault in faults])} |",
            f"| nothing besides | {share([fault.false == 0 for fault in faults])} |",
            "",
            f"The error of base b is {rms[0]:.3f} mm (root mean square), in the same cells "
            f"without faults {rms[1]:.3f} mm.",
            "",
            f"Four cameras at 40 stops, corners found: {four_s:.2f} s; a clean cell above: "
            f"{np.median([cell.taken_s for cell in cells]):.2f} s.",
        ]
    )


def main() -> None:
    count = wished(CELLS)
    with Pool() as pool:
        cells = pool.map(clean, range(count))
        faults = pool.map(faulty, range(1000, 1000 + count))
    text = report(cells, faults, four_cameras_s())
    print(text)
    if count >= CELLS:
        command = "PYTHONPATH=tests python tests/benchmarks/network.py"
        write_section("Whole cells", command, text)


if __name__ == "__main__":
    main()
