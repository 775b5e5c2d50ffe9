"""What each stop says of the joints' springs, beside what the fit of all of them says."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.armmodel import COMPLIANCE, ArmModel
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.linalg import covariance_among
from visioncal.estimation.parts import Effect, State
from visioncal.estimation.solve import normal_equations, whitened
from visioncal.estimation.variance import Knowledge
from visioncal.robot import Loads

# A stop determines a spring's bend where its torque is at least this, and this share of the
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


def bends_seen(arm: ArmData, torques: FloatArray) -> FloatArray:
    """How far each stop sees each joint bend, if all that is left of it were that joint's.

    Partial residuals of a regression (Larsen and McCleary 1972): the fitted bend and what the
    residual, weighted by its covariance, adds along the joint.

    Args:
        arm: What was seen of it.
        torques: (m, n) on the joints [N m].

    Returns:
        (m, n) [rad]; NaN where the torque is too small to show it.
    """
    model, problem = arm.model, arm.problem
    residuals, jacobian = whitened(problem, arm.state, arm.noise, ideal=False)
    springs = jacobian[:, :, arm.columns[model.place_of(COMPLIANCE)]]
    of = [problem.observations.stops == stop for stop in arm.stops.tolist()]
    pulled = np.array([np.einsum("mij,mi->j", springs[index], residuals[index]) for index in of])
    square = np.array([np.einsum("mij,mij->j", springs[index], springs[index]) for index in of])
    least = np.maximum(_LEAST_NM, _LEAST_SHARE * np.abs(torques).max(axis=0))
    determined = (np.abs(torques) > least) & (square > 0.0)
    more = np.full(torques.shape, np.nan)
    more[determined] = -pulled[determined] / square[determined]
    return torques * (model.compliance + compliance_unit(model) * more)


def payload_factor(arm: ArmData) -> Factor | None:
    """By which factor payload and force bend the arm beyond what is stated of them.

    One more unknown beside all others, tried at the answer (Rao's score test). The springs are
    determined by the arm's own weight, and by the loads' differences between postures.

    Args:
        arm: What was seen of it.

    Returns:
        The factor; None where there were no loads or they bend nothing.
    """
    model, problem, loads = arm.model, arm.problem, arm.loads
    if not loads.any or not model.compliance.any():
        return None
    bent, robot = model.bent(arm.q, loads), model.robot
    more = robot.load_torques(bent, loads) - robot.load_torques(bent)
    moved = np.zeros((len(problem.poses[arm.robot]), 6, 1))
    bends = np.einsum("mij,mj->mi", robot.axis_jacobian(bent), model.compliance * more)
    moved[arm.stops] = bends[:, :, None]
    nothing = Knowledge(np.zeros((1, 1)), np.zeros(1))
    one = Effect.free("payload", nothing, flange_jacobian={arm.robot: moved})
    widened = problem.with_effects([*problem.effects, one])
    there = State(arm.state.edges, np.append(arm.state.values, 0.0))
    information, gradient = normal_equations(widened, there, arm.noise)
    covariance = covariance_among(information, widened.moving)
    sigma = float(np.sqrt(covariance[-1, -1]))
    return Factor(1.0 - float(covariance[-1] @ gradient), sigma)


def flange_bends(model: ArmModel, q: FloatArray, loads: Loads | None = None) -> FloatArray:
    """How far (m,) loads move the flange from where the rigid arm has it [m]."""
    rigid = model.robot.base_from_flange(q)[:, :3, 3]
    return np.asarray(np.linalg.norm(model.base_from_flange(q, loads)[:, :3, 3] - rigid, axis=1))
