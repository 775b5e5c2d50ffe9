"""Arms of Universal Robots, through the client library ur-rtde.

Its control interface serves one call at a time and, if the controller falls silent, may not return
for minutes. One thread owns it; callers wait no longer than their timeout.
"""

import ctypes
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import closing, suppress
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS
from visioncal.core.errors import DriverError
from visioncal.core.extras import client_library
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray
from visioncal.live.drivers.protocols import ArmState, Safety, Stopwatch
from visioncal.live.drivers.ur_net import (
    SCRIPT_PORT,
    Dashboard,
    check_states_come,
    connect,
    read_condition,
    read_tool_offset,
    safety_of,
)

_EXTRA = "ur"
# Fast compared with the arm's motion, at a small load of the computer.
_RATE_HZ = 125.0
# Timeout of a call [s]; it takes three or four states, 30 ms.
_CALL_S = 0.9
# The controller ends its program, and stops the arm, where this computer is silent for 1 s.
_LEAST_HZ, _KICK_S = 1.0, 0.1
# Timeout of the start of an asynchronous motion [s].
_BEGIN_S = 0.5
# Silence after which a controller, which sends every 8 ms, counts as lost [s].
_SILENCE_S = 0.8
# The client library's limits [rad/s, rad/s^2].
_SPEED_LIMIT, _ACCELERATION_LIMIT = 3.14, 40.0

# State rates of CB3 and all later ones, by PolyScope's major version.
_RATES_HZ, _LATER_HZ = {3: 125.0}, 500.0
# Only names in the client's own table of variables: an unknown one would silently shift all that
# follow.
_VARIABLES = (
    *("timestamp", "actual_q", "actual_qd", "actual_current", "actual_TCP_pose"),
    *("joint_temperatures", "robot_mode", "runtime_state", "robot_status_bits"),
    "safety_status_bits",
)
# Variables of newer controllers, and the first version, by major version.
_PAYLOAD = ("payload", "payload_cog")
_REPORTS_PAYLOAD = {3: (3, 11, 0), 5: (5, 5, 1)}
T = TypeVar("T")
# Python exceptions for the C++ ones that the library throws.
_THROWN = (RuntimeError, ValueError)


class CallThread:
    """Worker thread that runs calls in order, and a periodic task [s] while there are none."""

    def __init__(self, name: str, idle: Callable[[], None], every_s: float) -> None:
        self._name = name
        self._idle, self._every_s = idle, every_s
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        # A daemon: a call that never returns must not keep the program from ending.
        threading.Thread(target=self._work, name=name, daemon=True).start()

    def call(self, work: Callable[[], T], what: str) -> T:
        """Runs a call in the thread, with a timeout; `what` it does is for messages.

        Raises:
            DriverError: It threw, or did not return in time.
        """
        future: Future[T] = Future()

        def run() -> None:
            try:
                future.set_result(work())
            except _THROWN as error:
                future.set_exception(error)

        self._jobs.put(run)
        waiting = Stopwatch()
        try:
            while not wait([future], 0.05).done:
                if waiting.read() > _CALL_S:
                    raise DriverError(
                        f"{self._name} did not {what} within {_CALL_S:.1f} s.",
                        culprits=[self._name],
                        next_step="Look at the pendant and at the network cable.",
                    )
            return future.result()
        except _THROWN as error:
            raise DriverError(
                f"{self._name} could not {what}: {error}.", culprits=[self._name]
            ) from error

    def end(self) -> None:
        """Ends the thread after the queued calls."""
        self._jobs.put(None)

    def _work(self) -> None:
        while True:
            try:
                job = self._jobs.get(timeout=self._every_s)
            except queue.Empty:
                self._idle()
                continue
            if job is None:
                return
            job()


