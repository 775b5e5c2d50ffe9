"""What a perfect camera would see of any arm, without images: for tests of what stops tell."""

from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.arm_report import add_parameters
from visioncal.core.transforms import exp, invert
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.chain import chain, robot_part
from visioncal.estimation.problem_parts import ROBOT, Noise, State
from visioncal.estimation.solve import (
    Solution,
    covariance_of,
)
from visioncal.results.arm import ArmLevel, ArmResult
from visioncal.robot import Loads

ERROR_RAD = 1e-3
# What a camera of 5 MP makes of a board at half a metre, and an arm that repeats well.
CAMERA_SIGMAS = np.repeat([5e-5, 3e-5], 3)
NOISE = Noise.of_robot(5e-5, 3e-5)
SIZES = {"links": 6, "offsets": 1, "eccentricity": 2}
X = exp(np.array([0.3, 0.2, -0.4, 0.05, 0.02, 0.1]))
Z = exp(np.array([2.9, 0.2, -0.4, 0.5, 0.2, 0.1]))
TOOL = exp(np.array([0.1, 0.0, 0.2, 0.01, 0.02, 0.1]))


def erring(robot, blocks=("links",)):
    """An arm with errors of some blocks to be estimated, and a tool on its flange."""
    sizes = sum(SIZES[index] for index in blocks) * robot.joint_count
    return ArmModel(robot, TOOL, dict.fromkeys(blocks, 1.0), np.zeros(sizes))


def problem_of(model, mount, q, flange=None, noise=None):
    """What is seen at stops with joint angles q, the flange being elsewhere, up to some noise."""
    poses = model.robot.base_from_flange(q)
    seen = invert(robot_part(poses if flange is None else flange, mount) @ X) @ Z
    errors = ArmErrors(model.basis(q), ERROR_RAD, 0.0, of_links=True)
    covariance = np.tile(np.diag(CAMERA_SIGMAS**2), (len(q), 1, 1))
    effect = replace(errors.effect(ROBOT, values=model.values), values=np.zeros(len(model.values)))
    return chain(
        mount, poses, seen if noise is None else seen @ noise, covariance, effects=[effect]
    )


def arm_data(robot, q, mount="eye-in-hand", blocks=("links",)):
    """What is seen of an arm that is as stated."""
    model = erring(robot, blocks)
    problem = problem_of(model, mount, q)
    state = State(np.stack([X, Z]), np.zeros(len(model.values)))
    covariance = covariance_of(problem, Solution(state, NOISE))
    return ArmData(
        problem,
        state,
        NOISE,
        covariance,
        ROBOT,
        model,
        np.arange(12, len(covariance)),
        ERROR_RAD,
        np.arange(len(q)),
        q,
        Loads.none(len(q)),
        np.zeros(3),
        np.arange(12),
        np.ones(6, dtype=bool),
    )


def identified(data, convention=None):
    """The arm's section with its parameters, and which stops to add."""
    level = ArmLevel(level="nominal", unknowns=0, rms_mm=0.0, held_out_mm=0.0, likelihood_ratio=0.0)
    result = ArmResult(level="nominal", levels=(level,))
    return add_parameters(result, data, convention)
