"""What a session knows of a cell's frames beforehand: `[prior.A_from_B]`, and what became of it."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, figure
from visioncal.core.types import FloatArray
from visioncal.core.verdict import CALIBRATE, NOTE, Finding, Remedy, remarks
from visioncal.estimation.observability import SIGMA_LIMIT_M
from visioncal.estimation.parts import FramePrior, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.tree import Tree
from visioncal.session.tables import PriorTable

_COMPONENTS = ("x_m", "y_m", "z_m")
# What was measured is contradicted by so many standard deviations.
_CONTRADICTION = 3.0
# A place of this sigma is overruled by any that views determine well enough to be accepted [m].
_LOOSE_M = 1.0


def _prior_of(name: str, table: PriorTable) -> FramePrior:
    """Reads `[prior.A_from_B]`: the components that it states, and the rotation where it does."""
    first, _, second = name.partition("_from_")
    values = [getattr(table, component) for component in _COMPONENTS]
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
    return tuple(
        component
        for prior in priors
        for component in _components(prior, problem, state, covariance)
    )


def _components(
    prior: FramePrior, problem: Problem, state: State, covariance: FloatArray
) -> Iterator[Component]:
    away, jacobian = problem.prior_rows(prior, state)
    used = {(frame_prior.name, axis) for frame_prior in problem.priors for axis in frame_prior.axes}
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


def priors_of(tables: Mapping[str, PriorTable], tree: Tree) -> tuple[FramePrior, ...]:
    """Reads the priors of a cell's frames.

    Args:
        tables: `[prior.A_from_B]` by its name: where frame B is in frame A.
        tree: The frames.

    Raises:
        DataError: A frame is unknown, or a robot moves one of the two before the other.
    """
    return tuple(_prior(name, table, tree) for name, table in tables.items())


def _prior(name: str, table: PriorTable, tree: Tree) -> FramePrior:
    found = _prior_of(name, table)
    first, second = found.first, found.second
    label = f"session.toml: prior.{name}"
    for frame in (first, second):
        if frame not in tree.branches:
            known = [branch for branch in tree.branches if branch != frame]
            raise DataError(
                f"{label}: {frame!r} is no frame of this cell; those are {', '.join(known)}.",
                culprits=[label],
                next_step=did_you_mean(frame, known)
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
    return found


def loosened(priors: Iterable[FramePrior]) -> tuple[FramePrior, ...]:
    """The priors with places so uncertain that the observations overrule them."""
    return tuple(replace(prior, sigma_m=max(prior.sigma_m, _LOOSE_M)) for prior in priors)


def without_most_contradicted(
    problem: Problem, state: State, covariance: FloatArray
) -> tuple[FramePrior, ...] | None:
    """The priors without the component that the observations contradict most.

    Args:
        problem: The observations in the fit.
        state: The answer.
        covariance: (p, p) covariance of the unknowns.

    Returns:
        The others; None where the observations contradict none.
    """
    found = [
        (component.contradiction, at, component.axis)
        for at, prior in enumerate(problem.priors)
        for component in components(problem, state, covariance, [prior])
        if component.is_contradicted
    ]
    if not found:
        return None
    _, worst, axis = max(found)
    kept = [
        prior.without(axis) if at == worst else prior for at, prior in enumerate(problem.priors)
    ]
    return tuple(
        frame_prior for frame_prior in kept if frame_prior.axes or frame_prior.rotation is not None
    )


def prior_words(
    problem: Problem, state: State, covariance: FloatArray, stated: Iterable[FramePrior]
) -> Iterator[Finding]:
    """Says what became of priors; what contradicts none is a note.

    Args:
        problem: The observations in the fit, with what of priors these do not contradict.
        state: The answer.
        covariance: (p, p) covariance of the unknowns.
        stated: All priors, whole.
    """
    for component in components(problem, state, covariance, tuple(stated)):
        if component.is_used:
            yield from remarks([component.remark], NOTE)
        else:
            step = Remedy("Measure it again, or delete it from session.toml.", CALIBRATE)
            yield Finding("prior", component.doubt, step, mahalanobis_sq=component.contradiction**2)
