"""How an arm grows and drifts, estimated jointly with the chain that its views close.

The coefficients are more unknowns that all views share, beside both edges and the arm's errors: one
closure, one fit. What is known of steel and aluminium, and of how fast arms warm up, is a prior;
what the views do not tell stays there.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from visioncal.estimation.closure import (
    Closure,
    Edges,
    Noise,
    closure_information,
    estimate_noise,
    fit_closure,
    noise_likelihood,
    normal_equations,
    residual_blocks,
)
from visioncal.estimation.descend import Linearised, descend
from visioncal.estimation.linalg import covariance, damped_step
from visioncal.estimation.problem import ROBOT, Effect
from visioncal.estimation.variance import Knowledge
from visioncal.robot import Robot
from visioncal.thermal.heating import Heating, Inputs, Kind
from visioncal.thermal.model import ThermalModel
from visioncal.threads import one_blas_thread
from visioncal.transforms import invert
from visioncal.types import FloatArray

# Steel grows by 12e-6 of its length for a kelvin, aluminium by 23e-6.
_GROWTH_PER_K, _GROWTH_SIGMA_PER_K = 17.5e-6, 5.5e-6
# A zero drifts by about a hundredth of a millimetre at a metre for a kelvin, either way.
_DRIFT_SIGMA_RAD_PER_K = 1e-5
# Gearboxes warm up in half an hour to an hour and a half; links follow a sensor in minutes.
_TAU_S: Mapping[Kind, float] = {"currents": 2400.0, "temperatures": 120.0}
_TAU_SIGMA: Mapping[Kind, float] = {"currents": 0.6, "temperatures": 1.0}
# Joints at work get warmer than the air by so much, give or take a factor [K].
RISE_K, _GAIN_SIGMA = 20.0, 0.8
# Rises of all joints below these tell nothing: temperatures [K], and shares of the rise at rest.
LEAST_RISE_K, LEAST_SHARE = 3.0, 0.15
# A parameter counts as told where its sigma is at most this share of its prior's.
_TOLD = 0.8
_ROUNDS, _SETTLED = 5, 1e-6


@dataclass(frozen=True, eq=False)
class Stops:
    """The stops whose views are fitted.

    Attributes:
        q: (m, n) joint angles [rad].
        stamps_s: (m,) when they were looked at [s].
    """

    q: FloatArray
    stamps_s: FloatArray


@dataclass(frozen=True, eq=False)
class ThermalFit:
    """What views say of an arm's drift.

    Attributes:
        model: The arm with its coefficients and their covariance.
        values: (p,) how far its parameters are from what was known beforehand, in units of (p,)
            `sigmas`.
        sigmas: To what they were known beforehand.
        edges: The edges, and what else was fitted with them.
        told: (p,) sigma of each parameter as a share of its prior's.
        gain: Twice the gain in log-likelihood over an arm that does not drift.
        before_m: Residual of the views without drift, as a root mean square [m].
        after_m: The same with it [m].
        rises_k: (n,) range of each link's temperature over the views [K].
    """

    model: ThermalModel
    values: FloatArray
    sigmas: FloatArray
    edges: Edges
    told: FloatArray
    gain: float
    before_m: float
    after_m: float
    rises_k: FloatArray

    @property
    def not_told(self) -> tuple[str, ...]:
        """The parameters that stay at what was known before, by joint."""
        names = parameter_names(self.model)
        return tuple(it for it, share in zip(names, self.told, strict=True) if share > _TOLD)

    def effect(self, stops: Stops, inputs: Inputs) -> Effect:
        """What is open about the parameters, as unknowns of the chain of some stops.

        They stay where they were found, and count in the covariance with what was known of them
        beforehand: what the stops tell of them the chain says itself.
        """
        free = _effect(self.model, self.values, self.sigmas, stops, inputs)
        return replace(free, held=np.ones(len(self.values), dtype=bool))


def parameter_names(model: ThermalModel) -> tuple[str, ...]:
    """The parameters' names, in the order of their covariance."""
    kinds = ["growth", "drift", "tau"] + ["gain"] * (model.heating.kind == "currents")
    return tuple(f"{kind} of {joint}" for kind in kinds for joint in model.robot.joint_names)


