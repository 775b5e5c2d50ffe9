"""Simulated UR controller as a process of its own, for the real client library to talk to.

It must be another process: the client's constructors hold the interpreter lock while they wait for
the controller. A pipe to it, which no real controller has, tells the arm's true state and injects
faults; the process ends with it.

Its poses are x, y, z [m] and a rotation vector [rad], by its nominal model of the arm. Its ports
are served in one event loop. Sources: Universal Robots, "Real-Time Data Exchange (RTDE) Guide": a
frame is its whole size (uint16), its type (one byte) and its payload. "Dashboard Server e-Series".
"Remote Control Via TCP/IP": a robot state message of the primary interface is its size (int32), 16,
and packages of size, type and content. Numbers are big-endian.
"""

import asyncio
import itertools
import multiprocessing
import os
import re
import signal
import struct
import threading
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Literal, NamedTuple, Self, TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.errors import DriverError
from visioncal.core.threads import safe_path
from visioncal.core.types import FloatArray
from visioncal.live.drivers import ur_net
from visioncal.simulation.arms import ArmOptions, DhArm, arm_named, forward

# `none` mends all others.
Fault: TypeAlias = Literal[
    "none", "protective-stop", "emergency-stop", "power-off", "remote-off", "link-lost", "silent"
]
# Starting takes a second, but much longer on a busy computer [s].
_START_S = 60.0
# Joint angles at the start [rad]: elbow up, the tool pointing down, clear of every singularity.
_HOME = (0.0, -1.45, 1.75, -1.9, -1.5708, 0.0)
# The payload that is set, and its centre of mass in the flange frame [kg, m].
_PAYLOAD_KG, _PAYLOAD_M = 0.6, (0.0, 0.0, 0.04)

# The control script of ur-rtde executes commands from registers. The client writes the number of
# one at a time into the first, its arguments into others; the script answers with 1 ready, 2 done.
# A command stays until the client clears it. Motions are asynchronous, as our driver asks for them,
# and commands that it does not use are done at once.
_COMMAND = "input_int_register_0"
_STATE, _PROGRESS = "output_int_register_0", "output_int_register_2"
_READY, _DONE, _REGISTERS = 1, 2, 48
_MOVE_JOINTS, _STOP_JOINTS, _SET_WATCHDOG, _GET_TOOL_OFFSET, _STOP = 1, 34, 35, 40, 255

_YES = b"\x01"
_SAFETY = {
    "normal": ("NORMAL", 1 << 0),
    "protective-stop": ("PROTECTIVE_STOP", 1 << 2),
    "emergency-stop": ("ROBOT_EMERGENCY_STOP", 1 << 6 | 1 << 7),
}
_MODES = {"POWER_OFF": 3, "RUNNING": 7}
# States are dropped for a client with this many unread bytes; period of primary messages [s].
_BUFFER_BYTES, _PRIMARY_EVERY_S = 1 << 20, 0.1
# Numbers of the controllers that this process has started.
_STARTED = itertools.count()
# The last line of the client's program.
_END = re.compile(rb"^end\s*$", re.MULTILINE)
_Handler: TypeAlias = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@dataclass(frozen=True)
class ControllerOptions:
    """A simulated controller and its arm."""

    robot: str = "ur10e"  # `ur3e`, `ur5e` or `ur10e`.
    seed: int = 0
    # Errors of the true arm relative to its controller's model.
    errors: ArmOptions = field(
        default_factory=lambda: ArmOptions(
            dh_sigma_m=3e-4, dh_sigma_rad=3e-4, offset_sigma_rad=5e-4
        )
    )
    # By how much each joint stands beyond what its encoder reads [rad]; empty for nothing.
    slip_rad: tuple[float, ...] = ()
    q: tuple[float, ...] = _HOME  # Joint angles at the start [rad].
    # Tool offset that is set: x, y, z [m] and a rotation vector [rad].
    tcp: tuple[float, ...] = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
    # Sigma of a joint's error relative to its encoder, drawn anew for each motion [rad].
    repeatability_rad: float = 1e-5
    rate_hz: float = 125.0  # States per second.
    # Its software; PolyScope X, from 10 on, has no dashboard.
    polyscope: tuple[int, int, int, int] = (5, 11, 6, 1010000)

    @property
    def believed_arm(self) -> DhArm:
        """Controller's model of the arm: its data sheet."""
        return arm_named(self.robot)

    @property
    def true_arm(self) -> DhArm:
        """True arm, with errors."""
        arm = replace(self.errors, robot=self.robot).built(np.random.default_rng([self.seed, 2]))
        return replace(arm, offset=arm.offset + np.array(self.slip_rad or 0.0))


