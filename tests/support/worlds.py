"""Simulated hand-eye problems: a camera that looks at a board, and noise of known size.

Written with numpy alone, so that the solvers are not judged with their own tools.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Mount

BOARD_CENTRE_M = np.array([0.12, 0.08, 0.0])
BOARD_M = np.array([(0.015 + 0.03 * x, 0.02 + 0.03 * y, 0.0) for y in range(5) for x in range(8)])
CAMERA_MATRIX = np.array([[1100.0, 0.0, 640.0], [0.0, 1100.0, 400.0], [0.0, 0.0, 1.0]])
# OpenCV's calibrateRobotWorldHandEye has these; calibrateHandEye has the others.
BOTH_AT_ONCE = ("shah", "li")


@dataclass(frozen=True)
class World:
    """What a set of views is drawn from."""

    views: int = 20  # How many.
    tilt_deg: float = 40.0  # The largest angle between the optical axis and the board's normal.
    roll_deg: float = 40.0  # The largest rotation about the optical axis.
    distance_m: tuple[float, float] = (0.4, 0.8)  # The nearest and the farthest camera.
    robot_mm: float = 0.0  # Noise of the reported robot pose, a standard deviation for each axis.
    robot_mrad: float = 0.0  # The same for its rotation.
    camera_mm: float = 0.0  # Noise of the board's centre across the optical axis.
    camera_mrad: float = 0.0  # Noise of the board's orientation.
    depth_ratio: float = 1.0  # Noise along the optical axis over the noise across it.
    # Where positive, the camera's poses come from corners with this noise instead.
    corner_px: float = 0.0
    # Rotation vector of X [rad]; drawn for each seed where it is absent.
    x_turn: tuple[float, float, float] | None = None
    mount: Mount = "eye-in-hand"  # What holds the camera.


@dataclass(frozen=True, eq=False)
class Problem:
    """Measured poses, all (m, 4, 4), and the (4, 4) truth behind them: R X C = Z."""

    robot: FloatArray
    camera: FloatArray
    x: FloatArray
    z: FloatArray


PRECISE = World(robot_mm=0.03, robot_mrad=0.05, camera_mm=0.2, camera_mrad=0.3)
COARSE = World(robot_mm=0.3, robot_mrad=0.5, camera_mm=0.2, camera_mrad=0.3)

NOISY_WORLDS = {
    "precise robot": PRECISE,
    "coarse robot": COARSE,
    "depth 4 times as noisy": replace(PRECISE, depth_ratio=4.0),
    "corners of 0.2 px": replace(COARSE, corner_px=0.2),
    "corners, precise robot": replace(PRECISE, corner_px=0.2),
    "any roll": replace(COARSE, roll_deg=180.0),
    "tilts of 20 deg": replace(PRECISE, tilt_deg=20.0, roll_deg=20.0),
    "tilts of 10 deg": replace(PRECISE, tilt_deg=10.0, roll_deg=10.0),
    "tilts of 5 deg": replace(PRECISE, tilt_deg=5.0, roll_deg=5.0),
    "tilts of 5 deg, coarse": replace(COARSE, tilt_deg=5.0, roll_deg=5.0),
    "X turned by 179 deg": replace(COARSE, x_turn=(0.0, 0.0, np.radians(179.0))),
    "8 views": replace(COARSE, views=8),
    "60 views": replace(COARSE, views=60),
    "eye-to-hand": replace(COARSE, mount="eye-to-hand"),
    "eye-to-hand, precise": replace(PRECISE, mount="eye-to-hand"),
    "eye-to-hand, corners": replace(COARSE, mount="eye-to-hand", corner_px=0.2),
}


def turn(vectors: FloatArray) -> FloatArray:
    """Rodrigues' formula: (..., 3) rotation vectors to (..., 3, 3) rotations."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    cross = np.cross(vectors[..., None, :], np.eye(3)).swapaxes(-1, -2)
    sinc, versine = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + sinc * cross + versine * (cross @ cross)


