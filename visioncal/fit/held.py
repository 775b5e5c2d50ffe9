"""Errors of what is held: in the covariance, not in the estimate (cf. Schmidt 1966).

The derivative of the estimate by something is their covariance over its own, if both are estimated.
"""

from collections.abc import Iterable

import numpy as np
from scipy.special import expit, logit

from visioncal.fit.assemble import mixed_model
from visioncal.fit.fit import Fit
from visioncal.fit.linearise import linearised
from visioncal.fit.pairs import pairs_of
from visioncal.fit.processes import Considered
from visioncal.fit.score import Score
from visioncal.fit.unknowns import Key, Vector, given_lens


def doubted_boards(considered: Iterable[Considered]) -> dict[Key, float]:
    """Mean square of what held boards may be off by beyond what is stated, by their shape's key."""
    squares = dict[Key, float]()
    for one in considered:
        # Share of boards whose size is not within what is stated.
        share = float(expit(one.board_odds + logit(0.05)))
        squares |= {key: share * square for key, square in one.board_squares.items()}
    return squares


def with_held_boards(fit: Fit, considered: Iterable[Considered]) -> Fit:
    """The fit with what boards whose size is held may be off by in its covariance.

    Boards are as stated, or of any size, as `considered` beside lasting errors of an arm.
    """
    squares = doubted_boards(considered)
    covariance, added = fit.estimate.covariance, np.zeros((fit.unknowns.count,) * 2)
    for member in fit.unknowns.members:
        for prior in member.priors:
            if prior.considered > 0.0:
                at = fit.unknowns.columns(*member.key)[prior.columns]
                board_covariance = covariance[at[:, None], at]
                slope = np.linalg.solve(board_covariance, covariance[at]).T
                square = prior.considered**2 + squares.get(member.key, 0.0)
                added += slope * square @ slope.T
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
    joint, first = mixed.at(fit.estimate.logs, is_sloped=False).covariance, fit.unknowns.count
    slope = np.linalg.solve(joint[first:, first:], joint[first:, :first]).T
    sigmas = np.concatenate([np.full(lens.count, lens.priors[0].sigma) for lens in lenses])
    return fit.considering((slope * sigmas**2) @ slope.T)


def with_small_sizes(fit: Fit) -> Fit:
    """The fit with what random unknowns may be whose size chance explains, in its covariance.

    Such unknowns are in no estimate. A priori, a size is none as likely as it is some, with a
    uniform logarithm; its posterior is by the score of the unknowns.
    """
    covariance, unknowns = fit.estimate.covariance, fit.unknowns
    added = np.zeros((unknowns.count,) * 2)
    values = unknowns.offsets(fit.linearised) + fit.estimate.values
    for member in unknowns.members:
        for prior in member.priors:
            if prior.size is None or prior.size.name not in unknowns.closed:
                continue
            at = unknowns.columns(*member.key)[prior.columns]
            inner = np.linalg.inv(covariance[at[:, None], at])
            shown = inner - np.eye(len(at)) / prior.size.low**2
            score = Score(inner @ values[at], (shown + shown.T) / 2, np.inf)
            sizes, gains = score.posterior(prior.size.low, prior.size.high)
            # A size of zero is as likely as all of these together.
            weights = np.exp(gains - np.logaddexp.reduce([*gains, np.log(len(gains))]))
            slope = covariance[:, at] @ inner
            # All sizes at once.
            posterior = np.linalg.inv(
                score.information + np.eye(len(at)) / sizes[:, None, None] ** 2
            )
            away = posterior @ score.pull - values[at]
            more = posterior - covariance[at[:, None], at] + away[:, :, None] * away[:, None]
            added += slope @ np.sum(weights[:, None, None] * more, axis=0) @ slope.T
    return fit.considering(added)
