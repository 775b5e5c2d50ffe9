"""Errors of what is held: in the covariance, not in the estimate (cf. Schmidt 1966).

The derivative of the estimate by something is their covariance over its own, if both are estimated.
"""

import numpy as np

from visioncal.fit.assemble import mixed_model
from visioncal.fit.fit import Fit
from visioncal.fit.linearise import linearised, pairs_of
from visioncal.fit.unknowns import Vector, given_lens


def with_held_boards(fit: Fit) -> Fit:
    """The fit with what boards whose size is held may be off by in its covariance."""
    covariance, added = fit.estimate.covariance, np.zeros((fit.unknowns.count,) * 2)
    for member in fit.unknowns.members:
        for prior in member.priors:
            if prior.considered > 0.0:
                at = fit.unknowns.columns(*member.key)[prior.columns]
                own = covariance[at[:, None], at]
                slope = np.linalg.solve(own, covariance[at]).T * prior.considered
                added += slope @ slope.T
    return fit.considering(added)


def with_held_lenses(fit: Fit) -> Fit:
    """The fit with what held lenses may be off by in its covariance."""
    lenses = list[Vector]()
    for name in fit.unknowns.lenses:
        table = fit.cell.cameras[name]
        if table.stated is not None and table.intrinsics == "hold":
            given = given_lens(table, name, np.zeros((0, 2)), is_spare=False)
            lenses += [] if given is None else [given]
    if not lenses:
        return fit
    unknowns = fit.unknowns.with_members(*lenses)
    grams = linearised(fit.cell, unknowns, fit.linearised, pairs_of(fit.cell))
    mixed = mixed_model(fit.cell, unknowns, fit.linearised, grams, fit.used)
    both, first = mixed.at(fit.estimate.logs, is_sloped=False).covariance, fit.unknowns.count
    slope = np.linalg.solve(both[first:, first:], both[first:, :first]).T
    sigmas = np.concatenate([np.full(lens.count, lens.priors[0].sigma) for lens in lenses])
    return fit.considering((slope * sigmas**2) @ slope.T)
