"""A recording that pages watch and steer: one thread owns arm, camera and folder."""

import queue
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial, wraps
from threading import Thread
from typing import Concatenate, ParamSpec

import numpy as np

from visioncal.core.conventions import POSE_FORMS
from visioncal.core.documents.pendants import PendantPose
from visioncal.core.errors import DataError, DriverError, VisioncalError
from visioncal.core.number_format import counted
from visioncal.core.types import Camera, Corners, FloatArray, Image, Rejection
from visioncal.live.capture.journal import picture_name, posed, state_of
from visioncal.live.capture.recording import Capture, CaptureEvent, RestWatch, take_requested
from visioncal.live.capture.take import Missed, TakenView, image_motion_px, pictured_views
from visioncal.live.drivers.manual import ManualArm
from visioncal.live.drivers.protocols import ArmState, MovingArm, RequestingArm, StoredPictures
from visioncal.live.page.drawing import coverage_svg, live_picture
from visioncal.live.page.outcome import Outcome, ask_command
from visioncal.live.page.state import (
    Fault,
    Row,
    Setup,
    Snapshot,
    Task,
    Visitor,
    mended_poses,
    sight_words,
    table_rows,
    why_same,
)
from visioncal.live.page.suggestion import NextPose, suggested_pose
from visioncal.planning.cell import flange_at
from visioncal.session import View
from visioncal.vision.boards.imaging import decode_image, grey_of
from visioncal.vision.detection import find_corners

_P = ParamSpec("_P")
# Why a request is refused.
_CHANGED = (
    "Another browser, or the arm, changed the table meanwhile: look at it, and press again. "
    "Nothing was done."
)


def _request(
    act: Callable[Concatenate["Station", Visitor, _P], str | None],
) -> Callable[Concatenate["Station", Visitor, _P], None]:
    """Has the thread of the devices do something for a browser, which gets why it is refused."""

    @wraps(act)
    def put(station: "Station", visitor: Visitor, /, *words: _P.args, **more: _P.kwargs) -> None:
        seen = visitor.seen.revision

        def guarded() -> None:
            visitor.refusal = "The recording is closed: press Start to go on."
            if station.snapshot.phase == "live":
                changed = any(author is not visitor for author in station._authors[seen:])
                visitor.refusal = (
                    _CHANGED if changed else act(station, visitor, *words, **more) or ""
                )
            visitor.answers += 1

        station._requests.put(guarded)

    return put


