"""Needs: how often simulated picks land within what is needed, over what is stated of them.

Cells of both mounts, of good and coarse robots, of few and many views, with lenses that are given
and estimated, by corners and by measured poses, are calibrated; nothing is told the noise. Each has
a need of its own, of place alone or of place and rotation, so that all probabilities occur. Then it
picks, with new noise of the robot: the camera looks at a thing as one of its views looked at the
board, and the robot goes there.

    PYTHONPATH=tests python tests/benchmarks/need.py [CELLS]
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing import Pool

import numpy as np
from results import wished, write_section
from scipy.spatial.transform import RigidTransform
from support.cells import calibrated
from support.picks import seen_corners

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.steps import STAGES
from visioncal.calibration.stages.need import Picks
from visioncal.core.errors import VisioncalError
from visioncal.core.transforms import exp, invert, rotation_angle
from visioncal.core.types import FloatArray, Need
from visioncal.estimation.tolerance_probability import radius_within
from visioncal.frames.camera_chain import CalibratedCamera
from visioncal.frames.target_in_image import target_pose_candidates
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE
from visioncal.simulation import BOARDS, CellOptions, SimulatedCell, simulate
from visioncal.vision.targets import corner_positions

CELLS, PICKS, BINS = 1000, 20, 10
BOARD = BOARDS["charuco"]
POSES, GIVEN, ESTIMATED = "poses", "lens given", "lens estimated"


@dataclass(frozen=True)
class Outcome:
    """One cell: its kind, what it states of its need, and the share of picks that land within."""

    kind: tuple[str, str]
    both: bool
    stated: float
    landed: float


def of_one_cell(seed: int) -> Outcome | None:
    """Calibrates a cell and picks with it; None where its session is refused."""
    rng = np.random.default_rng([seed, 7])
    seen = (GIVEN, ESTIMATED, POSES)[seed // 2 % 3]
    noise_m, least_tilt = float(np.exp(rng.uniform(*np.log([2e-5, 4e-4])))), rng.uniform(0.1, 0.4)
    # The board of the calibration differs from its description by what that is known to.
    scale = 1.0 + BOARD.square_sigma_m / BOARD.square_m * float(rng.standard_normal())
    cell = simulate(
        CellOptions(
            mount=("eye-in-hand", "eye-to-hand")[seed % 2],
            views=int(rng.integers(8, 31)),
            state_intrinsics=seen != ESTIMATED,
            tilt_rad=(least_tilt, least_tilt + 0.3),
            pixel_sigma_px=float(rng.uniform(0.05, 0.3)),
            robot_sigma_m=noise_m,
            robot_sigma_rad=noise_m * float(rng.uniform(0.5, 3.0)),
            board_scale=scale if seen != POSES else 1.0,
            seed=seed,
        )
    )
    try:
        known = of_poses(cell) if seen == POSES else calibrated(cell, joints=False)
    except VisioncalError:
        return None
    (picks,) = known.findings.picks
    need = some_need(picks, rng)
    eye = None if seen == POSES else CalibratedCamera.of(result_of(known))
    landed = [lands(cell, known, eye, need, rng) for _ in range(PICKS)]
    kind = (cell.options.mount, seen)
    return Outcome(kind, need.deg is not None, picks.probability(need), float(np.mean(landed)))


def some_need(picks: Picks, rng: np.random.Generator) -> Need:
    """A need that some share of picks meets, of place alone or of place and rotation."""
    quantile, both = float(rng.uniform(0.02, 0.98)), bool(rng.integers(2))
    mm = 1e3 * radius_within(picks.covariances, quantile, picks.freedom)
    turned = float(np.sqrt(np.trace(picks.covariances[:, :3, :3], axis1=1, axis2=2).mean()))
    return Need(mm, float(np.rad2deg(turned * rng.uniform(0.7, 1.8))) if both else None)


def of_poses(cell: SimulatedCell) -> RunState:
    """What is known at the end of the way from measured poses, which are exact."""
    rows = [
        [str(at), *numbers(robot), *numbers(camera)]
        for at, (robot, camera) in enumerate(
            zip(cell.robot.base_from_flange, cell.cam_from_target, strict=True)
        )
    ]
    document = {"schema": 1, "name": "poses", "mount": cell.options.mount}
    columns = ("view", *POSE, *(f"cft_{name}" for name in POSE))
    known = RunState(Session.assemble(document, columns, rows, MemoryImages({})))
    for stage in STAGES:
        known = stage.run(known)
    return known


def numbers(matrix: FloatArray) -> list[str]:
    """The cells of a pose."""
    pose = RigidTransform.from_matrix(matrix)
    return [repr(float(value)) for value in (*pose.translation, *pose.rotation.as_quat())]


def lands(
    cell: SimulatedCell,
    known: RunState,
    eye: CalibratedCamera | None,
    need: Need,
    rng: np.random.Generator,
) -> bool:
    """Looks at a thing and goes there; whether that is near enough."""
    at, middle = int(rng.integers(len(cell.cam_from_target))), np.array([0.0, 0.0, 0.0, 1.0])
    true, found = next(iter(cell.transforms.values())), known.assessment.state.edges[0]
    sigmas = np.repeat([cell.options.robot_sigma_rad, cell.options.robot_sigma_m], 3)
    if cell.options.mount == "eye-in-hand":
        reported = cell.robot.base_from_flange[at]
        true = reported @ exp(sigmas * rng.standard_normal(6)) @ true
        found = reported @ found
    shown = in_camera = cell.cam_from_target[at]
    if eye is not None:
        shown = seen_by(cell, eye, in_camera, rng)
        middle[:3] = corner_positions(BOARD).mean(axis=0)
    meant, went = true @ in_camera, found @ shown
    noise = sigmas * rng.standard_normal(6)
    away_mm = 1e3 * np.linalg.norm((went @ middle - meant @ middle)[:3] + noise[3:])
    turned = rotation_angle((invert(meant) @ went @ exp(noise))[None])
    near = need.mm is None or away_mm <= need.mm
    return bool(near and (need.deg is None or np.rad2deg(turned[0]) <= need.deg))


def seen_by(
    cell: SimulatedCell, eye: CalibratedCamera, in_camera: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """(4, 4) where the calibrated camera has a thing that stands somewhere, by exact corners."""
    exact = replace(cell, options=replace(cell.options, pixel_sigma_px=0.0))
    corners = seen_corners(exact, in_camera, BOARD, rng)
    return target_pose_candidates(eye, corners, BOARD, "thing", 0.1).cam_from_target[0]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in lines)


def in_bins(found: Sequence[Outcome]) -> list[tuple[str, ...]]:
    """By ten bins of what is stated: cells, means of stated and landed, and the difference."""
    rows = []
    for low in np.arange(BINS) / BINS:
        mine = [
            outcome
            for outcome in found
            if low <= outcome.stated < low + 1.0 / BINS or outcome.stated == low == 1
        ]
        if mine:
            stated, landed = (
                np.array([getattr(outcome, name) for outcome in mine])
                for name in ("stated", "landed")
            )
            error = float(np.std(landed - stated) / np.sqrt(len(mine)))
            rows.append(
                (f"{100 * low:.0f} to {100 * low + 100 / BINS:.0f} %", str(len(mine)),
                 f"{100 * stated.mean():.1f} %", f"{100 * landed.mean():.1f} %",
                 f"{100 * (landed - stated).mean():+.1f} ({100 * error:.1f})")
            )  # fmt: skip
    return rows


def by_kinds(found: Sequence[Outcome]) -> list[tuple[str, ...]]:
    """The same over all bins, by mount, by what was seen, and by what is needed."""
    rows = []
    kinds = {
        f"{mount}, {seen}": (mount, seen)
        for mount, seen in sorted({outcome.kind for outcome in found})
    }
    groups = {
        words: [outcome for outcome in found if outcome.kind == kind]
        for words, kind in kinds.items()
    }
    groups |= {
        "need of place": [outcome for outcome in found if not outcome.both],
        "need of place and rotation": [outcome for outcome in found if outcome.both],
    }
    for words, mine in groups.items():
        if mine:
            away = np.array([outcome.landed - outcome.stated for outcome in mine])
            error = float(np.std(away) / np.sqrt(len(mine)))
            rows.append((words, str(len(mine)), f"{100 * away.mean():+.1f} ({100 * error:.1f})"))
    return rows


def main(cells: int) -> None:
    """Prints the tables and keeps them."""
    with Pool(2) as pool:
        kept = pool.map(of_one_cell, range(cells), chunksize=2)
    found = [outcome for outcome in kept if outcome is not None]
    text = f"""{cells} simulated UR10e cells of 8 to 30 views, both mounts; robots with noise of
0.02 to 0.4 mm and 0.01 to 1.2 mrad a stop; corners with 0.05 to 0.3 px of noise, the lens given or
estimated, or poses; tilts from 0.1 to 0.7 rad; the board known to 0.1 %. Of each, {PICKS} picks
with new noise: an observation, from the pose of one of the views, of an object without image noise,
and a motion there. {cells - len(found)} sessions were refused. The standard error is in brackets
(picks of one cell share its calibration).

{table(("stated", "cells", "mean stated", "picks that land", "difference"), in_bins(found))}

{table(("kind", "cells", "difference"), by_kinds(found))}
"""
    print(text)
    write_section("Needs", "PYTHONPATH=tests python tests/benchmarks/need.py", text)


if __name__ == "__main__":
    started = time.perf_counter()
    main(wished(CELLS, 6))
    print(f"{time.perf_counter() - started:.0f} s")
