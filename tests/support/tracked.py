"""What is made of simulated readings of an instrument."""

from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.session import Session
from visioncal.simulation.instrument_session import InstrumentRecord


def known_of(session: Session, **changes) -> RunState:
    """What is known at the end of the way."""
    known = replace(RunState(session), **changes)
    for stage in STAGES:
        known = stage.run(known)
    return known


def errors_of(shop: InstrumentRecord, known: RunState) -> FloatArray:
    """(12,) right perturbations of both edges, true to estimated (rotation, translation)."""
    true = np.array([shop.base_from_instrument, shop.flange_from_probe])
    return log(invert(true) @ known.assessment.fit.state.edges[:2]).ravel()
