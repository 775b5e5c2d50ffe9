"""Bayesian model comparison of single changes of a cell, by a few new stops.

A calibration predicts where the chain of frames closes, with a covariance. New stops that
contradict it are explained by one of several causes, each with a few unknowns of unknown size.
Marginal likelihoods compare causes with any number of unknowns fairly (Kass and Raftery 1995,
section 3): flexible causes are penalised. Everything is Gaussian except for the noise's common
scale, which the calibration estimated with some degrees of freedom: integrated out, it gives
Student's distribution (Box and Tiao 1973, section 2.7).

Where stops stand again at postures of the calibration, the arm's errors there are known from its
residuals: new residuals y are predicted from those r of the calibrated stops as by a Gaussian
process with an unknown mean (universal kriging; Rasmussen and Williams 2006, section 2.7):

    G = S_yr S_rr^-1       y ~ N(G r, (A_y - G A_r) C (A_y - G A_r)' + S_yy - G S_ry)

with the errors' covariances S, the unknowns' Jacobians A and their covariance C by noise; errors of
other sources are those of the calibration again. How much of the robot's noise is the same again is
unknown, and averaged over.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular

from visioncal.core.linalg import LEAST_SIGMA
from visioncal.core.transforms import adjoint, exp, inverse_right_jacobian, invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, Noise, State
from visioncal.robot.errors import SIZES_M

# Shares of the noise's variance that are new at a repeated posture: sigmas are halved in each step.
_NEW_SHARES = tuple(float(value) for value in 4.0 ** -np.arange(0.0, 5.0))


@dataclass(frozen=True, eq=False)
class RepeatedStops:
    """Calibrated observations that n observations of a check repeat: the same board at a stop."""

    repeats: IntArray  # (r,) for each, the check's observation that repeats it.
    residuals: FloatArray  # (r, 6) their residuals in the calibration.
    # (n + r, n + r) correlation of the arm's errors at the check's observations, then at these.
    correlation: FloatArray
    stops: IntArray  # (n + r,) the stops of all these; those of the calibration differ.
    by_noise: FloatArray  # (p, p) the part of the posterior's covariance that is by noise.


@dataclass(frozen=True, eq=False)
class CalibrationPosterior:
    """Posterior of the calibration, the prior of a verification."""

    state: State
    covariance: FloatArray  # (p, p) of their steps.
    noise: Noise
    freedom: float  # Degrees of freedom of its scale; infinite where it is known.
    repeated: RepeatedStops | None = None  # Calibrated stops that are repeated; None for none.


@dataclass(frozen=True, eq=False)
class ChangeHypothesis:
    """A change that may have happened since the calibration, of p unknowns."""

    kind: str  # Its kind in one word.
    units: FloatArray  # (p,) the size of each unknown, for a change of one metre.
    # (n, 6, p) right perturbations of the measured poses that undo it; None for none.
    by_sensor: FloatArray | None = None
    # (s, 6, p) right perturbations of the flange at each stop that undo it; None for none.
    flange_jacobian: FloatArray | None = None
    start: FloatArray | None = None  # (p,) start of the search; None for zero.
    # Factors on the noise of the stops, where larger noise is the change.
    noise_factors: tuple[float, ...] = (1.0,)
    at: int = 0  # Index of the board or joint.
    # Sizes with equal prior probability, for a change of one metre.
    sizes_m: tuple[float, ...] = SIZES_M
    # (p,) factors on the units, of equally likely shapes of the change; none for the units alone.
    shapes: tuple[FloatArray, ...] = ()
    # Views whose images belong to the poses of others, and these.
    pairs: tuple[tuple[int, int], ...] = ()
    of: str = ""  # The name or number of the part that it is of, where there may be several.

    @property
    def name(self) -> str:
        """Kind and part, as `joint 3`."""
        return f"{self.kind} {self.of}".strip()


@dataclass(frozen=True, eq=False)
class HypothesisEvidence:
    """Evidence of the stops for one cause."""

    likelihood: float  # Logarithm of its marginal likelihood.
    values: FloatArray  # (p,) its unknowns, by the stops alone.
    covariance: FloatArray  # (p, p) of these.
    # (p, k) covariance of their errors with those of the belief's unknowns, which stay as they are.
    with_unknowns: FloatArray
    noise_factor: float  # Most likely factor on the noise.
    misfit: float  # Squared Mahalanobis distance that the cause leaves unexplained.
    freedom: int  # Degrees of freedom of the misfit.
    deviance: float  # Twice the negative log-likelihood at the values, up to a common constant.


def evidence_of(
    problem: Problem, belief: CalibrationPosterior, cause: ChangeHypothesis | None = None
) -> HypothesisEvidence:
    """Evidence for a cause, or no change, from the stops of one robot, by the belief's unknowns."""
    cause = cause or ChangeHypothesis("nothing", np.zeros(0))
    shares = (1.0,) if belief.repeated is None else _NEW_SHARES
    new_m = max(belief.noise.robots[0, 1], LEAST_SIGMA) * np.sqrt(shares)
    # Repeatability of well-kept arms [m], and the factor by which others differ from it: the
    # log-normal prior of what is new.
    log_priors = -0.5 * (np.log(new_m / 3e-5) / np.log(2.0)) ** 2
    log_priors -= np.logaddexp.reduce(log_priors) + np.log(len(cause.noise_factors))
    prior_of = dict(zip(shares, log_priors.tolist(), strict=True))
    sizes_m = cause.sizes_m if len(cause.units) else cause.sizes_m[:1]
    widest, shapes = SIZES_M[-1] * cause.units, cause.shapes or (np.ones(len(cause.units)),)
    values = np.zeros(len(cause.units)) if cause.start is None else cause.start
    for _ in range(6):
        trials = tuple(product(cause.noise_factors, shares))
        variants = _whitened(problem, belief, cause, values, trials)
        likeliest = max(
            variants,
            key=lambda trial: variants[trial].score(widest, belief.freedom) + prior_of[trial[1]],
        )
        before, values = values, variants[likeliest].posterior(widest)[0]
        # Far below any arm's repeatability.
        if np.abs(values - before).max(initial=0.0) < 1e-7:
            break
    scores = [
        variant.score(size_m * shape * cause.units, belief.freedom) + prior_of[share]
        for ((_, share), variant), size_m, shape in product(variants.items(), sizes_m, shapes)
    ]
    # With the widest prior on the change's size, which hardly shrinks it.
    mean, covariance = variants[likeliest].posterior(widest)
    white = variants[likeliest]
    remaining = white.residuals + white.jacobian @ mean
    misfit = float(remaining @ remaining)
    return HypothesisEvidence(
        float(np.logaddexp.reduce(scores) - np.log(len(sizes_m) * len(shapes))),
        mean,
        covariance,
        -covariance @ white.jacobian.T @ white.by_unknowns,
        likeliest[0],
        misfit,
        len(remaining) - len(mean),
        misfit + white.log_det,
    )


