"""Needs in cells that visioncal has not made: how often picks land, over what is stated of them.

The worlds of `elsewhere.py`, of both mounts, with lenses that are given and estimated. Each cell is
calibrated from `corners.csv` and `views.csv`, gets a need of its own, and picks: the camera looks
at a thing as one of its views looked at the board, and the tool goes to where its middle is found.
What is wrong with the world is so at the pick as well: the lens, its focus, the arm at the look and
where it goes, and moves of the base, which come as late in the picks as in the session. The tool is
where the arm itself taught it to be: what of an arm's error is the same twist of the flange at all
stops is in no residual, and in the taught tool too.

    PYTHONPATH=tests python tests/benchmarks/need_elsewhere.py [SEEDS]
"""

import tempfile
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from elsewhere import COLUMNS, ROWS, SQUARE_M, WORLDS, Case, cell, lifted, pose, seen
from results import first, wished, write_section

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.steps import STAGES
from visioncal.calibration.stages.need import Picks
from visioncal.core.errors import VisioncalError
from visioncal.core.transforms import exp, invert, rotation_angle
from visioncal.core.types import Corners, FloatArray, Need
from visioncal.estimation.tolerance_probability import radius_within
from visioncal.frames.camera_chain import CalibratedCamera
from visioncal.frames.target_in_image import target_pose_candidates
from visioncal.session import Session

SEEDS, PICKS, BINS = 6, 20, 10
GRID = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).reshape(-1, 2)
THING = SQUARE_M * np.column_stack([GRID, np.zeros(len(GRID))])
TO_MIDDLE = pose(np.zeros(3), THING.mean(axis=0))


@dataclass(frozen=True)
class Trial:
    """One cell: what it states of its need, the share of picks that land within, its verdict."""

    world: str
    mount: str
    stated: float
    landed: float
    status: str


def of_one_cell(at: tuple[str, str, bool, int], folder: Path) -> Trial | None:
    """Calibrates a cell and picks with it; None where its session is refused."""
    world, mount, given, seed = at
    case = cell(WORLDS[world], mount, given, seed, folder / "_".join(map(str, at)))
    known = RunState(Session.load(folder / "_".join(map(str, at))))
    rng = np.random.default_rng([seed, [*WORLDS].index(world), len(mount), given])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for stage in STAGES:
                known = stage.run(known)
    except VisioncalError:
        return None
    (picks,) = known.findings.picks
    need, result = some_need(picks, rng), result_of(known)
    landed = float(np.mean(lands(case, known, CalibratedCamera.of(result), need, rng)))
    return Trial(world, mount, picks.probability(need), landed, result.verdict.status)


def some_need(picks: Picks, rng: np.random.Generator) -> Need:
    """A need that some share of picks meets, of place alone or of place and rotation."""
    quantile, both = float(rng.uniform(0.02, 0.98)), bool(rng.integers(2))
    mm = 1e3 * radius_within(picks.covariances, quantile, picks.freedom)
    turned = float(np.sqrt(np.trace(picks.covariances[:, :3, :3], axis1=1, axis2=2).mean()))
    return Need(mm, float(np.rad2deg(turned * rng.uniform(0.7, 1.8))) if both else None)


def lands(
    case: Case, known: RunState, eye: CalibratedCamera, need: Need, rng: np.random.Generator
) -> FloatArray:
    """(p,) whether picks at times spread over the session come near enough."""
    at, noise = rng.integers(len(case.boards), size=PICKS), noise_of(case, rng)
    in_camera, found = case.boards[at], known.assessment.state.edges[0]
    shown = np.array([in_image(case, eye, known, value, rng) for value in in_camera])
    if case.mount == "eye-in-hand":
        robot = case.flanges(in_camera)
        meant = robot @ case.x @ in_camera @ TO_MIDDLE
        goal = reported(case, robot) @ noise[::2] @ found @ shown @ TO_MIDDLE
    else:
        meant, goal = case.x @ in_camera @ TO_MIDDLE, found @ shown @ TO_MIDDLE
    # Where the robot really is when it reports the goal.
    went = goal
    for _ in range(4):
        went = went @ invert(reported(case, went)) @ goal
    away = invert(meant) @ went @ case.frames[1] @ noise[1::2]
    near = need.mm is None or 1e3 * np.linalg.norm(away[:, :3, 3], axis=1) <= need.mm
    return near & (need.deg is None or np.rad2deg(rotation_angle(away)) <= need.deg)


