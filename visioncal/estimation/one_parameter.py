"""One parameter of an arm that is far off, beside the errors of links that all arms have.

An arm's errors are fitted with one size for each block of them. A single length of a table that was
mistyped makes that size large, and all links share it. Here each parameter in turn is free beside
smaller errors, and is compared by its marginal likelihood with all errors of the fitted size:
Gaussian in the errors, whose information follows from their posterior (Rasmussen and Williams 2006,
5.4).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.parameters import Parameter

# Relative sizes of the other errors of a parameter's blocks that are tried.
_RESTS = np.geomspace(0.05, 1.0, 9)
# Log odds against the errors that all arms have, of one parameter of some forty; and within which
# another one is as likely.
_CLEAR, _AS_LIKELY = float(np.log(40.0 * 1000.0)), float(np.log(20.0))


@dataclass(frozen=True)
class FarParameter:
    """A parameter that explains an arm's errors alone, or nearly so."""

    at: int  # Its index among the parameters.
    change: float  # By how much it is off, beside the other errors [rad, m or 1].
    sigma: float  # Standard deviation of this change.
    rest: float  # Size of the other errors of its kind, relative to that without it.
    gain: float  # Log marginal likelihood over errors of the fitted size alone.


def far_parameters(
    arm: ArmData, parameters: Sequence[Parameter], moves: FloatArray
) -> list[FarParameter]:
    """The parameters that explain an arm's errors alone, likeliest first; empty where none does.

    Parameters that the stops do not distinguish from the first within a factor of 20 follow it.

    Args:
        arm: The observations of the arm, with its errors.
        parameters: (k,) parameters of its table.
        moves: (k, p) their changes by the arm's errors; see `parameter_moves`.
    """
    size, columns = arm.model.error_rad, arm.columns
    posterior = arm.fit.by_noise[np.ix_(columns, columns)] / size**2
    information = np.linalg.inv(posterior) - np.eye(len(columns))
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    information = vectors * np.maximum(values, 0.0) @ vectors.T
    seen = (information + np.eye(len(columns))) @ (arm.model.values / size)
    others = _Rest(information, seen, np.ones(len(columns)))
    found, rests_of = list[FarParameter](), dict[bytes, list[_Rest]]()
    for at, direction in enumerate(np.linalg.pinv(moves).T):
        if not moves[at].any():
            continue
        blocks = map(arm.model.columns_of, arm.model.weights)
        in_blocks, whole = np.zeros(len(columns), dtype=bool), np.sum(direction**2)
        for block in blocks:
            # Least share of a parameter in a block whose other errors are then smaller.
            in_blocks[block] = np.sum(direction[block] ** 2) > 0.1 * whole
        # Parameters of one kind share their blocks.
        if (key := in_blocks.tobytes()) not in rests_of:
            sizes = (np.where(in_blocks, rest, 1.0) for rest in _RESTS.tolist())
            rests_of[key] = [_Rest(information, seen, each) for each in sizes]
        # Prior sigma of a parameter that was mistyped [rad]: 3 mm, 0.3 deg, 0.6 % of a gear.
        prior = 6e-3 * parameters[at].unit / size
        fits = []
        for rest, errors in zip(_RESTS.tolist(), rests_of[key], strict=True):
            gain, change, sigma = errors.with_free(direction, prior)
            fits.append(FarParameter(at, size * change, size * sigma, rest, gain - others.log))
        found.append(max(fits, key=lambda fit: fit.gain))
    found.sort(key=lambda fit: -fit.gain)
    if not found or found[0].gain < _CLEAR or not _is_far(found[0], parameters):
        return []
    return [fit for fit in found if fit.gain > found[0].gain - _AS_LIKELY]


def _is_far(found: FarParameter, parameters: Sequence[Parameter]) -> bool:
    """Whether a parameter is off by more than makers leave, and nearly alone."""
    parameter = parameters[found.at]
    # Ordinary arms leave less [rad]: 1 mm, 0.1 deg, 0.1 % of a gear.
    usual = 1e-3 if parameter.kind == "ratio" else 2e-3 * parameter.unit
    return abs(found.change) > max(usual, 5.0 * found.sigma) and 2.0 * found.rest < 1.0


class _Rest:
    """Errors z ~ N(0, sizes^2) with log likelihood z . seen - z . information . z / 2."""

    def __init__(self, information: FloatArray, seen: FloatArray, sizes: FloatArray) -> None:
        self._information, self._seen = information, seen
        self._covariance = np.linalg.inv(information + np.diag(sizes**-2.0))
        scaled = np.eye(len(sizes)) + sizes[:, None] * information * sizes
        half_squares = 0.5 * float(seen @ self._covariance @ seen)
        self.log = half_squares - 0.5 * float(np.linalg.slogdet(scaled)[1])

    def with_free(self, direction: FloatArray, prior: float) -> tuple[float, float, float]:
        """Log evidence with a step along a direction, the step and its sigma."""
        by_step = self._information @ direction
        absorbed = self._covariance @ by_step
        weight = float(direction @ by_step - by_step @ absorbed)
        pull = float(direction @ self._seen - absorbed @ self._seen)
        variance = 1.0 / (weight + prior**-2.0)
        log = self.log + 0.5 * pull**2 * variance - 0.5 * float(np.log1p(prior**2 * weight))
        return log, pull * variance, float(np.sqrt(variance))