class StateStream:
    """States of a controller in the order of arrival.

    Args:
        library: The module `rtde_receive`.
        host: The controller's address.
        version: PolyScope's version.
        rate_hz: Requested states per second.
    """

    def __init__(
        self, library: ModuleType, host: str, version: tuple[int, int, int], rate_hz: float
    ) -> None:
        self._host = host
        self.reports_payload = version >= _REPORTS_PAYLOAD.get(version[0], ())
        names = [*_VARIABLES, *(_PAYLOAD if self.reports_payload else ())]
        try:
            self.client: Any = library.RTDEReceiveInterface(host, rate_hz, names)
        except RuntimeError as error:
            raise DriverError(
                f"The states of the controller at {host} cannot be read: {error}.", culprits=[host]
            ) from error
        self._newest = self.client.getTimestamp()
        self._silence = Stopwatch()
        self._delays: deque[tuple[float, float]] = deque()

    @property
    def alive(self) -> bool:
        """Whether states arrive."""
        stamp = self.client.getTimestamp()
        if stamp != self._newest:
            self._newest = stamp
            self._silence.restart()
        return bool(self.client.isConnected()) and self._silence.read() < _SILENCE_S

    def check(self) -> None:
        """Checks that states arrive; raises DriverError."""
        if self.alive:
            return
        how = (
            f"it has sent nothing for {self._silence.read():.1f} s"
            if self.client.isConnected()
            else "it closed the connection"
        )
        raise DriverError(
            f"The controller at {self._host} is lost: {how}.",
            culprits=[self._host],
            next_step="Look at the robot: it may be switched off, or its cable is out. Connect "
            "again once the pendant has started.",
        )

    def wait(self) -> tuple[float, float]:
        """Waits for a state that is sent after the call.

        Returns:
            The controller's timestamp, and the same by the monotonic clock [s].

        Raises:
            DriverError: None arrives.
        """
        before = self.client.getTimestamp()
        while (stamp := float(self.client.getTimestamp())) == before:
            self.check()
            time.sleep(0.0005)
        now = time.monotonic()
        self._newest = stamp
        self._silence.restart()
        self._delays.append((now, now - stamp))
        # Clocks drift by less than a millisecond in 10 s.
        while self._delays[0][0] < now - 10.0:
            self._delays.popleft()
        # The shortest recent delay counts: a state may be noticed late, but never early.
        return stamp, stamp + min(delay for _, delay in self._delays)

    @property
    def safety(self) -> Safety:
        """State of the safety system."""
        return safety_of(int(self.client.getSafetyStatusBits()))

    def disconnect(self) -> threading.Thread:
        """Disconnects in a thread: a client whose controller is gone may not return at all."""
        keep(self.client)
        disconnecting = threading.Thread(target=self.client.disconnect, daemon=True)
        disconnecting.start()
        return disconnecting