def uninformative(inputs: Inputs, stamps_s: FloatArray) -> str:
    """Says why views were all taken about equally warm; empty where they were not."""
    links = _expected(inputs).links_c(inputs, stamps_s)
    rise = float(np.ptp(links, axis=0).max())
    hours = float(np.ptp(stamps_s)) / 3600.0
    during = f"in the {hours:.2g} h of the {len(stamps_s)} used stops"
    if inputs.kind == "temperatures" and rise < LEAST_RISE_K:
        return (
            f"the joints' temperatures change by at most {rise:.2g} K {during}, and "
            f"{LEAST_RISE_K:g} K are needed"
        )
    if inputs.kind == "currents" and rise < LEAST_SHARE * RISE_K:
        return (
            f"by their currents the joints warm up by at most {100.0 * rise / RISE_K:.2g} % of the "
            f"way {during}, and {100.0 * LEAST_SHARE:g} % are needed"
        )
    return ""


def fit_thermal(
    data: Closure, edges: Edges, robot: Robot, stops: Stops, inputs: Inputs, nominal: Robot
) -> ThermalFit:
    """Estimates how an arm drifts, with edges and arm free.

    Args:
        data: The stops' chain, with the arm as it is without drift.
        edges: Where to start.
        robot: That arm, up to the frame of its poses.
        stops: Joint angles and times.
        inputs: What heats the arm.
        nominal: The arm without what is mounted on its flange: its lengths are what grows.
    """
    problem = _Problem(data, stops, inputs, _start(robot, nominal, inputs))
    with one_blas_thread():
        cold = fit_closure(data, edges)
        state, noise = _descended(problem, _State(cold.edges, np.zeros(problem.size)), cold.noise)
        seen, at = problem.seen(state.values), problem.at(state)
        gain = noise_likelihood(data, cold.edges)[1] - noise_likelihood(seen, at)[1]
        spread = covariance(closure_information(seen, at, noise))[-problem.size :, -problem.size :]
        before_m, after_m = _rms_m(data, cold.edges, noise), _rms_m(seen, at, noise)
    model, sigmas = problem.model(state.values), problem.sigmas
    return ThermalFit(
        replace(model, covariance=spread * np.outer(sigmas, sigmas)),
        state.values,
        sigmas,
        state.edges,
        np.sqrt(np.diag(spread)),
        2.0 * gain,
        before_m,
        after_m,
        np.ptp(model.heating.links_c(inputs, stops.stamps_s), axis=0),
    )


def _descended(problem: "_Problem", state: "_State", noise: Noise) -> tuple["_State", Noise]:
    """Minimises under the noise that the residuals show, until that stays the same."""
    for _ in range(_ROUNDS):
        state, _ = descend(state, partial(problem.linearised, noise=noise), _SETTLED)
        last, noise = noise, estimate_noise(problem.seen(state.values), problem.at(state))
        if np.allclose(last.sigmas, noise.sigmas, rtol=1e-3):
            break
    return state, noise


def _rms_m(data: Closure, edges: Edges, noise: Noise) -> float:
    """How far the stops place what they see from one another, as a root mean square [m]."""
    residuals = residual_blocks(data, edges, noise)[0]
    return float(np.sqrt(np.mean(np.sum(residuals[:, 3:] ** 2, axis=1))))


@dataclass(frozen=True, eq=False)
class _State:
    """Edges with what the chain shares, and the (p,) values of the drift."""

    edges: Edges
    values: FloatArray


