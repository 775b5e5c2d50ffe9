"""What each stop says of the joints' springs, beside what the fit of all of them says."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.estimation.armmodel import COMPLIANCE, ArmModel
from visioncal.estimation.closure import (
    Closure,
    Edges,
    Noise,
    normal_equations,
    residual_blocks,
)
from visioncal.estimation.linalg import covariance
from visioncal.estimation.problem import ROBOT, Effect
from visioncal.estimation.variance import Knowledge
from visioncal.robot import Loads
from visioncal.types import FloatArray

# A spring's bend is told by a stop where its torque is at least this, and this share of the
# greatest [N m].
_LEAST_NM, _LEAST_SHARE = 0.05, 0.05


@dataclass(frozen=True)
class Factor:
    """A number that is 1 where the model is right, with its standard deviation."""

    value: float
    sigma: float

    @property
    def is_off(self) -> bool:
        """Whether it is off by more than three standard deviations."""
        return abs(self.value - 1.0) > 3.0 * self.sigma


def compliance_unit(model: ArmModel) -> float:
    """What compliance a value of 1 stands for [rad/(N m)]."""
    return model.weights[COMPLIANCE] / model.torque_nm


def bends_seen(
    data: Closure, edges: Edges, noise: Noise, model: ArmModel, torques: FloatArray
) -> FloatArray:
    """How far each stop sees each joint bend, if all that is left of it were that joint's.

    Partial residuals of a regression (Larsen and McCleary 1972): the fitted bend and what the
    residual, weighted by its covariance, adds along the joint.

    Args:
        data: The views, one a stop; the arm's errors are the last of what they share.
        edges: The answer.
        noise: Its noise.
        model: The arm.
        torques: (m, n) on the joints [N m].

    Returns:
        (m, n) [rad]; NaN where the torque is too small to tell.
    """
    residuals, jacobian, spread = residual_blocks(data, edges, noise)
    arm = jacobian[:, :, -len(model.values) :][:, :, model.place_of(COMPLIANCE)]
    weighted = np.linalg.solve(spread, arm)
    pulled = np.einsum("mij,mi->mj", weighted, residuals)
    square = np.einsum("mij,mij->mj", weighted, arm)
    least = np.maximum(_LEAST_NM, _LEAST_SHARE * np.abs(torques).max(axis=0))
    told = (np.abs(torques) > least) & (square > 0.0)
    more = np.full(torques.shape, np.nan)
    more[told] = -pulled[told] / square[told]
    return torques * (model.compliance + compliance_unit(model) * more)


def payload_factor(
    data: Closure, edges: Edges, noise: Noise, model: ArmModel, q: FloatArray, loads: Loads
) -> Factor | None:
    """By which factor payload and force bend the arm beyond what is stated of them.

    One more unknown beside all others, tried at the answer (Rao's score test). The springs are told
    by the arm's own weight, and by the loads' differences between postures.

    Args:
        data: The views, one a stop.
        edges: The answer.
        noise: Its noise.
        model: The arm.
        q: (m, n) joint angles [rad].
        loads: What the flange carried.

    Returns:
        The factor; None where there were no loads or they bend nothing.
    """
    if not loads.any or not model.compliance.any():
        return None
    bent = model.bent(q, loads)
    robot = model.robot
    more = robot.load_torques(bent, loads) - robot.load_torques(bent)
    moved = np.einsum("mij,mj->mi", robot.axis_jacobian(bent), model.compliance * more)
    nothing = Knowledge(np.zeros((1, 1)), np.zeros(1))
    one = Effect.free("loads", nothing, by_flange={ROBOT: moved[:, :, None]})
    widened = data.with_more(one)
    at = replace(edges, shared=np.append(edges.shared, 0.0))
    information, gradient = normal_equations(widened, at, noise)
    spread = covariance(information)
    sigma = float(np.sqrt(spread[-1, -1]))
    return Factor(1.0 - float(spread[-1] @ gradient), sigma)


def flange_bends(model: ArmModel, q: FloatArray, loads: Loads | None = None) -> FloatArray:
    """How far (m,) loads move the flange from where the rigid arm has it [m]."""
    rigid = model.robot.base_from_flange(q)[:, :3, 3]
    return np.asarray(np.linalg.norm(model.base_from_flange(q, loads)[:, :3, 3] - rigid, axis=1))
