"""How well a motion determines the base parameters: the condition of its regressor."""

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp, softmax

from visioncal.core.types import FloatArray
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.motion import Motion

# A motion without effect on a parameter must not divide by zero.
_TINY = 1e-12


@dataclass(frozen=True)
class Condition:
    """Condition numbers of a motion's regressor of the base parameters.

    Units of the parameters do not matter to a least-squares fit, and change the raw figure at will:
    columns of unit length are the ones to compare by (van der Sluis 1969).

    Attributes:
        weighted: Each joint's rows divided by its noise, columns of unit length.
        scaled: Rows as they are, columns of unit length.
        raw: Rows and columns as they are, in SI units.
    """

    weighted: float
    scaled: float
    raw: float


def condition_of(base: BaseModel, motion: Motion, weights: FloatArray) -> Condition:
    """Computes the condition numbers of a motion.

    Args:
        base: The parameters.
        motion: Evenly sampled.
        weights: (n,) inverse of each joint's torque noise, up to a common factor.
    """
    rows = base.regressor(motion)
    flat = rows.reshape(-1, base.rank)
    weighted = (rows * weights[:, None]).reshape(-1, base.rank)
    figures = [float(np.linalg.cond(it)) for it in (_unit(weighted), _unit(flat), flat)]
    return Condition(*figures)


def _unit(rows: FloatArray) -> FloatArray:
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=0), _TINY))


def smooth_condition(rows: FloatArray, sharpness: float) -> tuple[float, FloatArray]:
    """The logarithm of the condition of column-scaled rows, made smooth.

    Greatest and least eigenvalue are taken by power means over all of them: with sharpness 1 it is
    half the logarithm of trace(G) trace(G^-1), A-optimality; with more it tends to the condition.

    Args:
        rows: (r, b).
        sharpness: Power of the means.

    Returns:
        The value, and its derivatives (r, b) by the rows.
    """
    lengths = np.maximum(np.linalg.norm(rows, axis=0), _TINY)
    unit = rows / lengths
    values, vectors = np.linalg.eigh(unit.T @ unit)
    values = np.maximum(values, _TINY)
    powers = sharpness * np.log(values)
    value = 0.5 * (logsumexp(powers) + logsumexp(-powers)) / sharpness
    by_values = 0.5 * (softmax(powers) - softmax(-powers)) / values
    by_unit = 2.0 * unit @ ((vectors * by_values) @ vectors.T)
    by_rows = (by_unit - unit * np.sum(by_unit * unit, axis=0)) / lengths
    return float(value), np.asarray(by_rows)
