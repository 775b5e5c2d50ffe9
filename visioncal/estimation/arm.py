"""Errors of the arm that follow its posture: what white noise from stop to stop is not.

Real arms repeat to some hundredths of a millimetre and are off by several tenths, and by how much
depends on the posture. Small twists of all links, drawn from one distribution, are random effects
beside the edges; restricted likelihood determines their size from the residuals, and separates them
from white noise. What of them looks the same in all views hides in the edges: its share of the
covariance is the price of an uncalibrated arm.
"""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.budget import less_noise
from visioncal.estimation.linalg import covariance_among
from visioncal.estimation.parts import Effect, Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import RobotLikelihood, normal_equations
from visioncal.estimation.variance import LEAST_SIGMA, Components, Knowledge, level_weight
from visioncal.robot import Robot

# Arms are off by some 0.5 mm for each mrad.
LEVER_M = 0.5
# One unit of a twist turns by a radian, or shifts by as much as that is at the lever.
TWIST_UNITS: FloatArray = np.repeat([1.0, LEVER_M], 3)
# Twice the gain in log-likelihood that noise gives in one session of ten thousand, and in one of
# twenty: chi-square of one degree of freedom.
SIGNIFICANT, _LIKELY = 15.1, 3.84
# Sizes below are none [rad].
_NOTHING = 1e-6
# Fewer stops have hardly more residuals than the edges and the noise take.
_FEWEST_STOPS = 6
# Positions and directions change over about so much when an arm's posture does [m].
_REACH_M = 0.6


@dataclass(frozen=True, eq=False)
class ArmErrors:
    """Errors of the arm as random effects.

    Attributes:
        basis: (s, 6, p) how the flange moves with them at each stop, all of them in radians.
        sigma: Their standard deviation [rad], averaged over having none; lengths are off by 0.5 m
            times as much.
        gain: Twice the gain in log-likelihood over white noise alone.
        of_links: Whether they are errors of this arm's links, which can be estimated along; else
            they have the shape of any arm's, and only their size means something.
        white: (2,) the noise that is left beside them, of rotation [rad] and place [m]; None where
            that is the noise of the fit.
        look: (2,) both together as single stops show them, which is the noise of the fit; of the
            errors, what looks the same at all stops is not in it. None of links.
        away: (2, 2) what postures err by of which the fit has seen none near: of rotation [rad] and
            place [m], as found and as predicted; see `pose_errors.left_out_clusters`. None where
            that is not known.
        lasting: How many of the errors, the last ones, are alike at stops near in time; the others
            at postures that are near. At another time they are others.
    """

    basis: FloatArray
    sigma: float
    gain: float
    of_links: bool
    white: FloatArray | None = None
    look: FloatArray | None = None
    away: FloatArray | None = None
    lasting: int = 0

    @property
    def last(self) -> Mask:
        """(p,) which of the errors are alike at stops near in time."""
        count = self.basis.shape[2]
        return np.asarray(np.arange(count) >= count - self.lasting)

    @property
    def is_significant(self) -> bool:
        """Whether they are beyond chance; others are likely enough to be counted with."""
        return self.gain > SIGNIFICANT

    @property
    def is_likely(self) -> bool:
        """Whether they are likelier than noise alone."""
        return self.gain > _LIKELY

    @property
    def is_estimated(self) -> bool:
        """Whether they are unknowns of the fit; others only count in the covariance."""
        return self.of_links and self.is_significant

    def effect(self, robot: str, name: str = "arm", values: FloatArray | None = None) -> Effect:
        """Puts the effects as unknowns of a robot's flange, at their (p,) present values."""
        size = self.basis.shape[2]
        at = np.zeros(size) if values is None else values
        information = np.eye(size) / self.sigma**2
        known = Knowledge(information, information @ at)
        held = np.zeros(size, dtype=bool)
        return Effect(f"{name} of {robot}", at, known, held, flange_jacobian={robot: self.basis})


