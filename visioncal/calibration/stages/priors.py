"""Priors on a cell's frames, `[prior.A_from_B]`, and whether the views contradict them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.finding_kinds import NOTE
from visioncal.core.number_format import did_you_mean, figure
from visioncal.core.types import FloatArray
from visioncal.core.verdict import CALIBRATE, Finding, Remedy, remarks
from visioncal.estimation.observability import SIGMA_LIMIT_M
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import FramePrior, State
from visioncal.estimation.tree import Tree
from visioncal.session.document import PriorTable

_COMPONENTS = ("x_m", "y_m", "z_m")
# A measured component is contradicted beyond this many combined sigmas.
_CONTRADICTION = 3.0
# Prior sigma of a position that is overruled by any estimate that is accepted [m].
_LOOSE_M = 1.0


def _prior_of(name: str, table: PriorTable) -> FramePrior:
    """Reads `[prior.A_from_B]`: the stated components, and the rotation if stated."""
    first, _, second = name.partition("_from_")
    values = [getattr(table, component) for component in _COMPONENTS]
    axes = tuple(axis for axis, value in enumerate(values) if value is not None)
    places = tuple(float(values[axis]) for axis in axes)
    prior = FramePrior(first, second, axes, places, table.sigma_m or 1.0)
    if table.quaternion_xyzw is None or table.sigma_rad is None:
        return prior
    rotation = Rotation.from_quat(table.quaternion_xyzw).as_matrix()
    return replace(prior, rotation=rotation, sigma_rad=table.sigma_rad)


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
    def is_redundant(self) -> bool:
        """Whether the views alone determine it well enough."""
        return self.seen_sigma_m < SIGMA_LIMIT_M

    @property
    def is_contradicted(self) -> bool:
        """Whether the views contradict it significantly."""
        return self.is_redundant and self.contradiction > _CONTRADICTION

    @property
    def contradiction(self) -> float:
        """Distance of the views' value from the stated one, in combined sigmas."""
        distance_m = abs(self.seen_m - self.stated_m)
        return float(distance_m / np.hypot(self.sigma_m, self.seen_sigma_m))

    @property
    def remark(self) -> str:
        """States that the result uses it."""
        by_views = "leave it open"
        if self.is_redundant:
            by_views = f"determine it to {figure(1e3 * self.seen_sigma_m)} mm"
        return (
            f"The measured {self.label} = {1e3 * self.stated_m:g} mm was used, known to "
            f"{figure(1e3 * self.sigma_m)} mm; the views alone {by_views}."
        )

    @property
    def doubt(self) -> str:
        """States that the views contradict it."""
        return (
            f"The measured {self.label} = {1e3 * self.stated_m:g} mm, known to "
            f"{figure(1e3 * self.sigma_m)} mm, is contradicted by the views, which alone say "
            f"{1e3 * self.seen_m:.4g} mm to {figure(1e3 * self.seen_sigma_m)} mm; it is not used."
        )


def components(
    problem: Problem, state: State, covariance: FloatArray, priors: Sequence[FramePrior]
) -> tuple[Component, ...]:
    """The measured components of priors, used or not, beside the observations' estimates."""
    by_prior = (_components(prior, problem, state, covariance) for prior in priors)
    return tuple(chain.from_iterable(by_prior))


def _components(
    prior: FramePrior, problem: Problem, state: State, covariance: FloatArray
) -> Iterator[Component]:
    residuals, jacobian = problem.prior_rows(prior, state)
    used = {(frame_prior.name, axis) for frame_prior in problem.priors for axis in frame_prior.axes}
    sigmas = np.sqrt(np.einsum("dp,pq,dq->d", jacobian, covariance, jacobian)) * prior.sigma_m
    # The position's rows follow those of the rotation, which are not reported.
    rows = slice(len(residuals) - len(prior.axes), len(residuals))
    residuals_m = (residuals[rows] * prior.sigma_m).tolist()
    columns = zip(prior.axes, prior.values_m, residuals_m, sigmas[rows].tolist(), strict=True)
    for axis, stated_m, residual_m, sigma_m in columns:
        is_used = (prior.name, axis) in used
        by_views = (
            _without_prior(residual_m, sigma_m, prior.sigma_m) if is_used else (residual_m, sigma_m)
        )
        label, seen_m = f"{_COMPONENTS[axis]} of {prior.name}", stated_m + by_views[0]
        yield Component(label, axis, is_used, stated_m, prior.sigma_m, seen_m, by_views[1])


