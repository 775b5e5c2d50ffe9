"""Whole cells in plain arrays, by a forward model of their own: what is seen is the truth's chain.

Two robots on one floor, cameras that stand still or ride on a flange, boards on the floor and on
the flanges. A stop is one posture of every robot; at each, every camera sees some of the boards.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import compose, exp, invert, log
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Observations, State
from visioncal.session.tree import Branch, Tree

# Of a camera's poses [rad and m]: across the view, and towards it.
CAMERA_SIGMAS = np.array([3e-4, 3e-4, 1e-4, 3e-5, 3e-5, 1.2e-4])
ROBOT_SIGMAS = {"a": (5e-5, 3e-5), "b": (1e-4, 8e-5)}


def pose(rotvec_deg, place_m):
    turn = Rotation.from_rotvec(rotvec_deg, degrees=True)
    return compose(turn.as_matrix(), np.array(place_m))


@dataclass(frozen=True, eq=False)
class World:
    """A cell and what is seen of it."""

    truth: dict  # (4, 4) `parent_from_frame` of every frame but the flanges.
    parents: dict  # What each frame hangs on.
    flanges: dict  # (s, 4, 4) true `base_from_flange` by robot.
    pairs: list  # Which camera sees which board, at which stops.
    robot_sigmas: dict = field(default_factory=lambda: dict(ROBOT_SIGMAS))

    def place(self, frame, stop, changed=None):
        """(4, 4) `cell_from_frame` at a stop."""
        matrix = np.eye(4)
        while frame != "cell":
            if frame.startswith("flange_"):
                edge = self.flanges[frame[-1]][stop]
            else:
                edge = (changed or {}).get((frame, stop), self.truth[frame])
            matrix = edge @ matrix
            frame = self.parents[frame]
        return matrix

    def tree(self, known=("base_a",)):
        """The frames, some of them known."""
        branches = {}
        for name, parent in self.parents.items():
            robot = name[-1] if name.startswith("flange_") else ""
            branches[name] = Branch(parent, robot, self.truth[name] if name in known else None)
        return Tree("cell", branches)


PARENTS = {
    "base_a": "cell",
    "base_b": "cell",
    "flange_a": "base_a",
    "flange_b": "base_b",
    "cam_left": "cell",
    "cam_right": "cell",
    "target_floor": "cell",
    "target_a": "flange_a",
    "target_b": "flange_b",
}


def world(rng, stops=40, seen=0.7):
    """Two robots that hold a board each, two cameras that stand, a board on the floor."""
    truth = {
        "base_a": np.eye(4),
        "base_b": pose((2, -1, 170), (1.6, 0.1, 0.02)),
        "cam_left": pose((180, 5, 20), (0.75, -0.25, 1.5)),
        "cam_right": pose((170, 25, -10), (0.9, 0.3, 1.4)),
        "target_floor": pose((3, -2, 15), (0.7, 0.0, 0.05)),
        "target_a": pose((0, 3, 40), (0.01, 0.02, 0.05)),
        "target_b": pose((5, -3, -60), (-0.02, 0.01, 0.06)),
    }
    flanges = {"a": [], "b": []}
    for robot, base in (("a", truth["base_a"]), ("b", truth["base_b"])):
        middle = np.array([0.6, -0.05, 0.4]) if robot == "a" else np.array([0.9, 0.1, 0.45])
        for _ in range(stops):
            place = pose(rng.uniform(-35, 35, 3), middle + rng.uniform(-0.2, 0.2, 3))
            flanges[robot].append(np.linalg.inv(base) @ place)
    flanges = {robot: np.array(flange) for robot, flange in flanges.items()}
    pairs = [
        (cam, target, stop)
        for stop in range(stops)
        for cam in ("cam_left", "cam_right")
        for target in ("target_floor", "target_a", "target_b")
        if rng.random() < seen
    ]
    return World(truth, PARENTS, flanges, pairs)


def observed(world, rng, changed=None, noise=1.0):
    """Sees the world, with a share of the usual noise of cameras and robots.

    `changed` are edges that differ from the truth at some stops, by frame and stop.
    """
    reported, rows = {}, []
    for robot, flanges in world.flanges.items():
        sigma = np.repeat(world.robot_sigmas[robot], 3) * noise
        twists = rng.normal(size=(len(flanges), 6)) * sigma
        reported[robot] = flanges @ exp(twists)
    for cam, target, stop in world.pairs:
        true = np.linalg.inv(world.place(cam, stop, changed)) @ world.place(target, stop, changed)
        rows.append(true @ exp(rng.normal(size=6) * CAMERA_SIGMAS * noise))
    count = len(rows)
    observations = Observations(
        tuple(pair[0] for pair in world.pairs),
        tuple(pair[1] for pair in world.pairs),
        np.array([pair[2] for pair in world.pairs]),
        np.full(count, -1),
        np.array(rows),
        np.tile(np.diag(CAMERA_SIGMAS**2), (count, 1, 1)),
        np.ones(count, dtype=bool),
        np.zeros(count, dtype=bool),
    )
    return Problem(world.tree(), reported, observations)


def swung(times_s):
    """A flange that swings about all axes at up to 3 rad/s, never twice alike: (n, 4, 4)."""
    rates = np.array([0.31, 0.47, 0.73, 0.21, 0.37, 0.53])
    sizes = np.array([0.4, 0.5, 0.7, 0.1, 0.1, 0.1])
    return exp(np.sin(2 * np.pi * rates * times_s[:, None] + np.arange(6)) * sizes)


def true_state(world, tree):
    return State(np.array([world.truth[index] for index in tree.unknown]), np.zeros(0))


def away(world, problem, state):
    """(6 e,) twists of the estimated edges from the true ones, on their right."""
    truth = np.array([world.truth[name] for name in problem.tree.unknown])
    return log(invert(truth) @ state.edges).ravel()
