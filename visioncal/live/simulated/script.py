"""Simulated control script of ur-rtde, which executes commands from registers.

The client sends a script and then one command at a time: its number in the first integer input, its
arguments in the others. The script answers in its first integer output: 1 ready, 2 done. A command
stays until the client clears it. Commands that our driver does not use are done at once.
"""

from dataclasses import dataclass, field

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.live.simulated.arm import Machine, Motion

READY, DONE = 1, 2
MOVE_JOINTS, STOP_JOINTS, SET_WATCHDOG, GET_TOOL_OFFSET, _STOP = 1, 34, 35, 40, 255
# Commands that repeat while they are set, and are never done.
_CONTINUOUS = frozenset((6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)))
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
        self._waiting = self._asynchronous = False
        self._operation, self._writes = 0, 0
        self._watchdog_hz, self._last_command_s, self._last_tick_s = 0.0, 0.0, 0.0

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
        if now_s - self._last_tick_s > _STALL_S:
            # After a stall of this computer, commands may have arrived that are not read yet.
            self._last_command_s = now_s
        self._last_tick_s = now_s
        silent_s = now_s - self._last_command_s
        if machine.program == "playing" and self._watchdog_hz * silent_s > 1.0:
            machine.stop_program(now_s)
            return
        if self._asynchronous and not machine.moving(now_s):
            self._signal(running=False)
        if machine.program != "playing":
            return
        command, state = registers.int_in[0], registers.int_out[0]
        if self._waiting:
            self._waiting = machine.moving(now_s)
            registers.int_out[0] = state if self._waiting else DONE
        elif state == DONE:
            registers.int_out[0] = READY if command == 0 else DONE
        elif command == _STOP:
            machine.stop_program(now_s)
        elif command and command not in _CONTINUOUS:
            self._execute(command, now_s)
            registers.int_out[0] = state if self._waiting else DONE

    def _execute(self, command: int, now_s: float) -> None:
        machine, registers = self._machine, self.registers
        numbers: FloatArray = np.array(registers.double_in)
        returns_at_once = bool(registers.int_in[1])
        if command == MOVE_JOINTS:
            # Six joints, speed and acceleration.
            motion = Motion(machine.joints(now_s)[0], numbers[:6], *numbers[6:8].tolist())
            machine.start(motion, now_s)
            if returns_at_once:
                self._operation = (self._operation + 1) % 128
                self._signal(running=True)
            else:
                self._waiting = True
        elif command == STOP_JOINTS:
            machine.brake(now_s, max(numbers[0], 0.01))
            self._waiting = not returns_at_once
        elif command == SET_WATCHDOG:
            self._watchdog_hz, self._last_command_s = numbers[0], now_s
        elif command == GET_TOOL_OFFSET:
            registers.double_out[:6] = machine.options.tcp

    def _signal(self, *, running: bool) -> None:
        """Reports the asynchronous motion: count of reports, its number, whether it runs."""
        self._asynchronous = running
        self._writes = (self._writes + 1) % 256
        self.registers.int_out[2] = self._operation << 24 | self._writes << 16 | int(running) << 15
