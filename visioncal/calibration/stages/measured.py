"""What a session knows of frames beforehand, and what it did to the answer, in words."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.estimation.observability import SIGMA_LIMIT_M
from visioncal.estimation.parts import FramePrior, State
from visioncal.estimation.problem import Problem
from visioncal.session.tables import PriorTable

_COMPONENTS = ("x_m", "y_m", "z_m")
# What was measured is contradicted by so many standard deviations.
_CONTRADICTION = 3.0


def prior_of(name: str, table: PriorTable) -> FramePrior:
    """Reads `[prior.A_from_B]`: the components that it states, and the rotation where it does."""
    first, _, second = name.partition("_from_")
    values = [getattr(table, it) for it in _COMPONENTS]
    axes = tuple(axis for axis, value in enumerate(values) if value is not None)
    places = tuple(float(values[axis]) for axis in axes)
    found = FramePrior(first, second, axes, places, table.sigma_m or 1.0)
    if table.quaternion_xyzw is None or table.sigma_rad is None:
        return found
    rotation = Rotation.from_quat(table.quaternion_xyzw).as_matrix()
    return replace(found, rotation=rotation, sigma_rad=table.sigma_rad)


@dataclass(frozen=True)
class Component:
    """A measured component beside what the views alone say of it [m]."""

    label: str
    axis: int
    is_used: bool
    stated_m: float
    sigma_m: float
    seen_m: float
    seen_sigma_m: float

    @property
    def is_redundant(self) -> bool:
        """Whether the views would do without."""
        return self.seen_sigma_m < SIGMA_LIMIT_M

    @property
    def is_contradicted(self) -> bool:
        """Whether the views say otherwise, by more than both may be off."""
        return self.is_redundant and self.contradiction > _CONTRADICTION

    @property
    def contradiction(self) -> float:
        """How far the views alone are from it, in units of what both are known to."""
        apart_m = abs(self.seen_m - self.stated_m)
        return float(apart_m / np.hypot(self.sigma_m, self.seen_sigma_m))

    @property
    def remark(self) -> str:
        """Says that the answer rests on it."""
        alone = "leave it open"
        if self.is_redundant:
            alone = f"determine it to {figure(1e3 * self.seen_sigma_m)} mm"
        return (
            f"The measured {self.label} = {1e3 * self.stated_m:g} mm was used, known to "
            f"{figure(1e3 * self.sigma_m)} mm; the views alone {alone}."
        )

    @property
    def doubt(self) -> str:
        """Says that the views contradict it."""
        return (
            f"The measured {self.label} = {1e3 * self.stated_m:g} mm, known to "
            f"{figure(1e3 * self.sigma_m)} mm, is contradicted by the views, which alone say "
            f"{1e3 * self.seen_m:.4g} mm to {figure(1e3 * self.seen_sigma_m)} mm; it is not used."
        )


def components(
    problem: Problem,
    state: State,
    covariance: FloatArray,
    priors: Sequence[FramePrior],
) -> tuple[Component, ...]:
    """The measured components of priors beside what the observations alone say of them.

    Args:
        problem: The observations in the fit.
        state: The answer.
        covariance: (p, p) covariance of the unknowns.
        priors: Priors, in the problem or left out of it.
    """
    return tuple(it for prior in priors for it in _components(prior, problem, state, covariance))


def _components(
    prior: FramePrior, problem: Problem, state: State, covariance: FloatArray
) -> Iterator[Component]:
    away, jacobian = problem.prior_rows(prior, state)
    used = {(it.name, axis) for it in problem.priors for axis in it.axes}
    sigmas = np.sqrt(np.einsum("dp,pq,dq->d", jacobian, covariance, jacobian)) * prior.sigma_m
    # Behind those of the rotation, which no word is said of.
    places = slice(len(away) - len(prior.axes), len(away))
    for axis, stated, off, sigma in zip(
        prior.axes,
        prior.values_m,
        (away[places] * prior.sigma_m).tolist(),
        sigmas[places].tolist(),
        strict=True,
    ):
        is_used = (prior.name, axis) in used
        seen = _without_prior(off, sigma, prior.sigma_m) if is_used else (off, sigma)
        label = f"{_COMPONENTS[axis]} of {prior.name}"
        yield Component(label, axis, is_used, stated, prior.sigma_m, stated + seen[0], seen[1])


def _without_prior(off_m: float, sigma_m: float, prior_m: float) -> tuple[float, float]:
    """How far the views alone are from a measured component, and to what they know it [m]."""
    own = max(sigma_m**-2.0 - prior_m**-2.0, 0.0)
    alone = np.inf if own == 0.0 else 1.0 / np.sqrt(own)
    # Both together are their mean, each weighted with its information.
    return float(off_m + off_m * (alone / prior_m) ** 2), float(alone)
