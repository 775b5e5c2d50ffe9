"""Priors on a cell's frames, `[prior.A_from_B]`, and whether the views contradict them."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.directions import SIGMA_LIMIT_M
from visioncal.core.limits import CONTRADICTION
from visioncal.core.number_format import figure
from visioncal.core.verdict import CALIBRATE, NOTE, Finding, Remedy
from visioncal.estimation.fit import Fit
from visioncal.estimation.problem_parts import FramePrior
from visioncal.session.document import PriorTable
from visioncal.session.tree import Tree, check_prior

_AXES = ("x_m", "y_m", "z_m")


@dataclass(frozen=True)
class Component:
    """A measured component of a prior, beside what the views alone determine of it [m]."""

    label: str
    axis: int
    is_used: bool
    stated_m: float
    sigma_m: float
    seen_m: float
    seen_sigma_m: float

    @property
    def contradiction(self) -> float:
        """Distance of the views' value from it in combined sigmas; 0 where they leave it open."""
        distance_m = abs(self.seen_m - self.stated_m)
        is_seen = self.seen_sigma_m < SIGMA_LIMIT_M
        return float(distance_m / np.hypot(self.sigma_m, self.seen_sigma_m)) if is_seen else 0.0

    @property
    def finding(self) -> Finding:
        """A note that it was used, or that the views contradict it."""
        known = f"The measured {self.label} = {1e3 * self.stated_m:g} mm"
        sigma, seen_sigma = (figure(1e3 * value) for value in (self.sigma_m, self.seen_sigma_m))
        if self.is_used:
            is_seen = self.seen_sigma_m < SIGMA_LIMIT_M
            by_views = f"determine it to {seen_sigma} mm" if is_seen else "leave it open"
            words = f"{known} was used, known to {sigma} mm; the views alone {by_views}."
            return Finding(NOTE, words)
        return Finding(
            "prior",
            f"{known}, known to {sigma} mm, is contradicted by the views, which alone say "
            f"{1e3 * self.seen_m:.4g} mm to {seen_sigma} mm; it is not used.",
            Remedy("Measure it again, or delete it from session.toml.", CALIBRATE),
            mahalanobis_sq=self.contradiction**2,
        )


def components(fit: Fit, priors: Sequence[FramePrior]) -> Iterator[Component]:
    """The measured components of priors, used or not, beside the observations' estimates."""
    used = {(item.name, axis) for item in fit.problem.priors for axis in item.axes}
    for prior in priors:
        residuals, jacobian = fit.problem.prior_rows(prior, fit.state)
        sigmas = np.sqrt(np.einsum("dp,pq,dq->d", jacobian, fit.whole, jacobian)) * prior.sigma_m
        # The position's rows follow those of the rotation, which are not reported.
        rows = slice(len(residuals) - len(prior.axes), len(residuals))
        residuals_m, known_m = (residuals[rows] * prior.sigma_m).tolist(), prior.sigma_m
        columns = zip(prior.axes, prior.values_m, residuals_m, sigmas[rows].tolist(), strict=True)
        for axis, stated_m, residual_m, sigma_m in columns:
            away_m, seen_sigma_m = residual_m, sigma_m
            if is_used := (prior.name, axis) in used:
                # The estimate is the mean of views and prior, weighted by information.
                information = max(sigma_m**-2.0 - known_m**-2.0, 0.0)
                seen_sigma_m = information**-0.5 if information else np.inf
                away_m = residual_m * (1.0 + (seen_sigma_m / known_m) ** 2)
            label = f"{_AXES[axis]} of {prior.name}"
            seen_m = stated_m + away_m
            yield Component(label, axis, is_used, stated_m, known_m, seen_m, seen_sigma_m)


def prior_of(name: str, table: PriorTable, tree: Tree) -> FramePrior:
    """Reads the prior of a cell's frame: `[prior.A_from_B]` is the pose of frame B in frame A.

    Raises:
        DataError: A frame is unknown, or a robot moves one of the two relative to the other.
    """
    first, _, second = name.partition("_from_")
    check_prior(name, first, second, tree)
    values = {axis: getattr(table, column) for axis, column in enumerate(_AXES)}
    stated = {axis: float(value) for axis, value in values.items() if value is not None}
    prior = FramePrior(first, second, (*stated,), (*stated.values(),), table.sigma_m or 1.0)
    if table.quaternion_xyzw is None or table.sigma_rad is None:
        return prior
    rotation = Rotation.from_quat(table.quaternion_xyzw).as_matrix()
    return replace(prior, rotation=rotation, sigma_rad=table.sigma_rad)


def with_loose_positions(priors: Iterable[FramePrior]) -> tuple[FramePrior, ...]:
    """The priors with position sigmas so large that the observations overrule them."""
    # Prior sigma of a position that is overruled by any estimate that is accepted [m].
    return tuple(replace(prior, sigma_m=max(prior.sigma_m, 1.0)) for prior in priors)


def without_most_contradicted(fit: Fit) -> tuple[FramePrior, ...] | None:
    """The priors without the most contradicted component; None where none is contradicted."""
    found = [
        (component.contradiction, at, component.axis)
        for at, prior in enumerate(fit.problem.priors)
        for component in components(fit, [prior])
    ]
    contradiction, worst, axis = max(found, default=(0.0, 0, 0))
    if contradiction <= CONTRADICTION:
        return None
    kept = list(fit.problem.priors)
    kept[worst] = kept[worst].without(axis)
    return tuple(prior for prior in kept if prior.axes or prior.rotation is not None)
