"""An arm's own errors as unknowns of the chain: offsets of its joints, its links, its gears.

Every effect is a set of columns: how the flange moves with it at each stop. All columns are
carried, however redundant, as random effects of one size a block, which restricted likelihood
estimates: what the data cannot tell stays where it was stated, and what they can is told at its
bound (Harville 1977, section 4, for the linear mixed model).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from visioncal.estimation.arm import ArmErrors, find_arm_errors
from visioncal.estimation.armmodel import BACKLASH, COMPLIANCE, WEIGHT
from visioncal.estimation.closure import (
    Closure,
    ClosureFit,
    Edges,
    fit_closure,
    left_out_residuals,
    residual_blocks,
)
from visioncal.types import FloatArray


@dataclass(frozen=True)
class Blocks:
    """What is free at a level.

    Attributes:
        names: Blocks of the arm's errors, in the order in which they are looked for.
        own: Those that make the level what it is: without one of them it is another.
    """

    names: tuple[str, ...]
    own: tuple[str, ...]


LEVELS: Mapping[str, Blocks] = MappingProxyType(
    {
        "backlash": Blocks((BACKLASH,), (BACKLASH,)),
        "offsets": Blocks(("offsets", BACKLASH), ("offsets",)),
        "geometry": Blocks(("links", BACKLASH), ("links",)),
        "eccentricity": Blocks(
            ("links", "eccentricity", "ratios", BACKLASH), ("eccentricity", "ratios")
        ),
        "elastic": Blocks(
            ("links", COMPLIANCE, WEIGHT, "eccentricity", "ratios", BACKLASH), (COMPLIANCE, WEIGHT)
        ),
    }
)
_RIGID = Blocks((), ())


@dataclass(frozen=True, eq=False)
class LevelFit:
    """The chain with the arm's errors of one level free.

    Attributes:
        errors: The errors by block; empty for the arm as stated.
        fit: Edges and noise.
        gain: Twice the gain in log-likelihood over the arm as stated.
        inside: (m, 6) residuals of the fit (rotation [rad], translation [m]).
        left_out: (m, 6) the same of each stop from a fit without it, to first order.
    """

    errors: Mapping[str, ArmErrors]
    fit: ClosureFit
    gain: float
    inside: FloatArray
    left_out: FloatArray

    @property
    def size(self) -> int:
        """How many columns are carried."""
        return sum(it.basis.shape[2] for it in self.errors.values())


def fit_level(
    data: Closure, edges: Edges, bases: Mapping[str, FloatArray], blocks: Blocks = _RIGID
) -> LevelFit | None:
    """Fits the chain with some blocks of the arm's errors free.

    Args:
        data: The views, one a stop, without errors of the arm.
        edges: Where to start.
        bases: (m, 6, p) columns of each block by its name.
        blocks: Those to free; behind the first, those that explain no more than chance stay out.

    Returns:
        The fit; None where nothing beyond chance makes it this level.
    """
    plain, gain = data, 0.0
    fit = fit_closure(data, Edges(edges.x, edges.z, data.unchanged))
    errors: dict[str, ArmErrors] = {}
    if blocks.own and not bases.keys() & set(blocks.own):
        return None
    for name in (it for it in blocks.names if it in bases):
        found = find_arm_errors(data, fit.edges, bases[name], of_links=True)
        if found is None or not found.is_significant:
            if not errors:
                return None
            continue
        errors, gain = errors | {name: found}, gain + found.gain
        errors = _without_springs(plain, fit.edges, errors)
        data = _erring(plain, errors)
        fit = fit_closure(data, _at_rest(data, fit.edges))
    if blocks.own and not errors.keys() & set(blocks.own):
        return None
    return _level_fit(data, errors, fit, gain)


def resized(data: Closure, fit: LevelFit) -> LevelFit:
    """Estimates the size of each block's errors anew, beside those of all others.

    They were looked for one after the other: what explains the most takes too much at first.

    Args:
        data: The views of `fit_level`.
        fit: Its answer.
    """
    if len(fit.errors) < 2:
        return fit
    errors, edges = dict(fit.errors), fit.fit.edges
    for name, it in fit.errors.items():
        others = _erring(data, {other: errors[other] for other in errors if other != name})
        near = fit_closure(others, _at_rest(others, edges)).edges
        errors[name] = find_arm_errors(others, near, it.basis, of_links=True) or it
    whole = _erring(data, errors)
    return _level_fit(whole, errors, fit_closure(whole, _at_rest(whole, edges)), fit.gain)


def _level_fit(
    data: Closure, errors: Mapping[str, ArmErrors], fit: ClosureFit, gain: float
) -> LevelFit:
    inside = residual_blocks(data, fit.edges, fit.noise)[0]
    return LevelFit(errors, fit, gain, inside, left_out_residuals(data, fit.edges, fit.noise))


def _erring(data: Closure, errors: Mapping[str, ArmErrors]) -> Closure:
    """The views with errors of the arm among what they share."""
    for it in errors.values():
        data = data.with_more(it.shared())
    return data


def _at_rest(data: Closure, edges: Edges) -> Edges:
    return Edges(edges.x, edges.z, data.unchanged)


def _without_springs(
    data: Closure, edges: Edges, errors: Mapping[str, ArmErrors]
) -> dict[str, ArmErrors]:
    """Holds joints rigid that would yield against their load: the bound of a compliance is zero.

    An active set that only grows (Lawson and Hanson 1974, chapter 23, has the way back too, which
    columns that hardly lean on one another do not need).
    """
    kept = dict(errors)
    while COMPLIANCE in kept:
        seen = _erring(data, kept)
        values = fit_closure(seen, _at_rest(seen, edges)).edges.shared
        basis = kept[COMPLIANCE].basis
        behind = sum(it.basis.shape[2] for it in list(kept.values())[_place(kept) :])
        bends = values[len(values) - behind :][: basis.shape[2]]
        if not (bends < 0.0).any():
            break
        basis = basis * (bends >= 0.0)
        kept[COMPLIANCE] = replace(kept[COMPLIANCE], basis=basis)
    return kept


def _place(errors: Mapping[str, ArmErrors]) -> int:
    return list(errors).index(COMPLIANCE)