def link_basis(robot: Robot, joints_rad: FloatArray) -> FloatArray:
    """How the flange moves with small twists of all links.

    Args:
        robot: The nominal model.
        joints_rad: (m, n) joint angles.

    Returns:
        (m, 6, 6 n) right perturbations of `base_from_flange`, for a link's rotation by 1 rad and
        its translation by 0.5 m.
    """
    links = np.array([robot.link_frames(row)[:-1] for row in joints_rad])
    flange_from_base = invert(robot.base_from_flange(joints_rad))
    twists = adjoint(flange_from_base[:, None] @ links) * TWIST_UNITS
    return np.concatenate(list(np.moveaxis(twists, 1, 0)), axis=2)


def pose_basis(base_from_flange: FloatArray) -> FloatArray:
    """How arms err as a function of where the flange is, without their joints.

    Twists of base and flange that stay, and twists of the base that change in proportion to the
    flange's position and to the direction of its axis.

    Args:
        base_from_flange: (m, 4, 4).

    Returns:
        (m, 6, 48) in the units of `link_basis`.
    """
    of_base = adjoint(invert(base_from_flange)) * TWIST_UNITS
    of_flange = np.broadcast_to(np.eye(6) * TWIST_UNITS, of_base.shape)
    position, axis = base_from_flange[:, :3, 3] / _REACH_M, base_from_flange[:, :3, 2]
    changing = [
        of_base * factor[:, None, None] for factor in np.concatenate([position, axis], axis=1).T
    ]
    return np.concatenate([of_flange, of_base, *changing], axis=2)


def find_arm_errors(
    likelihood: RobotLikelihood,
    robot: int,
    basis: FloatArray,
    *,
    of_links: bool,
    least: float | None = None,
) -> ArmErrors | None:
    """Estimates the size of the errors of one robot's arm, where they are significant.

    Args:
        likelihood: That of the robots' levels without these errors, at the answer.
        robot: The robot, by its place among them.
        basis: (s, 6, p) by stop, of `link_basis` or `pose_basis`.
        of_links: Whether it is of this arm's links.
        least: What they have to gain over white noise; None for what makes them likelier, or of
            links for any gain at all.

    Returns:
        The errors; None where they gain no more than that.
    """
    # An arm whose links all look like its frames, as one with parallel axes, has no columns.
    stops, size = likelihood.stops[(likelihood.members == robot).any(axis=1)], basis.shape[2]
    if len(np.unique(stops)) < _FEWEST_STOPS or not size:
        return None
    levels, start = likelihood.start_beside(robot, basis)
    if start <= _NOTHING:
        return None
    widened = likelihood.beside(robot, basis)
    if least is None:
        # Every arm's links err: their size counts however little noise alone is less likely.
        least = 0.0 if of_links else _LIKELY
    unlikely = likelihood.white[1]
    sigma, value = _most_likely_size(widened, size, levels, start, unlikely - 0.5 * least)
    gain = 2.0 * (unlikely - value)
    if gain <= least:
        return None
    return ArmErrors(basis, float(np.sqrt(level_weight(gain))) * sigma, gain, of_links)


