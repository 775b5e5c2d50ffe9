"""The mixed model of some of the sightings, from their Gram matrices."""

from collections.abc import Sequence

import numpy as np

from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.mixed import SizePrior
from visioncal.fit.linearise import Gram
from visioncal.fit.mixed import Body, Mixed, Part, Term, body_with, prior_term, summed
from visioncal.fit.unknowns import State, Unknowns
from visioncal.model import Cell


def bodies_of(cell: Cell, unknowns: Unknowns, grams: Sequence[Gram]) -> tuple[Body, ...]:
    """Bodies with the stops and columns of all sightings, used or not."""
    found = []
    for names in cell.bodies:
        flanges = tuple(name for name in names if name in unknowns.erring)
        body_grams = [gram for gram in grams if set(gram.flanges) & set(flanges)]
        if body_grams:
            stops = np.unique(np.concatenate([gram.stops for gram in body_grams]))
            columns = np.unique(np.concatenate([gram.columns for gram in body_grams]))
            found.append(Body(flanges, stops, columns))
    return tuple(found)


def mixed_model(
    cell: Cell, unknowns: Unknowns, state: State, grams: Sequence[Gram], used: Mask
) -> Mixed:
    """The mixed model of the sightings in an (n,) mask."""
    bodies = bodies_of(cell, unknowns, grams)
    terms = dict[int, list[Term]]()
    for gram in grams:
        kept = used[gram.rows]
        if kept.any():
            for term in _terms(gram if kept.all() else gram.take(kept), bodies):
                terms.setdefault(term.size, []).append(term)
    for at, body in enumerate(bodies):
        for place, name in enumerate(body.flanges):
            for part, unit in enumerate(("rad", "m")):
                places = 6 * place + 3 * part + np.arange(3)
                size = unknowns.size_of(f"{unit} {name}")
                past = state.errors[name][body.stops, 3 * part : 3 * part + 3]
                terms.setdefault(size, []).append(_flange_term(size, at, body.width, places, past))
    offsets = unknowns.offsets(state)
    for size, columns, sigma in unknowns.priors():
        terms.setdefault(size, []).append(prior_term(size, columns, offsets[columns], sigma))
    ratios = [(unknowns.size_of(a), unknowns.size_of(b)) for a, b in unknowns.ratios]
    return Mixed(
        tuple(summed(group, bodies) for group in terms.values()),
        bodies,
        unknowns.count,
        len(unknowns.sizes),
        SizePrior.of_ratios(ratios, len(unknowns.sizes)),
    )


def _terms(gram: Gram, bodies: Sequence[Body]) -> list[Term]:
    """The terms of some sightings, by size."""
    f = 6 * len(gram.flanges)
    at, found = body_with(bodies, gram.flanges), []
    for products in gram.parts:
        of_errors, common = gram.in_common(products)
        parts: tuple[Part, ...] = ()
        if f:
            body = bodies[at]
            units, columns = np.searchsorted(body.stops, gram.stops), body.errors_of(gram.flanges)
            # Of many stops a few alone are in these sightings.
            held, units = np.unique(units, return_inverse=True)
            errors = np.zeros((len(held), body.width, body.width))
            cross = np.zeros((len(held), body.width, len(common)))
            np.add.at(
                errors, (units[:, None, None], columns[:, None], columns), of_errors[:, :, :f]
            )
            np.add.at(cross, (units[:, None], columns), of_errors[:, :, f:])
            parts = (Part(at, gram.columns, errors, cross, held),)
        count = float(products.counts.sum())
        found.append(Term(products.size, count, gram.columns, common, parts))
    return found


def _flange_term(size: int, body: int, width: int, columns: IntArray, past: FloatArray) -> Term:
    """Rows of the errors (u, 3) of one flange, of which some are in the state already."""
    errors, cross = np.zeros((len(past), width, width)), np.zeros((len(past), width, 1))
    errors[:, columns, columns], cross[:, columns, 0] = 1.0, -past
    none = np.zeros(0, dtype=np.int64)
    square = np.array([[float(np.sum(past**2))]])
    return Term(size, float(past.size), none, square, (Part(body, none, errors, cross),))
