"""The robots' own errors in a whole cell: unknowns beside the frames, where they are asked for.

What the first joint's place could take up is the base's, and what the last one's could is the
flange's: both are frames of the cell already.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from scipy.linalg import block_diag

from visioncal.alignment.cell import Cell, robot_key
from visioncal.estimator.joint import chance_limit
from visioncal.estimator.linalg import covariance
from visioncal.estimator.network import Network
from visioncal.estimator.networkfit import normal_equations
from visioncal.estimator.sightings import Common, Noise, State
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
        by_flange: (s, 6, k) by robot, how its flange moves at every station with all of them.
        prior_sigma: (k,) what they are known to beforehand.
        places: Which of them are a robot's.
        unasked: Robots whose errors cannot be asked for, because joints or models are missing.
    """

    by_flange: Mapping[str, FloatArray] = field(default_factory=dict)
    prior_sigma: FloatArray = field(default_factory=lambda: np.zeros(0))
    places: Mapping[str, slice] = field(default_factory=dict)
    unasked: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.prior_sigma)

    def added(self, network: Network) -> Network:
        """The network with these unknowns behind those that it shares; once, not twice."""
        if not len(self):
            return network
        first, seen = len(network.common.pull), network.sightings
        wider = np.concatenate([seen.by_shared, np.zeros((len(seen), 6, len(self)))], axis=2)
        moves = {
            robot: np.concatenate([np.zeros((len(it), 6, first)), it], axis=2)
            for robot, it in self.by_flange.items()
        }
        known = network.common
        return replace(
            network,
            sightings=replace(seen, by_shared=wider),
            common=Common(
                block_diag(known.information, np.diag(self.prior_sigma**-2.0)),
                np.concatenate([known.pull, np.zeros(len(self))]),
            ),
            by_flange=moves,
        )

    def document(self, values: FloatArray, spread: FloatArray) -> dict[str, Any]:
        """What was found of each arm, as it stands on disk.

        Args:
            values: (k,) the unknowns.
            spread: (k, k) their covariance.
        """
        return {
            robot: {
                "values": values[at].tolist(),
                "sigmas": np.sqrt(np.diag(spread)[at]).tolist(),
            }
            for robot, at in self.places.items()
        }


def arms_errors(cell: Cell, asked: ArmsAsked) -> ArmsErrors:
    """Sets up what is asked of the arms.

    Args:
        cell: The cell.
        asked: `offsets` for the zeros of all joints between the first and the last, in their
            order; `kinematics` for the place of each link in the one before, too, in six numbers
            each (rotation, translation).
    """
    if asked == "reported":
        return ArmsErrors()
    parts: dict[str, FloatArray] = {}
    sigmas: list[FloatArray] = []
    places: dict[str, slice] = {}
    unasked = []
    for name in cell.session.robots:
        key, document = robot_key(name), cell.session.robot_documents.get(name)
        if key not in cell.poses:
            continue
        joints = _joints(cell, name)
        if document is None or joints is None:
            unasked.append(name or "the robot")
            continue
        robot = Robot.from_document(document)
        parts[key] = _moves(robot, joints, cell.poses[key], asked)
        begin = sum(map(len, sigmas))
        sigmas.append(_sigmas(robot, asked))
        places[key] = slice(begin, begin + len(sigmas[-1]))
    count = sum(map(len, sigmas))
    by_flange = {}
    for key, moves in parts.items():
        by_flange[key] = np.zeros((len(moves), 6, count))
        by_flange[key][:, :, places[key]] = moves
    every = np.concatenate(sigmas) if sigmas else np.zeros(0)
    return ArmsErrors(by_flange, every, places, tuple(unasked))


def erring_arms(cell: Cell, network: Network, state: State, noise: Noise) -> dict[str, ArmsAsked]:
    """Robots whose errors follow their posture, by Rao's score test, and what explains them.

    Args:
        cell: The cell.
        network: The observations that agree, robots being as they report themselves.
        state: The fit.
        noise: Its noise.

    Returns:
        By robot, `offsets` where these explain its errors as well as chance asks, else
        `kinematics`.
    """
    offsets, links = (_gains(cell, network, state, noise, it) for it in ARMS_ASKED[1:])
    found: dict[str, ArmsAsked] = {}
    for robot, (gain, count) in links.items():
        of_offsets, fewer = offsets[robot]
        if gain - of_offsets > chance_limit(count - fewer):
            found[robot] = "kinematics"
        elif of_offsets > chance_limit(fewer):
            found[robot] = "offsets"
    return found


def _gains(
    cell: Cell, network: Network, state: State, noise: Noise, asked: ArmsAsked
) -> dict[str, tuple[float, int]]:
    """By how much each robot's errors would lower the squared error, and how many they are."""
    arms = arms_errors(cell, asked)
    if not len(arms):
        return {}
    wider = State(state.edges, np.concatenate([state.shared, np.zeros(len(arms))]))
    information, gradient = normal_equations(arms.added(network), wider, noise)
    first = len(gradient) - len(arms)
    between = information[first:, :first]
    taken = between @ covariance(information[:first, :first])
    left = information[first:, first:] - taken @ between.T
    pull = gradient[first:] - taken @ gradient[:first]
    return {
        robot: (float(pull[at] @ covariance(left[at, at]) @ pull[at]), at.stop - at.start)
        for robot, at in arms.places.items()
    }


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
