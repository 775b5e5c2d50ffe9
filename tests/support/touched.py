"""Touches of a simulated tool, by arithmetic of their own."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.estimation.problem_parts import Noise
from visioncal.frames.pivot import Touches

TIP = np.array([0.034, 0.001, 0.16])
TURN = Rotation.from_euler("xyz", [10.0, -20.0, 35.0], degrees=True)
POINTS = np.array([[0.62, 0.1, 0.2], [0.45, -0.25, 0.21], [0.7, 0.3, 0.05]])
EXACT = Noise.of_robot(0.0, 0.0)


@dataclass(frozen=True)
class Job:
    """What is touched: as the figures of a simulation."""

    tips: int = 10  # Touches of kind `point`, of each point.
    axes: int = 0  # Touches of kind `z`, and as many of kind `xz`.
    points: int = 1  # How many points.
    cone_deg: float = 45.0  # Largest tilt of the flange.
    contact_m: float = 1e-4  # Noise of a contact, per axis.
    noise: Noise = EXACT  # Of the flange.


@dataclass(frozen=True, eq=False)
class Made:
    """Simulated touches, the flange's true rotations (n,), and where in the tool the points are."""

    touches: Touches
    truly: Rotation
    reached: np.ndarray
    job: Job


def touched(job: Job, seed: int) -> Made:
    rng = np.random.default_rng(seed)
    kinds = ["point"] * job.tips * job.points + ["z"] * job.axes + ["xz"] * job.axes
    count = len(kinds)
    which = np.concatenate(
        [np.repeat(np.arange(job.points), job.tips), np.zeros(2 * job.axes, dtype=int)]
    )
    tilt = np.deg2rad(job.cone_deg) * np.sqrt(rng.uniform(0.0, 1.0, count))
    aside, spin = rng.uniform(0.0, 2 * np.pi, count), rng.uniform(-1.5, 1.5, count)
    lean = np.stack([tilt * np.cos(aside), tilt * np.sin(aside), np.zeros(count)], axis=1)
    down = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    truly = Rotation.from_rotvec(lean) * down * Rotation.from_rotvec(np.outer(spin, [0, 0, 1.0]))
    reached = np.array([_reach(kind, rng) for kind in kinds])
    met = POINTS[which] + job.contact_m * rng.standard_normal((count, 3))
    # The point of the tool at `reached` stands where the contact was.
    place = met - truly.apply(TURN.apply(reached) + TIP)
    shift = job.noise.robots[0, 1] * rng.standard_normal((count, 3))
    read = truly * Rotation.from_rotvec(job.noise.robots[0, 0] * rng.standard_normal((count, 3)))
    return Made(_touches(read, place + truly.apply(shift), which, kinds), truly, reached, job)


def slipped(touches: Touches, at: int, shift_m: np.ndarray) -> Touches:
    """The touches with one flange elsewhere."""
    poses = touches.base_from_flange.copy()
    poses[at, :3, 3] += shift_m
    return replace(touches, base_from_flange=poses)


def turned(touches: Touches, at: int, by_rad: np.ndarray) -> Touches:
    """The touches with one flange turned on the spot."""
    poses = touches.base_from_flange.copy()
    poses[at, :3, :3] = poses[at, :3, :3] @ Rotation.from_rotvec(by_rad).as_matrix()
    return replace(touches, base_from_flange=poses)


def relabelled(touches: Touches, at: int, point: int) -> Touches:
    """The touches with one said to be of another point."""
    points = touches.points.copy()
    points[at] = point
    return replace(touches, points=points)


def error_of(flange_from_tool: np.ndarray) -> np.ndarray:
    """How far off an answer is: (6,) rotation [rad] and translation [m] in the tool's frame."""
    turn = (TURN.inv() * Rotation.from_matrix(flange_from_tool[:3, :3])).as_rotvec()
    return np.concatenate([turn, TURN.inv().apply(flange_from_tool[:3, 3] - TIP)])


def _reach(kind: str, rng: np.random.Generator) -> np.ndarray:
    if kind == "point":
        return np.zeros(3)
    if kind == "z":
        return np.array([0.0, 0.0, rng.uniform(0.08, 0.12)])
    return np.array([rng.uniform(0.08, 0.12), 0.0, rng.uniform(-0.02, 0.02)])


def _touches(read: Rotation, place: np.ndarray, which: np.ndarray, kinds: list[str]) -> Touches:
    poses = np.zeros((len(kinds), 4, 4))
    poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = read.as_matrix(), place, 1.0
    names = tuple("ABC"[: which.max() + 1])
    return Touches(
        poses, which, tuple(kinds), tuple(str(index) for index in range(len(kinds))), names
    )
