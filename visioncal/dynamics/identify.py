"""Identification of base parameters, Stribeck humps and torque lag, and prediction of torques.

Torques that are filtered, or stamped by another clock, lag the angles. One lag of all streams is
found by Gauss-Newton steps with the torques' time derivative as one more column.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from visioncal.core.limits import DynamicsLimits
from visioncal.core.types import FloatArray, Mask, interpolated
from visioncal.dynamics.base import (
    BaseModel,
    check_identifiable,
    check_joints_move,
    fit_consistent,
    null_space,
)
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.convention_hypotheses import check_recording
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.model import DynamicModel, FrictionTerms, JointMotion
from visioncal.dynamics.regression import (
    NoiseBlock,
    Regression,
    Stribeck,
    fit_stribeck,
    regress,
    rms_of,
    std_of,
)
from visioncal.dynamics.statistics import Lag, StreamStatistics, TorqueValidation
from visioncal.robot import Robot

# Uncertainty of filtered speeds, below which the sign of friction is smoothed [rad/s].
SLOW_RAD_S = 1e-4

_LIMITS = DynamicsLimits()
# Greatest lag [s].
_LARGEST_S = 0.25


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
        tuple(
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
        ),
    )
    return Identification(identified, tuple(streams), fit)


def block_of(base: BaseModel, stream: Conditioned) -> NoiseBlock:
    """Filtered regressor and torques of a stream."""
    x = stream.filtered(base.regressor)
    return NoiseBlock(x, stream.torques_nm, stream.used, stream.correlation)


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
    lag_s = 0.0
    for _ in range(15):
        lagged = [_lagged(*pair, lag_s) for pair in zip(streams, blocks, strict=True)]
        fit = regress(lagged)
        change, sigma = float(fit.values[-1]), float(np.sqrt(fit.covariance[-1, -1]))
        lag_s -= change
        if abs(change) < 0.1 * sigma or abs(lag_s) > _LARGEST_S:
            break
    # Greatest change of a joint's torques by the lag, over their range.
    changes = [
        rms_of(lag_s * block.x[:, :, -1], block.used)
        / np.maximum(std_of(block.y, block.used), 1e-12)
        for block in fit.blocks
    ]
    lag = Lag(lag_s, sigma, float(np.max(changes)))
    # A torque that never changes shows no lag.
    residual_shares = [
        np.divide(rms_of(residual, block.used), std, out=np.ones(len(std)), where=std > 0.0)
        for residual, block in zip(fit.residuals, fit.blocks, strict=True)
        for std in (std_of(block.y, block.used),)
    ]
    # Larger residuals have other causes than a lag.
    significant = 5.0 * sigma < abs(lag_s) <= _LARGEST_S and lag.share > _LIMITS.slight_share
    return lag if significant and np.median(residual_shares) < 0.3 else None


def _lagged(stream: Conditioned, block: NoiseBlock, lag_s: float) -> NoiseBlock:
    """The block with its torques advanced by a lag, and their derivative as one more column."""
    step_s = 1.0 / stream.rate_hz
    parts = []
    for piece in stream.pieces:
        times_s, torques_nm = piece.measured.motion.times_s, piece.measured.torques_nm
        y, before, after = (
            piece.lowpass(interpolated(times_s + value, times_s, torques_nm), piece.present)
            for value in (lag_s, lag_s - step_s, lag_s + step_s)
        )
        # Windows are within the piece, shifted by the lag either way.
        margin_s = piece.lowpass.half / stream.rate_hz + abs(lag_s) + step_s
        used = (piece.times_s >= times_s[0] + margin_s) & (piece.times_s <= times_s[-1] - margin_s)
        parts.append((y, (after - before)[:, :, None] / (2.0 * step_s), used[:, None]))
    y, derivative, used = map(np.concatenate, zip(*parts, strict=True))
    x = np.concatenate([block.x, derivative], axis=2)
    return NoiseBlock(x, y, block.used & used, block.correlation)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Filtered torques of a stream, measured and predicted."""

    label: str  # The stream's file.
    times_s: FloatArray  # (k,) times [s].
    measured_nm: FloatArray  # (k, n) [N m].
    predicted_nm: FloatArray  # (k, n) by the base parameters [N m].
    # (k, n) by the consistent standard parameters [N m]; None without these.
    consistent_nm: FloatArray | None
    used: Mask  # (k, n) mask of valid torques.
    dq: FloatArray  # (k, n) speeds of the joints, filtered likewise [rad/s].
    notes: tuple[str, ...] = ()  # Messages on faults of the samples.

    def rms_nm(self, predicted_nm: FloatArray) -> FloatArray:
        """(n,) root mean square error of a prediction [N m]."""
        return rms_of(predicted_nm - self.measured_nm, self.used)

    @property
    def torque_nm(self) -> FloatArray:
        """(n,) standard deviation of the measured torques, as their range [N m]."""
        return std_of(self.measured_nm, self.used)


def predict(identified: Identified, stream: Conditioned) -> Prediction:
    """Predicts a stream's filtered torques."""
    with_bodies = identified.consistent is not None
    return Prediction(
        stream.label,
        stream.times_s,
        stream.torques_nm,
        stream.filtered(identified.torques),
        stream.filtered(identified.consistent_torques) if with_bodies else None,
        stream.used,
        stream.filtered(lambda motion: motion.dq),
        stream.notes,
    )


def validate(identified: Identified, prediction: Prediction) -> TorqueValidation:
    """Compares predicted with measured torques."""
    consistent = prediction.consistent_nm
    return TorqueValidation(
        prediction.label,
        prediction.rms_nm(prediction.predicted_nm),
        prediction.torque_nm,
        np.max([stream.noise_nm for stream in identified.streams], axis=0),
        None if consistent is None else prediction.rms_nm(consistent),
    )


def friction_at(identified: Identified, dq: FloatArray) -> FloatArray:
    """Friction torques (m, n) of all joints at (m, n) speeds [N m]."""
    model = identified.base.model
    values = np.zeros(len(model.names))
    values[identified.base.independent] = identified.values
    still = np.zeros_like(dq)
    motion = JointMotion(np.zeros(len(dq)), still, dq, still)
    linear_nm = model.terms.columns(motion) @ values[10 * model.robot.joint_count :]
    return np.asarray(linear_nm + identified.stribeck.torques(motion))
