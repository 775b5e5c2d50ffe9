"""Arms of Universal Robots, through the client library ur-rtde."""

import ctypes
import threading
import time
from contextlib import suppress
from typing import Any

import numpy as np

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS
from visioncal.core.errors import DriverError
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray
from visioncal.live.drivers.extras import client_library
from visioncal.live.drivers.protocols import ArmState, JointSample
from visioncal.live.drivers.stopwatch import Stopwatch
from visioncal.live.drivers.ur_line import Line
from visioncal.live.drivers.ur_net import (
    SCRIPT_PORT,
    Dashboard,
    check_states_come,
    connect,
    read_tool_offset,
    resolve,
)
from visioncal.live.drivers.ur_status import Condition, read_condition
from visioncal.live.drivers.ur_watch import StateStream

_EXTRA = "ur"
_RATE_HZ = 125.0
# A call takes three or four states, 30 ms; this is what a caller is promised.
_CALL_S = 0.9
_CLOSE_S = 0.9
# How long a controller that sends no more states is waited for, for a last order [s].
_LAST_WORD_S = 0.3
# The controller ends its program, and stops the arm, where this computer is silent for 1 s.
_LEAST_HZ, _KICK_S = 1.0, 0.1
# Until an asynchronous motion has begun, it is not over [s].
_BEGIN_S = 0.5
# Braking of `halt`: a joint at 1 rad/s stands after a quarter of a second.
_BRAKE_RAD_S2 = 4.0
_STILL_RAD_S = 1e-3
# What the client lets pass.
_MOST_RAD_S, _MOST_RAD_S2 = 3.14, 40.0

# States a second of the e-Series and of the CB3, by PolyScope's major version.
_RATES_HZ = {3: 125.0, 5: 500.0}