@dataclass(frozen=True, eq=False)
class _Problem:
    """The fit's unknowns beside those of the chain, in units of their priors' sigmas."""

    data: Closure
    stops: Stops
    inputs: Inputs
    start: ThermalModel

    @property
    def sigmas(self) -> FloatArray:
        count = self.start.joint_count
        kind = self.inputs.kind
        sizes = [_GROWTH_SIGMA_PER_K, _DRIFT_SIGMA_RAD_PER_K, _TAU_SIGMA[kind]]
        sizes += [_GAIN_SIGMA] * (kind == "currents")
        return np.repeat(sizes, count)

    @property
    def size(self) -> int:
        return len(self.sigmas)

    def model(self, values: FloatArray) -> ThermalModel:
        steps, count = self.sigmas * values, self.start.joint_count
        return replace(
            self.start,
            growth_per_k=self.start.growth_per_k + steps[:count],
            drift_rad_per_k=self.start.drift_rad_per_k + steps[count : 2 * count],
            heating=self.start.heating.changed(steps[2 * count :]),
        )

    def at(self, state: _State) -> Edges:
        """The unknowns where the drift is linearised."""
        shared = np.concatenate([state.edges.shared, np.zeros(self.size)])
        return replace(state.edges, shared=shared)

    def linearised(self, state: _State, noise: Noise) -> Linearised[_State]:
        """The whitened squared error with that of the priors, and the way on."""
        seen, at = self.seen(state.values), self.at(state)
        residuals, _, spread = residual_blocks(seen, at, noise)
        information, gradient = normal_equations(seen, at, noise)
        whitened = np.linalg.solve(spread, residuals[:, :, None])[:, :, 0]
        cost = float(np.sum(residuals * whitened) + state.values @ state.values)
        cost += seen.problem.cost_of_knowledge(at.state)

        def step(damping: float) -> _State:
            by = damped_step(information, gradient, damping)
            edges = state.edges.moved(by[: -self.size])
            return _State(edges, state.values + by[-self.size :])

        return Linearised(state, cost, step)

    def seen(self, values: FloatArray) -> Closure:
        """The chain with the arm as warm as it was, and how it moves with the unknowns."""
        model, stops = self.model(values), self.stops
        links = model.heating.links_c(self.inputs, stops.stamps_s)
        moved = moved_robot(self.data, model.motion(stops.q, links))
        more = _effect(model, values, self.sigmas, stops, self.inputs)
        return replace(self.data, robot=moved).with_more(more)


def _effect(
    model: ThermalModel, values: FloatArray, sigmas: FloatArray, stops: Stops, inputs: Inputs
) -> Effect:
    """The parameters as unknowns of a chain, in units of (p,) sigmas, at their (p,) values."""
    links = model.heating.links_c(inputs, stops.stamps_s)
    heated = model.heating.slopes(inputs, stops.stamps_s)
    basis = model.basis(stops.q, links, heated) * sigmas
    known = Knowledge(np.eye(len(values)), values)
    return Effect.free("temperature", known, by_flange={ROBOT: basis})


def moved_robot(data: Closure, motion: FloatArray) -> FloatArray:
    """The robot's part (m, 4, 4) of a chain after (m, 4, 4) motions of its flange."""
    if data.mount == "eye-in-hand":
        return data.robot @ motion
    return invert(invert(data.robot) @ motion)


def _start(robot: Robot, nominal: Robot, inputs: Inputs) -> ThermalModel:
    """The arm as it is expected to drift before anything was seen."""
    count, heating = robot.joint_count, _expected(inputs)
    return ThermalModel(
        robot,
        heating,
        heating.cold(inputs.told, inputs.ambient_c),
        np.full(count, _GROWTH_PER_K),
        np.zeros(count),
        np.zeros((0, 0)),
        nominal.chain.placements[:, :3, 3],
    )


def _expected(inputs: Inputs) -> Heating:
    """How links are expected to follow what heats them."""
    count = inputs.told.shape[1]
    gain = np.ones(count)
    if inputs.kind == "currents":
        gain = RISE_K / np.maximum(inputs.told.mean(axis=0), 1e-9)
    return Heating(inputs.kind, np.full(count, _TAU_S[inputs.kind]), gain)
