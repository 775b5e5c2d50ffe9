"""Recording with an arm guided by hand: a view whenever it rests, or on request."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.transforms import pose_difference
from visioncal.core.types import FloatArray
from visioncal.live.capture.core import Capture, CaptureEvent
from visioncal.live.capture.live import Clock, LiveCell
from visioncal.live.capture.options import Stillness
from visioncal.live.capture.record import closed_cleanly
from visioncal.live.capture.still import why_arm_moves
from visioncal.live.capture.take import TakenView
from visioncal.live.drivers.protocols import Arm, ArmState

# Polling interval of a guided arm [s].
_POLL_S = 0.05
# Least distance of a new pose from all others [mm], [deg].
_NEW_MM, _NEW_DEG = 20.0, 5.0


@dataclass(frozen=True, eq=False)
class HeldArm:
    """An arm that stays at a given pose."""

    name: str
    reported: ArmState  # Its state when it was read.
    clock: Clock  # Clock of the state's stamps.

    def state(self) -> ArmState:
        """The state, stamped now."""
        return replace(self.reported, stamp_s=self.clock.now())

    def close(self) -> None:
        """Holds no resources."""


def follow(capture: Capture, count: int) -> list[CaptureEvent]:
    """Takes `count` views (0: until Ctrl-C), one whenever a guided arm rests at a new pose.

    Raises:
        DriverError: A device failed, or the arm is stopped.
        DataError: A view cannot be written, or too many rests in a row gave none.
    """
    capture.catch_up()
    poses = [view.base_from_flange() for view in capture.journal.views]
    visited = [np.asarray(pose.as_matrix()) for pose in poses if pose is not None]
    with closed_cleanly(capture.cell, capture.journal, capture.options):
        try:
            while not count or len(capture.journal.views) < count:
                state, took_s = _rest(capture.cell, visited, capture.options.still)
                visited.append(state.base_from_flange)
                place = len(capture.journal.views) + 1
                step = capture.view(
                    _next_number(capture), place, count, took_s, capture.coach.advice
                )
                if isinstance(step.found, TakenView):
                    # The arm may have been moved on while the rest was waited for.
                    visited.append(step.found.state.base_from_flange)
        except KeyboardInterrupt:
            # Ctrl-C is the regular end of a recording without a number of views.
            if not capture.journal.views:
                raise DriverError(
                    "ended by Ctrl-C before the first view.",
                    next_step="Guide the arm to where the camera sees the board, and let it rest.",
                ) from None
    return capture.steps


def ask_and_take(
    capture: Capture, arm: Arm, count: int, ask: Callable[[str], str] | None
) -> list[CaptureEvent]:
    """Takes a view whenever a person requests it, and asks for its pose.

    Args:
        capture: The recording.
        arm: The arm that asks for the pose.
        count: Number of views; 0 until `q`.
        ask: Asks a question and returns the line that was typed; None where the poses are read from
            a file.

    Raises:
        DriverError: The camera failed, or Ctrl-C was pressed.
        DataError: A view cannot be written, or too many in a row gave none.
    """
    capture.catch_up()
    camera, clock = capture.cell.camera, capture.cell.clock
    with closed_cleanly(capture.cell, capture.journal, capture.options):
        while not count or len(capture.journal.views) < count:
            number = _next_number(capture)
            wish = capture.coach.advice()
            hint = f" ({wish})" if wish else ""
            if ask is not None and _ends(ask, f"View {number}{hint}: Enter takes it, q ends: "):
                break
            try:
                held = HeldArm(arm.name, arm.state(), clock)
            except EOFError:
                break
            capture.cell = LiveCell(held, camera, clock)
            place = len(capture.journal.views) + 1
            capture.view(number, place, count, 0.0, capture.coach.advice)
    return capture.steps


def _ends(ask: Callable[[str], str], question: str) -> bool:
    try:
        return ask(question).strip().lower() == "q"
    except EOFError:
        # End of a file of answers.
        return True


def _rest(
    cell: LiveCell, visited: Sequence[FloatArray], still: Stillness
) -> tuple[ArmState, float]:
    """Waits until the arm rests at a new pose; returns its state and the waiting time [s]."""
    start = cell.clock.now()
    first = cell.state()
    while True:
        cell.clock.sleep(_POLL_S)
        state = cell.state()
        if why_arm_moves(first, state, still):
            first = state
        elif state.stamp_s - first.stamp_s >= still.quiet_s and _is_new(state, visited):
            return state, cell.clock.now() - start


def _is_new(state: ArmState, visited: Sequence[FloatArray]) -> bool:
    for pose in visited:
        mm, deg = pose_difference(pose, state.base_from_flange)
        if mm < _NEW_MM and deg < _NEW_DEG:
            return False
    return True


def _next_number(capture: Capture) -> int:
    return 1 + max((view.number for view in capture.journal.views), default=0)
