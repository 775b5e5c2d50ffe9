"""The joint estimator against its bound, OpenCV's solvers, wrong views, wrong arms and boards.

Simulated cells from their corners on (no images are rendered): the stages behind detection run as
in a calibration, without being told the noise. The bound is that of
`tests/support/networkbound.py`.

    PYTHONPATH=tests python tests/benchmarks/handeye.py [SEEDS [SEEDS OF THE SMALLER TABLES]]
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from multiprocessing import Pool
from pathlib import Path

import cv2
import numpy as np
from results import few, first, wished, write_section
from support.cells import calibrated, error_of
from support.networkbound import network_bound
from support.worlds import BOTH_AT_ONCE, Problem, opencv

from visioncal.core.errors import VisioncalError
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.session import Session
from visioncal.simulation import CellOptions, SimulatedCell, fine_camera, simulate, wide_camera
from visioncal.simulation.boards import Sheet, corners_m

SEEDS, FEW = 1000, 50
IN_HAND, TO_HAND = "eye-in-hand", "eye-to-hand"
FINE, WIDE = fine_camera(), wide_camera()
GOOD, COARSE = (3e-5, 5e-5), (3e-4, 5e-4)
METHODS = ("tsai", "park", "horaud", "andreff", "daniilidis", *BOTH_AT_ONCE)


@dataclass(frozen=True)
class World:
    """One row of the table."""

    words: str
    options: CellOptions


def world(words: str, camera, pixel_px, robot, given, mount, **more) -> World:
    sigma_m, sigma_rad = robot
    return World(
        words,
        CellOptions(
            mount=mount,
            camera=camera,
            state_intrinsics=given,
            robot_sigma_m=sigma_m,
            robot_sigma_rad=sigma_rad,
            pixel_sigma_px=pixel_px,
            **more,
        ),
    )


WORLDS = (
    world("5 MP, 0.1 px, good robot, lens given, in hand", FINE, 0.1, GOOD, True, IN_HAND),
    world("5 MP, 0.05 px, good robot, lens estimated, to hand", FINE, 0.05, GOOD, False, TO_HAND),
    world("5 MP, 0.1 px, coarse robot, lens given, to hand", FINE, 0.1, COARSE, True, TO_HAND),
    world("1.0 MP, 0.2 px, good robot, lens given, to hand", WIDE, 0.2, GOOD, True, TO_HAND),
    world("1.0 MP, 0.1 px, good robot, lens estimated, in hand", WIDE, 0.1, GOOD, False, IN_HAND),
    world("1.0 MP, 0.2 px, coarse robot, lens estimated", WIDE, 0.2, COARSE, False, TO_HAND),
    world("the first, tilts under 10 deg", FINE, 0.1, GOOD, True, IN_HAND, tilt_rad=(0.0, 0.17)),
)
ROBUST = (WORLDS[0], WORLDS[4])


def opencv_poses(cell: SimulatedCell) -> FloatArray:
    """(m, 4, 4) `cam_from_target` by OpenCV: calibrateCamera or solvePnP."""
    options = cell.options
    points = corners_m(Sheet(target=options.target))
    stated = [points[view_corners.ids].astype(np.float32) for view_corners in cell.corners]
    px = [view_corners.px.astype(np.float32) for view_corners in cell.corners]
    if options.state_intrinsics:
        fx, fy, cx, cy = options.camera.matrix
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        lens = options.camera.distortion
        found = [cv2.solvePnP(a, b, matrix, lens)[1:] for a, b in zip(stated, px, strict=True)]
        turns, shifts = zip(*found, strict=True)
    else:
        *_, turns, shifts = cv2.calibrateCamera(stated, px, options.camera.resolution, None, None)
    poses = np.tile(np.eye(4), (len(px), 1, 1))
    poses[:, :3, :3] = [cv2.Rodrigues(turn)[0] for turn in turns]
    poses[:, :3, 3] = np.reshape(shifts, (-1, 3))
    return poses


def opencv_errors(cell: SimulatedCell) -> FloatArray:
    """(methods, 2) rotation [rad] and translation [m] errors of X by each of OpenCV's solvers."""
    x, z = cell.transforms.values()
    robot = cell.robot.base_from_flange
    problem = Problem(
        robot if cell.options.mount == IN_HAND else invert(robot), opencv_poses(cell), x, z
    )
    away = [log(invert(x) @ _rigid(opencv(name, problem))) for name in METHODS]
    return np.array([[np.linalg.norm(array[:3]), np.linalg.norm(array[3:])] for array in away])


