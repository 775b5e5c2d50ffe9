"""Needs: how often simulated picks land within what is needed, over what is stated of them.

Cells of both mounts, of good and coarse robots, of few and many views, with lenses that are given
and estimated, by corners and by measured poses, are calibrated; nothing is told the noise. Each has
a need of its own, of place alone or of place and rotation, so that all probabilities occur. Then it
picks, with new noise of the robot: the camera looks at a thing as one of its views looked at the
board, and the robot goes there.

Then cells with joint angles, whose arms are wrong and are calibrated along. A pick looks in the
posture of one view, and picks in that of another; its tool was taught by the arm itself. Targets
are sent as they are, and corrected for the calibrated arm.

    PYTHONPATH=tests python tests/benchmarks/need.py [CELLS] [ARMS]
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
from visioncal.core.transforms import adjoint, exp, invert, log, rotation_angle
from visioncal.core.types import FloatArray, Need
from visioncal.estimation.tolerance_probability import radius_within
from visioncal.frames.camera_chain import CalibratedCamera
from visioncal.frames.target_in_image import target_pose_candidates
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE
from visioncal.simulation import BOARDS, CellOptions, SimulatedCell, simulate
from visioncal.vision.targets import corner_positions

CELLS, PICKS, BINS = 1000, 20, 10
ARMS, PICKS_BY_ARM = 100, 400
BOARD = BOARDS["charuco"]
# A board that was measured over its whole width, so that it is not what the arm's errors drown in.
MEASURED = replace(BOARD, square_sigma_m=1e-5)
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


@dataclass(frozen=True)
class ArmOutcome:
    """One cell with an arm that was calibrated: its mount and level, and picks of both kinds."""

    kind: tuple[str, str]
    # Within which 95 % of them are to land: by the controller's poses, corrected.
    stated_mm: tuple[float, float]
    within_mm: tuple[float, float]  # Within which 95 % land.
    landed: tuple[float, float]  # Share that lands within what is stated.


def of_one_arm(seed: int) -> ArmOutcome | None:
    """Calibrates a cell with a wrong arm, and picks; None where the arm remains nominal."""
    rng = np.random.default_rng([seed, 8])
    wrong, scale = float(np.exp(rng.uniform(*np.log([5e-5, 5e-4])))), rng.standard_normal()
    options = CellOptions(
        mount=("eye-in-hand", "eye-to-hand")[seed % 2],
        robot=("ur5e", "ur10e")[seed // 2 % 2],
        views=int(rng.integers(20, 61)),
        pixel_sigma_px=float(rng.uniform(0.05, 0.2)),
        robot_sigma_m=2e-5,
        robot_sigma_rad=3e-5,
        dh_sigma_m=wrong,
        dh_sigma_rad=2.0 * wrong,
        target=MEASURED,
        board_scale=1.0 + MEASURED.square_sigma_m / MEASURED.square_m * float(scale),
        seed=seed,
    )
    cell = simulate(options)
    result = result_of(calibrated(cell))
    stated = result.verdict.good_for_mm_uncorrected, result.verdict.good_for_mm
    if not result.arm_is_calibrated or stated[0] is None or stated[1] is None:
        return None
    q, eye = cell.robot.joints, CalibratedCamera.of(result)
    really, middle = cell.robot.flange_at(q), np.append(corner_positions(BOARD).mean(axis=0), 1.0)
    shown = np.array([seen_by(cell, eye, pose, rng) for pose in cell.cam_from_target])
    found, real = next(iter(result.edges.values())).matrix, next(iter(cell.transforms.values()))
    looks, goes = rng.integers(len(q), size=(2, PICKS_BY_ARM))
    noise = np.repeat([options.robot_sigma_rad, options.robot_sigma_m], 3)
    looked, went = exp(noise * rng.standard_normal((2, PICKS_BY_ARM, 6)))
    within, landed = [], []
    for model, limit_mm in zip(
        (result.robot.base_from_flange(q), result.standing(q)), stated, strict=True
    ):
        tool = invert(common_twist(result.standing(q), really))
        if options.mount == "eye-in-hand":
            thing = (really[looks] @ looked @ real @ cell.cam_from_target[looks]) @ middle
            goal = (model[looks] @ found @ shown[looks]) @ middle
        else:
            goes = looks
            thing, goal = real @ cell.cam_from_target[looks] @ middle, found @ shown[looks] @ middle
        tip = invert(model[goes]) @ goal[:, :, None]
        reached = (really[goes] @ went @ tool @ tip)[:, :, 0]
        away_mm = 1e3 * np.linalg.norm((reached - thing)[:, :3], axis=1)
        within.append(float(np.quantile(away_mm, 0.95)))
        landed.append(float(np.mean(away_mm <= limit_mm)))
    kind = (options.mount, options.robot)
    return ArmOutcome(kind, stated, (within[0], within[1]), (landed[0], landed[1]))


def common_twist(calibrated: FloatArray, real: FloatArray) -> FloatArray:
    """(4, 4) the twist of the flange that all (m, 4, 4) poses of an arm have in common.

    It is real = base @ calibrated @ twist: in a tool that the arm taught, and in no residual.
    """
    both = np.concatenate([adjoint(invert(calibrated)), np.tile(np.eye(6), (len(real), 1, 1))], 2)
    away = log(invert(calibrated) @ real)
    return exp(np.linalg.lstsq(both.reshape(-1, 12), away.ravel())[0][6:])


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


def main_of_arms(cells: int) -> None:
    """Prints the table of calibrated arms and keeps it."""
    with Pool(2) as pool:
        kept = pool.map(of_one_arm, range(cells), chunksize=2)
    found, rows = [outcome for outcome in kept if outcome is not None], []
    for words in ("all", "eye-in-hand", "eye-to-hand", "ur5e", "ur10e"):
        mine = [outcome for outcome in found if words in ("all", *outcome.kind)]
        for at, sent in enumerate(("the controller's poses", "corrected targets")):
            stated, within, landed = (
                np.array([getattr(outcome, name)[at] for outcome in mine])
                for name in ("stated_mm", "within_mm", "landed")
            )
            error = float(np.std(landed) / np.sqrt(len(mine)))
            rows.append(
                (
                    words,
                    sent,
                    str(len(mine)),
                    f"{np.median(stated):.2f}",
                    f"{np.median(within):.2f}",
                    f"{100 * landed.mean():.1f} ({100 * error:.1f})",
                )
            )
    head = ("cells", "picks by", "count", "stated [mm]", "95 % within [mm]", "landed [%]")
    known = 1e5 * MEASURED.square_sigma_m / MEASURED.square_m
    text = f"""{cells} simulated cells of 20 to 60 views with joint angles, both mounts; links are
off by 0.05 to 0.5 mm and twice as many mrad, and the arm repeats to 0.02 mm and 0.03 mrad; the
board is known to {known:.0f} in 100,000. Of each, {PICKS_BY_ARM} picks with new noise.
`good_for_mm_uncorrected` and `good_for_mm` state within how much 95 % land; medians over the cells,
and the mean share that lands within, with its standard error.
{cells - len(found)} arms were not calibrated, or have unexplained errors.

{table(head, rows)}
"""
    print(text)
    write_section(
        "Picks with a calibrated arm", "PYTHONPATH=tests python tests/benchmarks/need.py 0", text
    )


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
    if wished(CELLS, 6):
        main(wished(CELLS, 6))
    main_of_arms(wished(ARMS, 2, place=1))
    print(f"{time.perf_counter() - started:.0f} s")