class TrueState(NamedTuple):
    """True states of the arm at m moments."""

    q: FloatArray  # (m, n) joint angles [rad].
    dq: FloatArray  # (m, n) joint speeds [rad/s].
    base_from_flange: FloatArray  # (m, 4, 4) by the arm's true geometry [m].


@dataclass(frozen=True, eq=False)
class Motion:
    """Straight path of all joints, with a trapezoidal or triangular speed profile.

    It is a function of time, not a table of ticks: the joints are defined at any moment, however
    late the simulating process is scheduled.
    """

    begins_s: float  # When it begins [s].
    start: FloatArray  # (n,) first posture [rad].
    goal: FloatArray  # (n,) last posture [rad].
    speed: float = 1.0  # Speed limit of the joint that travels farthest [rad/s].
    acceleration: float = 1.0  # Its acceleration [rad/s^2].

    @property
    def _profile(self) -> tuple[float, float]:
        """Distance [rad] and greatest speed [rad/s]."""
        distance = float(np.abs(self.goal - self.start).max())
        return distance, min(self.speed, float(np.sqrt(distance * self.acceleration)))

    @property
    def ends_s(self) -> float:
        """When the joints have come to rest [s]."""
        distance, peak = self._profile
        return self.begins_s + (distance / peak + peak / self.acceleration if distance else 0.0)

    def at(self, at_s: float) -> tuple[FloatArray, FloatArray]:
        """Joint angles (n,) [rad] and speeds (n,) [rad/s]."""
        distance, peak = self._profile
        since_s, left_s = at_s - self.begins_s, self.ends_s - at_s
        # Both halves are alike: the way from the start, or to the goal.
        near_s = max(min(since_s, left_s), 0.0)
        ramp_s = min(near_s, peak / self.acceleration)
        way = 0.5 * self.acceleration * ramp_s**2 + peak * (near_s - ramp_s)
        all_way = (self.goal - self.start) / max(distance, 1e-12)
        q = self.start + all_way * way if since_s < left_s else self.goal - all_way * way
        return q, all_way * self.acceleration * ramp_s


# When a motion takes over [s], the motion, and the joints' errors relative to their encoders [rad].
_Entry: TypeAlias = tuple[float, Motion, FloatArray]


