"""Errors that grow with time, reach or gravity: a suspect for each of `model.effects.NAMED`."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.random_effects import KINDS
from visioncal.calibration.suspects.suspect import UNEXPLAINED, Suspect
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.verdict import Finding, Remedy
from visioncal.model.effects import BracketBends
from visioncal.model.effects.effect import LensEffect

# A bracket bends by less [mm, deg]: one of 0.15 m whose end sinks by 1.5 mm turns by 0.9 deg.
# Larger turns that follow gravity are of another cause.
_MOST_BENDS = (3.0, 1.0)


def _found(kind: str, run: RunState) -> Iterator[Finding]:
    fit, effect, arms = run.assessment.fit, KINDS[kind], run.cell_fit.arms.values()
    # Errors of arms from stop to stop look like it: there the covariance, which has these, says
    # what chance explains.
    is_sole = not any(arm.errors is not None and arm.errors.is_significant for arm in arms)
    for owner in fit.unknowns.of(kind):
        shown = fit.unknowns.moved[fit.unknowns.columns((kind, owner))]
        values = fit.values((kind, owner)) + run.cell_fit.sizes.steadied_by(kind, owner)
        values = values[shown]
        covariance = fit.covariance((kind, owner))[np.ix_(shown, shown)]
        squared = float(values @ np.linalg.solve(covariance, values))
        if is_sole or issubclass(effect, LensEffect):
            squared = max(squared, run.cell_fit.gains.get(f"{kind} of {owner}", 0.0))
        if issubclass(effect, BracketBends) and np.greater(effect.up_to(values), _MOST_BENDS).any():
            continue
        if squared > chi2_limit(FALSE_ALARM, len(values)):
            found = Finding(kind, effect.says(values), Remedy(effect.do), mahalanobis_sq=squared)
            yield found.of(owner if len(fit.noise.robots) > 1 else "")


def _suspect(kind: str) -> Suspect:
    """The suspect of a kind: a pick errs by it as views do, and what no view shows is no motion."""
    effect, sources = KINDS[kind], ("robot_noise", "robot_noise_of_pick", UNEXPLAINED)
    inflated: tuple[str, ...] = () if issubclass(effect, LensEffect) else sources
    inflated += ("calibration",) if issubclass(effect, BracketBends) else ()
    return Suspect(kind, partial(_found, kind), 1e-4, True, effect.hides, inflated)


GROWING = tuple(map(_suspect, KINDS))