def _rigid(matrix: FloatArray) -> FloatArray:
    """The nearest rigid transform: some of OpenCV's results are rotations to 1e-6 only."""
    u, _, vt = np.linalg.svd(np.nan_to_num(matrix[:3, :3]))
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = u @ vt, np.nan_to_num(matrix[:3, 3], nan=1e3)
    return rigid


def squared(error: FloatArray) -> list[float]:
    return [float(error[:3] @ error[:3]), float(error[3:6] @ error[3:6])]


def mahalanobis_sq(error: FloatArray, covariance: FloatArray) -> float:
    return float(error @ np.linalg.solve(covariance, error)) / len(error)


def edge_bound(cell: SimulatedCell) -> FloatArray:
    """Least covariance (12, 12) of x and z of a cell whose board is as stated."""
    return network_bound(cell, "base", sizes=False).covariance


def against_the_bound(task: tuple[World, int]) -> list[float] | None:
    """Squared errors, their bound, the covariance's word, and OpenCV's squared errors."""
    row, seed = task
    cell = simulate(replace(row.options, seed=seed))
    try:
        known = calibrated(cell)
    except VisioncalError:
        return None
    bound, error = edge_bound(cell), error_of(cell, known)
    return [
        *squared(error),
        float(np.trace(bound[:3, :3])),
        float(np.trace(bound[3:6, 3:6])),
        mahalanobis_sq(error, known.assessment.covariance[:12, :12]),
        float(len(known.used) < row.options.views),
        *np.square(opencv_errors(cell)).ravel(),
    ]


def bound_table(pool, seeds: int) -> str:
    head = ("world", "error / bound, mm", "mrad", "error / OpenCV's best, mm", "mrad",
            "squared error / covariance", "sound views lost", "refused")  # fmt: skip
    rows = []
    for row in first(WORLDS):
        kept = _run(pool, against_the_bound, [(row, seed) for seed in range(seeds)])
        mean = np.mean(kept, axis=0)
        best = np.mean(np.reshape([value[6:] for value in kept], (len(kept), -1, 2)), axis=0).min(
            axis=0
        )
        rows.append(
            (
                row.words,
                f"{np.sqrt(mean[1] / mean[3]):.3f}",
                f"{np.sqrt(mean[0] / mean[2]):.3f}",
                f"{np.sqrt(mean[1] / best[1]):.2f}",
                f"{np.sqrt(mean[0] / best[0]):.2f}",
                f"{mean[4]:.3f}",
                f"{100 * mean[5]:.1f} % of runs",
                f"{seeds - len(kept)}",
            )
        )
        print(*rows[-1], sep=" | ", file=sys.stderr, flush=True)
    return table(head, rows)


def with_wrong_views(task: tuple[World, int, int]) -> list[float] | None:
    row, wrong, seed = task
    cell = simulate(replace(row.options, seed=seed, wrong_views=wrong))
    try:
        known = calibrated(cell)
    except VisioncalError:
        return None
    right = tuple(sight for sight in cell.sights if sight.view not in cell.wrong_views)
    bound, error = edge_bound(replace(cell, sights=right)), error_of(cell, known)
    out = set(range(row.options.views)) - set(known.used)
    return [
        *squared(error),
        float(np.trace(bound[:3, :3])),
        float(np.trace(bound[3:6, 3:6])),
        float(out == set(cell.wrong_views)),
        float(bool(set(cell.wrong_views) - out)),
        mahalanobis_sq(error, known.assessment.covariance[:12, :12]),
    ]


def wrong_table(pool, seeds: int) -> str:
    head = ("world", "wrong of 20", "error / bound of the right, mm", "mrad",
            "all wrong and no right view left out", "a wrong view missed",
            "squared error / covariance", "refused")  # fmt: skip
    rows = []
    for row in first(ROBUST):
        for wrong in first((0, 2, 4, 6), 2):
            kept = _run(pool, with_wrong_views, [(row, wrong, seed) for seed in range(seeds)])
            mean = np.mean(kept, axis=0)
            rows.append(
                (
                    row.words,
                    str(wrong),
                    f"{np.sqrt(mean[1] / mean[3]):.3f}",
                    f"{np.sqrt(mean[0] / mean[2]):.3f}",
                    f"{100 * mean[4]:.1f} %",
                    f"{100 * mean[5]:.1f} %",
                    f"{mean[6]:.3f}",
                    f"{seeds - len(kept)}",
                )
            )
    return table(head, rows)


