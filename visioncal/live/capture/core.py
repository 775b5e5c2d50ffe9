"""Recording of views: settling, taking, checking, storing and reporting each."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from visioncal.calibration.stages.detect import find_corners
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.types import Corners, Target
from visioncal.live.capture.coach import Coach
from visioncal.live.capture.facts import state_of
from visioncal.live.capture.joint_pose_check import JointPoseCheck
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.live import LiveCell
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.predict import Prediction
from visioncal.live.capture.take import Missed, TakenView, settle, take
from visioncal.live.planning.accuracy import Accuracy
from visioncal.live.planning.messages import accuracy_words
from visioncal.vision.finders.imaging import decode_image


@dataclass(frozen=True)
class Times:
    """Duration of a view: motion, settling, and everything else [s]."""

    moved_s: float
    settled_s: float
    worked_s: float


@dataclass(frozen=True, eq=False)
class CaptureEvent:
    """Result of a stop, for watchers."""

    view: int  # Number of the view.
    place: int  # Number of the stop, from 1 on.
    count: int  # Number of stops; 0 where it is not known.
    found: TakenView | Missed  # The view, or why there is none.
    covered: str  # Coverage so far, in words.
    accuracy: Accuracy | None  # Accuracy predicted so far; None while there is no prediction.
    advice: str  # What comes next, in words.
    times: Times


class Watcher(Protocol):
    """Observer of a recording; it must be quick."""

    def stepped(self, step: CaptureEvent) -> None:
        """Handles a stored view, or a stop that gave none."""


@dataclass(eq=False)
class Capture:
    """A recording in progress."""

    cell: LiveCell
    target: Target
    journal: Journal
    options: CaptureOptions
    agreement: JointPoseCheck  # Consistency check of joints and pose.
    coach: Coach  # Coverage, and advice for the next view.
    prediction: Prediction | None  # Predicted accuracy.
    watchers: Sequence[Watcher] = ()
    steps: list[CaptureEvent] = field(default_factory=list)

    def catch_up(self) -> None:
        """Takes the views on the disk into account."""
        for view in self.journal.views:
            image = decode_image(self.journal.image(view))
            detected = (
                None if isinstance(image, str) else find_corners(image, self.target, view.number)
            )
            if detected is not None and isinstance(detected[0], Corners):
                self.coach.add(detected[0])
            state = state_of(view)
            if state is not None:
                self.agreement.why_not(state)

    def view(
        self,
        number: int,
        place: int,
        count: int,
        moved_s: float,
        advise: Callable[[], str],
    ) -> CaptureEvent:
        """Takes a view at the arm's present pose.

        Args:
            number: Number of the view.
            place: Number of the stop, from 1 on.
            count: Number of stops; 0 where it is not known.
            moved_s: Duration of the motion to the stop [s].
            advise: States what comes next, once the view is stored.

        Raises:
            DriverError: A device fails, or the arm is stopped.
            DataError: The view cannot be written, or too many stops in a row gave none.
        """
        clock = self.cell.clock
        start = clock.now()
        rest = settle(self.cell, self.options)
        settled_at = clock.now()
        result: TakenView | Missed
        if isinstance(rest, Missed):
            result = rest
        else:
            result = take(self.cell, rest, self.target, number, self.options)
        result = self._stored(number, result)
        accuracy = self._accuracy()
        times = Times(moved_s, settled_at - start, clock.now() - settled_at)
        advice = advise()
        step = CaptureEvent(
            number, place, count, result, self.coach.words(), accuracy, advice, times
        )
        self.steps.append(step)
        for watcher in self.watchers:
            watcher.stepped(step)
        self._check_missed_in_a_row()
        return step

    def onward(self, view: int | None) -> str:
        """Names the next view and the accuracy predicted with it; empty without a next view."""
        if view is None:
            return ""
        if self.prediction is None:
            return f"view {view}"
        predicted = self.prediction.after([*(taken.number for taken in self.journal.views), view])
        if predicted is None or predicted.is_open:
            return f"view {view}"
        return f"view {view}, for {figure(predicted.mm)} mm"

    def _stored(self, number: int, taken: TakenView | Missed) -> TakenView | Missed:
        """Stores a view if its joints and pose are consistent."""
        if isinstance(taken, Missed):
            return taken
        disagreement = self.agreement.why_not(taken.state)
        if disagreement:
            return Missed(disagreement)
        self.journal.append(number, taken)
        self.coach.add(taken.corners)
        return taken

    def _accuracy(self) -> Accuracy | None:
        if self.prediction is None:
            return None
        return self.prediction.after([view.number for view in self.journal.views])

    def _check_missed_in_a_row(self) -> None:
        if not self.options.missed_in_a_row:
            return
        recent = self.steps[-self.options.missed_in_a_row :]
        reasons = [step.found.reason for step in recent if isinstance(step.found, Missed)]
        if len(reasons) < self.options.missed_in_a_row:
            return
        raise DataError(
            f"no view at {len(recent)} stops in a row "
            f"({', '.join(f'{step.view}' for step in recent)}): "
            f"{reasons[-1]}.",
            culprits=[f"view {step.view}" for step in recent],
            next_step="Look at the board: does it lie where the plan has it, in the light and "
            f"unhidden? Is it a {self.target.name}, and the lens in focus? Then go on with "
            "--resume.",
        )


def missed_stops(steps: Sequence[CaptureEvent]) -> Iterator[tuple[int, str]]:
    """Stops that gave no view, with the reasons."""
    for step in steps:
        if isinstance(step.found, Missed):
            yield step.view, step.found.reason


def line_of(step: CaptureEvent) -> str:
    """Reports a stop: `[3/30] view 2: 54 corners, ...; coverage 45 % -> next: ...`."""
    result, place = step.found, f"[{step.place}{f'/{step.count}' if step.count else ''}]"
    next_words = f" -> next: {step.advice}" if step.advice else ""
    if isinstance(result, Missed):
        return f"{place} view {step.view}: not taken: {result.reason}{next_words}"
    return (
        f"{place} view {step.view}: {len(result.corners.ids)} corners, edges "
        f"{result.corners.blur_px:.1f} px, {result.motion_px:.2f} px still; {step.covered}"
        f"{_accuracy(step.accuracy)}{next_words}"
    )


def note_of(step: CaptureEvent) -> str:
    """The same in Markdown, for the viewer."""
    sigma = "" if step.accuracy is None else f"\n\nPredicted sigma: {accuracy_words(step.accuracy)}"
    return f"**View {step.view}**\n\n{step.covered}{sigma}\n\nNext: {step.advice or 'anything new'}"


def _accuracy(accuracy: Accuracy | None) -> str:
    if accuracy is None:
        return ""
    if accuracy.is_open:
        return "; predicted sigma: not determined yet"
    return f"; predicted sigma {figure(accuracy.mm)} mm"
