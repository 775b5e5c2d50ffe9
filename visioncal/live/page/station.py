"""A recording that pages watch and steer: one thread owns arm, camera and folder."""

import queue
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Literal

import numpy as np

from visioncal.calibration.stages.detect import find_corners
from visioncal.core.conventions import controller_form
from visioncal.core.errors import DriverError, VisioncalError
from visioncal.core.number_format import figure
from visioncal.core.types import Camera, Corners, FloatArray, Image, Rejection
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.journal import Journal, RecordedCell, state_of
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.recording import Capture, CaptureEvent, RestWatch, take_requested
from visioncal.live.capture.take import TakenView, grey_of, image_motion_px
from visioncal.live.drivers.protocols import Answer, ArmState, MovingArm, RequestingArm
from visioncal.live.page.drawing import coverage_svg, live_picture
from visioncal.live.page.outcome import Light, Outcome, ask_command
from visioncal.live.page.suggestion import NextPose, near, next_view
from visioncal.live.planning.cell import PlanCell, flange_at


class TypedPoses:
    """Arm without a connection, whose poses are typed on a page."""

    name = "poses typed by hand"
    invitation = ""

    def __init__(self) -> None:
        # (4, 4) the pose whose view is not yet taken [m].
        self.pending: FloatArray | None = None

    def request(self, timeout_s: float, wanted: str = "") -> ArmState | None:
        """Returns the typed pose, once; it is never waited for."""
        del timeout_s, wanted
        pose, self.pending = self.pending, None
        return None if pose is None else ArmState(time.monotonic(), pose)

    def reply(self, answer: Answer, reason: str = "") -> None:
        """Nothing: the page shows the view's report."""

    def state(self) -> ArmState:
        """Never called: a view is taken at the pose that requested it."""
        raise NotImplementedError

    def close(self) -> None:
        """Holds no resources."""


@dataclass(frozen=True)
class Setup:
    """What a page asks before a recording begins, in the words of the command line."""

    target: str = "charuco_9x6_30mm"  # The board.
    mount: str = "eye-in-hand"
    robot: str = ""  # The arm's model; empty where it has none.
    arm: str = "manual"
    camera: str = "uvc:0"
    pose_form: str = ""  # How poses are typed; empty to recognise it.
    against: str = ""  # The calibration to verify.


@dataclass(frozen=True)
class PageText:
    """What a page asks and says."""

    title: str
    # Fields of the setup that are asked for, by their names: label, and what may be chosen.
    fields: Mapping[str, tuple[str, Sequence[str]]]
    finish: str  # Label of the button that judges the views.
    # Earlier results, the newest first: light, name and words.
    history: Callable[[], Sequence[tuple[Light, str, str]]] = lambda: ()


