"""Which change of a cell explains what a few stops show: marginal likelihoods of single causes.

A calibration says where the chain of frames closes, and how surely. New stops that do not close it
so are explained by one of several causes, each of a few further unknowns of a size that is not
known beforehand. Their marginal likelihoods compare causes of any number of unknowns fairly (Kass
and Raftery 1995, section 3): one that could explain anything pays for it. Everything is Gaussian
but the noise's common scale, which the calibration has estimated with so many degrees of freedom:
integrated out, it gives Student's distribution (Box and Tiao 1973, section 2.7).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from visioncal.estimation.closure import Closure, Edges, Noise, residual_blocks
from visioncal.estimation.problem import ROBOT, Effect
from visioncal.estimation.variance import Knowledge
from visioncal.transforms import adjoint, exp, inverse_right_jacobian, invert
from visioncal.types import FloatArray

# Changes come in all sizes: from a tenth of a millimetre to a tenth of a metre, by half decades.
SIZES_M = tuple(float(it) for it in 10.0 ** np.arange(-4.0, -0.9, 0.5))
# A knock that shifts by a millimetre turns by 4 mrad.
TURN_PER_M = 4.0
# Steps of a cause settle after two or three; far beyond any arm's repeatability is far enough.
_ROUNDS, _AT_REST = 6, 1e-7
# No chain closes better [rad and m]; exact data would otherwise measure rounding by zero.
_LEAST_SIGMA = 1e-9


@dataclass(frozen=True, eq=False)
class Belief:
    """What is known of a chain before it is looked at again.

    Attributes:
        edges: The unknowns: both edges, and k values that all stops share.
        covariance: (12 + k, 12 + k) of their steps.
        noise: Of one stop.
        freedom: Degrees of freedom that its scale was estimated with; infinite where it is known.
    """

    edges: Edges
    covariance: FloatArray
    noise: Noise
    freedom: float


@dataclass(frozen=True, eq=False)
class Cause:
    """A change that could have happened since, of p unknowns.

    Attributes:
        name: Which.
        by_camera: (m, 6, p) how each stop's `cam_from_target` has to be moved to undo it.
        by_flange: (m, 6, p) how each stop's `base_from_flange` has to be.
        units: (p,) the size of each unknown, for a change of one metre.
        start: (p,) where to look for it.
        noise_factors: What the noise of the stops may have grown by, where that is the change.
    """

    name: str
    by_camera: FloatArray
    by_flange: FloatArray
    units: FloatArray
    start: FloatArray
    noise_factors: tuple[float, ...] = ()

    @property
    def trials(self) -> tuple[tuple[float, float], ...]:
        """Sizes [m] and factors of the noise to be tried, all as likely beforehand."""
        if self.noise_factors:
            return tuple((0.0, it) for it in self.noise_factors)
        return tuple((it, 1.0) for it in SIZES_M)


@dataclass(frozen=True, eq=False)
class Explained:
    """What the stops say under one cause.

    Attributes:
        likelihood: Logarithm of its marginal likelihood.
        values: (p,) its unknowns, as the stops alone say them.
        covariance: (p, p) of these.
        noise_factor: What the noise has most likely grown by.
        misfit: Squared distance, in units of sigma, that the cause leaves unexplained.
        freedom: How many directions of the residuals that is in.
    """

    likelihood: float
    values: FloatArray
    covariance: FloatArray
    noise_factor: float
    misfit: float
    freedom: int


def explain(data: Closure, belief: Belief, cause: Cause | None = None) -> Explained:
    """Says how well a cause explains some stops.

    Args:
        data: The stops, with all that they share of `belief`.
        belief: What the calibration says.
        cause: The change; None where nothing has.
    """
    cause = cause or _nothing(len(data))
    units, (widest_m, factor) = cause.units, cause.trials[-1]
    stops = _rested(data, belief, cause, widest_m * units, factor)
    scores = []
    for size_m, grown in cause.trials:
        if grown != factor:
            stops = _at(data, belief, cause, stops.values, grown)
        scores.append(_score(stops, size_m * units, belief.freedom))
    grown = cause.trials[int(np.argmax(scores))][1]
    stops = _at(data, belief, cause, stops.values, grown)
    # The change's size is left to the stops: what is known of it beforehand would shrink it.
    mean, spread = _posterior(stops, widest_m * units)
    pulled = float(np.sum((mean / (widest_m * units)) ** 2))
    return Explained(
        float(np.logaddexp.reduce(scores) - np.log(len(scores))),
        mean,
        spread,
        grown,
        _misfit(stops, widest_m * units)[0] - pulled,
        len(stops.residuals) - len(units),
    )


@dataclass(frozen=True, eq=False)
class _Stops:
    """The residuals (n,) of all stops as they are linear in a cause's unknowns around some values.

    `residuals` are those at zero, by that linearisation; `slopes` (n, p), `spread` (n, n) of the
    noise and of the calibration's unknowns together, which are so small that they stay where the
    calibration has them.
    """

    values: FloatArray
    residuals: FloatArray
    slopes: FloatArray
    spread: FloatArray


def _nothing(stops: int) -> Cause:
    """No change at all."""
    still, none = np.zeros((stops, 6, 0)), np.zeros(0)
    return Cause("nothing", still, still, none, none, (1.0,))


def _rested(
    data: Closure, belief: Belief, cause: Cause, sigmas: FloatArray, factor: float
) -> _Stops:
    """Linearises at a cause's most likely values, which linearising finds."""
    stops = _at(data, belief, cause, cause.start, factor)
    for _ in range(_ROUNDS if len(sigmas) else 0):
        after = _posterior(stops, sigmas)[0]
        moved = np.abs(after - stops.values).max()
        stops = _at(data, belief, cause, after, factor)
        if moved < _AT_REST:
            break
    return stops


