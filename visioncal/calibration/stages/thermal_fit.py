"""How an arm grows and drifts, estimated jointly with the chain that its views close.

The coefficients are more unknowns that all views share, beside both edges and the arm's errors: one
closure, one fit. What is known of steel and aluminium, and of how fast arms warm up, is a prior;
what the views do not determine stays there.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.arm import rows_of
from visioncal.estimation.levenberg_marquardt import Linearised, levenberg_marquardt
from visioncal.estimation.linalg import covariance_among, damped_step
from visioncal.estimation.parts import Effect, Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import (
    equations_and_cost,
    estimate_noise,
    fisher_information,
    fit_problem,
    robot_levels,
)
from visioncal.estimation.variance import Knowledge
from visioncal.robot import Robot
from visioncal.robot.thermal.heating import Heating, Inputs, Kind
from visioncal.robot.thermal.model import ThermalModel

# Steel grows by 12e-6 of its length for a kelvin, aluminium by 23e-6.
_GROWTH_PER_K, _GROWTH_SIGMA_PER_K = 17.5e-6, 5.5e-6
# A zero drifts by about a hundredth of a millimetre at a metre for a kelvin, either way.
_DRIFT_SIGMA_RAD_PER_K = 1e-5
# Gearboxes warm up in half an hour to an hour and a half; links follow a sensor in minutes.
_TAU_S: Mapping[Kind, float] = {"currents": 2400.0, "temperatures": 120.0}
_TAU_SIGMA: Mapping[Kind, float] = {"currents": 0.6, "temperatures": 1.0}
# Joints at work get warmer than the air by so much, give or take a factor [K].
RISE_K, _GAIN_SIGMA = 20.0, 0.8
# Smaller rises of all joints determine nothing: temperatures [K], and shares of the rise at rest.
LEAST_RISE_K, LEAST_SHARE = 3.0, 0.15
# A parameter counts as determined where its sigma is at most this share of its prior's.
_LITTLE = 0.8
_ROUNDS, _SETTLED = 5, 1e-6


@dataclass(frozen=True, eq=False)
class ThermalStops:
    """A robot's stops.

    Attributes:
        robot: The robot, as the problem has it.
        places: (m,) the stops, as the problem has them.
        q: (m, n) joint angles [rad].
        stamps_s: (m,) when they were looked at [s].
    """

    robot: str
    places: IntArray
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
        shares: (p,) sigma of each parameter as a share of its prior's.
        gain: Twice the gain in log-likelihood over an arm that does not drift.
        before_m: Residual of the views without drift, as a root mean square [m].
        after_m: The same with it [m].
        rises_k: (n,) range of each link's temperature over the views [K].
        inputs: What heated the arm.
    """

    model: ThermalModel
    values: FloatArray
    sigmas: FloatArray
    shares: FloatArray
    gain: float
    before_m: float
    after_m: float
    rises_k: FloatArray
    inputs: Inputs

    @property
    def not_determined(self) -> tuple[str, ...]:
        """The parameters that stay at what was known before, by joint."""
        names = _parameter_names(self.model)
        return tuple(
            name for name, share in zip(names, self.shares, strict=True) if share > _LITTLE
        )

    def links_c(self, stops: ThermalStops) -> FloatArray:
        """(m, n) temperatures of the links at some stops [deg C]."""
        return self.model.heating.links_c(self.inputs, stops.stamps_s)

    def motion(self, stops: ThermalStops) -> FloatArray:
        """(m, 4, 4) how far the flange had moved at some stops, in its own frame."""
        return self.model.motion(stops.q, self.links_c(stops))

    def effect(self, stops: ThermalStops, count: int) -> Effect:
        """The uncertainty of the parameters, as unknowns of the chain at all of so many stops.

        They stay where they were found, and count in the covariance with what was known of them
        beforehand: what the stops determine of them the chain says itself.
        """
        free = _effect(self.model, self.values, self.sigmas, stops, self.inputs, count)
        nothing = np.zeros(len(self.values))
        return replace(free, values=nothing, held=nothing == 0.0)


def _parameter_names(model: ThermalModel) -> tuple[str, ...]:
    """The parameters' names, in the order of their covariance."""
    kinds = ["growth", "drift", "tau"] + ["gain"] * (model.heating.kind == "currents")
    return tuple(f"{kind} of {joint}" for kind in kinds for joint in model.robot.joint_names)


def uninformative(inputs: Inputs, stamps_s: FloatArray) -> str:
    """Says why views were all taken about equally warm; empty where they were not."""
    links = _expected(inputs).links_c(inputs, stamps_s)
    rise = float(np.ptp(links, axis=0).max())
    hours = float(np.ptp(stamps_s)) / 3600.0
    during = f"in the {figure(hours)} h of the {len(stamps_s)} used stops"
    if inputs.kind == "temperatures" and rise < LEAST_RISE_K:
        return (
            f"the joints' temperatures change by at most {figure(rise)} K {during}, and "
            f"{LEAST_RISE_K:g} K are needed"
        )
    if inputs.kind == "currents" and rise < LEAST_SHARE * RISE_K:
        return (
            f"by their currents the joints warm up by at most {figure(100.0 * rise / RISE_K)} % "
            f"of the way {during}, and {100.0 * LEAST_SHARE:g} % are needed"
        )
    return ""