class UrArm:
    """A UR arm, e-Series or CB-series, as a `MovingArm`.

    Args:
        host: The controller's address.
        watch_only: Whether it is only watched, as while it is led by hand: then it needs no remote
            control, and cannot be moved from here. The tool offset is read once.

    Raises:
        DriverError: The client library is missing; the host is unreachable or no UR; the arm is
            off, stopped or in local control; each with what to do.
    """

    def __init__(self, host: str, *, watch_only: bool = False) -> None:
        receive = client_library("rtde_receive", _EXTRA)
        control = None if watch_only else client_library("rtde_control", _EXTRA)
        self._host = resolve(host)
        condition = check_controller(self._host, moves=not watch_only)
        self._name, self._model = f"{condition.model} at {host}", condition.model.lower()
        self._states = StateStream(receive, self._host, condition.version)
        self._control: Any = None
        self._line: Line | None = None
        self._moves_before: int | None = None
        self._begun = Stopwatch()
        self._closed = False
        if control is None:
            self._flange_from_tool = _matrix(read_tool_offset(self._host))
            return
        try:
            self._take_control(control)
        except DriverError:
            self.close()
            raise

    @property
    def name(self) -> str:
        """The arm's model and address."""
        return self._name

    @property
    def model(self) -> str:
        """The model by the name that visioncal has for it, as `ur10e`."""
        return self._model

    def state(self) -> ArmState:
        """Waits for the next state that the controller sends.

        A stop by the safety system is reported in it, and is no error.

        Raises:
            DriverError: None comes for 0.8 s.
        """
        self._check_open()
        client = self._states.client
        while True:
            stamp = self._states.wait()
            pose, q, dq = client.getActualTCPPose(), client.getActualQ(), client.getActualQd()
            currents, temperatures = client.getActualCurrent(), client.getJointTemperatures()
            load = self._load()
            safety = self._states.safety
            # Another state that came in between would mix with this one.
            if client.getTimestamp() == stamp:
                break
        return ArmState(
            stamp_s=self._states.host_time(stamp),
            base_from_flange=_matrix(pose) @ invert(self._flange_from_tool),
            q=np.array(q),
            dq=np.array(dq),
            flange_from_tool=self._flange_from_tool,
            payload_kg=load[0],
            payload_m=load[1],
            currents_a=np.array(currents),
            temperatures_c=np.array(temperatures),
            safety=safety,
        )

    def start_move(self, q: FloatArray, *, speed: float, acceleration: float) -> None:
        """Starts towards a posture and returns; see `MovingArm`.

        Raises:
            DriverError: It is only watched, lost or stopped, or the controller refuses.
        """
        goal = np.asarray(q, dtype=float)
        _check_goal(goal, speed, acceleration)
        line = self._moving_line()
        self._states.check()
        self._check_safety()
        if not self._control.isProgramRunning():
            self._start_program_again(line)
        before = self._control.getAsyncOperationProgressEx().changeCount()
        taken = line.call(
            lambda: self._control.moveJ(goal.tolist(), speed, acceleration, True),
            limit_s=_CALL_S,
            what="take a motion",
        )
        if not taken:
            raise self._explain("refused a motion")
        self._moves_before = before
        self._begun.restart()

    def moving(self) -> bool:
        """Tells whether the last motion is still going on.

        Raises:
            DriverError: It was cut short: the controller is lost, a safety stop, or its program
                ended.
        """
        self._check_open()
        self._states.check()
        if self._moves_before is None:
            return bool(np.abs(self._states.client.getActualQd()).max() > _STILL_RAD_S)
        self._check_safety()
        if not self._control.isProgramRunning():
            self._moves_before = None
            raise self._explain(
                "ended its program during a motion, as it does where this computer is silent for "
                f"{1.0 / _LEAST_HZ:.0f} s"
            )
        progress = self._control.getAsyncOperationProgressEx()
        if progress.isAsyncOperationRunning():
            return True
        if progress.changeCount() == self._moves_before:
            if self._begun.read() < _BEGIN_S:
                return True
            raise self._explain(f"did not begin a motion within {_BEGIN_S} s")
        self._moves_before = None
        return False

    def halt(self) -> None:
        """Brakes at once; harmless where nothing moves or the link is gone."""
        if self._line is None or self._closed:
            return
        self._moves_before = None
        if self._states.alive:
            with suppress(DriverError):
                # The call returns as the arm begins to brake.
                self._line.call(
                    lambda: self._control.stopJ(_BRAKE_RAD_S2, True), limit_s=_CALL_S, what="stop"
                )
                return
        # What no longer comes may still be heard.
        with suppress(DriverError), Dashboard(self._host, _LAST_WORD_S) as dashboard:
            dashboard.ask("stop")

    def close(self) -> None:
        """Lets go of it, after a halt where it was moving; may be called twice."""
        if self._closed:
            return
        if self._moves_before is not None:
            self.halt()
        self._closed = True
        keep(self._states.client)
        # Each disconnection sleeps for half a second, so they do it together; a client whose
        # controller is gone may not return at all.
        states = threading.Thread(target=self._states.client.disconnect, daemon=True)
        states.start()
        ends_s = time.monotonic() + _CLOSE_S
        if self._line is not None:
            keep(self._control)
            with suppress(DriverError):
                self._line.call(self._let_go, limit_s=_CLOSE_S, what="close")
            self._line.end()
        states.join(max(0.0, ends_s - time.monotonic()))

    def _take_control(self, library: Any) -> None:  # noqa: ANN401
        """Sends the control script, and asks for the tool offset."""
        try:
            self._control = library.RTDEControlInterface(self._host, _RATE_HZ)
        except RuntimeError as error:
            raise self._explain(f"does not take the control script: {error}") from error
        self._line = Line(self._name, self._kick, _KICK_S)
        offset = self._line.call(
            self._control.getTCPOffset, limit_s=_CALL_S, what="report its tool offset"
        )
        self._flange_from_tool = _matrix(offset)
        self._watch_me(self._line)

    def _watch_me(self, line: Line) -> None:
        """Lets the controller stop the arm where this computer falls silent."""
        line.call(
            lambda: self._control.setWatchdog(_LEAST_HZ), limit_s=_CALL_S, what="set its watchdog"
        )

    def _kick(self) -> None:
        """Tells the controller's watchdog that this computer is there."""
        with suppress(RuntimeError):
            if self._states.alive and self._control.isProgramRunning():
                self._control.kickWatchdog()

    def _start_program_again(self, line: Line) -> None:
        """Sends the control script again: at the pendant, or in a pause, it was ended."""
        read_condition(self._host).check_moves()
        line.call(self._control.reuploadScript, limit_s=_CALL_S, what="take the control script")
        begun = Stopwatch()
        while not self._control.isProgramRunning():
            if begun.read() > _CALL_S:
                raise self._explain("does not run the control script")
            time.sleep(0.01)
        self._watch_me(line)

    def _let_go(self) -> None:
        if self._states.alive and self._control.isProgramRunning():
            self._control.stopScript()
        self._control.disconnect()

    def _load(self) -> tuple[float | None, FloatArray | None]:
        if not self._states.reports_load:
            return None, None
        client = self._states.client
        return float(client.getPayload()), np.array(client.getPayloadCog())

    def _moving_line(self) -> Line:
        self._check_open()
        if self._line is None:
            raise DriverError(
                f"The {self._name} is only watched; it cannot be moved from here.",
                culprits=[self._name],
                next_step="Move it by hand, or open it for moving.",
            )
        return self._line

    def _check_open(self) -> None:
        if self._closed:
            raise DriverError(f"The {self._name} was closed.", culprits=[self._name])

    def _check_safety(self) -> None:
        safety = self._states.safety
        if safety not in ("normal", "reduced"):
            self._moves_before = None
            raise self._explain(f"is stopped: {safety}")

    def _explain(self, what: str) -> DriverError:
        """The error that the dashboard's words explain, else one that says what was seen."""
        try:
            read_condition(self._host).check_moves()
        except DriverError as error:
            return error
        return DriverError(
            f"The {self._name} {what}.",
            culprits=[self._name],
            next_step="Read the pendant's log, and see that no other program or computer drives "
            "the arm.",
        )