def with_a_wrong_arm(task: tuple[CellOptions, bool, int]) -> list[float] | None:
    options, joints, seed = task
    cell = simulate(replace(options, seed=seed))
    try:
        known = calibrated(cell, joints=joints)
    except VisioncalError:
        return None
    error, covariance = error_of(cell, known), known.assessment.covariance[:12, :12]
    flagged = any("the arm" in reason.lower() for reason in known.verdict.reasons)
    return [*squared(error), mahalanobis_sq(error, covariance), float(flagged)]


def arm_table(pool, seeds: int) -> str:
    head = ("arm", "mount", "session has", "error [mm]", "[mrad]", "squared error / covariance",
            "errors of the arm flagged", "refused")  # fmt: skip
    arms = {
        "as its model": CellOptions(camera=FINE, pixel_sigma_px=0.1),
        "DH off by 0.5 mm, 1 mrad": CellOptions(
            camera=FINE, pixel_sigma_px=0.1, dh_sigma_m=5e-4, dh_sigma_rad=1e-3
        ),
    }
    rows = []
    for words, options in first(tuple(arms.items())):
        for mount in (IN_HAND, TO_HAND):
            for joints in (True, False):
                row = replace(options, mount=mount)
                tasks = [(row, joints, seed) for seed in range(seeds)]
                kept = _run(pool, with_a_wrong_arm, tasks)
                mean = np.mean(kept, axis=0)
                rows.append(
                    (
                        words,
                        mount,
                        "joints and model" if joints else "poses only",
                        f"{1e3 * np.sqrt(mean[1]):.3f}",
                        f"{1e3 * np.sqrt(mean[0]):.3f}",
                        f"{mean[2]:.2f}",
                        f"{100 * mean[3]:.1f} %",
                        f"{seeds - len(kept)}",
                    )
                )
    return table(head, rows)


def with_a_board(task: tuple[CellOptions, int]) -> list[float] | None:
    options, seed = task
    cell = simulate(replace(options, seed=seed))
    try:
        known = calibrated(cell)
    except VisioncalError:
        return None
    said = " ".join(known.verdict.reasons)
    return [
        *squared(error_of(cell, known)),
        float("not flat" in said),
        float("robot's motion the board" in said),
    ]


def board_table(pool, seeds: int) -> str:
    head = ("board", "lens", "error [mm]", "[mrad]", "bend noticed", "size noticed", "refused")
    boards = {
        "flat, as stated": {},
        "bent by 0.3 mm": {"board_bow_m": 3e-4},
        "bent by 0.1 mm": {"board_bow_m": -1e-4},
        "0.2 % too large": {"board_scale": 1.002},
        "0.1 % too large": {"board_scale": 1.001},
    }
    rows = []
    for words, more in first(tuple(boards.items())):
        for given in (True, False):
            options = CellOptions(camera=FINE, pixel_sigma_px=0.1, state_intrinsics=given, **more)
            kept = _run(pool, with_a_board, [(options, seed) for seed in range(seeds)])
            mean = np.mean(kept, axis=0)
            rows.append(
                (
                    words,
                    "given" if given else "estimated",
                    f"{1e3 * np.sqrt(mean[1]):.3f}",
                    f"{1e3 * np.sqrt(mean[0]):.3f}",
                    f"{100 * mean[2]:.1f} %",
                    f"{100 * mean[3]:.1f} %",
                    f"{seeds - len(kept)}",
                )
            )
    return table(head, rows)


def healthy(seed: int) -> float:
    """1 where a healthy set is refused; they differ in everything, small tilts included."""
    rng = np.random.default_rng(seed)
    tilt = rng.uniform(0.06, 0.8)
    options = CellOptions(
        mount=rng.choice([IN_HAND, TO_HAND]),
        robot=str(rng.choice(["ur3e", "ur5e", "ur10e"])),
        camera=FINE if rng.random() < 0.5 else WIDE,
        views=int(rng.integers(8, 31)),
        state_intrinsics=bool(tilt < 0.4 or rng.random() < 0.5),
        tilt_rad=(0.0, tilt),
        roll_rad=float(rng.uniform(0.2, 1.4)),
        pixel_sigma_px=float(rng.uniform(0.03, 0.2)),
        robot_sigma_m=float(10 ** rng.uniform(-5, -4)),
        robot_sigma_rad=float(10 ** rng.uniform(-5, -4)),
        seed=seed,
    )
    try:
        calibrated(simulate(options))
    except VisioncalError:
        return 1.0
    return 0.0


