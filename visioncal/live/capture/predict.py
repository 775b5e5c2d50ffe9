"""How accurate the views so far are predicted to make the result."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from visioncal.core.errors import VisioncalError
from visioncal.live.planning.accuracy import Accuracy
from visioncal.live.planning.information import World, worlds_of
from visioncal.live.planning.read_back import PlanFile
from visioncal.live.planning.recorded import so_far
from visioncal.session import Session

# Fewer views determine nothing.
_FEWEST = 3


class Prediction(Protocol):
    """Tells how accurate the result will be."""

    def after(self, views: Sequence[int]) -> Accuracy | None:
        """What is predicted of some views; None while nothing is known of it."""

    def close(self) -> None:
        """Ends whatever works for it."""


@dataclass(frozen=True, eq=False)
class PlannedAccuracy:
    """Predicts by the plan's own means, what the stops were chosen by; it takes a millisecond."""

    views: tuple[int, ...]
    world: World

    @classmethod
    def of(cls, plan: PlanFile) -> "PlannedAccuracy":
        """Prepares the predictions of a plan's stops."""
        q = np.array([stop.q for stop in plan.stops])
        (world,) = worlds_of((plan.cell,), plan.purpose, q)
        return cls(tuple(stop.view for stop in plan.stops), world)

    def after(self, views: Sequence[int]) -> Accuracy | None:
        """What is predicted of some of the plan's views; None without any."""
        rows = [at for at, view in enumerate(self.views) if view in set(views)]
        if not rows:
            return None
        covariance = self.world.covariance(rows)
        place, turn = (
            np.trace(array @ covariance) for array in (self.world.place, self.world.turn)
        )
        return Accuracy.of(float(place), float(turn))

    def close(self) -> None:
        """Nothing works for it."""


class RecordedAccuracy:
    """Predicts by calibrating what is on the disk, on a thread beside the recording.

    What it says is of the views that were there when it began; a new look begins when the last one
    has ended.
    """

    def __init__(self, folder: Path) -> None:
        """Prepares to look at a session's folder."""
        self._folder = folder
        self._worker = ThreadPoolExecutor(1)
        self._looking: Future[Accuracy | None] | None = None
        self._found: Accuracy | None = None

    def after(self, views: Sequence[int]) -> Accuracy | None:
        """What the newest look gave; None while there was none, or it determined nothing."""
        if self._looking is not None and self._looking.done():
            self._found, self._looking = self._looking.result(), None
        if self._looking is None and len(views) >= _FEWEST:
            self._looking = self._worker.submit(_calibrated, self._folder)
        return self._found

    def close(self) -> None:
        """Waits for a look at work."""
        self._worker.shutdown()


def _calibrated(folder: Path) -> Accuracy | None:
    """The accuracy of the camera's place from a session as it is now."""
    try:
        known = so_far(Session.load(folder)).known
    except VisioncalError:
        # Too little as yet; why is reported when the session is calibrated.
        return None
    if known.answer is None:
        return None
    covariance = known.answer.covariance[:6, :6]
    return Accuracy.of(float(np.trace(covariance[3:, 3:])), float(np.trace(covariance[:3, :3])))