class Station:
    """A recording that pages watch and steer.

    Pages read `snapshot`, which is replaced whole, and call the methods below, which put a request
    into the queue of the thread that owns the devices. A request of a page that has not seen what
    another page or the arm has changed since is refused, and its page says so.

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
    _shown: Image | None  # The folder's picture that is shown.
    _skipped: set[str]  # Names of its pictures that were there before the recording went on.
    _rejected: list[FloatArray]  # (4, 4) `cam_from_target` of suggestions that were skipped [m].

    def __init__(self, prepare: Callable[[Setup], Task], setup: Setup, *, begins: bool) -> None:
        self._prepare, self.snapshot = prepare, Snapshot(setup=setup)
        self._requests: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._open = ExitStack()
        self._judge = ThreadPoolExecutor(1)
        self._judging: Future[Outcome] | None = None
        # Who made each change of the table; None for the arm.
        self._authors: list[Visitor | None] = []
        if begins:
            self.begin(setup)
        self._thread = Thread(target=self._work, name="recording", daemon=True)
        self._thread.start()

    def begin(self, setup: Setup) -> None:
        """Opens the devices of a setup and begins, or goes on after a failure."""
        self._requests.put(lambda: self._begin(setup))

    @_request
    def take(
        self, visitor: Visitor, poses: Sequence[PendantPose], lines: Sequence[str], seen: Snapshot
    ) -> str:
        """Takes views at poses that were typed in these lines, each of the next picture.

        Of a camera that is no folder it takes one view; all are taken, or none.
        """
        if (typed := tuple(lines)) == visitor.lines and seen.revision < self.snapshot.revision:
            # A key that was pressed twice.
            return ""
        capture, again = self._capture, self.snapshot.again
        cell, journal = capture.cell, capture.journal
        if not self.snapshot.takes_typed or seen.again != again:
            return "Another pose is wanted now: look at the page, and press again."
        now_s = cell.clock.now()
        states = [
            ArmState(now_s, pose.pose, typed=line, pose_form=pose.form.name)
            for pose, line in zip(poses, typed, strict=True)
        ]
        others = [view for view in journal.views if view.number != again]
        for at, state in enumerate(states):
            if reason := why_same(state, [*others, *states[:at]]):
                return reason
        number, place = capture.next_numbers()
        numbers = [*([] if again is None else [again]), *range(number, number + len(states))]
        if not cell.is_stored:
            if len(states) > 1:
                return "The camera sees one place: type the pose of that one."
            found = capture.view_at(states[0], numbers[0], place, self._task.count)
            if isinstance(found.found, Missed):
                return found.words
        else:
            taken = pictured_views(
                cell, self._task.recorded.target, dict(zip(numbers, states, strict=False)), seen.due
            )
            if isinstance(taken, str):
                return taken
            old = [picture_name(view) for view in journal.views if view.number == again]
            self._with_pictures(lambda: capture.store(taken), old)
        self._publish(pose_form=poses[-1].form.name)
        visitor.lines = typed
        self._changed(visitor)
        return ""

    @_request
    def repose(self, visitor: Visitor, number: int, pose: PendantPose, line: str) -> str:
        """Replaces the pose of a view by one that was typed."""
        rows = {view.number: view for view in self._capture.journal.views}
        if number not in rows or rows[number].joints_rad is not None:
            return "Only the pose of a view without joints can be typed: take it again."
        state = ArmState(0.0, pose.pose, typed=line, pose_form=pose.form.name)
        others = [view for view in rows.values() if view.number != number]
        return why_same(state, others) or self._repair(visitor, {**rows, number: state})

    @_request
    def mend(self, visitor: Visitor, fault: Fault, number: int = 0, other: int = 0) -> str:
        """Mends what is wrong with a view (0: the last), or with its and another's pose."""
        poses: dict[int, View | ArmState] = {
            view.number: view for view in self._capture.journal.views
        }
        first = number or max(poses, default=0)
        if first not in poses or (fault == "exchanged" and other not in poses):
            return "Choose a view that is there."
        if fault == "no pose" or (fault == "not wanted" and not number):
            visitor.returned = self.snapshot.views[-1].pose
        return self._repair(visitor, mended_poses(poses, fault, first, other))

    def _repair(self, visitor: Visitor, poses: Mapping[int, View | ArmState]) -> str:
        """Gives the pictures of views these poses; the others are no longer in the table."""
        journal = self._capture.journal
        rows = [
            view if poses[view.number] is view else posed(view, poses[view.number])
            for view in journal.views
            if view.number in poses
        ]
        gone = [view for view in journal.views if view.number not in poses]
        # The last picture is due again.
        due = picture_name(gone[0]) if gone == [journal.views[-1]] else ""
        left_out = [] if due else map(picture_name, gone)
        self._with_pictures(lambda: journal.rewrite(rows), left_out, due)
        self._changed(visitor)
        return ""

    @_request
    def again(self, _: Visitor, number: int | None) -> None:
        """Lets the next view replace one, which stays until then; None for none."""
        is_listed = any(view.number == number for view in self._capture.journal.views)
        self._publish(again=number if is_listed else None)

    @_request
    def choose(self, _: Visitor, name: str, *, leaves_out: bool = False) -> None:
        """Makes a picture of the folder the one that is due, or leaves it out."""
        journal = self._capture.journal
        if not leaves_out:
            journal.leave_out({*journal.left_out} - {name})
        self._with_pictures(lambda: None, [name] * leaves_out, "" if leaves_out else name)

    def _with_pictures(
        self, write: Callable[[], None], left_out: Iterable[str], due: str = ""
    ) -> None:
        """Changes the table, and which pictures of a folder are left out, or is due, with it.

        A process that is killed meanwhile leaves a picture that is in the table, due or left out.
        """
        journal, camera = self._capture.journal, self._capture.cell.camera
        journal.leave_out({*journal.left_out, *filter(None, left_out)})
        write()
        journal.leave_out(journal.left_out)
        if isinstance(camera, StoredPictures) and self.snapshot.takes_typed:
            used = set(map(picture_name, journal.views))
            camera.given = (self._skipped - {due}) | used | {*journal.left_out}
            camera.chosen = due
            self._list_pictures(camera)

    def _list_pictures(self, camera: StoredPictures) -> None:
        """Publishes the names of a folder's pictures, the one that is due first."""
        waiting, left_out = tuple(camera.waiting()), self._capture.journal.left_out
        if (waiting, left_out) != (self.snapshot.waiting, self.snapshot.left_out):
            self._publish(due="".join(waiting[:1]), waiting=waiting, left_out=left_out)

    @_request
    def skip(self, _: Visitor) -> None:
        """Suggests another pose."""
        pose = self.snapshot.next_pose
        if pose is not None and pose.cam_from_target is not None:
            self._rejected.append(pose.cam_from_target)
        self._advise()

    def finish(self, visitor: Visitor) -> None:
        """Judges the views, also after the devices are closed."""
        if visitor.seen.views:
            self._requests.put(lambda: self._ask(is_trial=False))

    @_request
    def end(self, _: Visitor) -> None:
        """Closes the devices, and asks for another setup."""
        self._open.close()
        self.snapshot = Snapshot(setup=self.snapshot.setup, revision=len(self._authors))

    def picture(self, number: int) -> bytes | None:
        """The picture of a view with its corners, a JPEG; None where there is none."""
        if all(row.number != number for row in self.snapshot.views):
            return None
        coach, journal = self._capture.coach, self._capture.journal
        try:
            view = next(view for view in journal.views if view.number == number)
            image = decode_image(journal.image(view))
        except (DataError, StopIteration):
            # It was removed at this moment.
            return None
        if isinstance(image, str):
            return None
        return live_picture(image, coach.target, coach.corners.get(number), coach.lens, None)

    def close(self) -> None:
        """Ends the thread, which closes the devices."""
        self._requests.put(None)
        self._thread.join(10.0)
        self._judge.shutdown(cancel_futures=True)

    def _publish(self, **changes: object) -> None:
        self.snapshot = replace(self.snapshot, **changes)  # type: ignore[arg-type]

    def _work(self) -> None:
        """Serves requests, and between them the live picture, until it is closed."""
        while True:
            is_live = self.snapshot.phase == "live"
            try:
                # Of a folder there is nothing to be seen between two pictures.
                is_stream = is_live and not self.snapshot.is_stored
                request = self._requests.get(timeout=0.001 if is_stream else 0.1)
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
        self._previous, self._rejected, self._shown = None, [], None
        task = self._task
        cell, journal = self._open.enter_context(task.begin())
        self._capture = Capture(
            *(cell, task.recorded.target, task.recorded.robot, cell.camera.factory or task.lens),
            *(journal, task.options, None, self._taken),
        )
        self._skipped = cell.camera.given if isinstance(cell.camera, StoredPictures) else set()
        self._rest = RestWatch(journal, self._task.options.still)
        arm, usual = cell.arm, "ros" if self._task.usual is None else self._task.usual.name
        self._publish(
            phase="live",
            arm=arm.name,
            takes_typed=isinstance(arm, ManualArm),
            is_stored=cell.is_stored,
            pose_form=setup.pose_form or journal.form or usual,
            note=getattr(arm, "invitation", ""),
            missed="",
            trial=None,
            outcome=None,
        )
        self._publish(views=self._rows(), due="", waiting=(), again=None)
        self._with_pictures(lambda: None, ())
        self._advise()

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
        else:
            self._watch_folder()
        if self.snapshot.takes_typed:
            return
        if isinstance(cell.arm, RequestingArm):
            try:
                take_requested(self._capture, cell.arm, task.count, 0.01)
            except EOFError:
                self._ask(is_trial=False)
                self._stop("")
            except DriverError as error:
                if not cell.is_stored:
                    raise
                # The picture of a stop may still be saved.
                self._publish(missed=f"{error.message} {error.next_step}")
        elif isinstance(cell.arm, MovingArm) and self._rest.begins(cell.state()):
            self._capture.view(*self._capture.next_numbers(), task.count)

    def _watch_folder(self) -> None:
        """Shows the picture of a folder that is due, and the names of all."""
        camera = self._capture.cell.camera
        assert isinstance(camera, StoredPictures)
        self._list_pictures(camera)
        due = self.snapshot.due
        image = camera.look(due) if due else "no further picture is there"
        if isinstance(image, str):
            self._shown = None
            if image != self.snapshot.sees:
                self._publish(sees=image)
        elif image is not self._shown:
            found, _ = find_corners(grey_of(image), self._task.recorded.target, 0)
            self._show(image, found)
            self._shown = image

    def _show(self, image: Image, found: Corners | Rejection) -> None:
        """Publishes a picture with what is found in it."""
        corners = found if isinstance(found, Corners) else None
        pose = self.snapshot.next_pose
        # A picture of a folder is not where the next one is to be.
        wanted = None if pose is None or self.snapshot.is_stored else pose.cam_from_target
        sees = sight_words(found) if isinstance(found, Corners) else found.reason
        coach = self._capture.coach
        picture = live_picture(image, coach.target, corners, coach.lens, wanted)
        self._publish(picture=picture, pictures=self.snapshot.pictures + 1, sees=sees)

    def _taken(self, step: CaptureEvent) -> None:
        """Publishes what became of a stop of an arm that says itself where it stands."""
        if self.snapshot.takes_typed:
            return
        if not isinstance(step.found, TakenView):
            self._publish(missed=step.words)
            return
        self._publish(pose_form=step.found.state.pose_form or self.snapshot.pose_form)
        self._changed(None)

    def _changed(self, author: Visitor | None) -> None:
        """Publishes the table, and tries a calibration of it."""
        self._authors.append(author)
        self._capture.reconcile()
        now = self.snapshot
        self._publish(trial=now.outcome or now.trial, outcome=None, missed="", again=None)
        self._publish(views=self._rows(), outdated=self._outdated(), revision=len(self._authors))
        self._after_change()

    def _rows(self) -> tuple[Row, ...]:
        now, capture = self.snapshot, self._capture
        outcome, form = now.outcome or now.trial, POSE_FORMS[now.pose_form]
        return table_rows(capture.journal.views, capture.coach.corners, outcome, form)

    def _outdated(self) -> str:
        """The change since the newest outcome, in words."""
        outcome, views = self.snapshot.outcome or self.snapshot.trial, self._capture.journal.views
        if outcome is None or outcome.views == views:
            return ""
        added = len(views) - len(outcome.views)
        return f"{counted(added, 'view')} added since" if added > 0 else "the table changed since"

    def _after_change(self) -> None:
        count = len(self._capture.journal.views)
        if self._task.count and count >= self._task.count:
            self._ask(is_trial=False)
        elif count >= 5 and not self._task.stops:
            self._ask(is_trial=True)
        self._advise()

    def _ask(self, *, is_trial: bool) -> None:
        """Runs the judging command beside the recording; a trial, without its drawings."""
        views = self._capture.journal.views
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
        views = self._capture.journal.views
        if outcome.folder == self._task.result:
            self._publish(outcome=outcome, is_judging=False)
        elif self.snapshot.phase == "live" and (outcome.document or outcome.views == views):
            # One without a result may have met the table while it changed.
            self._publish(trial=outcome)
            coach, fitted = self._capture.coach, outcome.document.get("camera")
            if fitted and coach.camera is None:
                numbers = (np.array(fitted[name]) for name in ("matrix", "distortion"))
                coach.camera = Camera(fitted["model"], coach.resolution, *numbers)
                for corners in [*coach.corners.values()]:
                    coach.add(corners)
            self._advise()
        self._publish(views=self._rows(), outdated=self._outdated())

    def _advise(self) -> None:
        """Publishes the coverage, and the next pose."""
        unseen = self._capture.coach.unseen()
        coach, task, taken = self._capture.coach, self._task, len(self._capture.journal.views)
        pose: NextPose | None
        if task.count and taken >= task.count:
            pose = NextPose("All views are there.")
        elif task.stops:
            at = taken + len(self._rejected)
            pose = task.stops[at] if at < len(task.stops) else None
        else:
            recorded, trial = self._task.recorded, self.snapshot.trial
            good = {} if trial is None or trial.light == "red" else trial.document
            edges = [np.array(edge["matrix"]) for edge in good.get("transforms", {}).values()]
            states = map(state_of, self._capture.journal.views)
            stood = [state.base_from_flange for state in states if state is not None]
            place = partial(flange_at, recorded.mount, *edges) if edges else None
            pose = suggested_pose(coach, self._rejected, place, stood)
        self._publish(
            coverage=coverage_svg(coach.covered, coach.poses),
            advice=f"{coach.words()}{f'; the board was hardly in the {unseen}' if unseen else ''}",
            next_pose=pose,
        )