def _without_prior(residual_m: float, sigma_m: float, prior_m: float) -> tuple[float, float]:
    """Distance of the views' own value from a measured component, and its sigma [m]."""
    information = max(sigma_m**-2.0 - prior_m**-2.0, 0.0)
    views_sigma_m = np.inf if information == 0.0 else 1.0 / np.sqrt(information)
    # The estimate is the mean of views and prior, weighted by information.
    return float(residual_m + residual_m * (views_sigma_m / prior_m) ** 2), float(views_sigma_m)


def priors_of(tables: Mapping[str, PriorTable], tree: Tree) -> tuple[FramePrior, ...]:
    """Reads the priors of a cell's frames: `[prior.A_from_B]` is the pose of frame B in frame A.

    Raises:
        DataError: A frame is unknown, or a robot moves one of the two relative to the other.
    """
    return tuple(_prior(name, table, tree) for name, table in tables.items())


def _prior(name: str, table: PriorTable, tree: Tree) -> FramePrior:
    prior = _prior_of(name, table)
    first, second = prior.first, prior.second
    label = f"session.toml: prior.{name}"
    for frame in (first, second):
        if frame not in tree.branches:
            names = [branch for branch in tree.branches if branch != frame]
            raise DataError(
                f"{label}: {frame!r} is no frame of this cell; those are {', '.join(names)}.",
                culprits=[label],
                next_step=did_you_mean(frame, names)
                or "Name a prior A_from_B, as [prior.flange_a_from_cam_left].",
            )
    moved_by = [step.robot for step in tree.path(first, second) if step.robot]
    if moved_by or first == second:
        why = f"robot {moved_by[0]} moves one before the other" if moved_by else "they are one"
        raise DataError(
            f"{label}: {first} and {second} have no fixed place in each other: {why}.",
            culprits=[label],
            next_step="State where two frames are that stand in the cell, or on one flange.",
        )
    return prior


def with_loose_positions(priors: Iterable[FramePrior]) -> tuple[FramePrior, ...]:
    """The priors with position sigmas so large that the observations overrule them."""
    return tuple(replace(prior, sigma_m=max(prior.sigma_m, _LOOSE_M)) for prior in priors)


def without_most_contradicted(
    problem: Problem, state: State, covariance: FloatArray
) -> tuple[FramePrior, ...] | None:
    """The priors without the most contradicted component; None where none is contradicted."""
    contradicted = [
        (component.contradiction, at, component.axis)
        for at, prior in enumerate(problem.priors)
        for component in components(problem, state, covariance, [prior])
        if component.is_contradicted
    ]
    if not contradicted:
        return None
    _, worst, axis = max(contradicted)
    kept = list(problem.priors)
    kept[worst] = kept[worst].without(axis)
    return tuple(prior for prior in kept if prior.axes or prior.rotation is not None)


def prior_findings(
    problem: Problem, state: State, covariance: FloatArray, stated: Iterable[FramePrior]
) -> Iterator[Finding]:
    """Reports used priors as notes, and contradicted ones as findings.

    `problem` has the priors that the observations do not contradict, `stated` are all, whole.
    """
    for component in components(problem, state, covariance, tuple(stated)):
        if component.is_used:
            yield from remarks([component.remark], NOTE)
        else:
            step = Remedy("Measure it again, or delete it from session.toml.", CALIBRATE)
            yield Finding("prior", component.doubt, step, mahalanobis_sq=component.contradiction**2)
