"""Our closed-form hand-eye solvers against OpenCV's: accuracy and speed, into RESULTS.md.

Run from the repository's root: `python tests/benchmarks/closed_forms.py`.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from results import few, first, write_section
from threadpoolctl import threadpool_limits

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS), str(TESTS.parent)]

from support.worlds import (  # noqa: E402
    BOTH_AT_ONCE,
    COARSE,
    NOISY_WORLDS,
    Problem,
    opencv,
    shift_error,
    simulate,
    turn_error,
)

from visioncal.core.types import FloatArray  # noqa: E402
from visioncal.estimation.closed_form import SOLVERS  # noqa: E402

SEEDS = few(200, 3)
FAR_MM, FAR_MRAD = 50.0, 1e3 * np.radians(5.0)

ACCURACY_HEAD = f"""\
Median error of X over {SEEDS} seeds, ours against OpenCV's method of the same name
(`calibrateHandEye`; `calibrateRobotWorldHandEye` for shah and li). A failure is no result, or an
error of more than {FAR_MM:.0f} mm or 5 degrees; a median of mostly failures is `inf`.
The worlds are in `tests/support/worlds.py`. Unless their name says otherwise they have 20 views,
tilts and rolls up to 40 degrees, and an eye-in-hand camera with noise of 0.2 mm and 0.3 mrad. A
coarse robot has noise of 0.3 mm and 0.5 mrad, a precise one of 0.03 mm and 0.05 mrad; the robot is
precise in the world with noisy depth and in those with small tilts, and coarse in all others.

| world | solver | ours mrad | OpenCV mrad | ratio | ours mm | OpenCV mm | ratio | our failures \
| OpenCV's |
| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"""

SPEED_HEAD = """
Time of one call, median of interleaved repetitions, one thread:

| views | solver | ours ms | OpenCV ms | times faster |
| ---: | --- | ---: | ---: | ---: |"""


def errors(solve: Callable[[Problem], FloatArray], problems: list[Problem]) -> FloatArray:
    """(n, 2) rotation [mrad] and translation [mm] errors of X; NaN for a failure."""
    found = np.empty((len(problems), 2))
    for row, problem in zip(found, problems, strict=True):
        x = solve(problem)
        row[:] = 1e3 * turn_error(x, problem.x), 1e3 * shift_error(x, problem.x)
    found[~((found[:, 0] < FAR_MRAD) & (found[:, 1] < FAR_MM))] = np.nan
    return found


def accuracy_rows() -> list[str]:
    rows = []
    for label, world in first(tuple(NOISY_WORLDS.items())):
        problems = [simulate(world, seed) for seed in range(SEEDS)]
        for name, solver in SOLVERS.items():
            ours = errors(lambda p, solver=solver: solver(p.robot, p.camera).x, problems)
            theirs = errors(lambda p, name=name: opencv(name, p), problems)
            rows.append(f"| {label} | {name} | {_compared(ours, theirs)} |")
    return rows


def _compared(ours: FloatArray, theirs: FloatArray) -> str:
    cells = []
    for column in (0, 1):
        # A failure counts as infinitely far, so that a median cannot profit from it.
        pair = [np.median(np.nan_to_num(e[:, column], nan=np.inf)) for e in (ours, theirs)]
        ratio = pair[0] / pair[1] if np.isfinite(pair[1]) else 0.0
        cells.append(f"{pair[0]:.3f} | {pair[1]:.3f} | {ratio:.2f}")
    failures = [int(np.isnan(e[:, 0]).sum()) for e in (ours, theirs)]
    return " | ".join([*cells, f"{failures[0]} | {failures[1]}"])


def speed_rows() -> list[str]:
    rows = []
    for views, repetitions in ((20, few(300, 3)), (200, few(15, 1))):
        problem = simulate(replace(COARSE, views=views), 1)
        for name, solver in SOLVERS.items():
            ours, theirs = interleaved(
                partial(solver, problem.robot, problem.camera),
                _opencv_call(name, problem),
                repetitions,
            )
            rows.append(f"| {views} | {name} | {ours:.3f} | {theirs:.3f} | {theirs / ours:.1f} |")
    return rows


def _opencv_call(name: str, problem: Problem) -> Callable[[], object]:
    """OpenCV's call alone, with its lists made beforehand."""
    poses = problem.robot if name not in BOTH_AT_ONCE else np.linalg.inv(problem.robot)
    robot = list(poses[:, :3, :3].copy()), list(poses[:, :3, 3].copy())
    camera = list(problem.camera[:, :3, :3].copy()), list(problem.camera[:, :3, 3].copy())
    if name in BOTH_AT_ONCE:
        method = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name.upper()}")
        return lambda: cv2.calibrateRobotWorldHandEye(*camera, *robot, method=method)
    method = getattr(cv2, f"CALIB_HAND_EYE_{name.upper()}")
    return lambda: cv2.calibrateHandEye(*robot, *camera, method=method)


def interleaved(
    ours: Callable[[], object], theirs: Callable[[], object], repetitions: int
) -> tuple[float, float]:
    """Median times [ms] of two calls that take turns."""
    times = np.empty((repetitions, 2))
    for row in times:
        for column, call in enumerate((ours, theirs)):
            start = time.perf_counter()
            call()
            row[column] = 1e3 * (time.perf_counter() - start)
    return tuple(np.median(times, axis=0))


def main() -> None:
    cv2.setNumThreads(1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    with threadpool_limits(limits=1):
        text = "\n".join([ACCURACY_HEAD, *accuracy_rows(), SPEED_HEAD, *speed_rows()])
    print(text)
    write_section("Closed-form hand-eye", "python tests/benchmarks/closed_forms.py", text)


if __name__ == "__main__":
    main()