@dataclass(frozen=True, eq=False)
class _White:
    """Whitened residuals (6 n,) at zero values of a cause, and their Jacobian (6 n, p) by these."""

    residuals: FloatArray
    jacobian: FloatArray
    log_det: float  # Logarithm of the determinant of the covariance that was taken out.
    by_unknowns: FloatArray  # (6 n, k) covariance of the residuals with the belief's unknowns.

    def score(self, sigmas: FloatArray, freedom: float) -> float:
        """Log marginal likelihood for (p,) prior sigmas, up to a constant common to all causes."""
        scaled = self.jacobian * sigmas
        inner = np.eye(len(sigmas)) + scaled.T @ scaled
        projected = scaled.T @ self.residuals
        squares = self.residuals @ self.residuals - projected @ np.linalg.solve(inner, projected)
        log_det = self.log_det + float(np.linalg.slogdet(inner)[1])
        if np.isinf(freedom):
            return -0.5 * (log_det + float(squares))
        count = len(self.residuals)
        return -0.5 * (log_det + (freedom + count) * float(np.log1p(squares / freedom)))

    def posterior(self, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and covariance (p, p) of a cause's values."""
        information = self.jacobian.T @ self.jacobian + np.diag(sigmas**-2.0)
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        return -covariance @ (self.jacobian.T @ self.residuals), covariance


def _whitened(
    problem: Problem,
    belief: CalibrationPosterior,
    cause: ChangeHypothesis,
    values: FloatArray,
    trials: Sequence[tuple[float, float]],
) -> dict[tuple[float, float], _White]:
    """Whitens for factors on the noise and shares of it that do not repeat, at (p,) values."""
    without, count, again = undone(problem, cause, values), len(problem), belief.repeated
    linear = without.linear(with_change(belief.state, cause))
    jacobian, known = linear.jacobian, len(belief.covariance)
    by_cause = jacobian[:, :, known:].reshape(6 * count, len(values))
    by_unknowns = jacobian[:, :, :known]
    repeats = np.zeros(0, dtype=np.int64) if again is None else again.repeats
    rows = np.append(np.arange(count), repeats)
    stops = problem.observations.stops if again is None else again.stops
    one_stop = (stops[:, None] == stops).astype(float)
    by_flange = linear.by_errors[rows] * np.repeat(belief.noise.robots[0], 3)
    products = np.einsum("iab,jcb->iajc", by_flange, by_flange)
    size, end = 6 * len(rows), 6 * count
    # Exact data would otherwise be compared with rounding.
    sensor = block_diag(*without.covariance(belief.noise)[rows])
    sensor += (10.0 * LEAST_SIGMA) ** 2 * np.eye(size)
    whitened = {}
    for factor, new_share in trials:
        shared = one_stop if again is None else again.correlation
        weights = new_share * one_stop + (1.0 - new_share) * shared
        weights[:count, :count] += (factor**2 - 1.0) * one_stop[:count, :count]
        covariance = sensor + (weights[:, None, :, None] * products).reshape(size, size)
        jacobian, by_noise = by_unknowns.reshape(end, -1), belief.covariance
        residuals = linear.residuals.reshape(-1) - by_cause @ values
        total, lasting = covariance[:end, :end], np.zeros((end, known))
        if again is not None:
            by_noise = again.by_noise
            cross = covariance[end:, :end]
            gain = np.linalg.solve(covariance[end:, end:], cross).T
            residuals = residuals - gain @ again.residuals.reshape(-1)
            total = total - gain @ cross
            elsewhere = jacobian * np.repeat(~np.isin(np.arange(count), repeats), 6)[:, None]
            # Of other sources nothing may be left, or by rounding and other noise less than that.
            variances, vectors = np.linalg.eigh(belief.covariance - by_noise)
            root = elsewhere @ vectors * np.sqrt(np.maximum(variances, 0.0))
            total += root @ root.T
            lasting = root @ (vectors * np.sqrt(np.maximum(variances, 0.0))).T
            jacobian = jacobian - gain @ by_unknowns[repeats].reshape(size - end, -1)
        root = cholesky(total + jacobian @ by_noise @ jacobian.T, lower=True)
        whitened[factor, new_share] = _White(
            solve_triangular(root, residuals, lower=True),
            solve_triangular(root, by_cause, lower=True),
            2.0 * float(np.log(np.diag(root)).sum()),
            solve_triangular(root, jacobian @ by_noise + lasting, lower=True),
        )
    return whitened


def undone(problem: Problem, cause: ChangeHypothesis, values: FloatArray) -> Problem:
    """The stops with a change of (p,) values undone, however large, and these as last effect."""
    ((robot, poses),) = problem.poses.items()
    observations = problem.observations
    sensor, by_sensor = _stepped(cause.by_sensor, values, len(problem))
    flange, by_flange = _stepped(cause.flange_jacobian, values, len(poses))
    adjoints = adjoint(invert(sensor))
    changed = Effect.free("change", None, by_sensor, {robot: by_flange})
    return replace(
        problem,
        poses={robot: poses @ flange},
        observations=replace(
            observations,
            measured=observations.measured @ sensor,
            covariance=adjoints @ observations.covariance @ np.swapaxes(adjoints, 1, 2),
        ),
    ).with_effects([*(effect.carried(adjoints) for effect in problem.effects), changed])


def with_change(state: State, cause: ChangeHypothesis) -> State:
    """The unknowns followed by those of a cause, which are zero."""
    return State(state.edges, np.concatenate([state.values, np.zeros(len(cause.units))]))


def _stepped(
    jacobian: FloatArray | None, values: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Motions (m, 4, 4) for some values, and their right Jacobian (m, 6, p)."""
    if jacobian is None:
        return np.tile(np.eye(4), (count, 1, 1)), np.zeros((count, 6, len(values)))
    twists = jacobian @ values
    # The series does not converge beyond; no cause that leads there explains anything.
    near = np.linalg.norm(twists[:, :3], axis=1) < np.pi
    right_jacobian_inverse = inverse_right_jacobian(np.where(near[:, None], twists, 0.0))
    return exp(twists), np.asarray(np.linalg.solve(right_jacobian_inverse, jacobian))