@dataclass(frozen=True, eq=False)
class Task:
    """A recording to make, and the command that judges it."""

    # Opens the devices, and begins or resumes the session.
    begin: Callable[[], AbstractContextManager[tuple[LiveCell, Journal]]]
    recorded: RecordedCell | PlanCell
    lens: Camera | None  # Intrinsics; None where they are not known.
    stops: tuple[NextPose, ...]  # Planned poses; none where coverage decides.
    count: int  # Number of views after which it is judged; 0 where the person decides.
    options: CaptureOptions
    command: Sequence[str]  # The command's words, without the folder that it writes.
    result: Path  # That folder.


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What pages show."""

    phase: Literal["setup", "opening", "live", "stopped"] = "setup"
    setup: Setup = field(default_factory=Setup)
    problem: str = ""  # What is wrong, and what to do.
    picture: bytes = b""  # The live picture, a JPEG.
    pictures: int = 0  # Number of pictures so far.
    sees: str = ""  # What is seen in it.
    is_still: bool | None = None  # None where pictures are no stream.
    arm: str = ""  # The arm's name.
    takes_typed: bool = False  # Whether poses are typed.
    views: tuple[str, ...] = ()  # A line a view.
    note: str = ""  # How views are requested.
    missed: str = ""  # Why the last try gave no view.
    coverage: str = ""  # The coverage, as SVG.
    advice: str = ""
    next_pose: NextPose | None = None
    pose_form: str = ""  # The form in which poses are shown.
    trial: Outcome | None = None  # Result of the views so far.
    outcome: Outcome | None = None  # Result at the end.
    is_judging: bool = False


class Station:
    """A recording that pages watch and steer.

    Pages read `snapshot`, which is replaced whole, and call the methods below, which put a request
    into the queue of the thread that owns the devices. A request of a page that has not seen the
    newest view is dropped: two browsers, or a key pressed twice, take one view.

    Args:
        prepare: Makes the task of a setup; raises VisioncalError.
        setup: The setup to begin with, or to show.
        begins: Whether to begin at once.
    """

    # The recording in progress: what it is for, its views, and whether a guided arm rests.
    _task: Task
    _capture: Capture
    _rest: RestWatch
    _previous: Image | None  # The live picture before, in grey.
    _rejected: list[FloatArray]  # (4, 4) `cam_from_target` of suggestions that were skipped [m].

    def __init__(self, prepare: Callable[[Setup], Task], setup: Setup, *, begins: bool) -> None:
        self._prepare, self.snapshot = prepare, Snapshot(setup=setup)
        self._requests: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._open = ExitStack()
        self._judge = ThreadPoolExecutor(1)
        self._judging: Future[Outcome] | None = None
        if begins:
            self.begin(setup)
        self._thread = Thread(target=self._work, name="recording", daemon=True)
        self._thread.start()

    def begin(self, setup: Setup) -> None:
        """Opens the devices of a setup and begins, or goes on after a failure."""
        self._requests.put(lambda: self._begin(setup))

    def take(self, base_from_flange: FloatArray, form: str, seen: Snapshot) -> None:
        """Takes a view at a pose (4, 4) [m] that was typed in a form of `POSE_FORMS`."""

        def typed() -> None:
            cell, views = self._capture.cell, self._capture.journal.views
            for view in views:
                taken = state_of(view)
                if taken and np.abs(taken.base_from_flange - base_from_flange).max() < 1e-9:
                    same = f"View {view.number} has this very pose: type that of this picture, or "
                    self._publish(missed=f"{same}drive to another.")
                    return
            if isinstance(cell.arm, TypedPoses):
                self._publish(pose_form=form)
                if cell.is_stored:
                    self._publish(sees="waiting for the next picture of the folder ...")
                cell.arm.pending = base_from_flange

        self._put(seen, typed)

    def undo(self, seen: Snapshot) -> None:
        """Removes the last view."""

        def undo() -> None:
            capture = self._capture
            if capture.journal.views:
                capture.journal.undo()
                self._start(capture.cell, capture.journal, capture.coach.camera)
                self._publish(views=self.snapshot.views[:-1], missed="", trial=None, outcome=None)
                self._after_change()

        self._put(seen, undo)

    def skip(self, seen: Snapshot) -> None:
        """Suggests another pose."""

        def skip() -> None:
            pose = self.snapshot.next_pose
            if pose is not None and pose.cam_from_target is not None:
                self._rejected.append(pose.cam_from_target)
            self._advise()

        self._put(seen, skip)

    def finish(self, seen: Snapshot) -> None:
        """Judges the views, also after the devices are closed."""
        if seen.views:
            self._requests.put(lambda: self._ask(is_trial=False))

    def end(self, seen: Snapshot) -> None:
        """Closes the devices, and asks for another setup."""

        def end() -> None:
            self._open.close()
            self.snapshot = Snapshot(setup=self.snapshot.setup)

        self._put(seen, end)

    def close(self) -> None:
        """Ends the thread, which closes the devices."""
        self._requests.put(None)
        self._thread.join(10.0)
        self._judge.shutdown(cancel_futures=True)

    def _put(self, seen: Snapshot, request: Callable[[], None]) -> None:
        def guarded() -> None:
            now = self.snapshot
            if now.phase == "live" and len(now.views) == len(seen.views):
                request()

        self._requests.put(guarded)

    def _publish(self, **changes: object) -> None:
        self.snapshot = replace(self.snapshot, **changes)  # type: ignore[arg-type]

    def _work(self) -> None:
        """Serves requests, and between them the live picture, until it is closed."""
        while True:
            is_live = self.snapshot.phase == "live"
            try:
                request = self._requests.get(timeout=0.001 if is_live else 0.2)
            except queue.Empty:
                request = self._live if is_live else lambda: None
            if request is None:
                break
            try:
                request()
            except VisioncalError as error:
                self._stop(f"{error.message} {error.next_step}".strip())
            except Exception:  # noqa: BLE001
                traceback.print_exc()
                self._stop("This is a bug of visioncal; its terminal says more. Views are safe.")
        self._open.close()

    def _stop(self, problem: str) -> None:
        self._open.close()
        phase = "stopped" if self.snapshot.views else "setup"
        self._publish(phase=phase, problem=problem)

    def _begin(self, setup: Setup) -> None:
        if self.snapshot.phase == "live":
            return
        self._publish(phase="opening", setup=setup, problem="")
        self._task = self._prepare(setup)
        self._previous, self._rejected = None, []
        cell, journal = self._open.enter_context(self._task.begin())
        self._start(cell, journal, cell.camera.factory or self._task.lens)
        self._rest = RestWatch(journal, self._task.options.still)
        robot, arm = self._task.recorded.robot, cell.arm
        form = None if robot is None else controller_form(robot.name)
        self._publish(
            phase="live",
            arm=arm.name,
            takes_typed=isinstance(arm, TypedPoses),
            pose_form=setup.pose_form or ("ros" if form is None else form.name),
            views=tuple(f"view {view.number}: recorded before" for view in journal.views),
            note=getattr(arm, "invitation", ""),
            missed="",
            trial=None,
            outcome=None,
        )
        self._advise()

    def _start(self, cell: LiveCell, journal: Journal, lens: Camera | None) -> None:
        task = self._task
        seen = task.recorded.target, task.recorded.robot
        self._capture = Capture(cell, *seen, lens, journal, task.options, None, self._taken)

    def _live(self) -> None:
        """Shows a picture, and takes a view where the arm requests one or has come to rest."""
        cell, task = self._capture.cell, self._task
        if not cell.is_stored:
            image = cell.camera.frame().image
            grey = grey_of(image)
            found, _ = find_corners(grey, task.recorded.target, 0)
            moved_px = np.inf if self._previous is None else image_motion_px(self._previous, grey)
            self._previous = grey
            self._show(image, found)
            self._publish(is_still=moved_px <= task.options.still.image_px)
        if isinstance(cell.arm, RequestingArm):
            try:
                take_requested(self._capture, cell.arm, task.count, 0.01)
            except EOFError:
                self._ask(is_trial=False)
                self._stop("")
            except DriverError as error:
                if not cell.is_stored:
                    raise
                # The picture of a typed pose may still be saved.
                self._publish(missed=f"{error.message} {error.next_step}")
        elif isinstance(cell.arm, MovingArm) and self._rest.begins(cell.state()):
            self._capture.view(*self._capture.next_numbers(), task.count)

    def _show(self, image: Image, found: Corners | Rejection) -> None:
        """Publishes a picture with what is found in it."""
        corners = found if isinstance(found, Corners) else None
        pose = self.snapshot.next_pose
        wanted = None if pose is None else pose.cam_from_target
        sees = (
            f"{len(found.ids)} corners, edges {figure(found.blur_px)} px"
            if isinstance(found, Corners)
            else found.reason
        )
        coach = self._capture.coach
        picture = live_picture(image, coach.target, corners, coach.lens, wanted)
        self._publish(picture=picture, pictures=self.snapshot.pictures + 1, sees=sees)

    def _taken(self, step: CaptureEvent) -> None:
        """Publishes a view, and tries a calibration of all so far."""
        if not isinstance(step.found, TakenView):
            self._publish(missed=step.words)
            return
        if self._capture.cell.is_stored:
            self._show(step.found.frame.image, step.found.corners)
        form = step.found.state.pose_form or self.snapshot.pose_form
        views = (*self.snapshot.views, step.words)
        self._publish(views=views, missed="", outcome=None, pose_form=form)
        self._after_change()

    def _after_change(self) -> None:
        count = len(self._capture.journal.views)
        if self._task.count and count >= self._task.count:
            self._ask(is_trial=False)
        elif count >= 5 and not self._task.stops:
            self._ask(is_trial=True)
        self._advise()

    def _ask(self, *, is_trial: bool) -> None:
        """Runs the judging command beside the recording; a trial, without its drawings."""
        views = len(self._capture.journal.views)
        if not views:
            self._publish(missed="There is no view yet.")
            return
        folder = None if is_trial else self._task.result
        if self._judging is not None:
            # One that is still waiting is superseded; one that runs says how it is so far.
            self._judging.cancel()
        self._judging = self._judge.submit(ask_command, self._task.command, folder, views)
        self._judging.add_done_callback(self._answered)
        self._publish(is_judging=not is_trial)

    def _answered(self, future: Future[Outcome]) -> None:
        if not future.cancelled():
            self._requests.put(lambda: self._judged(future.result()))

    def _judged(self, outcome: Outcome) -> None:
        if outcome.folder == self._task.result:
            self._publish(outcome=outcome, is_judging=False)
        elif self.snapshot.phase == "live" and outcome.views <= len(self._capture.journal.views):
            self._publish(trial=outcome)
            capture, fitted = self._capture, outcome.document.get("camera")
            if fitted and capture.coach.camera is None:
                numbers = (np.array(fitted[name]) for name in ("matrix", "distortion"))
                lens = Camera(fitted["model"], capture.coach.resolution, *numbers)
                self._start(capture.cell, capture.journal, lens)
            self._advise()

    def _advise(self) -> None:
        """Publishes the coverage, and the next pose."""
        coach, task, taken = self._capture.coach, self._task, len(self._capture.journal.views)
        pose: NextPose | None
        if task.count and taken >= task.count:
            pose = NextPose("All views are there.")
        elif task.stops:
            at = taken + len(self._rejected)
            pose = task.stops[at] if at < len(task.stops) else None
        else:
            pose = self._suggested()
        self._publish(
            coverage=coverage_svg(coach.covered, coach.poses),
            advice=coach.words(),
            next_pose=pose,
        )

    def _suggested(self) -> NextPose:
        """The next view by coverage, and where a trial says it, the pose of the flange."""
        coach, trial = self._capture.coach, self.snapshot.trial
        if not coach.poses:
            return NextPose("Begin with the whole board large in the picture.")
        avoid, flange, view = [*coach.poses, *self._rejected], None, None
        if trial is not None and trial.light != "red" and trial.document:
            edges = trial.document["transforms"].values()
            x, z = (np.array(edge["matrix"]) for edge in edges)
            place = partial(flange_at, self._task.recorded.mount, x, z)
            states = map(state_of, self._capture.journal.views)
            taken = np.array([state.base_from_flange for state in states if state is not None])
            view = next_view(coach.target, coach.lens, avoid, lambda at: near(place(at), taken))
            flange = None if view is None else place(view)
        view = next_view(coach.target, coach.lens, avoid) if view is None else view
        if view is None:
            return NextPose("Another place, with the whole board in the picture.")
        tilt = np.rad2deg(np.arccos(np.clip(view[2, 2], -1.0, 1.0)))
        words = (
            "Move until the board fills the orange outline, its first corner in the ring; it is "
            f"tilted by {tilt:.0f} degrees there."
        )
        return NextPose(words, view, flange)
