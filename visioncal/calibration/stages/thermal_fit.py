"""Joint estimation of an arm's thermal growth and drift with the chain that its views close.

The coefficients are further unknowns that all views share, beside both edges and the arm's errors.
Known properties of steel, aluminium and warm-up are their prior; coefficients that the views do not
determine stay there.
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
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.normal_equations import (
    equations_and_cost,
    fisher_information,
)
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, Noise, State
from visioncal.estimation.solve import (
    estimate_noise,
    fit_problem,
    robot_levels,
)
from visioncal.robot import Robot
from visioncal.robot.thermal import Heating, Inputs, Kind, ThermalModel

# Relative growth per kelvin: 12e-6 of steel, 23e-6 of aluminium.
_GROWTH_PER_K, _GROWTH_SIGMA_PER_K = 17.5e-6, 5.5e-6
# A zero drifts by about a hundredth of a millimetre at one metre per kelvin, either way.
_DRIFT_SIGMA_RAD_PER_K = 1e-5
# Gearboxes warm up in half an hour to an hour and a half; links follow a sensor in minutes.
_TAU_S: Mapping[Kind, float] = {"currents": 2400.0, "temperatures": 120.0}
_TAU_SIGMA: Mapping[Kind, float] = {"currents": 0.6, "temperatures": 1.0}
# Rise of joints at work above the air, within a factor [K].
RISE_K, _GAIN_SIGMA = 20.0, 0.8
# Smaller rises of all joints determine nothing: temperatures [K], and shares of the final rise.
LEAST_RISE_K, LEAST_SHARE = 3.0, 0.15
# A parameter counts as determined where its sigma is at most this share of its prior's.
_UNDETERMINED = 0.8
_ROUNDS, _SETTLED = 5, 1e-6


@dataclass(frozen=True, eq=False)
class ThermalStops:
    """A robot's stops."""

    robot: str  # The robot's name in the problem.
    places: IntArray  # (m,) the problem's stops.
    q: FloatArray  # (m, n) joint angles [rad].
    stamps_s: FloatArray  # (m,) when they were observed [s].


@dataclass(frozen=True, eq=False)
class ThermalFit:
    """Estimated drift of an arm."""

    model: ThermalModel  # The arm with its coefficients and their covariance.
    # (p,) deviation of the parameters from their prior, in units of (p,) `sigmas`.
    values: FloatArray
    sigmas: FloatArray  # The prior's sigmas.
    shares: FloatArray  # (p,) posterior over prior sigma of each parameter.
    gain: float  # Twice the gain in log-likelihood over an arm without drift.
    before_m: float  # Residual of the views without drift, as a root mean square [m].
    after_m: float  # The same with drift [m].
    rises_k: FloatArray  # (n,) range of each link's temperature over the views [K].
    inputs: Inputs  # What heated the arm.

    @property
    def not_determined(self) -> tuple[str, ...]:
        """The parameters that stay at their prior, by joint."""
        names = _parameter_names(self.model)
        return tuple(
            name for name, share in zip(names, self.shares, strict=True) if share > _UNDETERMINED
        )

    def links_c(self, stops: ThermalStops) -> FloatArray:
        """(m, n) temperatures of the links at some stops [deg C]."""
        return self.model.heating.links_c(self.inputs, stops.stamps_s)

    def motion(self, stops: ThermalStops) -> FloatArray:
        """(m, 4, 4) drift of the flange at some stops, in its own frame."""
        return self.model.motion(stops.q, self.links_c(stops))

    def effect(self, stops: ThermalStops, count: int) -> Effect:
        """The uncertainty of the parameters, as an effect on all `count` stops.

        Its values are held at zero and count in the covariance with their prior: the information of
        the stops is in the problem itself.
        """
        free = _effect(self.model, self.values, self.sigmas, stops, self.inputs, count)
        zero = np.zeros(len(self.values))
        return replace(free, values=zero, held=zero == 0.0)


def _parameter_names(model: ThermalModel) -> tuple[str, ...]:
    """The parameters' names, in the order of their covariance."""
    kinds = ["growth", "drift", "tau"] + ["gain"] * (model.heating.kind == "currents")
    return tuple(f"{kind} of {joint}" for kind in kinds for joint in model.robot.joint_names)


def uninformative(inputs: Inputs, stamps_s: FloatArray) -> str:
    """States why views were all taken about equally warm; empty where they were not."""
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
    """Estimates an arm's drift, with all unknowns free.

    Args:
        problem: The observations, with the arm without drift.
        state: The start.
        robot: That arm, up to the frame of its poses.
        stops: Its stops, with times.
        inputs: What heats the arm.
        nominal: The arm without a tool on its flange: its lengths are what grows.
    """
    warming = _WarmingUnknowns(problem, stops, inputs, _start(robot, nominal, inputs))
    with one_blas_thread():
        cold = fit_problem(problem, state)
        start, free = _WarmState(cold.state, np.zeros(warming.size)), slice(-warming.size, None)
        warm, noise = _minimised(warming, start, cold.noise)
        drifted, at = warming.problem(warm.values), warming.at(warm)
        gain = _neg_log_likelihood(problem, cold.state, noise)
        gain -= _neg_log_likelihood(drifted, at, noise)
        information = fisher_information(drifted, at, noise)
        covariance = covariance_among(information, drifted.counted)[free, free]
        before_m = _rms_m(problem, cold.state, stops.robot)
        after_m = _rms_m(drifted, at, stops.robot)
    model, sigmas = warming.model(warm.values), warming.sigmas
    return ThermalFit(
        replace(model, covariance=covariance * np.outer(sigmas, sigmas)),
        warm.values,
        sigmas,
        np.sqrt(np.diag(covariance)),
        2.0 * gain,
        before_m,
        after_m,
        np.ptp(model.heating.links_c(inputs, stops.stamps_s), axis=0),
        inputs,
    )