class _Machine:
    """The arm with its safety system and control script; times are monotonic [s]."""

    def __init__(self, options: ControllerOptions) -> None:
        self.options, self.believed, self.true = options, options.believed_arm, options.true_arm
        self.safety, self.mode, self.remote, self.playing = "normal", "RUNNING", True, False
        self.began_s = time.monotonic()
        self.registers: dict[str, float] = {}
        for way in ("input", "output"):
            for place in range(_REGISTERS):
                self.registers[f"{way}_int_register_{place}"] = 0
                self.registers[f"{way}_double_register_{place}"] = 0.0
        self._is_driven, self._reports = False, 0
        self._watchdog_hz, self._last_tick_s = 0.0, 0.0
        # When the client last wrote its command register.
        self.heard_s = 0.0
        self._rng = np.random.default_rng([options.seed, 3])
        # Replaced as a whole, since another thread reads it.
        self._history: tuple[_Entry, ...] = ()
        self.start(Motion(self.began_s, np.array(options.q), np.array(options.q)), self.began_s)

    def joints(self, at_s: float) -> tuple[FloatArray, FloatArray]:
        """Joint angles (n,) [rad] and speeds (n,) [rad/s] by the encoders."""
        return self._entry(at_s)[1].at(at_s)

    def state(self, at_s: Sequence[float]) -> TrueState:
        """True states at some moments."""
        entries = [(*self.joints(moment), self._entry(moment)[2]) for moment in at_s]
        q, dq, errors = (np.array(rows) for rows in zip(*entries, strict=True))
        return TrueState(q + errors, dq, forward(self.true, q + errors))

    def moving(self, at_s: float) -> bool:
        """Whether a motion is in progress."""
        return at_s < self._history[-1][1].ends_s

    def start(self, motion: Motion, now_s: float) -> None:
        """Starts a motion, replacing one in progress."""
        error = self.options.repeatability_rad * self._rng.standard_normal(len(motion.goal))
        # Pictures are requested within a motion or two.
        self._history = (*self._history[-50:], (now_s, motion, error))

    def brake(self, now_s: float, deceleration: float = 20.0) -> None:
        """Brakes a motion in progress, with a deceleration in [rad/s^2]."""
        if self.moving(now_s):
            q, dq = self.joints(now_s)
            speed = max(float(np.abs(dq).max()), 1e-12)
            # The last ramp of a motion.
            way = 0.5 * dq * speed / deceleration
            begins_s = now_s - speed / deceleration
            self.start(Motion(begins_s, q - way, q + way, speed, deceleration), now_s)

    def guide(self, q: FloatArray, speed: float, acceleration: float) -> float:
        """Moves the arm as if by hand; see `SimulatedController.guide`."""
        now_s = time.monotonic()
        motion = Motion(now_s, self.joints(now_s)[0], q, speed, acceleration)
        self.start(motion, now_s)
        return motion.ends_s

    def stop_program(self, now_s: float) -> None:
        """Ends the control script, and any motion with it."""
        self.playing = False
        self.brake(now_s)

    def inject(self, fault: Fault) -> None:
        """Lets a fault happen, or mends all."""
        self.safety = fault if fault in _SAFETY else "normal"
        self.mode = "POWER_OFF" if fault in ("emergency-stop", "power-off") else "RUNNING"
        self.remote = fault != "remote-off"
        # Once mended, the control script has to be sent again.
        self.stop_program(time.monotonic())

    def tool_pose(self, now_s: float) -> FloatArray:
        """Pose (6,) of the tool, by the controller's model."""
        tcp = np.array(self.options.tcp)
        offset = RigidTransform.from_components(tcp[:3], Rotation.from_rotvec(tcp[3:]))
        pose = forward(self.believed, self.joints(now_s)[0][None])[0] @ offset.as_matrix()
        return np.concatenate([pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_rotvec()])

    def reported(self, now_s: float) -> dict[str, Sequence[float]]:
        """Values of the variables that clients are sent."""
        q, dq = self.joints(now_s)
        # Power, program, power button.
        status = (self.mode != "POWER_OFF") | self.playing << 1 | 1 << 3
        return {
            "timestamp": [now_s - self.began_s],
            "actual_q": q.tolist(),
            "actual_qd": dq.tolist(),
            "actual_current": [1.5] * 6,
            "actual_TCP_pose": self.tool_pose(now_s).tolist(),
            "external_force_torque": [0.0] * 6,
            "joint_temperatures": [33.0] * 6,
            "robot_mode": [_MODES[self.mode]],
            "runtime_state": [1 + self.playing],
            "robot_status_bits": [status],
            "safety_status_bits": [_SAFETY[self.safety][1]],
            "payload": [_PAYLOAD_KG],
            "payload_cog": _PAYLOAD_M,
        } | {name: [value] for name, value in self.registers.items()}

    def begin_script(self, now_s: float) -> None:
        """Starts the control script when its text arrives."""
        if self.safety == "normal" and self.mode == "RUNNING" and self.remote:
            self.playing, self._is_driven = True, False
            self._watchdog_hz, self.heard_s = 0.0, now_s
            self.registers[_STATE] = _READY

    def tick(self, now_s: float) -> None:
        """Executes what is due, once a cycle."""
        registers = self.registers
        if now_s - self._last_tick_s > 0.1:
            # After a stall of this computer, commands may have arrived that are not read yet.
            self.heard_s = now_s
        self._last_tick_s = now_s
        if self._is_driven and not self.moving(now_s):
            self._report(is_driven=False)
        if not self.playing:
            return
        if self._watchdog_hz * (now_s - self.heard_s) > 1.0:
            self.stop_program(now_s)
            return
        command = int(registers[_COMMAND])
        if registers[_STATE] == _DONE:
            registers[_STATE] = _DONE if command else _READY
        elif command:
            registers[_STATE] = _DONE
            self._execute(command, now_s)

    def _execute(self, command: int, now_s: float) -> None:
        # Of a motion: six joints, speed and acceleration.
        numbers = [self.registers[f"input_double_register_{place}"] for place in range(8)]
        if command == _MOVE_JOINTS:
            self.guide(np.array(numbers[:6]), *numbers[6:])
            self._report(is_driven=True)
        elif command == _STOP_JOINTS:
            self.brake(now_s, max(numbers[0], 0.01))
        elif command == _SET_WATCHDOG:
            self._watchdog_hz, self.heard_s = numbers[0], now_s
        elif command == _GET_TOOL_OFFSET:
            for place, value in enumerate(self.options.tcp):
                self.registers[f"output_double_register_{place}"] = value
        elif command == _STOP:
            self.stop_program(now_s)

    def _report(self, *, is_driven: bool) -> None:
        """Reports the motion: its number, the count of reports, whether it runs."""
        self._is_driven, self._reports = is_driven, (self._reports + 1) % 256
        number = self._reports // 2
        self.registers[_PROGRESS] = number << 24 | self._reports << 16 | int(is_driven) << 15

    def _entry(self, at_s: float) -> _Entry:
        history = self._history
        return next((entry for entry in reversed(history) if entry[0] <= at_s), history[0])


