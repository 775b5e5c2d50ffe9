"""The robots' own errors in a whole cell: unknowns beside the frames, where they are asked for.

What the first joint's place could take up is the base's, and what the last one's could is the
flange's: both are frames of the cell already.
"""

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from visioncal.alignment.cell import Cell, robot_key
from visioncal.estimation.joint import chance_limit
from visioncal.estimation.problem import Effect, Noise, Problem, State
from visioncal.estimation.solve import normal_equations, score_gain
from visioncal.estimation.variance import Knowledge
from visioncal.robot import Robot
from visioncal.transforms import adjoint, invert
from visioncal.types import FloatArray

# What of the arms is estimated: nothing, the offsets of their joints, or all of their geometry.
ArmsAsked: TypeAlias = Literal["reported", "offsets", "kinematics"]
ARMS_ASKED: tuple[ArmsAsked, ...] = get_args(ArmsAsked)
# What is known of any arm: its joints' zeros [rad], and each link's place in the one before.
_OFFSET_SIGMA, _LINK_SIGMA_RAD, _LINK_SIGMA_M = 0.02, 2e-3, 1e-3


@dataclass(frozen=True, eq=False)
class ArmsErrors:
    """Unknowns of the arms.

    Attributes:
        effects: One a robot, by how its flange moves at every station.
        robots: The robots, in that order.
        unasked: Robots whose errors cannot be asked for, because joints or models are missing.
    """

    effects: tuple[Effect, ...] = ()
    robots: tuple[str, ...] = ()
    unasked: tuple[str, ...] = ()

    @property
    def values(self) -> FloatArray:
        """(k,) all of them, of arms as they are stated."""
        return np.concatenate([np.zeros(0), *(it.values for it in self.effects)])

    def document(self, problem: Problem, state: State, spread: FloatArray) -> dict[str, Any]:
        """What was found of each arm, as it stands on disk.

        Args:
            problem: The problem that has these effects.
            state: The unknowns.
            spread: (p, p) their covariance.
        """
        sigmas = np.sqrt(np.diag(spread))
        return {
            robot: {
                "values": problem.values_of(it.name, state).tolist(),
                "sigmas": sigmas[problem.effect_columns[it.name]].tolist(),
            }
            for robot, it in zip(self.robots, self.effects, strict=True)
        }


def arms_errors(cell: Cell, asked: ArmsAsked) -> ArmsErrors:
    """Sets up what is asked of the arms.

    Args:
        cell: The cell.
        asked: `offsets` for the zeros of all joints between the first and the last, in their
            order; `kinematics` for the place of each link in the one before, too, in six numbers
            each (rotation, translation).
    """
    effects: dict[str, Effect] = {}
    unasked = []
    for name in cell.session.robots if asked != "reported" else ():
        key, document = robot_key(name), cell.session.robot_documents.get(name)
        if key not in cell.poses:
            continue
        joints = _joints(cell, name)
        if document is None or joints is None:
            unasked.append(name or "the robot")
            continue
        robot = Robot.from_document(document)
        sigmas = _sigmas(robot, asked)
        effects[key] = Effect(
            f"arm {key}",
            np.zeros(len(sigmas)),
            Knowledge(np.diag(sigmas**-2.0), np.zeros(len(sigmas))),
            np.zeros(len(sigmas), dtype=bool),
            by_flange={key: _moves(robot, joints, cell.poses[key], asked)},
        )
    return ArmsErrors(tuple(effects.values()), tuple(effects), tuple(unasked))


def erring_arms(cell: Cell, problem: Problem, state: State, noise: Noise) -> dict[str, ArmsAsked]:
    """Robots whose errors follow their posture, by Rao's score test, and what explains them.

    Args:
        cell: The cell.
        problem: The observations that agree, robots being as they report themselves.
        state: The fit.
        noise: Its noise.

    Returns:
        By robot, `offsets` where these explain its errors as well as chance asks, else
        `kinematics`.
    """
    offsets, links = (_gains(cell, problem, state, noise, it) for it in ARMS_ASKED[1:])
    found: dict[str, ArmsAsked] = {}
    for robot, (gain, count) in links.items():
        of_offsets, fewer = offsets[robot]
        if gain - of_offsets > chance_limit(count - fewer):
            found[robot] = "kinematics"
        elif of_offsets > chance_limit(fewer):
            found[robot] = "offsets"
    return found


def _gains(
    cell: Cell, problem: Problem, state: State, noise: Noise, asked: ArmsAsked
) -> dict[str, tuple[float, int]]:
    """By how much each robot's errors would lower the squared error, and how many they are."""
    arms = arms_errors(cell, asked)
    wider = problem.with_effects([*problem.effects, *arms.effects])
    there = State(state.edges, np.concatenate([state.values, arms.values]))
    information, gradient = normal_equations(wider, there, noise)
    now = np.zeros(wider.size, dtype=bool)
    now[: problem.size] = problem.moving
    found = {}
    for robot, it in zip(arms.robots, arms.effects, strict=True):
        more = now.copy()
        more[wider.effect_columns[it.name]] = True
        found[robot] = score_gain(information, gradient, more, now), len(it)
    return found


def _joints(cell: Cell, name: str) -> FloatArray | None:
    """(s, n) joints by station, not a number where unknown; None where a known pose has none."""
    told = {it.station: it.robots[name] for it in cell.session.observations if name in it.robots}
    angles = {station: view.joints_rad for station, view in told.items()}
    known = [it for it in angles.values() if it is not None]
    if not known or len(known) < len(angles) or len({len(it) for it in known}) > 1:
        return None
    joints = np.full((len(cell.poses[robot_key(name)]), len(known[0])), np.nan)
    for station, values in angles.items():
        joints[station] = values
    return joints


def _moves(robot: Robot, joints: FloatArray, poses: FloatArray, asked: ArmsAsked) -> FloatArray:
    """(s, 6, k) how the reported flange moves; zero where no joints are known."""
    stood = np.isfinite(joints).all(axis=1) & np.isfinite(poses[:, 0, 0])
    q = joints[stood]
    moves = robot.joint_jacobian(q)[:, :, 1:-1]
    if asked == "kinematics":
        links = robot.placement_jacobian(q)[:, :, 6:-6]
        moves = np.concatenate([moves, links], axis=2)
    # Where the reported frame sits on the model's flange.
    mounted = invert(robot.base_from_flange(q)) @ poses[stood]
    found = np.zeros((len(joints), 6, moves.shape[2]))
    found[stood] = adjoint(invert(mounted)) @ moves
    return found


def _sigmas(robot: Robot, asked: ArmsAsked) -> FloatArray:
    offsets = np.full(robot.joint_count - 2, _OFFSET_SIGMA)
    if asked == "offsets":
        return offsets
    link = np.repeat([_LINK_SIGMA_RAD, _LINK_SIGMA_M], 3)
    return np.concatenate([offsets, np.tile(link, robot.joint_count - 1)])
