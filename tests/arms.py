"""What a perfect camera would see of any arm, without images: for tests of what stops tell."""

import numpy as np

from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.closure import Closure, Edges, Noise, closure_information
from visioncal.estimation.linalg import covariance
from visioncal.estimation.problem import ROBOT
from visioncal.robot import Loads
from visioncal.stages.handeye import robot_part
from visioncal.transforms import exp, invert

ERROR_RAD = 1e-3
# What a camera of 5 MP makes of a board at half a metre, and an arm that repeats well.
CAMERA_SIGMAS = np.repeat([5e-5, 3e-5], 3)
NOISE = Noise(5e-5, 3e-5)
SIZES = {"links": 6, "offsets": 1, "eccentricity": 2}
X = exp(np.array([0.3, 0.2, -0.4, 0.05, 0.02, 0.1]))
Z = exp(np.array([2.9, 0.2, -0.4, 0.5, 0.2, 0.1]))
TOOL = exp(np.array([0.1, 0.0, 0.2, 0.01, 0.02, 0.1]))


def erring(robot, blocks=("links",)):
    """An arm with errors of some blocks to be estimated, and a tool on its flange."""
    sizes = sum(SIZES[it] for it in blocks) * robot.joint_count
    return ArmModel(robot, TOOL, dict.fromkeys(blocks, 1.0), np.zeros(sizes))


def closure_of(model, mount, q, flange=None):
    """The chain's known parts, at stops with joint angles q and a flange that is elsewhere."""
    robot = robot_part(model.robot.base_from_flange(q), mount)
    moved = robot if flange is None else robot_part(flange, mount)
    errors = ArmErrors(model.basis(q), ERROR_RAD, 0.0, of_links=True)
    spread = np.tile(np.diag(CAMERA_SIGMAS**2), (len(q), 1, 1))
    return Closure(
        mount, robot, invert(moved @ X) @ Z, spread, (errors.effect("robot", values=model.values),)
    )


def arm_data(robot, q, mount="eye-in-hand", blocks=("links",)):
    """What is seen of an arm that is as stated."""
    model = erring(robot, blocks)
    data, edges = closure_of(model, mount, q), Edges(X, Z, np.zeros(len(model.values)))
    spread = covariance(closure_information(data, edges, NOISE))
    return ArmData(
        data.problem,
        edges.state,
        NOISE.levels,
        spread,
        ROBOT,
        model,
        np.arange(12, len(spread)),
        ERROR_RAD,
        np.arange(len(q)),
        q,
        Loads.none(len(q)),
        np.zeros(3),
        np.arange(12),
    )
