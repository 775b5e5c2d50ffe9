"""Driving the stops of a plan and taking a view at each."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np

from visioncal.core.errors import DriverError, VisioncalError
from visioncal.core.types import Camera, FloatArray
from visioncal.live.capture.coach import Coach
from visioncal.live.capture.core import Capture, CaptureEvent, Watcher
from visioncal.live.capture.drive import JointPace, joints_of
from visioncal.live.capture.gate import Consent, Gate, check_same_arm, clear_path
from visioncal.live.capture.joint_pose_check import JointPoseCheck
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.live import LiveCell
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.predict import PlannedAccuracy
from visioncal.live.planning.plan_file import PlanFile, Stop

# Typical duration of a stop besides the motion to it [s].
_STOP_S = 1.5
# Timeout of a picture while the arm moves [s].
_FRAME_S = 0.5
# Largest joint difference at which an arm counts as being at a posture [rad].
_ARRIVED_RAD = 5e-3


@dataclass(frozen=True, eq=False)
class MotionSummary:
    """Summary of a recording before anything moves."""

    stops: tuple[Stop, ...]  # Stops that have no view yet.
    # Postures (n,) to the first stop, its own last; empty where no stop is left.
    first: tuple[FloatArray, ...]
    turn_rad: float  # Largest joint travel on that path [rad].
    duration_s: float  # Approximate duration of the recording [s].


def motion_summary(
    cell: LiveCell, plan: PlanFile, done: Sequence[int], options: CaptureOptions
) -> MotionSummary:
    """Checks and summarises what is to be driven, without the views `done`; nothing moves.

    Raises:
        DriverError: The arm does not report its joints, or is stopped.
        DataError: The plan is for another arm, or no safe path to the first stop was found.
    """
    here = joints_of(cell.live)
    check_same_arm(cell.live, plan.cell.robot, here)
    stops = tuple(stop for stop in plan.stops if stop.view not in done)
    if not stops:
        return MotionSummary((), (), 0.0, 0.0)
    first = CheckedPaths(plan).to(stops[0], here)
    postures = [here, *first, *(q for stop in stops[1:] for q in (*stop.via, stop.q))]
    turns = np.abs(np.diff(np.array([here, *first]), axis=0)).sum(axis=0)
    duration_s = JointPace.of(options).path_duration_s(postures) + _STOP_S * len(stops)
    return MotionSummary(stops, first, float(turns.max()), duration_s)


def record(
    cell: LiveCell,
    plan: PlanFile,
    journal: Journal,
    options: CaptureOptions,
    consent: Consent,
    watchers: Sequence[Watcher] = (),
    *,
    lens: Camera | None = None,
) -> list[CaptureEvent]:
    """Records the stops of a plan that have no view yet, and returns their results.

    However it ends, the arm is halted and every reported view is on the disk. Without the
    intrinsics of the camera, those of the plan are good enough for tilts and distances.

    Raises:
        DriverError: A device failed, the arm was stopped, or Ctrl-C was pressed.
        DataError: A view cannot be written, no safe path leads to a stop, consent is refused, or
            three stops in a row gave no view.
    """
    capture = Capture(
        cell,
        plan.cell.target,
        journal,
        options,
        JointPoseCheck(plan.cell.robot),
        Coach(plan.cell.target, cell.camera.resolution, lens or plan.cell.camera),
        PlannedAccuracy.of(plan),
        watchers,
    )
    capture.catch_up()
    done = {view.number for view in journal.views}
    remaining = [stop for stop in plan.stops if stop.view not in done]
    paths = CheckedPaths(plan)
    gate = Gate(cell.live, plan.cell.robot, consent, JointPace.of(options))

    def look() -> None:
        # A failure is reported now, not at the end of a long motion.
        cell.camera.frame(timeout_s=_FRAME_S)
        journal.check_room()

    with closed_cleanly(cell, journal, options):
        for index, stop in enumerate(remaining):
            path = paths.to(stop, joints_of(cell.live))
            moved_s = gate.move(path, f"to view {stop.view}", look)
            place = len(plan.stops) - len(remaining) + index + 1
            next_view = remaining[index + 1].view if index + 1 < len(remaining) else None
            advise = partial(capture.onward, next_view)
            capture.view(stop.view, place, len(plan.stops), moved_s, advise)
    return capture.steps


@contextmanager
def closed_cleanly(cell: LiveCell, journal: Journal, options: CaptureOptions) -> Iterator[None]:
    """Halts the arm if a recording fails, and adds what is on the disk to the error.

    Raises:
        DriverError: A device failed, or Ctrl-C was pressed.
        DataError: The recording failed for another reason.
    """
    try:
        with cell.live.halting():
            yield
    except KeyboardInterrupt:
        raise DriverError(
            f"stopped by Ctrl-C or a signal; the arm was halted. {_kept_words(journal)}",
            culprits=["Ctrl-C"],
            next_step=_resume_advice(journal, options),
        ) from None
    except VisioncalError as error:
        message = f"{error.message} {_kept_words(journal)}"
        step = error.next_step
        if "--resume" not in step:
            step = f"{step} {_resume_advice(journal, options)}".strip()
        raise type(error)(message, culprits=error.culprits, next_step=step) from error


def _resume_advice(journal: Journal, options: CaptureOptions) -> str:
    """Advice on continuing a recording that failed."""
    if options.single and journal.views:
        return "A folder begins with its first picture again: record all of it into a new session."
    return "Go on with --resume."


def _kept_words(journal: Journal) -> str:
    """States what is on the disk."""
    count = len(journal.views)
    if not count:
        return f"No view was taken; {journal.folder} is no session yet."
    return f"{count} view{'s are' if count > 1 else ' is'} safe in {journal.folder}."


@dataclass(frozen=True, eq=False)
class CheckedPaths:
    """Collision-checked paths: the plan's, or new ones where the arm is elsewhere."""

    plan: PlanFile

    def to(self, stop: Stop, q: FloatArray) -> tuple[FloatArray, ...]:
        """Finds the postures (n,) to drive through from joints (n,) to a stop of the plan [rad].

        Raises:
            DataError: No path clear of everything declared was found, or the arm is too near to
                something.
        """
        if _is_at(q, stop.q):
            return (stop.q,)
        index = self.plan.stops.index(stop)
        planned = self.plan.stops[index - 1].q if index else self.plan.start_q
        if planned is not None and _is_at(q, planned):
            return (*stop.via, stop.q)
        return clear_path(self.plan.cell, q, stop.q, f"view {stop.view}")


def _is_at(q: FloatArray, posture: FloatArray) -> bool:
    return q.shape == posture.shape and bool(np.abs(q - posture).max() < _ARRIVED_RAD)