def _minimised(
    warming: "_WarmingUnknowns", state: "_WarmState", noise: Noise
) -> tuple["_WarmState", Noise]:
    """Minimises, and re-estimates the noise from the residuals, until that is constant."""
    for _ in range(_ROUNDS):
        state, _ = levenberg_marquardt(state, partial(warming.linearised, noise=noise), _SETTLED)
        problem, at, previous = warming.problem(state.values), warming.at(state), noise
        noise = estimate_noise(problem, at, noise, from_above=True)
        if np.allclose(previous.robots, noise.robots, rtol=1e-3):
            break
    return state, noise


def _neg_log_likelihood(problem: Problem, state: State, noise: Noise) -> float:
    return robot_levels(problem, state, noise, from_above=True)[1]


def _rms_m(problem: Problem, state: State, robot: str) -> float:
    """RMS of the position residuals of a robot's stops [m]."""
    residuals = problem.linear(state).residuals[rows_of(problem, robot)]
    return float(np.sqrt(np.mean(np.sum(residuals[:, 3:] ** 2, axis=1))))


@dataclass(frozen=True, eq=False)
class _WarmState:
    """The unknowns of the cold arm's problem, and the (p,) values of the drift."""

    state: State
    values: FloatArray


@dataclass(frozen=True, eq=False)
class _WarmingUnknowns:
    """The cold arm's problem, extended by the drift's parameters in units of their sigmas."""

    cold: Problem
    stops: ThermalStops
    inputs: Inputs
    start: ThermalModel

    @property
    def sigmas(self) -> FloatArray:
        kind = self.inputs.kind
        sizes = [_GROWTH_SIGMA_PER_K, _DRIFT_SIGMA_RAD_PER_K, _TAU_SIGMA[kind]]
        sizes += [_GAIN_SIGMA] * (kind == "currents")
        return np.repeat(sizes, self.start.joint_count)

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

    def at(self, warm: _WarmState) -> State:
        """The unknowns at the linearisation point of the drift."""
        return State(warm.state.edges, np.concatenate([warm.state.values, warm.values]))

    def linearised(self, warm: _WarmState, noise: Noise) -> Linearised[_WarmState]:
        """The whitened squared error with that of the priors, and the damped step."""
        problem = self.problem(warm.values)
        information, gradient, cost = equations_and_cost(problem, self.at(warm), noise)
        moving = problem.moving
        free = information[np.ix_(moving, moving)]

        def step(damping: float) -> _WarmState:
            change = np.zeros(problem.size)
            change[moving] = damped_step(free, gradient[moving], damping)
            state = warm.state.moved(change[: -self.size])
            return _WarmState(state, warm.values + change[-self.size :])

        return Linearised(warm, cost + float(warm.values @ warm.values), step)

    def problem(self, values: FloatArray) -> Problem:
        """The observations with the drifted arm, and the effect of the parameters."""
        model, stops, poses = self.model(values), self.stops, dict(self.cold.poses)
        links = model.heating.links_c(self.inputs, stops.stamps_s)
        moved = poses[stops.robot].copy()
        moved[stops.places] = moved[stops.places] @ model.motion(stops.q, links)
        effect = _effect(model, values, self.sigmas, stops, self.inputs, len(moved))
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
    """The parameters as an effect on all `count` stops, in units of (p,) sigmas."""
    links = model.heating.links_c(inputs, stops.stamps_s)
    heated = model.heating.jacobian(inputs, stops.stamps_s)
    basis = np.zeros((count, 6, len(values)))
    basis[stops.places] = model.basis(stops.q, links, heated) * sigmas
    prior = PriorInformation(np.eye(len(values)), values)
    held = np.zeros(len(values), dtype=bool)
    name = f"temperature of {stops.robot}"
    return Effect(name, values, prior, held, flange_jacobian={stops.robot: basis})


def _start(robot: Robot, nominal: Robot, inputs: Inputs) -> ThermalModel:
    """The arm with its expected drift (the prior)."""
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
    """The prior of how links follow what heats them."""
    count = inputs.signal.shape[1]
    gain = np.ones(count)
    if inputs.kind == "currents":
        gain = RISE_K / np.maximum(inputs.signal.mean(axis=0), 1e-9)
    return Heating(inputs.kind, np.full(count, _TAU_S[inputs.kind]), gain)
