"""The gain of an effect of a known size, by a fit's linearisation with it.

A score from the factorisation does for effects that are linear in their values. Others are
linearised, once, at the point where the fit was.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visioncal.fit.assemble import mixed_model
from visioncal.fit.fit import Fit
from visioncal.fit.linearise import Pair, linearised
from visioncal.fit.sizes import most_likely
from visioncal.fit.unknowns import State, random_effect
from visioncal.model.effects import Effect


def gain_of(fit: Fit, pairs: Sequence[Pair], effect: Effect) -> float:
    """Log-likelihood of an effect against none, each at its most likely sizes of all else."""
    member = random_effect(effect)
    unknowns = fit.unknowns.with_members(member)
    unknowns = replace(unknowns, effects=(*unknowns.effects, effect))
    values = {**fit.linearised.values, member.key: np.zeros(member.count)}
    state = State(values, fit.linearised.errors)
    grams = linearised(fit.cell, unknowns, state, tuple(pairs))
    mixed = mixed_model(fit.cell, unknowns, state, grams, fit.used)
    starts, (low, high) = unknowns.starts(), unknowns.bounds()
    for name, value in fit.sizes.items():
        starts[unknowns.size_of(name)] = np.log(value)
    found = most_likely(mixed, np.clip(starts, low, high), low, high)
    return (fit.estimate.value - found.estimate.value) / 2.0