def _at(data: Closure, belief: Belief, cause: Cause, values: FloatArray, factor: float) -> _Stops:
    """Linearises at some values (p,) of a cause."""
    without, known = undone(data, cause, values), len(belief.covariance)
    shared = np.concatenate([belief.edges.shared, np.zeros(len(values))])
    noise = Noise(factor * belief.noise.sigma_rad, factor * belief.noise.sigma_m)
    residuals, jacobian, spreads = residual_blocks(
        without, replace(belief.edges, shared=shared), noise
    )
    slopes = jacobian.reshape(-1, known + len(values))
    before, own = slopes[:, :known], slopes[:, known:]
    spread = block_diag(*spreads) + before @ belief.covariance @ before.T
    spread += _LEAST_SIGMA**2 * np.eye(len(spread))
    return _Stops(values, residuals.reshape(-1) - own @ values, own, spread)


def undone(data: Closure, cause: Cause, values: FloatArray) -> Closure:
    """The stops as they would be without a change of some size, and how they go on moving with it.

    A change may be large: a board that was put elsewhere has turned by any angle.

    Args:
        data: The stops.
        cause: What has changed.
        values: (p,) its unknowns, by how much.

    Returns:
        The stops, with the p unknowns behind those that they share.
    """
    by_camera, by_flange = (
        _stepped(slopes, values) for slopes in (cause.by_camera, cause.by_flange)
    )
    carried = adjoint(invert(by_camera.moved))
    known = data.camera_covariance
    nothing = Knowledge(np.zeros((len(values), len(values))), np.zeros(len(values)))
    changed = Effect.free("change", nothing, by_camera.slopes, {ROBOT: by_flange.slopes})
    flange = data.robot if data.mount == "eye-in-hand" else invert(data.robot)
    flange = flange @ by_flange.moved
    return replace(
        data,
        robot=flange if data.mount == "eye-in-hand" else invert(flange),
        camera=data.camera @ by_camera.moved,
        camera_covariance=None if known is None else carried @ known @ np.swapaxes(carried, 1, 2),
        effects=tuple(it.carried(carried) for it in data.effects),
    ).with_more(changed)


@dataclass(frozen=True, eq=False)
class _Step:
    """Motions (m, 4, 4) by some values, and how they go on with them: (m, 6, p), on the right."""

    moved: FloatArray
    slopes: FloatArray


def _stepped(slopes: FloatArray, values: FloatArray) -> _Step:
    twists = slopes @ values
    # Beyond, the series does not converge; no cause that leads there explains anything.
    near = np.linalg.norm(twists[:, :3], axis=1) < np.pi
    onward = inverse_right_jacobian(np.where(near[:, None], twists, 0.0))
    return _Step(exp(twists), np.asarray(np.linalg.solve(onward, slopes), dtype=float))


def _score(stops: _Stops, sigmas: FloatArray, freedom: float) -> float:
    """Logarithm of the marginal likelihood, up to what all causes have in common."""
    squares, log_det = _misfit(stops, sigmas)
    if np.isinf(freedom):
        return -0.5 * (log_det + squares)
    count = len(stops.residuals)
    return -0.5 * (log_det + (freedom + count) * float(np.log1p(squares / freedom)))


def _misfit(stops: _Stops, sigmas: FloatArray) -> tuple[float, float]:
    """Squared length of the residuals in units of their covariance, and its log-determinant."""
    root, lower = _root(stops, sigmas)
    squares = float(stops.residuals @ cho_solve((root, lower), stops.residuals))
    return squares, 2.0 * float(np.log(np.diag(root)).sum())


def _posterior(stops: _Stops, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (p,) and covariance (p, p) of a cause's values, given the residuals."""
    carried = stops.slopes * sigmas**2
    taken = cho_solve(_root(stops, sigmas), carried)
    return -taken.T @ stops.residuals, np.diag(sigmas**2) - carried.T @ taken


def _root(stops: _Stops, sigmas: FloatArray) -> tuple[FloatArray, bool]:
    """Cholesky's root of the residuals' covariance, for a cause of some size."""
    total = stops.spread + (stops.slopes * sigmas**2) @ stops.slopes.T
    root, lower = cho_factor(total, lower=True)
    return np.asarray(root), bool(lower)
