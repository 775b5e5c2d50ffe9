"""Simulated control script of ur-rtde, which executes commands from registers.

The client sends a script and then one command at a time: its number in the first integer input, its
arguments in the others. The script answers in its first integer output: 1 ready, 2 done. A command
stays until the client clears it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.live.rehearsal.machine import Machine, flange_pose, posture, postures_to, tool_pose
from visioncal.live.rehearsal.motion import joint_path, sampled_way

READY, DONE = 1, 2
# Commands that repeat while they are set, and are never done.
_CONTINUOUS = frozenset((6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)))
_STOP = 255
_REGISTERS = 48
# Time between ticks above which this computer has stalled [s].
_STALL_S = 0.1


@dataclass
class Registers:
    """Registers through which client and script communicate."""

    int_in: list[int] = field(default_factory=lambda: [0] * _REGISTERS)
    double_in: list[float] = field(default_factory=lambda: [0.0] * _REGISTERS)
    int_out: list[int] = field(default_factory=lambda: [0] * _REGISTERS)
    double_out: list[float] = field(default_factory=lambda: [0.0] * _REGISTERS)


class ControlScript:
    """The script of one controller; `tick` is called at its rate."""

    def __init__(self, machine: Machine) -> None:
        self.registers = Registers()
        self._machine = machine
        self._waiting = False
        self._asynchronous = False
        self._operation, self._writes = 0, 0
        self._watchdog_hz, self._last_command_s, self._last_tick_s = 0.0, 0.0, 0.0
        self._commands: Mapping[int, Callable[[float], None]] = {
            1: lambda now_s: self._move_joints(self._goal(), now_s),
            2: self._move_joints_to_pose,
            3: lambda now_s: self._move_straight(self._goal(), now_s),
            4: lambda now_s: self._move_straight(tool_pose(machine, self._goal()), now_s),
            17: self._set_payload,
            29: self._set_tcp,
            30: self._inverse,
            31: lambda now_s: machine.trip("protective-stop", now_s),
            33: self._halt,
            34: self._halt,
            35: self._set_watchdog,
            40: lambda _: self._send(machine.tcp),
            43: lambda now_s: self._send(tool_pose(machine, machine.joints(now_s)[0])),
            44: lambda _: self._send(
                flange_pose(machine, self._goal(), self.registers.double_in[6:12])
            ),
            46: self._inverse,
            47: self._steady,
        }

    def begin(self, now_s: float) -> None:
        """Starts when the text of the script arrives."""
        if not self._machine.may_move or not self._machine.remote:
            return
        self._machine.program = "playing"
        self._waiting = self._asynchronous = False
        self._watchdog_hz, self._last_command_s = 0.0, now_s
        self.registers.int_out[0] = READY

    def heard(self, now_s: float) -> None:
        """Resets the watchdog: the client wrote its command register."""
        self._last_command_s = now_s

    def tick(self, now_s: float) -> None:
        """Executes what is due."""
        machine, registers = self._machine, self.registers
        elapsed_s, self._last_tick_s = now_s - self._last_tick_s, now_s
        if elapsed_s > _STALL_S:
            # After a stall of this computer, commands may have arrived that are not read yet.
            self._last_command_s = now_s
        if machine.program != "playing":
            self._finish_asynchronous(now_s)
            return
        if self._watchdog_hz and now_s - self._last_command_s > 1.0 / self._watchdog_hz:
            machine.stop_program(now_s)
            return
        self._finish_asynchronous(now_s)
        command, state = registers.int_in[0], registers.int_out[0]
        if self._waiting:
            if not machine.moving(now_s):
                self._waiting = False
                registers.int_out[0] = DONE
        elif state == DONE:
            registers.int_out[0] = READY if command == 0 else DONE
        elif command == _STOP:
            machine.stop_program(now_s)
        elif command and command not in _CONTINUOUS:
            self._execute(command, now_s)

    def _execute(self, command: int, now_s: float) -> None:
        work = self._commands.get(command)
        if work is not None:
            work(now_s)
        if self._machine.program == "playing" and not self._waiting:
            self.registers.int_out[0] = DONE

    # Motions: six numbers, speed and acceleration; whether to wait for the end.

    def _goal(self) -> FloatArray:
        return np.array(self.registers.double_in[:6])

    def _move_joints_to_pose(self, now_s: float) -> None:
        q, _ = self._machine.joints(now_s)
        goal = posture(self._machine, self._goal(), q)
        if goal is None:
            self._fail(now_s)
        else:
            self._move_joints(goal, now_s)

    def _move_joints(self, goal: FloatArray, now_s: float) -> None:
        speed, acceleration = self.registers.double_in[6:8]
        q, _ = self._machine.joints(now_s)
        self._machine.start(joint_path(q, goal, speed=speed, acceleration=acceleration), now_s)
        self._after_start(now_s)

    def _move_straight(self, goal: FloatArray, now_s: float) -> None:
        q, _ = self._machine.joints(now_s)
        knots, distance = postures_to(self._machine, goal, q)
        if not knots:
            self._fail(now_s)
            return
        speed, acceleration = self.registers.double_in[6:8]
        path = sampled_way(knots, distance, speed=speed, acceleration=acceleration)
        self._machine.start(path, now_s)
        self._after_start(now_s)

    def _after_start(self, now_s: float) -> None:
        if self.registers.int_in[1]:
            self._asynchronous = True
            self._operation = (self._operation + 1) % 128
            self._signal(running=True)
        else:
            self._waiting = self._machine.moving(now_s)

    def _fail(self, now_s: float) -> None:
        """Ends the script, as for an impossible command."""
        self._machine.stop_program(now_s)

    def _finish_asynchronous(self, now_s: float) -> None:
        if self._asynchronous and not self._machine.moving(now_s):
            self._asynchronous = False
            self._signal(running=False)

    def _signal(self, *, running: bool) -> None:
        """Reports the asynchronous motion: count of reports, its number, whether it runs."""
        self._writes = (self._writes + 1) % 256
        self.registers.int_out[2] = self._operation << 24 | self._writes << 16 | int(running) << 15

    def _halt(self, now_s: float) -> None:
        self._machine.brake(now_s, max(self.registers.double_in[0], 0.01))
        self._waiting = self._machine.moving(now_s) and not self.registers.int_in[1]

    # Settings.

    def _set_payload(self, now_s: float) -> None:  # noqa: ARG002
        self._machine.payload_kg = self.registers.double_in[0]
        self._machine.payload_m = np.array(self.registers.double_in[1:4])

    def _set_tcp(self, now_s: float) -> None:  # noqa: ARG002
        self._machine.tcp = self._goal()

    def _set_watchdog(self, now_s: float) -> None:
        self._watchdog_hz, self._last_command_s = self.registers.double_in[0], now_s

    # Queries.

    def _send(self, numbers: FloatArray) -> None:
        self.registers.double_out[: numbers.size] = numbers.tolist()

    def _inverse(self, now_s: float) -> None:
        goal = posture(self._machine, self._goal(), self._machine.joints(now_s)[0])
        if goal is None:
            self._fail(now_s)
        else:
            self._send(goal)

    def _steady(self, now_s: float) -> None:
        self.registers.int_out[1] = int(not self._machine.moving(now_s))
