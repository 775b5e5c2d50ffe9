"""Small cells with known truth, as the core sees them: corners by OpenCV, not by our camera."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.types import Corners, Target
from visioncal.model import Arm, Cell, Moments, Sighting
from visioncal.model.arm import even_progress
from visioncal.session.document import CameraTable
from visioncal.session.tree import Branch, Tree
from visioncal.vision.targets import corner_positions

BOARD = Target("board", "checkerboard", 5, 4, 0.04, 4e-6)
TABLE = CameraTable(
    resolution=(1280, 1024),
    matrix=(1150.0, 1152.0, 644.0, 508.0),
    distortion=(-0.11, 0.09, 0.0004, -0.0006, -0.01),
)
PX, ROBOT_RAD, ROBOT_M = 0.1, 2e-4, 1e-4


def pose(turn, place):
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place
    return found


@dataclass(frozen=True, eq=False)
class Made:
    """A cell and its true edges."""

    cell: Cell
    edges: dict[str, np.ndarray]
    robot: np.ndarray  # (s, 4, 4) where the flange truly is.


def seen_at(rng):
    """cam_from_target: tilted, in the image."""
    turn = rng.uniform(0, 2 * np.pi)
    tilt = Rotation.from_rotvec(rng.uniform(0.1, 0.7) * np.array([np.cos(turn), np.sin(turn), 0]))
    found = np.eye(4)
    found[:3, :3] = (tilt * Rotation.from_rotvec([0, 0, rng.uniform(-1, 1)])).as_matrix()
    middle = np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.4, 0.7)])
    found[:3, 3] = middle - found[:3, :3] @ corner_positions(BOARD).mean(axis=0)
    return found


def pixels(cam_from_target, table, rng):
    fx, fy, cx, cy = table.matrix
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    points = corner_positions(BOARD) @ cam_from_target[:3, :3].T + cam_from_target[:3, 3]
    px = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(table.distortion))
    return px[0].reshape(-1, 2) + PX * rng.normal(size=(len(points), 2))


def made(seed=0, stops=8, cameras=1, *, in_hand=True, given=True, sways=0.0):
    """One arm, with some cameras on its flange that see one board, or fixed ones that see its.

    The last of several cameras `sways` on its mount from stop to stop [rad].
    """
    rng = np.random.default_rng([seed, 59])
    names = ["cam", *(f"cam_{at}" for at in range(1, cameras))]
    x = {name: pose(rng.normal(0, 0.1, 3), [0.03, -0.05, 0.09]) for name in names}
    z = pose([2.0, 0.1, 0.3], [0.55, -0.1, 0.02])
    boards = np.array([seen_at(rng) for _ in range(stops)])
    if in_hand:
        robot = z @ np.linalg.inv(boards) @ np.linalg.inv(x["cam"])
    else:
        robot = x["cam"] @ boards @ np.linalg.inv(z)
    noise = rng.normal(size=(stops, 2, 3)) * np.array([ROBOT_RAD, ROBOT_M])[:, None]
    reported = np.array([at @ pose(*step) for at, step in zip(robot, noise, strict=True)])
    sightings = []
    for stop in range(stops):
        for name in names:
            edge = np.linalg.inv(x[name]) @ x["cam"]
            if sways and name == names[-1]:
                edge = pose(sways * rng.normal(size=3), np.zeros(3)) @ edge
            px = pixels(edge @ boards[stop], TABLE, rng)
            ids = np.arange(len(px))
            corners = Corners(len(sightings), ids, px, 0.0)
            sightings.append(Sighting(len(sightings), stop, name, "target", corners))
    carried, fixed = (names, ["target"]) if in_hand else (["target"], names)
    branches = {"flange": Branch("base", robot="flange"), "base": Branch("cell", known=np.eye(4))}
    branches |= {name: Branch("flange") for name in carried}
    branches |= {name: Branch("base") for name in fixed}
    table = TABLE if given else replace_lens(TABLE)
    arms = {"flange": Arm("flange", reported)}
    cell = Cell(
        Tree("cell", branches), arms, dict.fromkeys(names, table), {"target": BOARD},
        tuple(sightings), Moments.of(arms, even_progress(stops)),
    )  # fmt: skip
    return Made(cell, {**x, "target": z}, robot)


def replace_lens(table):
    """A camera of which only the resolution is stated."""
    return replace(table, matrix=None, distortion=None)


def without(cell, row):
    """A cell without one sighting."""
    kept = [sighting for at, sighting in enumerate(cell.sightings) if at != row]
    return replace(cell, sightings=tuple(kept))