def fit_thermal(
    problem: Problem,
    state: State,
    robot: Robot,
    stops: ThermalStops,
    inputs: Inputs,
    nominal: Robot,
) -> ThermalFit:
    """Estimates how an arm drifts, with all unknowns free.

    Args:
        problem: The observations, with the arm as it is without drift.
        state: Where to start.
        robot: That arm, up to the frame of its poses.
        stops: Where it stood, and when.
        inputs: What heats the arm.
        nominal: The arm without what is mounted on its flange: its lengths are what grows.
    """
    warming = _WarmingUnknowns(problem, stops, inputs, _start(robot, nominal, inputs))
    with one_blas_thread():
        cold = fit_problem(problem, state)
        found, noise = _descended(warming, _Warm(cold.state, np.zeros(warming.size)), cold.noise)
        warm, at = warming.problem(found.values), warming.at(found)
        gain = _unlikeliness(problem, cold.state, noise) - _unlikeliness(warm, at, noise)
        information = fisher_information(warm, at, noise)
        covariance = covariance_among(information, warm.counted)[-warming.size :, -warming.size :]
        before_m = _rms_m(problem, cold.state, stops.robot)
        after_m = _rms_m(warm, at, stops.robot)
    model, sigmas = warming.model(found.values), warming.sigmas
    return ThermalFit(
        replace(model, covariance=covariance * np.outer(sigmas, sigmas)),
        found.values,
        sigmas,
        np.sqrt(np.diag(covariance)),
        2.0 * gain,
        before_m,
        after_m,
        np.ptp(model.heating.links_c(inputs, stops.stamps_s), axis=0),
        inputs,
    )


def _descended(warming: "_WarmingUnknowns", state: "_Warm", noise: Noise) -> tuple["_Warm", Noise]:
    """Minimises under the noise that the residuals show, until that stays the same."""
    for _ in range(_ROUNDS):
        state, _ = levenberg_marquardt(state, partial(warming.linearised, noise=noise), _SETTLED)
        problem, at, last = warming.problem(state.values), warming.at(state), noise
        noise = estimate_noise(problem, at, noise, from_above=True)
        if np.allclose(last.robots, noise.robots, rtol=1e-3):
            break
    return state, noise


def _unlikeliness(problem: Problem, state: State, noise: Noise) -> float:
    return robot_levels(problem, state, noise, from_above=True)[1]


def _rms_m(problem: Problem, state: State, robot: str) -> float:
    """How far a robot's stops place what they see from one another, as a root mean square [m]."""
    residuals = problem.linear(state).residuals[rows_of(problem, robot)]
    return float(np.sqrt(np.mean(np.sum(residuals[:, 3:] ** 2, axis=1))))


@dataclass(frozen=True, eq=False)
class _Warm:
    """The unknowns of the cold arm's problem, and the (p,) values of the drift."""

    state: State
    values: FloatArray


@dataclass(frozen=True, eq=False)
class _WarmingUnknowns:
    """The fit's unknowns beside those of the cold arm's problem, in units of their sigmas."""

    cold: Problem
    stops: ThermalStops
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

    def at(self, warm: _Warm) -> State:
        """The unknowns where the drift is linearised."""
        return State(warm.state.edges, np.concatenate([warm.state.values, warm.values]))

    def linearised(self, warm: _Warm, noise: Noise) -> Linearised[_Warm]:
        """The whitened squared error with that of the priors, and the way on."""
        problem = self.problem(warm.values)
        information, gradient, cost = equations_and_cost(problem, self.at(warm), noise)
        moving = problem.moving
        free, slope = information[np.ix_(moving, moving)], gradient[moving]

        def step(damping: float) -> _Warm:
            by = np.zeros(problem.size)
            by[moving] = damped_step(free, slope, damping)
            return _Warm(warm.state.moved(by[: -self.size]), warm.values + by[-self.size :])

        return Linearised(warm, cost + float(warm.values @ warm.values), step)

    def problem(self, values: FloatArray) -> Problem:
        """The observations with the arm as warm as it was, and how it moves with the unknowns."""
        model, stops, poses = self.model(values), self.stops, dict(self.cold.poses)
        links = model.heating.links_c(self.inputs, stops.stamps_s)
        moved = poses[stops.robot].copy()
        moved[stops.places] = moved[stops.places] @ model.motion(stops.q, links)
        count = len(moved)
        effect = _effect(model, values, self.sigmas, stops, self.inputs, count)
        warm = replace(self.cold, poses=poses | {stops.robot: moved})
        return warm.with_effects([*warm.effects, effect])


def _effect(
    model: ThermalModel,
    values: FloatArray,
    sigmas: FloatArray,
    stops: ThermalStops,
    inputs: Inputs,
    count: int,
) -> Effect:
    """The parameters as unknowns at all of so many stops, in units of (p,) sigmas."""
    links = model.heating.links_c(inputs, stops.stamps_s)
    heated = model.heating.jacobian(inputs, stops.stamps_s)
    basis = np.zeros((count, 6, len(values)))
    basis[stops.places] = model.basis(stops.q, links, heated) * sigmas
    known = Knowledge(np.eye(len(values)), values)
    nothing = np.zeros(len(values), dtype=bool)
    name = f"temperature of {stops.robot}"
    return Effect(name, values, known, nothing, flange_jacobian={stops.robot: basis})


def _start(robot: Robot, nominal: Robot, inputs: Inputs) -> ThermalModel:
    """The arm as it is expected to drift before anything was seen."""
    count, heating = robot.joint_count, _expected(inputs)
    return ThermalModel(
        robot,
        heating,
        heating.cold(inputs.signal, inputs.ambient_c),
        np.full(count, _GROWTH_PER_K),
        np.zeros(count),
        np.zeros((0, 0)),
        nominal.chain.placements[:, :3, 3],
    )


def _expected(inputs: Inputs) -> Heating:
    """How links are expected to follow what heats them."""
    count = inputs.signal.shape[1]
    gain = np.ones(count)
    if inputs.kind == "currents":
        gain = RISE_K / np.maximum(inputs.signal.mean(axis=0), 1e-9)
    return Heating(inputs.kind, np.full(count, _TAU_S[inputs.kind]), gain)
