"""Errors that grow with time, reach or gravity: columns with one size, found by their evidence.

Each is a file with a `RandomEffect`, and an entry in `RANDOM_EFFECTS`. All sizes are estimated
together in the restricted likelihood of the robots' noise, beside errors of the arm by its posture;
an effect with a size is an unknown of the fit, whose prior is that size.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.mixed import LEAST_SIGMA, MOST_SIGMA, PriorInformation, level_weight
from visioncal.estimation.outliers import InlierFit
from visioncal.estimation.problem_parts import Effect, State
from visioncal.estimation.robot_likelihood import robot_likelihood

# Share of sessions that have one such error.
_RARE = 0.01
# Typical size of an arm's errors by its posture [rad].
_ARM = 3e-4


@dataclass(frozen=True)
class Stops:
    """What errors may depend on, at a robot's s stops, or at s observations of a sensor."""

    base_from_flange: FloatArray  # (s, 4, 4) its poses.
    time: FloatArray  # (s,) share of the session that is over, from 0 to 1.
    # (s, 6) derivative of the measured pose by the relative focal length; zero of other cameras.
    by_focal: FloatArray


class RandomEffect(ABC):
    """A kind of error, with columns of one size."""

    kind: ClassVar[str]  # The kind of its finding, and its name in the budget.
    typical: ClassVar[float]  # Its typical size, in the unit of its values.
    most: ClassVar[float]  # Beyond this, what else looks like it is likelier.
    do: ClassVar[str]  # Advice.
    is_of_sensor: ClassVar[bool] = False  # Whether it moves the measured poses, not the flange.

    @abstractmethod
    def columns(self, stops: Stops) -> FloatArray:
        """(s, 6, k) right Jacobian by its k values, of the flange at s stops or of s poses."""

    @abstractmethod
    def says(self, values: FloatArray) -> str:
        """What (k,) estimated values mean, as a sentence."""


def find_random_effects(
    inliers: InlierFit,
    candidates: Sequence[tuple[RandomEffect, Effect]],
    nuisance: Sequence[Effect],
) -> tuple[Effect, ...]:
    """Those of some kinds, each with its columns, that the residuals of the inliers show.

    All have the rows of all observations. Their sizes are their priors; `nuisance` are errors of
    arms by posture, each of unknown size.
    """
    effects = [*(effect for _, effect in candidates), *nuisance]
    typical = [kind.typical for kind, _ in candidates] + [_ARM] * len(nuisance)
    problem, fit = inliers.problem, inliers.fit
    wide = problem.with_effects([*problem.effects, *effects]).subset(inliers.used)
    values = np.append(fit.state.values, np.zeros(sum(map(len, effects))))
    likelihood = robot_likelihood(wide, State(fit.state.edges, values), fit.noise)
    columns = np.full(wide.size, -1)
    for index, effect in enumerate(effects):
        columns[wide.effect_columns[effect.name]] = index
    of_size = columns[likelihood.moving]
    shares = (of_size[:, None] == np.arange(len(effects))).astype(float)
    first, prior = likelihood.model.shares.shape[1], likelihood.model.prior
    model = replace(
        likelihood.model,
        shares=np.concatenate([likelihood.model.shares, shares], axis=1),
        prior=None if prior is None else prior.beside(np.zeros(len(effects)), np.inf),
    )
    levels = np.maximum(fit.noise.robots.ravel(), LEAST_SIGMA)
    low = np.full(first + len(effects), np.log(LEAST_SIGMA))
    # The search starts above the typical sizes.
    logs = np.log(np.concatenate([levels, 3.0 * np.array(typical)]))
    found = model.maximised(logs, low, np.log(MOST_SIGMA))

    def gain(index: int) -> float:
        high = np.full(len(low), np.log(MOST_SIGMA))
        high[first + index] = low[first + index]
        return 2.0 * (model.maximised(found.logs, low, high).value - found.value)

    chosen = []
    for index, (kind, effect) in enumerate(candidates):
        size = float(np.exp(found.logs[first + index]))
        if 10.0 * LEAST_SIGMA < size <= kind.most and level_weight(gain(index), _RARE) > 0.5:
            information = PriorInformation(np.eye(len(effect)) / size**2, np.zeros(len(effect)))
            chosen.append(replace(effect, prior=information))
    return tuple(chosen)


def effect_of(kind: RandomEffect, owner: str, stops: Stops) -> Effect:
    """A kind's columns as an effect of a robot or a camera, without a prior."""
    columns, name = kind.columns(stops), f"{kind.kind} of {owner}"
    flat = PriorInformation.flat(columns.shape[2])
    if kind.is_of_sensor:
        return Effect.free(name, flat, columns)
    return Effect.free(name, flat, flange_jacobian={owner: columns})