def reported(case: Case, flanges: FloatArray) -> FloatArray:
    """(p, 4, 4) what the robot says of its flange without noise, over the time of a session."""
    found, lift = case.reported_of(flanges), case.world.lift
    return lifted(found, lift) if lift else found


def noise_of(case: Case, rng: np.random.Generator) -> FloatArray:
    """(2 p, 4, 4) the robot's noise, at each look and behind it at its pick."""
    sigmas = np.repeat([case.world.robot_rad, case.world.robot_m], 3)
    return np.array([exp(value) for value in sigmas * case.world.noise((2 * PICKS, 6), rng)])


def in_image(
    case: Case,
    eye: CalibratedCamera,
    known: RunState,
    in_camera: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """(4, 4) where the calibrated camera has a thing that stands somewhere, by exact corners."""
    far = in_camera[2:3, 3] / case.mean_m
    focal = float(case.world.focus(far, rng)[0]) if case.world.focus else 1.0
    px = seen(THING @ in_camera[:3, :3].T + in_camera[:3, 3], case.shift, focal)
    corners = Corners(0, np.arange(len(px)), px, 0.0)
    return target_pose_candidates(eye, corners, known.session.target, "thing", 0.1).cam_from_target[
        0
    ]


def main(seeds: int) -> None:
    """Prints the tables and keeps them."""
    worlds = first(list(WORLDS))
    every = [
        pair
        for pair in product(worlds, ("eye-in-hand", "eye-to-hand"), (True, False), range(seeds))
        if pair[2] or WORLDS[pair[0]].off_px == 0.0
    ]
    with tempfile.TemporaryDirectory() as folder, Pool(2) as pool:
        kept = pool.map(partial(of_one_cell, folder=Path(folder)), every, chunksize=2)
    found = [trial for trial in kept if trial is not None]
    rows = []
    for world in worlds:
        mine = [trial for trial in found if trial.world == world]
        rows.append((world, *(in_words(group) for group in (
            mine,
            [trial for trial in mine if trial.mount == "eye-in-hand"],
            [trial for trial in mine if trial.mount == "eye-to-hand"],
            [trial for trial in mine if trial.status == "good"],
        ))))  # fmt: skip
    bins = in_bins(found)
    text = f"""{len(every)} cells of `elsewhere.py`, {seeds} seeds of each; {PICKS} picks of each.
{len(every) - len(found)} sessions were refused. The standard error is in brackets.

{table(("stated", "cells", "mean stated", "picks that land", "difference"), bins)}

{table(("world", "difference", "in hand", "to hand", "where the verdict is good"), rows)}
"""
    print(text)
    write_section(
        "Needs elsewhere", "PYTHONPATH=tests python tests/benchmarks/need_elsewhere.py", text
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in lines)


def in_bins(found: Sequence[Trial]) -> list[tuple[str, ...]]:
    """By ten bins of what is stated: cells, means of stated and landed, and the difference."""
    rows, places = [], np.array([min(int(BINS * trial.stated), BINS - 1) for trial in found])
    for place in np.unique(places):
        mine = [trial for trial, at in zip(found, places, strict=True) if at == place]
        stated, landed = (
            np.array([getattr(trial, name) for trial in mine]) for name in ("stated", "landed")
        )
        low, error = 100 * place / BINS, float(np.std(landed - stated) / np.sqrt(len(mine)))
        rows.append(
            (f"{low:.0f} to {low + 100 / BINS:.0f} %", str(len(mine)),
             f"{100 * stated.mean():.1f} %", f"{100 * landed.mean():.1f} %",
             f"{100 * (landed - stated).mean():+.1f} ({100 * error:.1f})")
        )  # fmt: skip
    return rows


def in_words(trials: Sequence[Trial]) -> str:
    """By how much picks land more often than stated, with its standard error [percent points]."""
    if not trials:
        return "none"
    away = 100 * np.array([trial.landed - trial.stated for trial in trials])
    return f"{away.mean():+.1f} ({float(np.std(away)) / np.sqrt(len(away)):.1f})"


if __name__ == "__main__":
    started = time.perf_counter()
    main(wished(SEEDS))
    print(f"{time.perf_counter() - started:.0f} s")
