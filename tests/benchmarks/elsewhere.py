"""Cells that visioncal has not made: the worlds `elsewhere` of `compare.py`.

The generator is numpy and OpenCV alone; corners travel through `corners.csv`, poses through
`views.csv`. Base and flange are those of which the robot reports: what of an arm's errors is one
twist of the base and one of the flange at all postures is in no residual, and an arm that goes
where it is sent does it again.
"""

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

SIZE = (1280, 1024)
MATRIX = np.array([[1150.0, 0.0, 644.0], [0.0, 1152.0, 508.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.11, 0.09, 0.0004, -0.0006, -0.01])
COLUMNS, ROWS, SQUARE_M = 11, 8, 0.02
WINDOW_M = np.array([0.22, 0.16])
# A turn by a radian counts as a shift by so much where base and flange are fitted.
LEVER_M = 0.3
# Picks of each cell.
LOOKS = 4


@dataclass(frozen=True, eq=False)
class World:
    """What is wrong with a cell, beside noise."""

    views: int = 22  # How many stops.
    pixel_px: float = 0.05  # Noise of a corner's coordinate, an axis [px].
    robot_m: float = 5e-5  # Noise of the flange's place, an axis [m].
    robot_rad: float = 1e-4  # And of its rotation [rad].
    # (n, 2) pixels to (n, 2) displacements, drawn by a seed: a lens beyond its model.
    shift: Callable[[np.random.Generator], Callable[[np.ndarray], np.ndarray]] | None = None
    # By distance over the mean one, and by view: factors of the focal length.
    focus: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None
    # (c, 3) corners to where they really are, drawn by a seed.
    board: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None
    # (m, 4, 4) poses to what is reported of them, drawn by a seed, before noise.
    robot: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None
    # By what a share of the session, from -0.5 to 0.5, gives the robot's base has risen.
    lift: Callable[[np.ndarray], np.ndarray] | None = None
    off_px: float = 0.0  # Standard deviation of what given fx, fy, cx, cy are off by [px].
    is_said: bool = False  # Whether the session says so.
    causes: str = ""  # First ones that are right, where a fault is no source of noise: a pattern.
    noise: Callable[[tuple[int, int], np.random.Generator], np.ndarray] = field(
        default=lambda shape, rng: rng.normal(size=shape)
    )


def lens_field(sigma_px: float, length: float = 0.2):
    """A smooth field over the image: a Gaussian process of this size, `length` of the width."""

    def drawn(rng):
        # Random Fourier features of a squared exponential (Rahimi and Recht 2007).
        waves = rng.normal(size=(2, 400, 2)) / (length * SIZE[0])
        phases = rng.uniform(0, 2 * np.pi, (2, 400))
        weights = rng.normal(size=(2, 400)) * np.sqrt(2 / 400) * sigma_px

        def at(px):
            return np.stack(
                [np.cos(px @ waves[k].T + phases[k]) @ weights[k] for k in (0, 1)], axis=1
            )

        return at

    return drawn


def thin_prism(size: float):
    """Displacement of Brown's thin prism of this size, in units of the focal length."""

    def drawn(rng):
        turn = rng.uniform(0, 2 * np.pi)
        along = np.array([np.cos(turn), np.sin(turn)])

        def at(px):
            away = (px - MATRIX[:2, 2]) / MATRIX[0, 0]
            return MATRIX[0, 0] * size * np.sum(away**2, axis=1)[:, None] * along

        return at

    return drawn


def correlated(share: float):
    """Noise of stop after stop that remembers its last value by a share."""

    def drawn(shape, rng):
        found = rng.normal(size=shape)
        for at in range(1, shape[0]):
            found[at] = share * found[at - 1] + np.sqrt(1 - share**2) * found[at]
        return found

    return drawn


def bent(height_m: float):
    def drawn(corners, rng):
        half = (corners - corners.mean(axis=0)) / (np.ptp(corners, axis=0).max() / 2)
        turn = rng.uniform(0, np.pi)
        bow = height_m * (half[:, 0] * np.cos(turn) + half[:, 1] * np.sin(turn)) ** 2
        return corners + np.stack([0 * bow, 0 * bow, bow], axis=1)

    return drawn


def stretched(x: float, y: float):
    return lambda corners, _: corners * np.array([x, y, 1.0])


def sheared(by_rad: float):
    return lambda corners, _: corners + by_rad / 2 * corners[:, [1, 0, 2]] * [1.0, 1.0, 0.0]


def breathing(share: float):
    """The focal length follows the distance, over the mean one."""
    return lambda far, _: 1 + share * (far - 1)


def lifted(poses, by_m):
    """(m, 4, 4) poses of a robot whose base rises meanwhile."""
    found = poses.copy()
    found[:, 2, 3] += by_m(np.linspace(-0.5, 0.5, len(poses)))
    return found


# Denavit-Hartenberg rows (theta, d, a, alpha) of an arm of six joints that reaches 1.75 m.
ARM = np.array(
    [
        [0.0, 0.2363, 0.0, np.pi / 2],
        [0.0, 0.0, -0.862, 0.0],
        [0.0, 0.0, -0.7287, 0.0],
        [0.0, 0.201, 0.0, np.pi / 2],
        [0.0, 0.1593, 0.0, -np.pi / 2],
        [0.0, 0.1543, 0.0, 0.0],
    ]
)
HOME = np.array([0.0, -1.2, -1.8, -1.6, 1.6, 0.0])


def links(q, arm=ARM):
    """(m, 7, 4, 4) the base and the frames behind each joint, at (m, 6) joint angles."""
    found = [np.broadcast_to(np.eye(4), (len(q), 4, 4))]
    for joint, (theta, d, a, alpha) in enumerate(arm):
        c, s = np.cos(q[:, joint] + theta), np.sin(q[:, joint] + theta)
        step = np.zeros((len(q), 4, 4))
        step[:, 0] = np.stack([c, -s * np.cos(alpha), s * np.sin(alpha), a * c], axis=1)
        step[:, 1] = np.stack([s, c * np.cos(alpha), -c * np.sin(alpha), a * s], axis=1)
        step[:, 2], step[:, 3, 3] = [0.0, np.sin(alpha), np.cos(alpha), d], 1.0
        found.append(found[-1] @ step)
    return np.stack(found, axis=1)


def joints_at(poses, flange=links, rng=None):
    """(m, 6) joint angles of flange poses, all of one posture where they can be."""
    rng, q = rng or np.random.default_rng(5), np.tile(HOME, (len(poses), 1))
    for _ in range(60):
        for _ in range(40):
            frames = flange(q)
            away = np.zeros((len(q), 6))
            away[:, :3] = Rotation.from_matrix(
                poses[:, :3, :3] @ np.swapaxes(frames[:, -1, :3, :3], 1, 2)
            ).as_rotvec()
            away[:, 3:] = poses[:, :3, 3] - frames[:, -1, :3, 3]
            axis, origin = frames[:, :-1, :3, 2], frames[:, :-1, :3, 3]
            slope = np.concatenate([axis, np.cross(axis, frames[:, -1:, :3, 3] - origin)], axis=2)
            square = np.swapaxes(slope, 1, 2) @ slope + 1e-9 * np.eye(6)
            step = np.einsum("mki,mi->mk", slope, np.linalg.solve(square, away[..., None])[..., 0])
            q = q + np.clip(step, -0.3, 0.3)
        lost = np.abs(away).max(axis=1) > 1e-10
        if not lost.any():
            return q
        q[lost] = HOME + rng.normal(0, 0.8, (lost.sum(), 6))
    raise RuntimeError("a pose is out of reach")


def arm_off_by(size_m):
    """An arm whose lengths are off by so much, and its angles by that over half a metre."""

    def moved(poses, rng):
        errors = rng.normal(0, size_m, ARM.shape) / [0.5, 1.0, 1.0, 0.5]
        return links(joints_at(poses, lambda q: links(q, ARM + errors)))[:, -1]

    return moved


def joints_off_by(by_rad):
    """An arm whose joints stand elsewhere than it reports: by (m, 6) of its frames and a seed."""

    def moved(poses, rng):
        q = joints_at(poses)
        return links(q + by_rad(links(q), q, rng))[:, -1]

    return moved


def sagging(size):
    """Springs under the weight of the links beyond them: so much at the shoulder, stretched [m]."""

    def by_rad(frames, q, _):
        found = np.zeros_like(q)
        masses = np.array([0.0, 1.0, 0.6, 0.2, 0.2, 0.1, 0.1])
        for joint in (1, 2, 3):
            arms = frames[:, joint + 1 :, :3, 3] - frames[:, joint, None, :3, 3]
            force = np.array([0.0, 0.0, -1.0]) * masses[joint + 1 :, None]
            torque = np.cross(arms, force).sum(axis=1)
            found[:, joint] = np.sum(torque * frames[:, joint, :3, 2], axis=1)
        return size * found

    return by_rad


def playing(size_rad):
    """Each joint stands on the side that it came from."""

    def by_rad(_, q, rng):
        way = np.sign(np.diff(q, axis=0, prepend=rng.normal(q[:1], 1.0)))
        return 0.5 * size_rad * way * np.abs(rng.normal(1.0, 0.3, 6))

    return by_rad


def bending(size_m):
    """What the flange carries bends with its weight: it looks as if the flange were elsewhere."""

    def moved(poses, rng):
        down = poses[:, 2, :3]
        turn, shift = size_m / 0.1 * rng.normal(size=(3, 3)), size_m * rng.normal(size=(3, 3))
        bends = [pose(turn @ value, shift @ value) for value in down]
        return poses @ np.linalg.inv(np.array(bends))

    return moved


def tilting(size_rad_m):
    """The base tilts with the moment of what hangs at the flange, by its stand's stiffness."""

    def moved(poses, rng):
        stiff = rng.uniform(0.5, 1.0, 2)
        turns = size_rad_m * np.pad(poses[:, [1, 0], 3] * [-1.0, 1.0] * stiff, ((0, 0), (0, 1)))
        return np.array([pose(turn, np.zeros(3)) for turn in turns]) @ poses

    return moved


def growing(size):
    """A camera that warms up during the session."""

    def focal(far, _):
        return 1.0 + size * (1.0 - np.exp(-3.0 * np.arange(len(far)) / len(far)))

    return focal


WORLDS = {
    "clean": World(),
    "clean, 6 views": World(views=6),
    "clean, 200 views": World(views=200),
    "heavy tails (t, 3)": World(
        noise=lambda shape, rng: rng.standard_t(3, size=shape) / np.sqrt(3.0)
    ),
    "correlated 0.9": World(noise=correlated(0.9)),
    "correlated 0.97": World(noise=correlated(0.97)),
    "field 0.03 px": World(shift=lens_field(0.03)),
    "field 0.1 px": World(shift=lens_field(0.1)),
    "field 0.2 px": World(shift=lens_field(0.2)),
    "field 0.1 px, 80 views": World(shift=lens_field(0.1), views=80),
    "field 0.2 px, 200 views": World(shift=lens_field(0.2), views=200),
    "lens grows by 0.15 %, 30 views": World(focus=growing(0.0015), views=30, causes="lens_grows"),
    "base tilts by 1.5 mrad/m, 30 views": World(
        robot=tilting(1.5e-3), views=30, causes="base_tilts"
    ),
    "thin prism": World(shift=thin_prism(0.002)),
    "breathing 0.1 %": World(focus=breathing(0.001)),
    "breathing 0.3 %": World(focus=breathing(0.003)),
    "breathing 1 %": World(focus=breathing(0.01)),
    "focus jitter 0.1 %": World(focus=lambda far, rng: 1 + 0.001 * rng.normal(size=len(far))),
    "board bent 0.5 mm": World(board=bent(5e-4)),
    "board 0.2 % too large": World(board=stretched(1.002, 1.002)),
    "board 0.1 % longer one way": World(board=stretched(1.0005, 0.9995)),
    "board sheared by 1.5 mrad": World(board=sheared(1.5e-3)),
    "drift 0.5 mm": World(lift=lambda share: 5e-4 * share, causes="drift|moved|base_creeps"),
    "given lens off by 0.5 px": World(off_px=0.5),
    "given lens off by 2 px": World(off_px=2.0),
    "given lens off by 0.5 px, said": World(off_px=0.5, is_said=True),
    "given lens off by 2 px, said": World(off_px=2.0, is_said=True),
    "camera bumped 1 mm": World(
        lift=lambda share: 1e-3 * ((share > 0) - 0.5), causes="moved|step|slip|drift"
    ),
    "arm off by 0.05 mm": World(robot=arm_off_by(5e-5)),
    "arm off by 0.1 mm": World(robot=arm_off_by(1e-4)),
    "arm off by 0.3 mm": World(robot=arm_off_by(3e-4)),
    "backlash 0.2 mrad": World(robot=joints_off_by(playing(2e-4))),
    "sag 1 mm": World(robot=joints_off_by(sagging(5e-4))),
    "mount flex 0.1 mm": World(robot=bending(1e-4)),
}


@dataclass(frozen=True, eq=False)
class Case:
    """One cell, as it truly is; `reported_of` flanges (m, 4, 4) leaves noise out."""

    world: World
    mount: str
    x: np.ndarray
    z: np.ndarray
    reported_of: Callable[[np.ndarray], np.ndarray]
    shift: Callable[[np.ndarray], np.ndarray]
    mean_m: float

    def flanges(self, boards):
        """(m, 4, 4) where the flange is when the camera sees its board so."""
        if self.mount == "eye-in-hand":
            return self.z @ np.linalg.inv(boards) @ np.linalg.inv(self.x)
        return self.x @ boards @ np.linalg.inv(self.z)

    @property
    def reported_x(self):
        """The camera in the flange or the base of which the robot reports."""
        base, flange = self.frames
        return (np.linalg.inv(flange) if self.mount == "eye-in-hand" else base) @ self.x

    @cached_property
    def frames(self):
        """(4, 4) twice: the base that is in the one reported, the flange reported in the other.

        As other views of that cell have them, by least squares. A base that tilts leaves the
        flange where it is.
        """
        if self.world.robot is None:
            return np.eye(4), np.eye(4)
        for seed in count():
            robot = self.flanges(np.array([*views_of(22, np.random.default_rng([seed, 47]))]))
            try:
                reported = np.linalg.inv(self.reported_of(robot))
                break
            except RuntimeError:  # Out of the arm's reach.
                continue

        def away(twists):
            twists = np.pad(twists, (0, 12 - len(twists)))
            found = reported @ pose(*twists[:6].reshape(2, 3)) @ robot
            found = found @ pose(*twists[6:].reshape(2, 3))
            turns = Rotation.from_matrix(found[:, :3, :3]).as_rotvec()
            return np.append(LEVER_M * turns, found[:, :3, 3])

        free = np.zeros(6 if self.world.causes == "base_tilts" else 12)
        best = np.pad(least_squares(away, free, x_scale=1e-3).x, (0, 12 - len(free)))
        return pose(*best[:6].reshape(2, 3)), pose(*best[6:].reshape(2, 3))


def pose(turn, place):
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place
    return found


def seen(camera_from_points, shift, focal=1.0):
    """Pixels of (n, 3) points in the camera's frame."""
    matrix = MATRIX.copy()
    matrix[[0, 1], [0, 1]] *= focal
    px = cv2.projectPoints(
        camera_from_points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, DISTORTION
    )[0].reshape(-1, 2)
    return px + shift(px)


def centre_ray(shift) -> np.ndarray:
    """(3,) rotation vector of the least turn of z into the ray of the image's centre."""
    px = middle = (np.array([SIZE]) - 1.0) / 2.0
    for _ in range(20):
        px = middle - shift(px)
    exact = (3, 100, 1e-14)
    ray = cv2.undistortPointsIter(
        px.reshape(1, 1, 2), MATRIX, DISTORTION, None, None, exact
    ).ravel()
    about = np.array([-ray[1], ray[0], 0.0])
    return np.arctan(np.linalg.norm(ray)) * about / np.linalg.norm(about)


def views_of(views, rng) -> Iterator[np.ndarray]:
    """cam_from_target: the board in the image, tilted by up to 40 degrees about any axis."""
    corner = np.array([[0, 0, 0], [WINDOW_M[0], 0, 0], [0, WINDOW_M[1], 0], [*WINDOW_M, 0]])
    while views:
        tilt = np.deg2rad(rng.uniform(5, 40)) * np.array([*_unit(rng), 0.0])
        turn = Rotation.from_rotvec(tilt) * Rotation.from_rotvec([0, 0, rng.uniform(-1, 1)])
        far = rng.uniform(0.3, 0.7)
        at = np.array([*(rng.uniform(-0.28, 0.28, 2) * far), far])
        found = np.eye(4)
        found[:3, :3] = turn.as_matrix()
        found[:3, 3] = at - found[:3, :3] @ np.array([*(WINDOW_M / 2), 0])
        px = seen(corner @ found[:3, :3].T + found[:3, 3], np.zeros_like)
        if np.all((px > 25) & (px < np.array(SIZE) - 25)):
            views -= 1
            yield found


def _unit(rng):
    turn = rng.uniform(0, 2 * np.pi)
    return np.cos(turn), np.sin(turn)


def cell(world: World, mount: str, given: bool, seed: int, folder: Path) -> Case:
    rng = np.random.default_rng([seed, 41])
    shift = world.shift(rng) if world.shift else np.zeros_like
    grid = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).reshape(-1, 2)
    corners = np.column_stack([SQUARE_M * grid, np.zeros(len(grid))])
    real = world.board(corners, rng) if world.board else corners
    boards = np.array([*views_of(world.views, rng)])
    if mount == "eye-in-hand":
        x = pose(rng.normal(0, 0.1, 3), [0.03, -0.05, 0.09])
        z = pose([0.02, -0.01, 0.4], [0.55, -0.1, 0.02])
        z[:3, :3] = z[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        robot = z @ np.linalg.inv(boards) @ np.linalg.inv(x)
    else:
        x = pose(np.array([0.1, 2.9, 0.2]), [0.9, 0.1, 0.7])
        z = pose(rng.normal(0, 0.2, 3), [-0.1, -0.08, 0.05])
        robot = x @ boards @ np.linalg.inv(z)
    mean_m = float(boards[:, 2, 3].mean())
    far = boards[:, 2, 3] / mean_m
    focal = world.focus(far, rng) if world.focus else np.ones(len(far))
    pixels = np.array(
        [
            seen(real @ board[:3, :3].T + board[:3, 3], shift, zoom)
            for board, zoom in zip(boards, focal, strict=True)
        ]
    )
    pixels = pixels + world.pixel_px * rng.normal(size=pixels.shape)
    drawn = deepcopy(rng)

    def reported_of(flanges):
        return world.robot(flanges, deepcopy(drawn)) if world.robot else flanges

    try:
        reported = world.robot(robot, rng) if world.robot else robot
    except RuntimeError:  # Other views instead of those that the arm does not reach.
        return cell(world, mount, given, seed + 1000, folder)
    reported = lifted(reported, world.lift) if world.lift else reported
    errors = world.noise((len(robot), 6), rng)
    steps = np.array(
        [pose(world.robot_rad * error[:3], world.robot_m * error[3:]) for error in errors]
    )
    reported = reported @ steps
    stated = MATRIX.copy()
    stated[[0, 1, 0, 1], [0, 1, 2, 2]] += world.off_px * rng.normal(size=4)
    write(folder, mount, stated if given else None, reported, pixels)
    if given and world.is_said:
        with (folder / "session.toml").open("a") as file:
            file.write(f"matrix_sigma_px = {world.off_px}\n")
    return Case(world, mount, x, z, reported_of, shift, mean_m)


def write(folder, mount, matrix, reported, pixels):
    folder.mkdir(parents=True)
    lens = (
        ""
        if matrix is None
        else f"matrix = {matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()}\n"
        f"distortion = {DISTORTION.tolist()}\n"
    )
    (folder / "board.toml").write_text(
        f'kind = "checkerboard"\ncolumns = {COLUMNS}\nrows = {ROWS}\nsquare_m = {SQUARE_M}\n'
        "square_sigma_m = 0.000002\n"
    )
    (folder / "session.toml").write_text(
        f'schema = 1\nname = "elsewhere"\nmount = "{mount}"\ntarget = "board.toml"\n[camera]\n'
        f"resolution = {list(SIZE)}\n{lens}"
    )
    rows = ["view,x_m,y_m,z_m,qx,qy,qz,qw"]
    for view, value in enumerate(reported):
        q = Rotation.from_matrix(value[:3, :3]).as_quat()
        rows.append(",".join([str(view), *(f"{v:.9f}" for v in (*value[:3, 3], *q))]))
    (folder / "views.csv").write_text("\n".join(rows) + "\n")
    lines = ["view,point,u_px,v_px"]
    for view, px in enumerate(pixels):
        lines += [f"{view},{at},{u:.5f},{v:.5f}" for at, (u, v) in enumerate(px)]
    (folder / "corners.csv").write_text("\n".join(lines) + "\n")


@dataclass(frozen=True, eq=False)
class Look:
    """One more image, of a point that is to be picked."""

    px: np.ndarray  # (2,) its pixel.
    point: np.ndarray  # (3,) where it is in the base of which the robot reports.
    normal: np.ndarray  # (3,) of the plane that it lies in: across the camera's axis.
    reported: np.ndarray  # (4, 4) where the robot says that it was.


def looks_of(case: Case, seed: int) -> list[Look]:
    rng, world = np.random.default_rng([seed, 43]), case.world
    base, looks, robots = case.frames[0], [], []
    for board in views_of(LOOKS, rng):
        point = board @ np.array([*(WINDOW_M / 2), 0.0, 1.0])
        noise = rng.normal(size=6)
        error = pose(world.robot_rad * noise[:3], world.robot_m * noise[3:])
        robots.append(case.flanges(board))
        camera = base @ (robots[-1] @ case.x if case.mount == "eye-in-hand" else case.x)
        far = board[2:3, 3] / case.mean_m
        focal = float(world.focus(far, rng)[0]) if world.focus else 1.0
        px = seen(point[None, :3], case.shift, focal)[0] + world.pixel_px * rng.normal(size=2)
        looks.append(Look(px, (camera @ point)[:3], camera[:3, 2], error))
    try:
        reported = case.reported_of(np.array(robots))
    except RuntimeError:  # Other looks instead of those that the arm does not reach.
        return looks_of(case, seed + 1000)
    return [
        replace(look, reported=at @ look.reported) for look, at in zip(looks, reported, strict=True)
    ]