class UrArm:
    """A UR arm, e-Series or CB-series, as a `MovingArm`.

    Args:
        host: The controller's address.
        watch_only: Whether only states are read, as while it is guided by hand: it then needs no
            remote control, and cannot be moved from here. The tool offset is read once.
        full_rate: Whether all states of the controller are asked for, up to 500 a second.

    Raises:
        DriverError: The client library is missing; the host is unreachable or no UR; the arm is
            off, stopped or in local control; each with a remedy.
    """

    def __init__(self, host: str, *, watch_only: bool = False, full_rate: bool = False) -> None:
        receive = client_library("rtde_receive", _EXTRA)
        control = None if watch_only else client_library("rtde_control", _EXTRA)
        self._host = host
        # By plain connections first, as the library's constructors have no timeout.
        condition = read_condition(host)
        if watch_only:
            condition.check_reports()
        else:
            condition.check_moves()
            connect(host, SCRIPT_PORT, "programs").close()
        check_states_come(host)
        self.name = f"{condition.model} at {host}"
        # Visioncal's name of the model, such as `ur10e`.
        self.model = condition.model.lower()
        self.rate_hz = _RATES_HZ.get(condition.version[0], _LATER_HZ) if full_rate else _RATE_HZ
        self._states = StateStream(receive, self._host, condition.version, self.rate_hz)
        self._control: Any = None
        self._line: CallThread | None = None
        self._moves_before: int | None = None
        self._motion_timer = Stopwatch()
        self._closed = False
        # RTDE's `robot_mode` in which joints report their positions: idle, backdrive, running.
        if condition.is_polyscope_x and self._states.client.getRobotMode() not in (5, 6, 7):
            self.close()
            raise DriverError(
                f"The {self.name} does not know where its joints are: it is not switched on.",
                culprits=[host],
                next_step="Switch it on at the pendant, and release its brakes.",
            )
        if control is None:
            self._flange_from_tool = _matrix(read_tool_offset(self._host))
            return
        try:
            try:
                self._control = control.RTDEControlInterface(self._host, _RATE_HZ)
            except RuntimeError as error:
                raise self._explained_error(f"does not take the control script: {error}") from error
            self._line = CallThread(self.name, self._kick_watchdog, _KICK_S)
            offset = self._line.call(self._control.getTCPOffset, "report its tool offset")
            self._flange_from_tool = _matrix(offset)
            self._enable_watchdog(self._line)
        except DriverError:
            self.close()
            raise

    def state(self) -> ArmState:
        """Waits for the next state that the controller sends.

        A stop by the safety system is part of the state, not an error.

        Raises:
            DriverError: None comes for 0.8 s.
        """
        self._check_open()
        client = self._states.client
        while True:
            stamp, stamp_s = self._states.wait()
            pose, q, dq = client.getActualTCPPose(), client.getActualQ(), client.getActualQd()
            currents, temperatures = client.getActualCurrent(), client.getJointTemperatures()
            payload_kg, payload_m = None, None
            if self._states.reports_payload:
                payload_kg = float(client.getPayload())
                payload_m = np.array(client.getPayloadCog())
            safety = self._states.safety
            # Otherwise values of a newer state are among them.
            if client.getTimestamp() == stamp:
                break
        return ArmState(
            stamp_s=stamp_s,
            base_from_flange=_matrix(pose) @ invert(self._flange_from_tool),
            q=np.array(q),
            dq=np.array(dq),
            flange_from_tool=self._flange_from_tool,
            payload_kg=payload_kg,
            payload_m=payload_m,
            currents_a=np.array(currents),
            temperatures_c=np.array(temperatures),
            safety=safety,
            controller_s=stamp,
        )

    def start_move(self, q: FloatArray, *, speed: float, acceleration: float) -> None:
        """Starts a motion to a posture and returns; see `MovingArm`.

        Raises:
            DriverError: It was opened to be watched only, is lost or stopped, or the controller
                refuses.
        """
        goal = np.asarray(q, dtype=float)
        if goal.shape != (6,) or not np.isfinite(goal).all():
            raise DriverError(f"A motion of a UR must have six joint angles, not {goal.tolist()}.")
        if not (0.0 < speed <= _SPEED_LIMIT and 0.0 < acceleration <= _ACCELERATION_LIMIT):
            raise DriverError(
                f"A motion is at {speed:g} rad/s and {acceleration:g} rad/s^2, but must be at "
                f"more than 0 and at most {_SPEED_LIMIT} and {_ACCELERATION_LIMIT}."
            )
        self._check_open()
        line = self._line
        if line is None:
            raise DriverError(
                f"The {self.name} is only watched; it cannot be moved from here.",
                culprits=[self.name],
                next_step="Move it by hand, or open it for moving.",
            )
        self._states.check()
        self._check_safety()
        if not self._control.isProgramRunning():
            read_condition(self._host).check_moves()
            line.call(self._control.reuploadScript, "take the control script")
            timer = Stopwatch()
            while not self._control.isProgramRunning():
                if timer.read() > _CALL_S:
                    raise self._explained_error("does not run the control script")
                time.sleep(0.01)
            self._enable_watchdog(line)
        before = self._control.getAsyncOperationProgressEx().changeCount()
        accepted = line.call(
            lambda: self._control.moveJ(goal.tolist(), speed, acceleration, True), "take a motion"
        )
        if not accepted:
            raise self._explained_error("refused a motion")
        self._moves_before = before
        self._motion_timer.restart()

    def moving(self) -> bool:
        """Whether the last motion is still in progress.

        Raises:
            DriverError: It was interrupted: the controller is lost, a safety stop, or its program
                ended.
        """
        self._check_open()
        self._states.check()
        if self._moves_before is None:
            # Slower is noise of a joint at rest [rad/s].
            return bool(np.abs(self._states.client.getActualQd()).max() > 1e-3)
        self._check_safety()
        if not self._control.isProgramRunning():
            self._moves_before = None
            raise self._explained_error(
                "ended its program during a motion, as it does where this computer is silent for "
                f"{1.0 / _LEAST_HZ:.0f} s"
            )
        progress = self._control.getAsyncOperationProgressEx()
        if progress.isAsyncOperationRunning():
            return True
        if progress.changeCount() == self._moves_before:
            if self._motion_timer.read() < _BEGIN_S:
                return True
            raise self._explained_error(f"did not begin a motion within {_BEGIN_S} s")
        self._moves_before = None
        return False

    def halt(self) -> None:
        """Brakes at once; harmless where nothing moves or the connection is lost."""
        if self._line is None or self._closed:
            return
        self._moves_before = None
        if self._states.alive:
            with suppress(DriverError):
                # The call returns when the arm starts to brake, by 4 rad/s^2: a joint at 1 rad/s
                # stops within a quarter of a second.
                self._line.call(lambda: self._control.stopJ(4.0, True), "stop")
                return
        # A controller whose states no longer arrive may still receive commands, within 0.3 s.
        with suppress(DriverError), closing(Dashboard(self._host, 0.3)) as dashboard:
            dashboard.ask("stop")

    def close(self) -> None:
        """Disconnects, after a halt where it was moving; may be called twice."""
        if self._closed:
            return
        if self._moves_before is not None:
            self.halt()
        self._closed = True
        # Each disconnection sleeps for half a second, so they run in parallel.
        disconnecting_states = self._states.disconnect()
        ends_s = time.monotonic() + _CALL_S
        if self._line is not None:
            keep(self._control)
            with suppress(DriverError):
                self._line.call(self._disconnect_control, "close")
            self._line.end()
        disconnecting_states.join(max(0.0, ends_s - time.monotonic()))

    def _enable_watchdog(self, line: CallThread) -> None:
        """Makes the controller stop the arm if this computer falls silent."""
        line.call(lambda: self._control.setWatchdog(_LEAST_HZ), "set its watchdog")

    def _kick_watchdog(self) -> None:
        """Resets the controller's watchdog."""
        with suppress(RuntimeError):
            if self._states.alive and self._control.isProgramRunning():
                self._control.kickWatchdog()

    def _disconnect_control(self) -> None:
        if self._states.alive and self._control.isProgramRunning():
            self._control.stopScript()
        self._control.disconnect()

    def _check_open(self) -> None:
        if self._closed:
            raise DriverError(f"The {self.name} was closed.", culprits=[self.name])

    def _check_safety(self) -> None:
        safety = self._states.safety
        if safety not in ("normal", "reduced"):
            self._moves_before = None
            raise self._explained_error(f"is stopped: {safety}")

    def _explained_error(self, what: str) -> DriverError:
        """The dashboard's explanation as an error, else an error that states what was observed."""
        try:
            read_condition(self._host).check_moves()
        except DriverError as error:
            return error
        return DriverError(
            f"The {self.name} {what}.",
            culprits=[self.name],
            next_step="Read the pendant's log, and see that no other program or computer drives "
            "the arm.",
        )


def keep(client: Any) -> None:  # noqa: ANN401
    """Prevents a client's destruction for good.

    Its destructor disconnects once more, sleeping for half a second with the interpreter lock held:
    the whole program would freeze whenever the garbage collector runs it.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(client))


def _matrix(pose: list[float]) -> FloatArray:
    """Pose (4, 4) from x, y, z [m] and a rotation vector [rad]."""
    numbers = np.array(pose)
    form = ROTATION_FORMS[POSE_FORMS["ur"].rotation]
    return compose(form.read(numbers[None, 3:])[0], numbers[:3])
