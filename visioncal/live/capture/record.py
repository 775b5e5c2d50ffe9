"""Driving the stops of a plan and taking a view at each."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np

from visioncal.core.errors import DataError, DriverError, VisioncalError
from visioncal.core.transforms import pose_difference
from visioncal.core.types import Camera, FloatArray
from visioncal.live.capture.coach import Coach
from visioncal.live.capture.core import Capture, CaptureEvent, Watcher
from visioncal.live.capture.drive import JointPace, drive, joints_of
from visioncal.live.capture.joint_pose_check import JointPoseCheck
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.live import LiveCell
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.predict import PlannedAccuracy
from visioncal.live.drivers.protocols import MovingArm
from visioncal.live.planning.path import ordered
from visioncal.live.planning.read_back import PlanFile, Stop

# A stop takes about so long besides the way to it [s].
_STOP_S = 1.5
# A nominal model is nearer to its own arm; beyond, the plan is for another one, or another base.
_SAME_ARM_MM = 50.0
# An arm this near to where the plan has it is there [rad].
_THERE_RAD = 5e-3


@dataclass(frozen=True, eq=False)
class Departure:
    """What is about to happen, before anything moves.

    Attributes:
        stops: The stops that have no view yet.
        first: The postures (n,) on the way to the first stop, its own last; empty where no stop is
            left.
        turn_rad: How far the joint turns that turns farthest on that way [rad].
        duration_s: How long all will take, about [s].
    """

    stops: tuple[Stop, ...]
    first: tuple[FloatArray, ...]
    turn_rad: float
    duration_s: float


def departure(
    cell: LiveCell, plan: PlanFile, done: Sequence[int], options: CaptureOptions
) -> Departure:
    """Looks at what is to be driven; nothing moves.

    Args:
        cell: The devices.
        plan: The stops.
        done: The views that are on the disk.
        options: Speed and acceleration.

    Raises:
        DriverError: The arm does not report where it is, or is stopped.
        DataError: The plan is for another arm, or the way to the first stop cannot be shown to be
            free.
    """
    here = joints_of(cell)
    _check_model(cell, plan, here)
    stops = tuple(stop for stop in plan.stops if stop.view not in done)
    if not stops:
        return Departure((), (), 0.0, 0.0)
    first = CheckedPaths(plan).to(stops[0], here)
    way = [here, *first, *(q for stop in stops[1:] for q in (*stop.via, stop.q))]
    turns = np.abs(np.diff(np.array([here, *first]), axis=0)).sum(axis=0)
    duration_s = JointPace.of(options).way_s(way) + _STOP_S * len(stops)
    return Departure(stops, first, float(turns.max()), duration_s)


def record(
    cell: LiveCell,
    plan: PlanFile,
    journal: Journal,
    options: CaptureOptions,
    watchers: Sequence[Watcher] = (),
    *,
    lens: Camera | None = None,
) -> list[CaptureEvent]:
    """Records the stops of a plan that have no view yet.

    However it ends, the arm stands still and every reported view is on the disk.

    Args:
        cell: The devices; its arm can be driven.
        plan: The stops.
        journal: Where the views go.
        options: How they are taken.
        watchers: Who is notified of each.
        lens: The intrinsics that the camera reports; else those of the plan are good enough for
            tilts and distances.

    Returns:
        What became of each stop.

    Raises:
        DriverError: A device failed, the arm was stopped, or Ctrl-C came.
        DataError: A view cannot be written, no clear way leads to a stop, or three stops in a row
            gave no view.
    """
    arm = cell.arm
    if not isinstance(arm, MovingArm):
        raise DriverError(
            f"{arm.name} cannot be driven.",
            culprits=[arm.name],
            next_step="Guide it by hand: --follow.",
        )
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
    left = [stop for stop in plan.stops if stop.view not in done]
    ways = CheckedPaths(plan)
    with closed_cleanly(cell, journal, options):
        for at, stop in enumerate(left):
            begun = cell.clock.now()
            way = ways.to(stop, joints_of(cell))
            drive(cell, arm, way, options, look=journal.check_room)
            moved_s = cell.clock.now() - begun
            place = len(plan.stops) - len(left) + at + 1
            onward = left[at + 1].view if at + 1 < len(left) else None
            advise = partial(capture.onward, onward)
            capture.view(stop.view, place, len(plan.stops), moved_s, advise)
    return capture.steps


@contextmanager
def closed_cleanly(cell: LiveCell, journal: Journal, options: CaptureOptions) -> Iterator[None]:
    """Runs a recording, after which the arm stands still; says what is on the disk if it fails.

    Args:
        cell: The arm and the camera.
        journal: What was written.
        options: How views are taken.

    Raises:
        DriverError: A device failed, or Ctrl-C came.
        DataError: The recording could not go on for another reason.
    """
    try:
        with cell.halting():
            yield
    except KeyboardInterrupt:
        raise DriverError(
            f"stopped by Ctrl-C or a signal; the arm was halted. {_kept_words(journal)}",
            culprits=["Ctrl-C"],
            next_step=_again(journal, options),
        ) from None
    except VisioncalError as error:
        message = f"{error.message} {_kept_words(journal)}"
        step = error.next_step
        if "--resume" not in step:
            step = f"{step} {_again(journal, options)}".strip()
        raise type(error)(message, culprits=error.culprits, next_step=step) from error


def _again(journal: Journal, options: CaptureOptions) -> str:
    """How a recording that failed is continued."""
    if options.single and journal.views:
        return "A folder begins with its first picture again: record all of it into a new session."
    return "Go on with --resume."


def _kept_words(journal: Journal) -> str:
    """Says what is on the disk."""
    count = len(journal.views)
    if not count:
        return f"No view was taken; {journal.folder} is no session yet."
    return f"{count} view{'s are' if count > 1 else ' is'} safe in {journal.folder}."


def _check_model(cell: LiveCell, plan: PlanFile, here: FloatArray) -> None:
    """Checks that the arm is the plan's: its ways were looked at with that arm in that base."""
    robot = plan.cell.robot
    if len(here) != robot.joint_count:
        raise DataError(
            f"{cell.arm.name} has {len(here)} joints, and the plan is for {robot.name} with "
            f"{robot.joint_count}.",
            culprits=["--arm", "--plan"],
            next_step="Plan for the arm that is connected.",
        )
    reported = cell.state().base_from_flange
    off_mm, off_deg = pose_difference(robot.base_from_flange(here[None])[0], reported)
    if off_mm > _SAME_ARM_MM:
        raise DataError(
            f"{cell.arm.name}: its flange is {off_mm:.0f} mm and {off_deg:.0f} deg from where the "
            f"plan's {robot.name} has it at these joints (limit {_SAME_ARM_MM:.0f} mm).",
            culprits=["--plan"],
            next_step="Plan for the arm that is connected, in its controller's base.",
        )


