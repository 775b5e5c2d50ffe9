"""Mistakes of the record planted into measured poses, and sound sessions: what is named first.

Cells by camera in hand and to hand of 12 to 60 views with noise of several sizes; rows are shifted
from one on, boards turned or tilted the other way in some views, poses copied from the row before.

    PYTHONPATH=tests python tests/benchmarks/undone.py [--quick] [PLANTED OF EACH KIND]
"""

from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from time import process_time

import cv2
import numpy as np
from elsewhere import pose, views_of
from results import wished, write_section
from scipy.spatial.transform import Rotation
from support.cells import pairs_session

import visioncal
from visioncal.core.transforms import compose

COMMAND = "PYTHONPATH=tests python tests/benchmarks/undone.py"
# How often sound sessions are tried for each planted one of a kind: 100 beside 40.
SOUND = 2.5
Pair = tuple[np.ndarray, np.ndarray]


def cell(seed: int) -> tuple[str, Pair, np.random.Generator]:
    """The mount, and poses of robot and camera with noise."""
    rng = np.random.default_rng([seed, 53])
    boards = np.array([*views_of(int(rng.integers(12, 61)), rng)])
    mount = ("eye-in-hand", "eye-to-hand")[seed % 2]
    x, z = pose(rng.normal(0, 1, 3), rng.normal(0, 0.1, 3)), pose(rng.normal(0, 1, 3), [0.6, 0, 0])
    robot = z @ np.linalg.inv(boards) @ np.linalg.inv(x)
    if mount == "eye-to-hand":
        robot = np.linalg.inv(robot)
    level = 10 ** rng.uniform(-1.0, 0.7)
    noise = rng.normal(size=(2, len(boards), 6)) * level * np.repeat([1e-3, 5e-4], 3)
    robot, boards = (
        poses @ np.array([pose(step[:3], step[3:]) for step in steps])
        for poses, steps in zip((robot, boards), noise, strict=True)
    )
    return mount, (robot, boards), rng


def shifted(pair: Pair, rng: np.random.Generator) -> Pair:
    robot, boards = pair
    by, start = int(rng.choice([1, 2, 3, -1])), int(rng.uniform(0.25, 0.7) * len(robot))
    if rng.random() < 0.2:
        start, by = 0, int(rng.choice([2, 3]))
    rows = np.arange(len(robot))
    moved = np.where(rows >= start, rows + by, rows)
    is_within = moved < len(rows)
    return robot[is_within], boards[moved[is_within]]


def turned(pair: Pair, rng: np.random.Generator) -> Pair:
    robot, boards = pair
    angle, middle = rng.choice([np.pi, np.pi / 2]), np.array([*rng.uniform(0.03, 0.12, 2), 0.0])
    rotation = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    turn = compose(rotation, middle - rotation @ middle)
    some = rng.choice(len(robot), int(rng.integers(2, int(0.42 * len(robot)))), replace=False)
    boards = boards.copy()
    boards[some] = boards[some] @ turn
    return robot, boards


def flipped(pair: Pair, rng: np.random.Generator) -> Pair:
    """The second of the poses that OpenCV finds of a marker of 40 to 80 mm in some views."""
    robot, boards = pair
    boards, side = boards.copy(), rng.uniform(0.02, 0.04)
    marker = side * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    for view in rng.choice(len(robot), int(rng.integers(1, int(0.42 * len(robot)))), replace=False):
        turn, place = cv2.Rodrigues(boards[view, :3, :3])[0], boards[view, :3, 3]
        px = cv2.projectPoints(marker, turn, place, np.eye(3), None)[0]
        way = cv2.SOLVEPNP_IPPE_SQUARE
        _, turns, places, _ = cv2.solvePnPGeneric(marker, px, np.eye(3), None, flags=way)
        boards[view] = compose(cv2.Rodrigues(turns[1])[0], places[1].ravel())
    return robot, boards


def copied(pair: Pair, rng: np.random.Generator) -> Pair:
    robot, boards = pair
    robot, count = robot.copy(), len(robot)
    if rng.random() < 0.5:
        start = int(rng.uniform(0.45, 0.85) * count)
        robot[start:] = robot[start]
    else:
        some = rng.choice(np.arange(1, count, 2), int(rng.integers(1, 1 + count // 5)), False)
        robot[some] = robot[some - 1]
    return robot, boards


def exchanged(pair: Pair, rng: np.random.Generator) -> Pair:
    robot, boards = pair
    first, second = rng.choice(len(robot), 2, replace=False)
    robot = robot.copy()
    robot[[first, second]] = robot[[second, first]]
    return robot, boards


def wrong(pair: Pair, rng: np.random.Generator) -> Pair:
    """Views that are wrong in no way that can be undone, and a camera that was pushed midway."""
    robot, boards = pair
    boards, some = boards.copy(), rng.choice(len(robot), 1 + len(robot) // 10, replace=False)
    boards[some] = boards[some] @ pose(rng.normal(0, 0.5, 3), rng.normal(0, 0.1, 3))
    pushed = pose(rng.normal(0, 0.05, 3), rng.normal(0, 0.02, 3))
    late = len(robot) * 2 // 3 if rng.random() < 0.5 else len(robot)
    boards[late:] = pushed @ boards[late:]
    return robot, boards


PLANTS: dict[str, Callable[[Pair, np.random.Generator], Pair]] = {
    "shifted_rows": shifted,
    "turned_board": turned,
    "flipped_poses": flipped,
    "copied_poses": copied,
    "exchanged_views": exchanged,
    "wrong views": wrong,
    "nothing": lambda pair, _: pair,
}
# Kinds that none of the last two may be accused of.
UNDONE = [*PLANTS][:-2]


def first_cause(task: tuple[str, int]) -> tuple[str, str, float]:
    """The kind, what the verdict names first, and processor time [s]."""
    kind, seed = task
    mount, pair, rng = cell(seed)
    session = pairs_session(mount, *PLANTS[kind](pair, rng))
    began = process_time()
    causes = visioncal.calibrate(session).verdict.causes
    first = causes[0].kind if causes else "none"
    if kind not in UNDONE:
        first = next((cause.kind for cause in causes if cause.kind in UNDONE), kind)
    if first != kind:
        print(kind, seed, mount, len(pair[0]), first, flush=True)
    return kind, first, process_time() - began


def main() -> None:
    planted = wished(40, 2)
    counts = {kind: int(SOUND * planted) if kind == "nothing" else planted for kind in PLANTS}
    tasks = [(kind, 100 + seed) for kind, count in counts.items() for seed in range(count)]
    with ProcessPoolExecutor(2) as pool:
        found = [*pool.map(first_cause, tasks, chunksize=4)]
    lines = [
        "| planted | sessions | named first | else | processor time of a run |",
        "|---|---|---|---|---|",
    ]
    for kind in PLANTS:
        counted = Counter(first for of, first, _ in found if of == kind)
        total, right = counted.total(), counted.pop(kind, 0)
        seconds = np.median([time for of, _, time in found if of == kind])
        others = ", ".join(f"{name} {count}" for name, count in counted.most_common()) or "-"
        what = f"{right}" + ("" if kind in UNDONE else " accused of no mistake")
        lines.append(f"| {kind} | {total} | {what} | {others} | {seconds:.1f} s |")
    print("\n".join(lines))
    write_section("Mistakes of the record", COMMAND, "\n".join(lines))


if __name__ == "__main__":
    main()
