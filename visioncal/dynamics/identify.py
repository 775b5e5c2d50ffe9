"""Identification of an arm's base parameters, Stribeck humps, standard parameters and torque lag.

Torques that are filtered, or stamped by another clock, lag the angles. One lag of all streams is
searched on a grid by the residuals of the best fit, and refined by Gauss-Newton steps with the
torques' time derivative as one more column.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from visioncal.core.limits import DynamicsLimits
from visioncal.core.types import FloatArray, Mask
from visioncal.dynamics.base import BaseModel, check_identifiable, check_joints_move, null_space
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.consistent import fit_consistent
from visioncal.dynamics.convention_hypotheses import check_recording
from visioncal.dynamics.identified import Identified, Lag, StreamStatistics
from visioncal.dynamics.model import DynamicModel, FrictionTerms
from visioncal.dynamics.regression import NoiseBlock, Regression, regress, rms_of, std_of
from visioncal.dynamics.stribeck import Stribeck, fit_stribeck
from visioncal.robot import Robot

# Uncertainty of filtered speeds, below which the sign of friction is smoothed [rad/s].
SLOW_RAD_S = 1e-4

_LIMITS = DynamicsLimits()
# Greatest lag [s], grid points per period of the cut-off, and number of torques of the grid search.
_LARGEST_S, _PER_PERIOD, _ROWS = 0.25, 16, 20_000
# A lag is significant from so many sigmas on, if the median residual of the joints is at most this
# share of the torques' range: larger residuals have other causes.
_SIGMAS, _LEFT = 5.0, 0.3
_ROUNDS, _SETTLED = 5, 0.1


@dataclass(frozen=True)
class Options:
    """Options of the identification."""

    # The joints' own parameters: friction, offsets, rotors.
    terms: FrictionTerms = field(default_factory=partial(FrictionTerms, slow_rad_s=SLOW_RAD_S))
    stribeck: bool = True  # Whether Stribeck humps of friction are fitted.
    # Whether consistent standard parameters are fitted near the robot's own.
    consistent: bool = True
    checked: bool = True  # Whether mistaken recordings are searched for and refused.


@dataclass(frozen=True, eq=False)
class Identification:
    """Identified dynamics, the fitted streams, and the regression, Stribeck terms last."""

    identified: Identified
    streams: tuple[Conditioned, ...]
    fit: Regression


def identify(
    robot: Robot, streams: Sequence[Conditioned], options: Options | None = None
) -> Identification:
    """Identifies an arm's dynamics.

    Args:
        robot: The arm; its inertias, if known, serve to check the torques' units and as prior of
            the standard parameters.
        streams: Motions with their torques.
        options: What is estimated.

    Raises:
        DataError: Torques are of other units, of other joints, or of the other sign.
        DegenerateError: The motion does not determine all base parameters; the error names them.
    """
    options = Options() if options is None else options
    base = BaseModel.reduce(DynamicModel(robot, options.terms))
    check_joints_move(base, streams)
    if options.checked:
        check_recording(base, streams)
    blocks = [block_of(base, stream) for stream in streams]
    check_identifiable(base, blocks)
    fit = regress(blocks)
    humps = Stribeck.none()
    if options.stribeck and options.terms.coulomb:
        names = [base.model.names[index] for index in base.independent]
        coulomb_indices = np.array(
            [names.index(f"Fc{index + 1}") for index in range(robot.joint_count)]
        )
        humps, fit = fit_stribeck(streams, blocks, fit, options.terms.slow_rad_s, coulomb_indices)
    consistent = None
    if options.consistent and robot.inertias is not None:
        kept = slice(base.rank)
        consistent = fit_consistent(
            base, fit.values[kept], fit.covariance[kept, kept], robot.inertias
        )
    identified = Identified(
        robot,
        base,
        fit.values[: base.rank],
        fit.covariance,
        humps,
        consistent,
        stream_statistics(streams, fit),
    )
    return Identification(identified, tuple(streams), fit)


def block_of(base: BaseModel, stream: Conditioned) -> NoiseBlock:
    """Filtered regressor and torques of a stream."""
    x = stream.filtered(base.regressor)
    return NoiseBlock(x, stream.torques_nm, stream.used, stream.correlation)


def stream_statistics(
    streams: Sequence[Conditioned], fit: Regression
) -> tuple[StreamStatistics, ...]:
    """Statistics of each stream."""
    return tuple(
        StreamStatistics(
            label=stream.label,
            samples=stream.count,
            left_out=int(np.sum(~block.used)),
            band_hz=stream.band_hz,
            cutoff_hz=stream.cutoff_hz,
            rate_hz=stream.rate_hz,
            noise_nm=sigma,
            rms_nm=rms_of(residuals, block.used),
            torque_nm=std_of(block.y, block.used),
            notes=stream.notes,
        )
        for stream, block, residuals, sigma in zip(
            streams, fit.blocks, fit.residuals, fit.sigmas, strict=True
        )
    )


def find_lag(robot: Robot, streams: Sequence[Conditioned], terms: FrictionTerms) -> Lag | None:
    """Estimates the lag of the torques behind the angles.

    Args:
        robot: The arm.
        streams: Its motions, with torques of one lag.
        terms: The joints' own parameters. Rotors are added where the motion determines them:
            otherwise a lag of viscous friction would take their place.

    Returns:
        The lag; None where it is insignificant, or the motion does not determine it.
    """
    for rotors in (True, terms.motor_inertia):
        model = DynamicModel(robot, replace(terms, motor_inertia=rotors))
        base = BaseModel.reduce(model)
        blocks = [block_of(base, stream) for stream in streams]
        if not null_space(base, blocks):
            break
    else:
        return None
    try:
        return _estimated_lag(streams, blocks)
    except np.linalg.LinAlgError:
        return None


def _estimated_lag(streams: Sequence[Conditioned], blocks: Sequence[NoiseBlock]) -> Lag | None:
    lag_s = _grid_lag(streams, blocks)
    if lag_s is None:
        return None
    for _ in range(_ROUNDS):
        lagged = [_lagged(*pair, lag_s) for pair in zip(streams, blocks, strict=True)]
        fit = regress(lagged)
        change, sigma = float(fit.values[-1]), float(np.sqrt(fit.covariance[-1, -1]))
        lag_s -= change
        if abs(change) < _SETTLED * sigma or abs(lag_s) > _LARGEST_S:
            break
    lag = Lag(lag_s, sigma, _change_share(fit, lag_s))
    # A torque that never changes tells nothing of a lag.
    residual_shares = [
        np.divide(rms_of(residual, block.used), std, out=np.ones(len(std)), where=std > 0.0)
        for residual, block in zip(fit.residuals, fit.blocks, strict=True)
        for std in (std_of(block.y, block.used),)
    ]
    significant = _SIGMAS * sigma < abs(lag_s) <= _LARGEST_S and lag.share > _LIMITS.slight_share
    return lag if significant and np.median(residual_shares) < _LEFT else None


def _grid_lag(streams: Sequence[Conditioned], blocks: Sequence[NoiseBlock]) -> float | None:
    """Most likely lag on a grid [s]; None where samples are too few."""
    step_s = 1.0 / (_PER_PERIOD * max(stream.cutoff_hz for stream in streams))
    steps = int(_LARGEST_S / step_s)
    lags = step_s * np.arange(-steps, steps + 1)
    rows, torques, joints = [], [], []
    total = sum(block.y.size for block in blocks)
    for stream, block in zip(streams, blocks, strict=True):
        used = block.used & _inside(stream, _LARGEST_S)[:, None]
        used[np.arange(len(used)) % max(total // _ROWS, 1) > 0] = False
        sizes = np.maximum(std_of(block.y, used), 1e-12)
        rows.append((block.x / sizes[:, None])[used])
        torques.append(np.stack([(_torques(stream, lag) / sizes)[used] for lag in lags], axis=1))
        joints.append(np.nonzero(used)[1])
    x, y, joint = np.concatenate(rows), np.concatenate(torques), np.concatenate(joints)
    if len(x) < 2 * x.shape[1]:
        return None
    directions = np.linalg.qr(x / np.maximum(np.linalg.norm(x, axis=0), 1e-12))[0]
    left = (y - directions @ (directions.T @ y)) ** 2
    # Negative log-likelihood, with a noise level per joint.
    cost = np.zeros(len(lags))
    for number in np.unique(joint):
        rows_of_joint = joint == number
        cost += rows_of_joint.sum() * np.log(np.maximum(left[rows_of_joint].sum(axis=0), 1e-12))
    return float(lags[np.argmin(cost)])


def _lagged(stream: Conditioned, block: NoiseBlock, lag_s: float) -> NoiseBlock:
    """The block with its torques advanced by a lag, and their derivative as one more column."""
    step_s = 1.0 / stream.rate_hz
    y, before, after = (
        _torques(stream, value) for value in (lag_s, lag_s - step_s, lag_s + step_s)
    )
    derivative = (after - before) / (2.0 * step_s)
    used = block.used & _inside(stream, abs(lag_s) + step_s)[:, None]
    return NoiseBlock(
        np.concatenate([block.x, derivative[:, :, None]], axis=2), y, used, block.correlation
    )


def _torques(stream: Conditioned, lag_s: float) -> FloatArray:
    """Filtered torques (k, n), advanced by a lag, over the samples present now [N m]."""
    parts = []
    for piece in stream.pieces:
        times_s = piece.measured.motion.times_s
        later = [
            np.interp(times_s + lag_s, times_s, column) for column in piece.measured.torques_nm.T
        ]
        parts.append(piece.lowpass(np.stack(later, axis=1), piece.present))
    return np.concatenate(parts)


def _inside(stream: Conditioned, lag_s: float) -> Mask:
    """(k,) filtered samples whose windows, shifted by a lag either way, are within the piece."""
    parts = []
    for piece in stream.pieces:
        ends_s = piece.measured.motion.times_s[[0, -1]] + np.array([1.0, -1.0]) * (
            piece.lowpass.half / stream.rate_hz + lag_s
        )
        parts.append((piece.times_s >= ends_s[0]) & (piece.times_s <= ends_s[1]))
    return np.concatenate(parts)


def _change_share(fit: Regression, lag_s: float) -> float:
    """Greatest change of a joint's torques by a lag, over their range."""
    shares = [
        rms_of(lag_s * block.x[:, :, -1], block.used)
        / np.maximum(std_of(block.y, block.used), 1e-12)
        for block in fit.blocks
    ]
    return float(np.max(shares))