@dataclass(frozen=True, eq=False)
class CheckedPaths:
    """Ways that were looked at: those of the plan, and others where the arm stands elsewhere."""

    plan: PlanFile

    def to(self, stop: Stop, here: FloatArray) -> tuple[FloatArray, ...]:
        """Finds the way to a stop.

        Args:
            stop: One of the plan.
            here: (n,) where the joints are [rad].

        Returns:
            The postures (n,) to drive through, the last of which is the stop's.

        Raises:
            DataError: No way that is clear of everything declared was found, or the arm stands too
                near to something.
        """
        if _there(here, stop.q):
            return (stop.q,)
        at = self.plan.stops.index(stop)
        planned = self.plan.stops[at - 1].q if at else self.plan.start_q
        if planned is not None and _there(here, planned):
            return (*stop.via, stop.q)
        self._check_limits(here)
        route = ordered(self.plan.cell, here, stop.q[None])
        if route.unreachable:
            (obstacle,) = route.unreachable.values()
            stands = ", ".join(f"{value:.0f}" for value in np.rad2deg(here))
            raise DataError(
                f"view {stop.view}: no clear way leads there from where the arm stands "
                f"({stands} deg): in the way are {obstacle}.",
                culprits=[f"view {stop.view}"],
                next_step="Bring the arm near to the plan's first stop by hand, or plan anew with "
                "--start-joints as it stands.",
            )
        return (*route.segments[0], stop.q)

    def _check_limits(self, here: FloatArray) -> None:
        robot = self.plan.cell.robot
        outside = (here < robot.lower_rad) | (here > robot.upper_rad)
        if outside.any():
            joint = robot.joint_names[int(np.argmax(outside))]
            raise DataError(
                f"{joint} stands at {np.rad2deg(here[np.argmax(outside)]):.1f} deg, outside the "
                f"limits of {robot.name}.",
                culprits=[joint],
                next_step="Turn it back by hand.",
            )


def _there(here: FloatArray, posture: FloatArray) -> bool:
    return here.shape == posture.shape and bool(np.abs(here - posture).max() < _THERE_RAD)
