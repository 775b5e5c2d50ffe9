"""What a session knows of its unknown edges beforehand, and what it did to the answer, in words."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from visioncal.estimator.measured import Measured
from visioncal.estimator.observability import SIGMA_LIMIT_M, edge_names
from visioncal.figures import figure
from visioncal.session import Session
from visioncal.stages.handeye import HandEyeResult

_COMPONENTS = ("x_m", "y_m", "z_m")
# What was measured is contradicted by so many standard deviations.
_CONTRADICTION = 3.0


def measured_of(session: Session) -> tuple[Measured, ...]:
    """The components of edges that a session states in [prior.EDGE].

    With several boards the target's edge is that of none in particular: it is left aside.
    """
    found = []
    for place, edge in enumerate(edge_names(session.mount)):
        prior = session.declaration.prior.get(edge)
        if prior is None or (place == 1 and len(session.boards) > 1):
            continue
        values = [getattr(prior, it) for it in _COMPONENTS]
        axes = tuple(axis for axis, value in enumerate(values) if value is not None)
        stated = tuple(float(values[axis]) for axis in axes)
        found.append(Measured(place, axes, stated, prior.sigma_m))
    return tuple(found)


@dataclass(frozen=True)
class _Component:
    """A measured component beside what the views alone say of it [m]."""

    label: str
    stated_m: float
    sigma_m: float
    seen_m: float
    seen_sigma_m: float

    @property
    def is_told(self) -> bool:
        """Whether the views would do without."""
        return self.seen_sigma_m < SIGMA_LIMIT_M

    @property
    def is_contradicted(self) -> bool:
        """Whether the views say otherwise, by more than both may be off."""
        away = abs(self.seen_m - self.stated_m)
        return self.is_told and away > _CONTRADICTION * np.hypot(self.sigma_m, self.seen_sigma_m)


def remarks(session: Session, result: HandEyeResult) -> Iterator[str]:
    """Says which measured components the answer rests on."""
    for it in _components(session, result):
        if it.is_contradicted:
            continue
        alone = "leave it open"
        if it.is_told:
            alone = f"tell it to {figure(1e3 * it.seen_sigma_m)} mm"
        yield (
            f"The measured {it.label} = {1e3 * it.stated_m:g} mm was used, known to "
            f"{figure(1e3 * it.sigma_m)} mm; the views alone {alone}."
        )


def doubts(session: Session, result: HandEyeResult) -> Iterator[str]:
    """Says which measured components the views contradict."""
    for it in _components(session, result):
        if it.is_contradicted:
            yield (
                f"The measured {it.label} = {1e3 * it.stated_m:g} mm, known to "
                f"{figure(1e3 * it.sigma_m)} mm, is contradicted by the views, which alone say "
                f"{1e3 * it.seen_m:.4g} mm to {figure(1e3 * it.seen_sigma_m)} mm; both count in "
                "the answer. Measure it again, or leave it out."
            )


def _components(session: Session, result: HandEyeResult) -> Iterator[_Component]:
    """Takes what was measured out of the answer again, one component after the other."""
    edges = result.edges
    for known in measured_of(session):
        away = known.away_m(edges.x, edges.z)
        found = known.sigmas_m(result.covariance, edges.x, edges.z)
        for axis, stated, off, sigma in zip(known.axes, known.values_m, away, found, strict=True):
            own = max(float(sigma) ** -2.0 - known.sigma_m**-2.0, 0.0)
            spread = np.inf if own == 0.0 else 1.0 / np.sqrt(own)
            # Both together are their mean, each weighted with its information.
            seen = stated + off + off * (spread / known.sigma_m) ** 2
            yield _Component(
                f"{_COMPONENTS[axis]} of {edge_names(session.mount)[known.edge]}",
                stated,
                known.sigma_m,
                float(seen),
                float(spread),
            )
