"""Recording of views: driven to the stops of a plan, guided by hand, or on request."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from visioncal.core.errors import DataError, DriverError, VisioncalError
from visioncal.core.number_format import figure
from visioncal.core.transforms import pose_difference
from visioncal.core.types import Camera, Corners, FloatArray, Target
from visioncal.live.capture.assessment import Coach, JointPoseCheck, Prediction, planned_accuracy
from visioncal.live.capture.cell import HostClock, LiveCell
from visioncal.live.capture.gate import Consent, Gate, check_same_arm, clear_path, travel_s
from visioncal.live.capture.journal import Journal, state_of
from visioncal.live.capture.options import CaptureOptions, Stillness
from visioncal.live.capture.take import Missed, TakenView, take, why_arm_moves
from visioncal.live.drivers.protocols import ArmState, MovingArm, RequestingArm
from visioncal.planning.design import Accuracy
from visioncal.planning.plan import Stop
from visioncal.planning.plan_file import PlanFile
from visioncal.robot import Robot
from visioncal.session import View
from visioncal.vision.boards.imaging import decode_image
from visioncal.vision.detection import find_corners


@dataclass(frozen=True, eq=False)
class CaptureEvent:
    """Result of a stop."""

    view: int  # Number of the view.
    place: int  # Number of the stop, from 1 on.
    count: int  # Number of stops; 0 where it is not known.
    found: TakenView | Missed  # The view, or why there is none.
    covered: str  # Coverage so far, in words.
    accuracy: Accuracy | None  # Accuracy predicted so far; None while there is no prediction.
    advice: str  # The next step, in words.

    @property
    def words(self) -> str:
        """The outcome: `view 2: 54 corners, edges 0.8 px, 0.01 px still`."""
        view = self.found
        if isinstance(view, Missed):
            return f"view {self.view}: not taken: {view.reason}"
        return (
            f"view {self.view}: {len(view.corners.ids)} corners, edges {view.corners.blur_px:.1f} "
            f"px, {view.motion_px:.2f} px still"
        )

    @property
    def line(self) -> str:
        """A report: `[3/30] view 2: 54 corners, ...; coverage 45 % -> next: ...`."""
        sigma = ""
        if self.accuracy is not None:
            is_open = self.accuracy.is_open
            mm = ": not determined yet" if is_open else f" {figure(self.accuracy.mm)} mm"
            sigma = f"; predicted sigma{mm}"
        place = f"[{self.place}{f'/{self.count}' if self.count else ''}]"
        covered = "" if isinstance(self.found, Missed) else f"; {self.covered}{sigma}"
        return f"{place} {self.words}{covered}{f' -> next: {self.advice}' if self.advice else ''}"


@dataclass(frozen=True, eq=False)
class _HeldArm:
    """An arm that stays at a given pose."""

    name: str
    reported: ArmState  # Its state when it was read.
    clock: HostClock  # Clock of the state's stamps.

    def state(self) -> ArmState:
        """The state, stamped now."""
        return replace(self.reported, stamp_s=self.clock.now())

    def close(self) -> None:
        """Holds no resources."""


class Capture:
    """A recording in progress; the views that are on the disk already count.

    Args:
        cell: The devices.
        target: The board.
        robot: The arm's model; None where it is not known.
        lens: Intrinsics for tilts and distances; None where they are not known.
        journal: Where views are stored.
        options: Its options.
        prediction: Predicted accuracy; None for no prediction.
        watch: Called with each stored view, or stop that gave none; it must be quick.
    """

    def __init__(
        self,
        cell: LiveCell,
        target: Target,
        robot: Robot | None,
        lens: Camera | None,
        journal: Journal,
        options: CaptureOptions,
        prediction: Prediction | None,
        watch: Callable[[CaptureEvent], None] = lambda _: None,
    ) -> None:
        self.cell, self.target, self.journal, self.options = cell, target, journal, options
        self.prediction, self.watch = prediction, watch
        self.coach = Coach(target, cell.camera.resolution, lens)
        self.steps: list[CaptureEvent] = []
        self._robot = robot
        for view in journal.views:
            image = decode_image(journal.image(view))
            if not isinstance(image, str):
                corners, _ = find_corners(image, target, view.number)
                if isinstance(corners, Corners):
                    self.coach.add(corners)
        self.reconcile()

    def reconcile(self) -> None:
        """Counts the views that the journal has now: some may be gone, or have other poses."""
        views = self.journal.views
        for number in self.coach.corners.keys() - {view.number for view in views}:
            self.coach.drop(number)
        self._check = JointPoseCheck(self._robot)
        for view in views:
            if (state := state_of(view)) is not None:
                self._check.why_not(state)

    def store(self, taken: Mapping[int, TakenView]) -> None:
        """Stores views by their numbers, all of them or none; raises DataError."""
        self.journal.store(taken)
        for view in taken.values():
            self.coach.add(view.corners)

    def view(
        self, number: int, place: int, count: int, next_view: int | None = None
    ) -> CaptureEvent:
        """Takes a view at the arm's present pose.

        Args:
            number: Number of the view.
            place: Number of the stop, from 1 on.
            count: Number of stops; 0 where it is not known.
            next_view: Number of the next planned one, 0 after the last; None where a person
                chooses it.

        Raises:
            DriverError: A device fails, or the arm is stopped.
            DataError: The view cannot be written, or too many stops in a row gave none.
        """
        result = take(self.cell, self.target, number, self.options)
        if isinstance(result, TakenView):
            disagreement = self._check.why_not(result.state)
            if disagreement:
                result = Missed(disagreement)
            else:
                self.store({number: result})
        taken = [view.number for view in self.journal.views]
        accuracy = None if self.prediction is None else self.prediction(taken)
        advice = f"view {next_view}" if next_view else ""
        if next_view is None:
            advice = self.coach.advice()
        elif next_view and self.prediction is not None:
            predicted = self.prediction([*taken, next_view])
            if predicted is not None and not predicted.is_open:
                advice += f", for {figure(predicted.mm)} mm"
        covered = self.coach.words()
        self.steps.append(CaptureEvent(number, place, count, result, covered, accuracy, advice))
        self.watch(self.steps[-1])
        in_a_row = self.options.missed_in_a_row
        recent = self.steps[-in_a_row:] if in_a_row else []
        reasons = [step.found.reason for step in recent if isinstance(step.found, Missed)]
        if reasons and len(reasons) >= in_a_row:
            raise DataError(
                f"no view at {len(recent)} stops in a row "
                f"({', '.join(f'{step.view}' for step in recent)}): {reasons[-1]}.",
                culprits=[f"view {step.view}" for step in recent],
                next_step="Look at the board: does it lie where the plan has it, in the light and "
                f"unhidden? Is it a {self.target.name}, and the lens in focus?",
            )
        return self.steps[-1]

    def view_at(self, state: ArmState, number: int, place: int, count: int) -> CaptureEvent:
        """Takes a view of an arm that stays at a given state; otherwise as `view`."""
        cell = self.cell
        self.cell = replace(cell, arm=_HeldArm(cell.arm.name, state, cell.clock))
        try:
            return self.view(number, place, count)
        finally:
            self.cell = cell

    def next_numbers(self) -> tuple[int, int]:
        """Number and place of the next view, where there is no plan."""
        numbers = [view.number for view in self.journal.views]
        return 1 + max(numbers, default=0), len(numbers) + 1

    @contextmanager
    def halting(self) -> Iterator[None]:
        """Halts the arm if a recording fails, and adds what is on the disk to the error.

        Raises:
            DriverError: A device failed, or Ctrl-C was pressed.
            DataError: The recording failed for another reason.
        """
        try:
            with self.cell.halting():
                yield
        except (KeyboardInterrupt, VisioncalError) as error:
            count, folder = len(self.journal.views), self.journal.folder
            stored = f"{count} view{'s are' if count > 1 else ' is'} safe in {folder}."
            resume = "Go on with --resume."
            if not count:
                stored, resume = "No view was taken: there is no session yet.", "Then record again."
            elif self.cell.is_stored:
                resume = "Record all into a new session: a folder begins with its first picture."
            if isinstance(error, KeyboardInterrupt):
                halted = "; the arm was halted" if isinstance(self.cell.arm, MovingArm) else ""
                raise DriverError(
                    f"stopped by Ctrl-C or a signal{halted}. {stored}",
                    culprits=["Ctrl-C"],
                    next_step=resume,
                ) from None
            step = f"{error.next_step} {resume}".strip()
            raise error.but(f"{error.message} {stored}", next_step=step) from error

    @contextmanager
    def until(self, end: type[BaseException]) -> Iterator[None]:
        """Takes an exception for the regular end; raises DriverError where there is no view."""
        with suppress(end):
            yield
        if not self.journal.views:
            arm = self.cell.arm.name
            step = "Let the arm rest, or give its pose, where the camera sees the board."
            raise DriverError(f"{arm}: it ended before a view.", culprits=[arm], next_step=step)


def missed_stops(steps: Sequence[CaptureEvent]) -> dict[int, str]:
    """Stops that gave no view, with the reasons."""
    return {step.view: step.found.reason for step in steps if isinstance(step.found, Missed)}


@dataclass(frozen=True, eq=False)
class MotionSummary:
    """Summary of a recording before anything moves."""

    stops: tuple[Stop, ...]  # Stops that have no view yet.
    # Postures (n,) to the first stop, its own last; empty where no stop is left.
    first: tuple[FloatArray, ...] = ()
    turn_rad: float = 0.0  # Largest joint travel on that path [rad].
    duration_s: float = 0.0  # Approximate duration of the recording [s].


def motion_summary(
    cell: LiveCell, plan: PlanFile, done: Sequence[int], options: CaptureOptions
) -> MotionSummary:
    """Checks and summarises what is to be driven, without the views `done`; nothing moves.

    Raises:
        DriverError: The arm does not report its joints, or is stopped.
        DataError: The plan is for another arm, or no safe path to the first stop was found.
    """
    start = cell.joints()
    check_same_arm(cell, plan.cell.robot, start)
    stops = tuple(stop for stop in plan.stops if stop.view not in done)
    if not stops:
        return MotionSummary(())
    first = checked_path(plan, stops[0], start)
    postures = [start, *first, *(q for stop in stops[1:] for q in (*stop.via, stop.q))]
    turns = np.abs(np.diff(np.array([start, *first]), axis=0)).sum(axis=0)
    # A stop takes 1.5 s besides the motion to it.
    duration_s = sum(travel_s(options, *ends) for ends in pairwise(postures)) + 1.5 * len(stops)
    return MotionSummary(stops, first, float(turns.max()), duration_s)


def record(
    cell: LiveCell,
    plan: PlanFile,
    journal: Journal,
    options: CaptureOptions,
    consent: Consent,
    watch: Callable[[CaptureEvent], None] = lambda _: None,
) -> list[CaptureEvent]:
    """Records the stops of a plan that have no view yet, and returns their results.

    However it ends, the arm is halted and every reported view is on the disk. Without the
    intrinsics of the camera, those of the plan are good enough for tilts and distances.

    Raises:
        DriverError: A device failed, the arm was stopped, or Ctrl-C was pressed.
        DataError: A view cannot be written, no safe path leads to a stop, consent is refused, or
            three stops in a row gave no view.
    """
    planned, lens = plan.cell, cell.camera.factory or plan.cell.camera
    capture = Capture(
        *(cell, planned.target, planned.robot, lens, journal, options),
        *(planned_accuracy(plan), watch),
    )
    done = {view.number for view in journal.views}
    remaining = [stop for stop in plan.stops if stop.view not in done]
    gate = Gate(cell, planned.robot, consent, options)

    def look() -> None:
        # A failure is reported now, not at the end of a long motion.
        cell.camera.frame(timeout_s=0.5)
        journal.check_room()

    with capture.halting():
        for index, stop in enumerate(remaining):
            path = checked_path(plan, stop, cell.joints())
            gate.move(path, f"to view {stop.view}", look)
            place = len(plan.stops) - len(remaining) + index + 1
            next_view = remaining[index + 1].view if index + 1 < len(remaining) else 0
            capture.view(stop.view, place, len(plan.stops), next_view)
    return capture.steps


def checked_path(plan: PlanFile, stop: Stop, q: FloatArray) -> tuple[FloatArray, ...]:
    """Collision-checked postures (n,) from joints (n,) to a stop: the plan's, or new ones [rad].

    Raises:
        DataError: No path clear of everything declared was found, or the arm is too near to
            something.
    """

    def is_at(posture: FloatArray) -> bool:
        # Largest joint difference [rad].
        return q.shape == posture.shape and bool(np.abs(q - posture).max() < 5e-3)

    if is_at(stop.q):
        return (stop.q,)
    index = plan.stops.index(stop)
    planned = plan.stops[index - 1].q if index else plan.start_q
    if planned is not None and is_at(planned):
        return (*stop.via, stop.q)
    return clear_path(plan.cell, q, stop.q, f"view {stop.view}")


class RestWatch:
    """Waits for an arm that is guided by hand to rest where no view was taken."""

    def __init__(self, journal: Journal, still: Stillness) -> None:
        self._journal, self._still = journal, still
        self._first: ArmState | None = None
        # (4, 4) where it rested last, until it leaves [m].
        self._tried: FloatArray | None = None

    def begins(self, state: ArmState) -> bool:
        """Whether by its newest state the arm has come to rest at a new pose."""
        still, flange_pose = self._still, state.base_from_flange
        if self._first is None or why_arm_moves(self._first, state, still):
            self._first = state
        if self._tried is not None and _is_elsewhere(self._tried, flange_pose):
            self._tried = None
        if state.stamp_s - self._first.stamp_s < still.quiet_s or self._tried is not None:
            return False
        taken = [pose for view in self._journal.views if (pose := state_of(view)) is not None]
        if not all(_is_elsewhere(pose.base_from_flange, flange_pose) for pose in taken):
            return False
        self._first, self._tried = None, flange_pose
        return True


def _is_elsewhere(pose: FloatArray, other: FloatArray) -> bool:
    mm, deg = pose_difference(pose, other)
    return mm >= 20.0 or deg >= 5.0


def follow(capture: Capture, count: int) -> list[CaptureEvent]:
    """Takes `count` views (0: until Ctrl-C), one whenever a guided arm rests at a new pose.

    Raises:
        DriverError: A device failed, or the arm is stopped.
        DataError: A view cannot be written, or too many rests in a row gave none.
    """
    cell, rest = capture.cell, RestWatch(capture.journal, capture.options.still)
    # Ctrl-C is the regular end of a recording without a number of views.
    with capture.halting(), capture.until(KeyboardInterrupt):
        while not count or len(capture.journal.views) < count:
            while not rest.begins(cell.state()):
                cell.clock.sleep(0.05)
            capture.view(*capture.next_numbers(), count)
    return capture.steps


def take_requested(capture: Capture, arm: RequestingArm, count: int, wait_s: float = 1.0) -> bool:
    """Waits for a requested view, takes it, and replies once it is on the disk.

    A stop with a number is the view of that number. If that is recorded, no second view is taken:
    the answer to it was lost.

    Args:
        capture: The recording.
        arm: The arm that requests views.
        count: Number of views; 0 for any.
        wait_s: Longest time to wait for a request [s]; then nothing is taken.

    Returns:
        Whether more views are wanted.

    Raises:
        EOFError: No more are requested.
        DriverError: The arm or the camera failed.
        DataError: A view cannot be written, or too many in a row gave none.
    """
    number, place = capture.next_numbers()
    wish = capture.coach.advice()
    state = arm.request(wait_s, f"View {number}{f' ({wish})' if wish else ''}")
    if state is None:
        return True
    number = number if state.stop is None else state.stop
    recorded = next((view for view in capture.journal.views if view.number == number), None)
    if recorded is None:
        found = capture.view_at(state, number, place, count).found
        if isinstance(found, Missed):
            arm.reply("again", found.reason)
            return True
    elif reason := _why_another_stop(recorded, state):
        arm.reply("error", reason)
        return True
    is_last = 0 < count <= len(capture.journal.views)
    arm.reply("done" if is_last else "next")
    return not is_last


def _why_another_stop(recorded: View, state: ArmState) -> str:
    """States why a stop is not that of a recorded view of its number; empty where it is."""
    taken = state_of(recorded)
    if taken is None:
        return f"view {recorded.number} is recorded without a pose"
    mm, deg = pose_difference(taken.base_from_flange, state.base_from_flange)
    # An arm that returns to a taught stop is nearer to it; other stops are farther.
    if mm <= 0.5 and deg <= 0.05:
        return ""
    return (
        f"stop {recorded.number} is recorded {figure(mm)} mm and {figure(deg)} deg from here: "
        "count on, or record into a new folder"
    )


def ask_and_take(capture: Capture, arm: RequestingArm, count: int) -> list[CaptureEvent]:
    """Takes a view whenever a person or the robot's own program requests it.

    Args:
        capture: The recording.
        arm: The arm that requests views.
        count: Number of views; 0 for as many as are requested.

    Raises:
        DriverError: The arm or the camera failed, Ctrl-C was pressed, or no view was requested.
        DataError: A view cannot be written, or too many in a row gave none.
    """
    with capture.halting(), capture.until(EOFError):
        while not count or len(capture.journal.views) < count:
            if not take_requested(capture, arm, count):
                break
    return capture.steps
