"""Dynamic identification: from streams of motion and torque to the parameters of an arm."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from visioncal.dynamics.base import BaseModel, check_identifiable, check_turning
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.consistent import fit_consistent
from visioncal.dynamics.convention_hypotheses import check_mistakes
from visioncal.dynamics.identified import Identified, StreamFacts
from visioncal.dynamics.model import DynamicModel, FrictionTerms
from visioncal.dynamics.regression import NoiseBlock, Regression, regress, rms_of, spread_of
from visioncal.dynamics.stribeck import Stribeck, fit_stribeck
from visioncal.robot import Robot

# What speeds are known to after filtering; joints are through it in no time [rad/s].
SLOW_RAD_S = 1e-4


@dataclass(frozen=True)
class Options:
    """What is estimated.

    Attributes:
        terms: What joints have of their own.
        stribeck: Whether humps of dry friction at low speed are looked for.
        consistent: Whether standard parameters of bodies are sought near the robot's own.
        checked: Whether the torques are compared with what the robot's inertias predict.
    """

    terms: FrictionTerms = field(default_factory=partial(FrictionTerms, slow_rad_s=SLOW_RAD_S))
    stribeck: bool = True
    consistent: bool = True
    checked: bool = True


@dataclass(frozen=True, eq=False)
class Identification:
    """A result with what it rests on.

    Attributes:
        identified: The result.
        streams: What it was identified from.
        fit: The regression; behind the base parameters stand those of Stribeck's humps.
    """

    identified: Identified
    streams: tuple[Conditioned, ...]
    fit: Regression


def identify(
    robot: Robot, streams: Sequence[Conditioned], options: Options | None = None
) -> Identification:
    """Identifies an arm's dynamics.

    Args:
        robot: The arm; where it has inertias, torques are checked against these, and standard
            parameters are sought near them. Without, units of all torques cannot be told.
        streams: Motions with their torques.
        options: What is estimated.

    Raises:
        DataError: Torques are of other units, of other joints, or of the other sign.
        DegenerateError: The motion does not determine all base parameters; the error names them.
    """
    options = Options() if options is None else options
    base = BaseModel.reduce(DynamicModel(robot, options.terms))
    check_turning(base, streams)
    if options.checked:
        check_mistakes(base, streams)
    blocks = [block_of(base, stream) for stream in streams]
    check_identifiable(base, blocks)
    fit = regress(blocks)
    humps = Stribeck.none()
    if options.stribeck and options.terms.coulomb:
        names = [base.model.names[index] for index in base.independent]
        sliding = np.array([names.index(f"Fc{index + 1}") for index in range(robot.joint_count)])
        humps, fit = fit_stribeck(streams, blocks, fit, options.terms.slow_rad_s, sliding)
    consistent = None
    if options.consistent and robot.inertias is not None:
        kept = slice(base.rank)
        consistent = fit_consistent(
            base, fit.values[kept], fit.covariance[kept, kept], robot.inertias
        )
    identified = Identified(
        robot, base, fit.values[: base.rank], fit.covariance, humps, consistent, facts(streams, fit)
    )
    return Identification(identified, tuple(streams), fit)


def block_of(base: BaseModel, stream: Conditioned) -> NoiseBlock:
    """The filtered regressor and torques of a stream."""
    x = stream.filtered(base.regressor)
    return NoiseBlock(x, stream.torques_nm, stream.used, stream.correlation)


def facts(streams: Sequence[Conditioned], fit: Regression) -> tuple[StreamFacts, ...]:
    """The figures of each stream."""
    return tuple(
        StreamFacts(
            label=stream.label,
            samples=stream.count,
            left_out=int(np.sum(~block.used)),
            band_hz=stream.band_hz,
            cutoff_hz=stream.cutoff_hz,
            rate_hz=stream.rate_hz,
            noise_nm=sigma,
            rms_nm=rms_of(residuals, block.used),
            torque_nm=spread_of(block.y, block.used),
            notes=stream.notes,
        )
        for stream, block, residuals, sigma in zip(
            streams, fit.blocks, fit.residuals, fit.sigmas, strict=True
        )
    )