def _most_likely_size(
    likelihood: RobotLikelihood, size: int, levels: FloatArray, start: float, enough: float
) -> tuple[float, float]:
    """The most likely size of the last unknowns as random effects, beside the robots' levels."""
    # They are observed to be zero, in units of their own, as one more component of the variance.
    # Where that does not seem to be likely enough, the search ends before.
    reduced, components = likelihood.reduced, likelihood.components
    width, columns = reduced.errors.shape[1], reduced.jacobian.shape[2]
    units, places = np.divmod(np.arange(size), width)
    count = int(units[-1]) + 1
    jacobian, part = np.zeros((count, width, columns)), np.zeros((count, width))
    jacobian[units, places, columns - size + np.arange(size)] = 1.0
    part[units, places] = 1.0
    parts = np.zeros((len(components.parts) + 1, len(reduced.errors) + count, width))
    parts[:-1, :-count], parts[-1, -count:] = components.parts, part
    # Places that are left over in the last unit are of no unknown.
    rest = np.eye(width) * (1.0 - part)[:, None, :]
    grown = replace(
        likelihood,
        reduced=replace(
            reduced,
            errors=np.pad(reduced.errors, ((0, count), (0, 0))),
            jacobian=np.concatenate([reduced.jacobian, jacobian]),
        ),
        components=Components(np.concatenate([components.known, rest]), parts),
    )
    sigmas, value = grown.most_likely(
        np.append(levels, start),
        np.append(np.repeat(likelihood.seen, 2), True),
        np.append(np.full(levels.size, LEAST_SIGMA), _NOTHING),
        enough=enough,
    )
    return float(sigmas[-1]), value


def rows_of(problem: Problem, robot: str) -> Mask:
    """(n,) which observations belong to units that have the error of a robot's flange."""
    (of, members), place = problem.units, problem.robots.index(robot)
    found = of >= 0
    found[found] = (members[of[found]] == place).any(axis=1)
    return found


def stops_of(problem: Problem, robot: str) -> IntArray:
    """The stops at which a robot was observed, in their order."""
    return np.unique(problem.observations.stops[rows_of(problem, robot)])


def misfit_covariance(
    problem: Problem, state: State, noise: Noise, robot: str, errors: ArmErrors
) -> FloatArray:
    """What errors of the arm add to the covariance of a fit that takes them for white noise.

    Where the noise beside them is known, the fit's covariance is that of too much noise: what it
    has too much of is taken off.

    Args:
        problem: The observations.
        state: The answer.
        noise: The white noise that it was weighted with.
        robot: The robot.
        errors: The arm's errors, at the same stops.

    Returns:
        (p, p) among the unknowns.
    """
    answer = errors.sigma * misfit_jacobian(problem, state, noise, robot, errors)
    found = answer @ answer.T
    if errors.white is not None:
        found += less_noise(problem, state, noise, robot, errors.white)
    return np.asarray(found)


def covariance_of_size(
    problem: Problem, covariance: FloatArray, robot: str, errors: ArmErrors
) -> FloatArray:
    """What it adds to a fit's covariance that the size of an arm's errors was estimated, too.

    What the observations do not determine of the errors is drawn from a distribution whose variance
    was found from the k that they do determine: it follows Student's t, whose variance is k / (k -
    2) times that. To first order in the variance of the errors, for all unknowns.

    Args:
        problem: The observations, with these errors among the unknowns.
        covariance: (p, p) the fit's covariance.
        robot: The robot.
        errors: The arm's errors.

    Returns:
        (p, p) among the unknowns.
    """
    arm, variance = problem.effect_columns[f"arm of {robot}"], errors.sigma**2
    with_arm = covariance[arm]
    determined = len(with_arm) - float(np.trace(with_arm[:, arm])) / variance
    # Two or fewer would leave it without bound.
    return np.asarray(2.0 / (max(determined - 2.0, 1.0) * variance) * with_arm.T @ with_arm)


def misfit_jacobian(
    problem: Problem, state: State, noise: Noise, robot: str, errors: ArmErrors
) -> FloatArray:
    """How a fit that takes errors of the arm for white noise moves with them.

    Args:
        problem: The observations.
        state: The answer.
        noise: The white noise that it was weighted with.
        robot: The robot.
        errors: The arm's errors, at the same stops.

    Returns:
        (p, q) by how much the fit is off from the truth, for each error of one.
    """
    effect = errors.effect(robot)
    widened = problem.with_effects([*problem.effects, effect])
    there = State(state.edges, np.concatenate([state.values, effect.values]))
    information = normal_equations(widened, there, noise)[0]
    size = problem.size
    fitted = covariance_among(information[:size, :size], problem.moving)
    return np.asarray(fitted @ information[:size, size:])