def rigid(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    matrices = np.zeros((*shape, 4, 4))
    matrices[..., :3, :3], matrices[..., :3, 3] = rotation, translation
    matrices[..., 3, 3] = 1.0
    return matrices


def random_turns(rng: np.random.Generator, count: int, largest_rad: float) -> FloatArray:
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return turn(axes * rng.uniform(0.0, largest_rad, size=(count, 1)))


def simulate(world: World, seed: int) -> Problem:
    rng = np.random.default_rng(seed)
    turned = (
        random_turns(rng, 1, np.pi)[0] if world.x_turn is None else turn(np.array(world.x_turn))
    )
    # What is bolted to the flange is near it; the base is not.
    reach_x, reach_z = (0.15, 0.8) if world.mount == "eye-in-hand" else (0.8, 0.15)
    x = rigid(turned, rng.uniform(-reach_x, reach_x, size=3))
    z = rigid(random_turns(rng, 1, np.pi)[0], rng.uniform(-reach_z, reach_z, size=3))
    camera = _looking_at_board(world, rng)
    robot = z @ np.linalg.inv(x @ camera)
    seen = _from_corners if world.corner_px > 0.0 else _camera_noise
    return Problem(_robot_noise(robot, world, rng), seen(camera, world, rng), x, z)


def free_poses(
    rng: np.random.Generator, views: int, largest_rad: float, reach_m: float, x: FloatArray
) -> Problem:
    """Exact views of no camera in particular: any orientation, translations up to `reach_m`."""
    z = rigid(random_turns(rng, 1, np.pi)[0], rng.uniform(-reach_m, reach_m, size=3))
    camera = rigid(
        random_turns(rng, views, largest_rad), rng.uniform(-reach_m, reach_m, size=(views, 3))
    )
    return Problem(z @ np.linalg.inv(x @ camera), camera, x, z)


def _looking_at_board(world: World, rng: np.random.Generator) -> FloatArray:
    m = world.views
    heading = rng.uniform(-np.pi, np.pi, size=m)
    tilt = np.radians(world.tilt_deg) * np.sqrt(rng.uniform(size=m))
    roll = np.radians(world.roll_deg) * rng.uniform(-1.0, 1.0, size=m)
    zero = np.zeros(m)
    tilted = turn(np.stack([tilt * np.cos(heading), tilt * np.sin(heading), zero], axis=1))
    rotation = turn(np.stack([zero, zero, roll], axis=1)) @ tilted
    centre = rng.uniform(-0.05, 0.05, size=(m, 3))
    centre[:, 2] = rng.uniform(*world.distance_m, size=m)
    return rigid(rotation, centre - rotation @ BOARD_CENTRE_M)


def _robot_noise(robot: FloatArray, world: World, rng: np.random.Generator) -> FloatArray:
    m = len(robot)
    error = rigid(
        turn(1e-3 * world.robot_mrad * rng.normal(size=(m, 3))),
        1e-3 * world.robot_mm * rng.normal(size=(m, 3)),
    )
    # The error is the flange's own: at the right of base_from_flange, at the left of its inverse.
    return robot @ error if world.mount == "eye-in-hand" else error @ robot


def _camera_noise(camera: FloatArray, world: World, rng: np.random.Generator) -> FloatArray:
    m = len(camera)
    shift = 1e-3 * world.camera_mm * rng.normal(size=(m, 3)) * [1.0, 1.0, world.depth_ratio]
    rotation = camera[:, :3, :3] @ turn(1e-3 * world.camera_mrad * rng.normal(size=(m, 3)))
    centre = camera[:, :3, :3] @ BOARD_CENTRE_M + camera[:, :3, 3] + shift
    # A pose from an image is sharp at the board's centre, not at the frame's far origin.
    return rigid(rotation, centre - rotation @ BOARD_CENTRE_M)


def _from_corners(camera: FloatArray, world: World, rng: np.random.Generator) -> FloatArray:
    poses = np.empty_like(camera)
    for view, pose in enumerate(camera):
        start = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3].copy()
        corners = cv2.projectPoints(BOARD_M, *start, CAMERA_MATRIX, None)[0].reshape(-1, 2)
        corners += world.corner_px * rng.normal(size=corners.shape)
        _, rotation, translation = cv2.solvePnP(BOARD_M, corners, CAMERA_MATRIX, None)
        poses[view] = rigid(cv2.Rodrigues(rotation)[0], translation.ravel())
    return poses


def opencv(name: str, problem: Problem) -> FloatArray:
    """X by OpenCV's method of that name; NaN where it refuses with an error."""
    robot_from_x = problem.robot if name not in BOTH_AT_ONCE else np.linalg.inv(problem.robot)
    robot = list(robot_from_x[:, :3, :3]), list(robot_from_x[:, :3, 3])
    camera = list(problem.camera[:, :3, :3]), list(problem.camera[:, :3, 3])
    try:
        if name in BOTH_AT_ONCE:
            method = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name.upper()}")
            *_, turned, shifted = cv2.calibrateRobotWorldHandEye(*camera, *robot, method=method)
            return np.linalg.inv(rigid(turned, shifted.ravel()))
        method = getattr(cv2, f"CALIB_HAND_EYE_{name.upper()}")
        turned, shifted = cv2.calibrateHandEye(*robot, *camera, method=method)
    except cv2.error:
        return np.full((4, 4), np.nan)
    return rigid(turned, shifted.ravel())


def turn_error(estimate: FloatArray, truth: FloatArray) -> float:
    """Angle [rad] between two transforms, from the chord: exact where the angle is tiny."""
    chord = np.linalg.norm(estimate[:3, :3] - truth[:3, :3])
    return float(2.0 * np.arcsin(min(chord / np.sqrt(8.0), 1.0)))


def shift_error(estimate: FloatArray, truth: FloatArray) -> float:
    """Distance [m] between the origins of two transforms."""
    return float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3]))
