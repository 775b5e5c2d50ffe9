"""Errors of lenses that are held: in the covariance, not in the estimate."""

import numpy as np

from visioncal.fit.assemble import mixed_model
from visioncal.fit.fit import Fit
from visioncal.fit.linearise import linearised, pairs_of
from visioncal.fit.unknowns import Vector, given_lens


def with_held_lenses(fit: Fit) -> Fit:
    """The fit with what held lenses may be off by in its covariance (cf. Schmidt 1966).

    The derivative of the estimate by a lens is their covariance over the lens's, if both are
    estimated.
    """
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
