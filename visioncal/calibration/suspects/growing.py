"""Errors that grow with time, reach or gravity: a suspect for each of `RANDOM_EFFECTS`."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.suspects.suspect import Suspect
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.effects import RANDOM_EFFECTS
from visioncal.estimation.effects.random_effect import RandomEffect


def _found(effect: RandomEffect, run: RunState) -> Iterator[Finding]:
    fit = run.assessment.fit
    for owner in fit.unknowns.of(effect.kind):
        values = fit.values((effect.kind, owner))
        covariance = fit.covariance((effect.kind, owner))
        squared = float(values @ np.linalg.solve(covariance, values))
        # Of a lens, all corners are the evidence.
        if effect.is_of_sensor:
            squared = max(squared, run.cell_fit.sizes.growth[owner].gain)
        if squared > chi2_limit(FALSE_ALARM, len(values)):
            do = Remedy(effect.do)
            found = Finding(effect.kind, effect.says(values), do, mahalanobis_sq=squared)
            yield found.of(owner if len(fit.noise.robots) > 1 else "")


GROWING = tuple(
    Suspect(effect.kind, partial(_found, effect), 1e-4, True) for effect in RANDOM_EFFECTS
)
