"""One view after the other: settled, taken, checked, put on the disk, and reported in words."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from visioncal.calibration.stages.detect import look_for
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
    """How long a view took: on the way, until all stood still, and for everything else [s]."""

    moved_s: float
    settled_s: float
    worked_s: float


@dataclass(frozen=True, eq=False)
class CaptureEvent:
    """What became of a view, for whoever watches.

    Attributes:
        view: Its number.
        place: Which of the stops it is, from 1 on; of `count`, 0 where that is not known.
        count: How many there are.
        found: What was taken, or why nothing was.
        covered: What is covered so far, in words.
        accuracy: What is predicted so far; None while nothing is.
        advice: What comes next, in words.
        times: How long it took.
    """

    view: int
    place: int
    count: int
    found: TakenView | Missed
    covered: str
    accuracy: Accuracy | None
    advice: str
    times: Times


class Watcher(Protocol):
    """Whoever watches a recording; what it does must be quick."""

    def stepped(self, step: CaptureEvent) -> None:
        """Takes note of a view on the disk, or of a stop that gave none."""


@dataclass(eq=False)
class Capture:
    """A recording at work.

    Attributes:
        cell: The devices.
        target: What is to be seen.
        journal: Where the views go.
        options: How they are taken.
        agreement: Whether joints and pose belong together.
        coach: What is covered.
        prediction: How accurate the result will be.
        watchers: Who is notified.
        steps: What became of each stop so far.
    """

    cell: LiveCell
    target: Target
    journal: Journal
    options: CaptureOptions
    agreement: JointPoseCheck
    coach: Coach
    prediction: Prediction | None
    watchers: Sequence[Watcher] = ()
    steps: list[CaptureEvent] = field(default_factory=list)

    def catch_up(self) -> None:
        """Takes into account what is on the disk already."""
        for view in self.journal.views:
            image = decode_image(self.journal.image(view))
            found = None if isinstance(image, str) else look_for(image, self.target, view.number)
            if found is not None and isinstance(found[0], Corners):
                self.coach.add(found[0])
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
        """Takes a view where the arm stands.

        Args:
            number: The view's number.
            place: Which of the stops it is, from 1 on.
            count: How many there are; 0 where that is not known.
            moved_s: How long the arm was on its way here [s].
            advise: Says what comes next, once the view is there.

        Raises:
            DriverError: A device fails, or the arm is stopped.
            DataError: The view cannot be written, or nothing was seen at too many stops in a row.
        """
        clock = self.cell.clock
        begun = clock.now()
        settled = settle(self.cell, self.options)
        rested = clock.now()
        found: TakenView | Missed
        if isinstance(settled, Missed):
            found = settled
        else:
            found = take(self.cell, settled, self.target, number, self.options)
        found = self._kept(number, found)
        accuracy = self._accuracy()
        times = Times(moved_s, rested - begun, clock.now() - rested)
        advice = advise()
        step = CaptureEvent(
            number, place, count, found, self.coach.words(), accuracy, advice, times
        )
        self.steps.append(step)
        for watcher in self.watchers:
            watcher.stepped(step)
        self._check_lost()
        return step

    def onward(self, view: int | None) -> str:
        """Names the view that is next, and what is predicted with it; empty where none is."""
        if view is None:
            return ""
        if self.prediction is None:
            return f"view {view}"
        then = self.prediction.after([*(other.number for other in self.journal.views), view])
        if then is None or then.is_open:
            return f"view {view}"
        return f"view {view}, for {figure(then.mm)} mm"

    def _kept(self, number: int, found: TakenView | Missed) -> TakenView | Missed:
        """Puts a view on the disk, if it can be believed."""
        if isinstance(found, Missed):
            return found
        disagreement = self.agreement.why_not(found.state)
        if disagreement:
            return Missed(disagreement)
        self.journal.append(number, found)
        self.coach.add(found.corners)
        return found

    def _accuracy(self) -> Accuracy | None:
        if self.prediction is None:
            return None
        return self.prediction.after([view.number for view in self.journal.views])

    def _check_lost(self) -> None:
        if not self.options.lost:
            return
        last = self.steps[-self.options.lost :]
        reasons = [step.found.reason for step in last if isinstance(step.found, Missed)]
        if len(reasons) < self.options.lost:
            return
        raise DataError(
            f"no view at {len(last)} stops in a row "
            f"({', '.join(f'{step.view}' for step in last)}): "
            f"{reasons[-1]}.",
            culprits=[f"view {step.view}" for step in last],
            next_step="Look at the board: does it lie where the plan has it, in the light and "
            f"unhidden? Is it a {self.target.name}, and the lens in focus? Then go on with "
            "--resume.",
        )


def missed(steps: Sequence[CaptureEvent]) -> Iterator[tuple[int, str]]:
    """The stops that gave no view, with the reasons."""
    for step in steps:
        if isinstance(step.found, Missed):
            yield step.view, step.found.reason


def line_of(step: CaptureEvent) -> str:
    """Says what became of a view: `[3/30] view 2: 54 corners, ...; coverage 45 % -> next: ...`."""
    found, place = step.found, f"[{step.place}{f'/{step.count}' if step.count else ''}]"
    onward = f" -> next: {step.advice}" if step.advice else ""
    if isinstance(found, Missed):
        return f"{place} view {step.view}: not taken: {found.reason}{onward}"
    return (
        f"{place} view {step.view}: {len(found.corners.ids)} corners, edges "
        f"{found.corners.blur_px:.1f} px, {found.motion_px:.2f} px still; {step.covered}"
        f"{_accuracy(step.accuracy)}{onward}"
    )


def note_of(step: CaptureEvent) -> str:
    """The same in Markdown, for the viewer."""
    sigma = "" if step.accuracy is None else f"\n\nPredicted sigma: {accuracy_words(step.accuracy)}"
    return f"**View {step.view}**\n\n{step.covered}{sigma}\n\nNext: {step.advice or 'anything new'}"


def _accuracy(found: Accuracy | None) -> str:
    if found is None:
        return ""
    if found.is_open:
        return "; predicted sigma: not determined yet"
    return f"; predicted sigma {figure(found.mm)} mm"