def check_controller(host: str, *, moves: bool) -> Condition:
    """Asks everything by plain connections first: the library's constructors wait without end.

    Raises:
        DriverError: It cannot be reached, is no UR, reports nothing, or could not be moved.
    """
    condition = read_condition(host)
    if moves:
        condition.check_moves()
        connect(host, SCRIPT_PORT, "programs").close()
    else:
        condition.check_reports()
    check_states_come(host)
    return condition


def keep(client: Any) -> None:  # noqa: ANN401
    """Keeps a client from being destroyed, ever.

    Its destructor disconnects once more, sleeping for half a second with Python's lock held: the
    whole program would stand still at a moment that the garbage collector chooses.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(client))


def _check_goal(q: FloatArray, speed: float, acceleration: float) -> None:
    if q.shape != (6,) or not np.isfinite(q).all():
        raise DriverError(f"A UR has six joints; a motion to {q.tolist()} cannot be asked for.")
    if not (0.0 < speed <= _MOST_RAD_S and 0.0 < acceleration <= _MOST_RAD_S2):
        raise DriverError(
            f"A motion at {speed:g} rad/s and {acceleration:g} rad/s^2 cannot be asked for; more "
            f"than 0 and at most {_MOST_RAD_S} and {_MOST_RAD_S2} are needed."
        )


def _matrix(pose: list[float]) -> FloatArray:
    """(4, 4) of x, y, z [m] and a rotation vector."""
    numbers = np.array(pose)
    form = ROTATION_FORMS[POSE_FORMS["ur"].rotation]
    return compose(form.read(numbers[None, 3:])[0], numbers[:3])


class UrMotion:
    """The joints of a UR, which is only watched: who moves it is not asked.

    Args:
        host: The controller's address.

    Raises:
        DriverError: The client library is missing, or the host is unreachable or no UR.
    """

    def __init__(self, host: str) -> None:
        receive = client_library("rtde_receive", _EXTRA)
        address = resolve(host)
        condition = check_controller(address, moves=False)
        self.name = f"{condition.model} at {host}"
        self.model = condition.model.lower()
        self.rate_hz = _RATES_HZ[condition.version[0]]
        self._states = StateStream(receive, address, condition.version, self.rate_hz)

    def sample(self) -> JointSample:
        """Waits for the next state that the controller sends.

        Raises:
            DriverError: None comes for 0.8 s, or the arm was stopped.
        """
        client = self._states.client
        while True:
            stamp_s = self._states.wait()
            q, dq, currents = client.getActualQ(), client.getActualQd(), client.getActualCurrent()
            # Another state that came in between would mix with this one.
            if client.getTimestamp() == stamp_s:
                break
        if self._states.safety not in ("normal", "reduced"):
            raise DriverError(
                f"The {self.name} is stopped: {self._states.safety}.",
                culprits=[self.name],
                next_step="See the pendant, and record the motion again from its beginning.",
            )
        return JointSample(stamp_s, np.array(q), np.array(dq), np.array(currents))

    def close(self) -> None:
        """Lets go of it."""
        keep(self._states.client)
        # A client whose controller is gone may not return at all.
        going = threading.Thread(target=self._states.client.disconnect, daemon=True)
        going.start()
        going.join(_CLOSE_S)
