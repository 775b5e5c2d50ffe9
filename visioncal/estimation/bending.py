"""Compliance of the joints as single stops and stated loads show it."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.armmodel import COMPLIANCE, ArmModel
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.linalg import covariance_among
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.normal_equations import normal_equations
from visioncal.estimation.problem_parts import Effect, State
from visioncal.estimation.solve import whitened
from visioncal.robot import Loads

# Least torque at which a stop determines a joint's bend [N m], and its least share of the greatest
# torque.
_LEAST_NM, _LEAST_SHARE = 0.05, 0.05


@dataclass(frozen=True)
class Factor:
    """Factor with its standard deviation; it is 1 where the model is right."""

    value: float
    sigma: float

    @property
    def is_off(self) -> bool:
        """Whether it differs from 1 by more than three standard deviations."""
        return abs(self.value - 1.0) > 3.0 * self.sigma


def compliance_unit(model: ArmModel) -> float:
    """Compliance for a value of 1 [rad/(N m)]."""
    return model.weights[COMPLIANCE] / model.torque_nm


def observed_bends(arm: ArmData, torques: FloatArray) -> FloatArray:
    """Bend (m, n) of each joint at each stop, as if the stop's whole residual were its own [rad].

    Partial residuals of a regression (Larsen and McCleary 1972): the fitted bend plus the component
    of the residual, weighted by its covariance, along the joint. NaN where the (m, n) torque [N m]
    is too small to show it.
    """
    model, problem = arm.model, arm.problem
    residuals, jacobian = whitened(problem, arm.state, arm.noise, ideal=False)
    columns = jacobian[:, :, arm.columns[model.columns_of(COMPLIANCE)]]
    masks = [problem.observations.stops == stop for stop in arm.stops.tolist()]
    gradient = np.array([np.einsum("mij,mi->j", columns[mask], residuals[mask]) for mask in masks])
    own = [columns[mask] for mask in masks]
    information = np.array([np.einsum("mij,mij->j", part, part) for part in own])
    least = np.maximum(_LEAST_NM, _LEAST_SHARE * np.abs(torques).max(axis=0))
    determined = (np.abs(torques) > least) & (information > 0.0)
    correction = np.full(torques.shape, np.nan)
    correction[determined] = -gradient[determined] / information[determined]
    return torques * (model.compliance + compliance_unit(model) * correction)


def payload_factor(arm: ArmData) -> Factor | None:
    """Ratio of the actual to the predicted bending under the stated payload and force.

    One more unknown beside all others, tested at the solution (Rao's score test). The compliances
    are determined by the arm's own weight, and by the loads' differences between postures. None
    where there were no loads or they bend nothing.
    """
    model, problem, loads = arm.model, arm.problem, arm.loads
    if not loads.any or not model.compliance.any():
        return None
    bent, robot = model.bent(arm.q, loads), model.robot
    load_torques = robot.load_torques(bent, loads) - robot.load_torques(bent)
    flange_jacobian = np.zeros((len(problem.poses[arm.robot]), 6, 1))
    twists = np.einsum("mij,mj->mi", robot.axis_jacobian(bent), model.compliance * load_torques)
    flange_jacobian[arm.stops] = twists[:, :, None]
    flanges = {arm.robot: flange_jacobian}
    payload = Effect.free("payload", PriorInformation.flat(1), flange_jacobian=flanges)
    widened = problem.with_effects([*problem.effects, payload])
    widened_state = State(arm.state.edges, np.append(arm.state.values, 0.0))
    information, gradient = normal_equations(widened, widened_state, arm.noise)
    covariance = covariance_among(information, widened.moving)
    sigma = float(np.sqrt(covariance[-1, -1]))
    return Factor(1.0 - float(covariance[-1] @ gradient), sigma)


def flange_bends(model: ArmModel, q: FloatArray, loads: Loads | None = None) -> FloatArray:
    """Flange deflection under load (m,) [m]."""
    rigid = model.robot.base_from_flange(q)[:, :3, 3]
    return np.asarray(np.linalg.norm(model.base_from_flange(q, loads)[:, :3, 3] - rigid, axis=1))