def real_folds(path: Path, repeats: int) -> tuple[float, float]:
    """Held-out position [mm] and rotation [deg] of the board, rms over repeated 5-fold."""
    from visioncal.calibration.pipeline.run_state import RunState
    from visioncal.calibration.pipeline.solving import solve
    from visioncal.calibration.pipeline.steps import STAGES
    from visioncal.calibration.stages.cell import read_cell
    from visioncal.estimation.problem_parts import State

    session = Session.load(path)
    seen = RunState(session)
    for stage in STAGES:
        if stage.name in ("robot", "detect", "intrinsics", "pnp"):
            seen = stage.run(seen)
    cell, away = read_cell(seen), []
    whole = solve(cell, seen, "hand-eye")
    views = np.array([row.view for row in whole.cell.rows])[whole.inlier_fit.used]
    problem = whole.inlier_problem.with_effects([])
    rng = np.random.default_rng(0)
    for _ in range(repeats):
        for fold in np.array_split(rng.permutation(len(views)), 5):
            part = cell.without(dict.fromkeys(views[fold].tolist(), "left out"))
            edges = solve(part, seen, "hand-eye").inlier_fit.fit.state.edges
            left = problem.subset(np.isin(np.arange(len(views)), fold))
            state = State(edges, np.zeros(0))
            away.append(log(left.change_of(left.observations.observed[0], state)))
    error = np.concatenate(away)
    return (
        1e3 * float(np.sqrt(np.mean(np.sum(error[:, 3:] ** 2, axis=1)))),
        float(np.rad2deg(np.sqrt(np.mean(np.sum(error[:, :3] ** 2, axis=1))))),
    )


def real_table() -> str:
    folder = Path(__file__).parents[3] / "shared" / "data" / "sessions"
    path = folder / "ric_charuco_eye_to_hand"
    if not path.is_dir():
        return "The real session is not here (../shared/data)."
    millimetres, degrees = real_folds(path, few(20, 1))
    return (
        f"`ric_charuco_eye_to_hand`, 20 times 5-fold over 15 views, everything but the corners "
        f"estimated again in each fold: {millimetres:.2f} mm and {degrees:.3f} deg."
    )


def _run(pool, function: Callable, tasks: Sequence) -> list:
    return [value for value in pool.map(function, tasks, chunksize=4) if value is not None]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in lines)


def main(seeds: int, few: int) -> None:
    """Prints the tables and keeps them."""
    healthy_sets = 4 * few
    with Pool() as pool:
        refused = int(sum(pool.map(healthy, range(healthy_sets), chunksize=4)))
        text = f"""Simulated UR10e cells, 20 views of a 9 x 6 ChArUco board of 30 mm squares,
cameras of 2448 x 2048 (5 MP) and 1280 x 800 (1.0 MP). A good robot has noise of 0.03 mm and 0.05
mrad per stop, a coarse one of 0.3 mm and 0.5 mrad. Errors are root mean squares of the camera's
transform; the bound is the Cramer-Rao bound with the stated board. The squared error over the
stated covariance of both transforms, per degree of freedom, is 1 if the covariance is right; the
board's scale is exact here but has a prior sigma of 0.1 %, so 11/12 is expected. OpenCV's best is
the best of seven methods for each figure, with poses from solvePnP or calibrateCamera.

{seeds} seeds a row:

{bound_table(pool, seeds)}

Views with errors of 5 to 30 mm and 1 to 5 degrees in the reported pose, {few} seeds a row:

{wrong_table(pool, few)}

Arms that differ from their model, {few} seeds a row:

{arm_table(pool, few)}

Boards that differ from their description, {few} seeds a row (5 MP, 0.1 px, good robot, in hand):

{board_table(pool, few)}

Of {healthy_sets} sets (8 to 30 views, tilts up to 3 to 45 degrees, both mounts, three arms),
{refused} are refused: few views with the smallest tilts, over 5 mm at a typical noise.

{real_table()}
"""
    print(text)
    write_section(
        "The joint estimator", "PYTHONPATH=tests python tests/benchmarks/handeye.py", text
    )


if __name__ == "__main__":
    main(wished(SEEDS), wished(FEW, place=1))
