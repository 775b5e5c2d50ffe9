"""Accuracy predicted from the views so far."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from visioncal.core.errors import VisioncalError
from visioncal.live.planning.accuracy import Accuracy
from visioncal.live.planning.information import World, predict_worlds
from visioncal.live.planning.plan_file import PlanFile
from visioncal.live.planning.recorded import calibrate_partially
from visioncal.session import Session

# Least number of views for a calibration.
_FEWEST = 3


class Prediction(Protocol):
    """Source of predicted accuracy."""

    def after(self, views: Sequence[int]) -> Accuracy | None:
        """Accuracy predicted with some views; None while there is no prediction."""

    def close(self) -> None:
        """Releases resources."""


@dataclass(frozen=True, eq=False)
class PlannedAccuracy:
    """Prediction from the plan's information; it takes a millisecond."""

    views: tuple[int, ...]
    world: World

    @classmethod
    def of(cls, plan: PlanFile) -> "PlannedAccuracy":
        """Prepares the predictions of a plan's stops."""
        q = np.array([stop.q for stop in plan.stops])
        (world,) = predict_worlds((plan.cell,), plan.purpose, q)
        return cls(tuple(stop.view for stop in plan.stops), world)

    def after(self, views: Sequence[int]) -> Accuracy | None:
        """Accuracy predicted with some of the plan's views; None without any."""
        rows = [row for row, view in enumerate(self.views) if view in set(views)]
        if not rows:
            return None
        covariance = self.world.covariance(rows)
        place, turn = (
            np.trace(array @ covariance) for array in (self.world.position, self.world.rotation)
        )
        return Accuracy.of(float(place), float(turn))

    def close(self) -> None:
        """Holds no resources."""


class RecordedAccuracy:
    """Prediction from calibrating the session on the disk in a background thread.

    It is for the views that were there when the calibration started; a new one starts when the last
    has ended.
    """

    def __init__(self, folder: Path) -> None:
        """Prepares to calibrate a session's folder."""
        self._folder = folder
        self._worker = ThreadPoolExecutor(1)
        self._pending: Future[Accuracy | None] | None = None
        self._latest: Accuracy | None = None

    def after(self, views: Sequence[int]) -> Accuracy | None:
        """Accuracy of the newest calibration; None while there is none, or it gave no result."""
        if self._pending is not None and self._pending.done():
            self._latest, self._pending = self._pending.result(), None
        if self._pending is None and len(views) >= _FEWEST:
            self._pending = self._worker.submit(_session_accuracy, self._folder)
        return self._latest

    def close(self) -> None:
        """Waits for a calibration in progress."""
        self._worker.shutdown()


def _session_accuracy(folder: Path) -> Accuracy | None:
    """Accuracy of the camera's pose from a session as it is now."""
    try:
        run = calibrate_partially(Session.load(folder)).known
    except VisioncalError:
        # Too few views yet; the reason is reported when the session is calibrated.
        return None
    if run.assessment_or_none is None:
        return None
    covariance = run.assessment_or_none.covariance[:6, :6]
    return Accuracy.of(float(np.trace(covariance[3:, 3:])), float(np.trace(covariance[:3, :3])))