@dataclass
class _Client:
    """State of an RTDE client."""

    writer: asyncio.StreamWriter
    outputs: tuple[str, ...] = ()  # Names of the variables that it is sent.
    # Names of the variables that it sends, by recipe; it counts these from 1.
    inputs: list[tuple[str, ...]] = field(default_factory=list)
    every_s: float = 0.0  # Period of its states [s].
    due_s: float = np.inf  # When the next one is due [s]; infinity while none are wanted.


class _Server:
    """Servers of a controller's ports."""

    def __init__(self, options: ControllerOptions, host: str) -> None:
        self.machine = _Machine(options)
        self._host, self._rate_hz, self._polyscope = host, options.rate_hz, options.polyscope
        self._clients: list[_Client] = []
        # While it is clear, the controller keeps its connections open but stays silent.
        self._awake = threading.Event()
        self._awake.set()

    async def run(self, ready: Callable[[], None]) -> None:
        """Serves until the process ends; calls `ready` once all ports listen.

        Raises:
            OSError: A port is taken.
        """
        self._loop = asyncio.get_running_loop()
        handlers = (self._serve_rtde, self._serve_dashboard, self._take_script, self._send_primary)
        with ExitStack() as servers:
            ports = ur_net.RTDE_PORT, ur_net.DASHBOARD_PORT, ur_net.SCRIPT_PORT
            for port, handler in zip((*ports, ur_net.PRIMARY_PORTS[0]), handlers, strict=True):
                if port == ur_net.DASHBOARD_PORT and self._polyscope[0] >= 10:
                    continue
                server = await asyncio.start_server(_tolerant(handler), self._host, port)
                servers.callback(server.close)
            ready()
            cycle, began_s = 0, self.machine.began_s
            while True:
                # Cycles that a busy computer missed are skipped.
                cycle = max(cycle + 1, int((time.monotonic() - began_s) * self._rate_hz))
                due_s = began_s + cycle / self._rate_hz
                await asyncio.sleep(due_s - time.monotonic())
                self.machine.tick(time.monotonic())
                self._send_states(due_s)

    def inject(self, fault: Fault) -> None:
        """Lets a fault happen, or mends all; called by another thread."""
        if fault == "link-lost":
            # As a killed process: connections are not shut down.
            os._exit(1)
        self.machine.inject(fault)
        if fault == "silent":
            self._awake.clear()
            self._loop.call_soon_threadsafe(self._awake.wait)
        else:
            self._awake.set()

    async def _serve_rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = _Client(writer)
        self._clients.append(client)
        try:
            while True:
                size, kind = ur_net.HEADER.unpack(await reader.readexactly(ur_net.HEADER.size))
                payload = await reader.readexactly(size - ur_net.HEADER.size)
                if kind == ur_net.DATA:
                    self._receive(client, payload)
                else:
                    writer.write(ur_net.frame(kind, self._answer_rtde(client, kind, payload)))
        finally:
            self._clients.remove(client)

    def _answer_rtde(self, client: _Client, kind: int, payload: bytes) -> bytes:
        """Content of the answer to a frame."""
        if kind == ur_net.VERSION_OF:
            return struct.pack(">4I", *self._polyscope)
        if kind in (ur_net.START, ur_net.PAUSE):
            client.due_s = 0.0 if kind == ur_net.START else np.inf
        if kind not in (ur_net.OUTPUTS, ur_net.INPUTS):
            return _YES
        text = payload[8:] if kind == ur_net.OUTPUTS else payload
        # The last may be followed by a comma.
        names = tuple(part for part in text.decode("ascii").split(",") if part)
        values = self.machine.reported(time.monotonic())
        types = ",".join(_type(values[name]) if name in values else "NOT_FOUND" for name in names)
        if kind == ur_net.OUTPUTS:
            client.every_s = 1.0 / struct.unpack_from(">d", payload)[0]
            client.outputs = tuple(name for name in names if name in values)
            return _YES + types.encode()
        client.inputs.append(names)
        return bytes([len(client.inputs)]) + types.encode()

    def _receive(self, client: _Client, payload: bytes) -> None:
        """Writes a client's values to the registers."""
        names = client.inputs[payload[0] - 1]
        if all("_register_" in name for name in names):
            form = ">" + "".join("i" if "_int_" in name else "d" for name in names)
            self.machine.registers |= zip(names, struct.unpack_from(form, payload, 1), strict=True)
        if _COMMAND in names:
            self.machine.heard_s = time.monotonic()

    def _send_states(self, now_s: float) -> None:
        """Sends the state to every client that is due."""
        # Cycles are no finer than this tolerance.
        due = [client for client in self._clients if now_s >= client.due_s - 1e-3]
        if not due:
            return
        values = self.machine.reported(now_s)
        for client in due:
            if client.writer.transport.get_write_buffer_size() < _BUFFER_BYTES:
                client.due_s = max(client.due_s + client.every_s, now_s)
                numbers = [number for name in client.outputs for number in values[name]]
                form = "".join("i" if isinstance(number, int) else "d" for number in numbers)
                packed = struct.pack(f">{form}", *numbers)
                client.writer.write(ur_net.frame(ur_net.DATA, _YES + packed))

    async def _serve_dashboard(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        while line := await reader.readline():
            machine, question = self.machine, line.decode("utf-8", "replace").strip().lower()
            answers = {
                "polyscopeversion": "URSoftware " + ".".join(map(str, self._polyscope)),
                "get serial number": "20235500001",
                # The model's name without its series, as from a real controller.
                "get robot model": machine.options.robot.removesuffix("e").upper(),
                "is in remote control": str(machine.remote).lower(),
                "robotmode": f"Robotmode: {machine.mode}",
                "safetystatus": f"Safetystatus: {_SAFETY[machine.safety][0]}",
                "running": f"Program running: {str(machine.playing).lower()}",
                "stop": "Stopped",
            }
            if question == "stop":
                machine.stop_program(time.monotonic())
            writer.write(answers.get(question, "could not understand").encode() + b"\n")

    async def _take_script(self, reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
        text = b""
        while part := await reader.read(65536):
            text += part
            if _END.search(text):
                self.machine.begin_script(time.monotonic())
                text = b""

    async def _send_primary(self, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Sends robot states (16) of one package: the tool's pose and offset (4)."""
        while not writer.is_closing():
            pose = self.machine.tool_pose(time.monotonic())
            content = struct.pack(">12d", *pose, *self.machine.options.tcp)
            size = 5 + len(content)
            writer.write(struct.pack(">IBIB", 5 + size, 16, size, 4) + content)
            await writer.drain()
            await asyncio.sleep(_PRIMARY_EVERY_S)


def _tolerant(handler: _Handler) -> _Handler:
    """Wraps a handler so that a client may disconnect at any time."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError, asyncio.IncompleteReadError):
            await handler(reader, writer)
        writer.close()

    return serve


def _type(values: Sequence[float]) -> str:
    """The protocol's name of the type of a variable."""
    return (
        f"VECTOR{len(values)}D" if values[1:] else "INT32" if type(values[0]) is int else "DOUBLE"
    )


@dataclass(frozen=True, eq=False)
class SimulatedController:
    """A running controller; it ends with the context."""

    host: str  # The loopback address that it listens on.
    _process: BaseProcess
    _pipe: "Connection[Any, Any]"
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def state(self, at_s: Sequence[float]) -> TrueState:
        """Reads true states at moments of the monotonic clock within the arm's memory [s].

        Raises:
            DriverError: The controller is gone.
        """
        state: TrueState = self._ask("state", list(at_s))
        return state

    def inject(self, fault: Fault) -> None:
        """Injects a fault; returns when it has happened; raises DriverError."""
        try:
            self._ask("inject", fault)
        except DriverError:
            if fault != "link-lost":
                raise

    def guide(self, q: FloatArray, *, speed: float, acceleration: float) -> float:
        """Moves the arm to a posture (n,) [rad] as if by hand, and returns the time of arrival [s].

        Speed [rad/s] and acceleration [rad/s^2] are of the joint that travels farthest.
        """
        return float(self._ask("guide", q, speed, acceleration))

    def close(self) -> None:
        """Ends it; may be called twice."""
        self._process.terminate()
        self._process.join(5.0)
        self._process.kill()
        self._pipe.close()

    def _ask(self, *question: object) -> Any:  # noqa: ANN401
        """Asks through the pipe, from any thread."""
        with self._lock:
            try:
                self._pipe.send(question)
                return self._pipe.recv()
            except (OSError, EOFError) as error:
                raise DriverError(
                    f"The simulated controller at {self.host} is gone.", culprits=[self.host]
                ) from error


def spawn(options: ControllerOptions | None = None) -> SimulatedController:
    """Starts a simulated controller at a loopback address of its own.

    Raises:
        DriverError: It does not start, for example because a port is taken.
    """
    host = free_host()
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    arguments = (options or ControllerOptions(), host, there)
    process = context.Process(target=_serve, args=arguments, daemon=True)
    with safe_path():
        process.start()
    # This end alone must hold the pipe open, so that the end of either process is noticed.
    there.close()
    controller = SimulatedController(host, process, here)
    reason: object = f"it did not start within {_START_S:.0f} s"
    if here.poll(_START_S):
        try:
            reason = here.recv()
        except EOFError:
            reason = "it ended"
        if reason is None:
            return controller
    controller.close()
    raise DriverError(f"No simulated controller at {host}: {reason}.", culprits=[host])


def free_host() -> str:
    """A loopback address that no controller of this process has, nor of another one."""
    number = os.getpid() + 251 * next(_STARTED)
    return f"127.{number // 62500 % 250 + 2}.{number // 250 % 250 + 2}.{number % 250 + 2}"


def _serve(options: ControllerOptions, host: str, pipe: "Connection[Any, Any]") -> None:
    """Runs a controller in its process, until the pipe's other end is closed."""
    # Ctrl-C reaches all processes of a terminal; a controller must not end before its client.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    server = _Server(options, host)

    def answer_all() -> None:
        while True:
            try:
                what, *arguments = pipe.recv()
            except (OSError, EOFError):
                os._exit(0)
            answering = server if what == "inject" else server.machine
            pipe.send(getattr(answering, what)(*arguments))

    def ready() -> None:
        pipe.send(None)
        threading.Thread(target=answer_all, daemon=True).start()

    try:
        asyncio.run(server.run(ready))
    except OSError as error:
        pipe.send(str(error))
