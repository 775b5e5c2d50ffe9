"""RTDE variables of a simulated controller."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.live.rehearsal.machine import Machine, tool_pose
from visioncal.live.rehearsal.rtde_wire import Value
from visioncal.live.rehearsal.script import Registers
from visioncal.simulation.arms import link_frames

_RUNTIME = {"stopped": 1, "playing": 2, "paused": 4}
_MODES = {"POWER_OFF": 3, "IDLE": 5, "RUNNING": 7}
_SAFETY_MODES = {"normal": 1, "protective-stop": 3, "emergency-stop": 7}
# Bits of `safety_status_bits`: normal mode, protective stop, robot emergency stop, emergency stop.
_SAFETY_BITS = {"normal": 1 << 0, "protective-stop": 1 << 2, "emergency-stop": 1 << 6 | 1 << 7}
_POWER_ON, _PROGRAM_RUNNING, _POWER_BUTTON = 1 << 0, 1 << 1, 1 << 3
_GRAVITY = 9.81
# A plausible arm: total mass [kg], each link's share of it, torque constant after the gear [Nm/A],
# and friction [A].
_MASS_KG = {"ur3e": 11.2, "ur5e": 20.6, "ur10e": 33.5}
_SHARES = np.array([0.20, 0.40, 0.16, 0.09, 0.09, 0.06])
_TORQUE_PER_A = np.array([13.0, 13.0, 13.0, 9.0, 9.0, 9.0])
_FRICTION_A = np.array([0.5, 0.5, 0.4, 0.2, 0.2, 0.2])
# Final temperatures of joints at rest, room temperature [C], and the time constant [s].
_WARM_C = np.array([31.0, 32.5, 33.0, 34.5, 35.5, 36.0])
_ROOM_C, _WARMING_S = 23.0, 1800.0


@dataclass(frozen=True, eq=False)
class Moment:
    """The machine at one moment.

    Attributes:
        now_s: The moment, on the monotonic clock [s].
        up_s: Uptime of the controller [s].
    """

    machine: Machine
    registers: Registers
    now_s: float
    up_s: float

    @cached_property
    def joints(self) -> tuple[FloatArray, FloatArray]:
        """Angles [rad] and speeds [rad/s]."""
        return self.machine.joints(self.now_s)

    @cached_property
    def tcp_pose(self) -> tuple[float, ...]:
        """Pose of the tool by the controller's model."""
        return tuple(tool_pose(self.machine, self.joints[0]).tolist())

    @cached_property
    def currents(self) -> tuple[float, ...]:
        """Motor currents that hold the links and the load, and overcome friction [A]."""
        arm = self.machine.believed
        frames = link_frames(arm, self.joints[0][None])[0]
        origins, axes = frames[:, :3, 3], frames[:-1, :3, 2]
        centres = 0.5 * (origins[:-1] + origins[1:])
        load = origins[-1] + frames[-1, :3, :3] @ self.machine.payload_m
        masses = np.append(_MASS_KG[arm.name] * _SHARES, self.machine.payload_kg)
        levers = np.vstack([centres, load])[None] - origins[:-1, None]
        # Gravity torque of body k about joint i, for the bodies beyond that joint.
        pulls = np.cross(levers, [0.0, 0.0, _GRAVITY])
        torques = np.einsum("ik,k,ikx,ix->i", np.triu(np.ones((6, 7))), masses, pulls, axes)
        friction = _FRICTION_A * np.tanh(self.joints[1] / 0.01)
        return tuple((torques / _TORQUE_PER_A + friction).tolist())

    @property
    def temperatures(self) -> tuple[float, ...]:
        """Joint temperatures [C]."""
        warm = 1.0 - math.exp(-self.up_s / _WARMING_S)
        return tuple((_ROOM_C + warm * (_WARM_C - _ROOM_C)).tolist())

    @property
    def status_bits(self) -> int:
        """Power, program, power button."""
        power = _POWER_ON if self.machine.mode != "POWER_OFF" else 0
        program = _PROGRAM_RUNNING if self.machine.program == "playing" else 0
        return power | program | _POWER_BUTTON


_Reader = Callable[[Moment], Value]


def _constant(value: Value) -> _Reader:
    return lambda _: value


def _register(kind: str, index: int) -> _Reader:
    return lambda moment: getattr(moment.registers, f"{kind}_out")[index]


def _table() -> dict[str, tuple[str, _Reader]]:
    """Variables by name: type, and reader of the value."""
    six, three = "VECTOR6D", "VECTOR3D"
    table: dict[str, tuple[str, _Reader]] = {
        "timestamp": ("DOUBLE", lambda moment: moment.up_s),
        "joint_temperatures": (six, lambda moment: moment.temperatures),
        "joint_mode": ("VECTOR6INT32", _constant((253,) * 6)),
        "robot_mode": ("INT32", lambda moment: _MODES.get(moment.machine.mode, -1)),
        "safety_mode": ("INT32", lambda moment: _SAFETY_MODES[moment.machine.safety]),
        "runtime_state": ("UINT32", lambda moment: _RUNTIME[moment.machine.program]),
        "robot_status_bits": ("UINT32", lambda moment: moment.status_bits),
        "safety_status_bits": ("UINT32", lambda moment: _SAFETY_BITS[moment.machine.safety]),
        "payload": ("DOUBLE", lambda moment: moment.machine.payload_kg),
        "payload_cog": (three, lambda moment: tuple(moment.machine.payload_m.tolist())),
        "actual_tool_accelerometer": (three, _constant((0.0, 0.0, _GRAVITY))),
        "actual_main_voltage": ("DOUBLE", _constant(48.0)),
        "actual_robot_voltage": ("DOUBLE", _constant(48.0)),
        "actual_joint_voltage": (six, _constant((48.0,) * 6)),
        "actual_digital_input_bits": ("UINT64", _constant(0.0)),
        "actual_digital_output_bits": ("UINT64", _constant(0.0)),
    }
    # Targets are reached at once.
    for kind in ("actual", "target"):
        table[f"{kind}_q"] = (six, lambda moment: tuple(moment.joints[0].tolist()))
        table[f"{kind}_qd"] = (six, lambda moment: tuple(moment.joints[1].tolist()))
        table[f"{kind}_current"] = (six, lambda moment: moment.currents)
        table[f"{kind}_TCP_pose"] = (six, lambda moment: moment.tcp_pose)
    table |= dict.fromkeys(("speed_scaling", "target_speed_fraction"), ("DOUBLE", _constant(1.0)))
    numbers = ("actual_execution_time", "actual_momentum", "actual_robot_current")
    analog = [f"standard_analog_{way}{place}" for way in ("input", "output") for place in (0, 1)]
    table |= dict.fromkeys((*numbers, *analog), ("DOUBLE", _constant(0.0)))
    vectors = ("target_qdd", "target_moment", "joint_control_output", "actual_TCP_speed")
    more = ("actual_TCP_force", "target_TCP_speed", "ft_raw_wrench", "payload_inertia")
    table |= dict.fromkeys((*vectors, *more), (six, _constant((0.0,) * 6)))
    for place in range(48):
        table[f"output_int_register_{place}"] = ("INT32", _register("int", place))
        table[f"output_double_register_{place}"] = ("DOUBLE", _register("double", place))
    return table


VARIABLES: Mapping[str, tuple[str, _Reader]] = _table()


def input_type(name: str) -> str:
    """Type of a variable that a client may write; empty for any other name."""
    if name.startswith("input_int_register_"):
        return "INT32"
    if name.startswith("input_double_register_"):
        return "DOUBLE"
    if re.fullmatch("(standard|configurable|tool)_digital_output(_mask)?", name):
        return "UINT8"
    if re.fullmatch("standard_analog_output_(mask|type)", name):
        return "UINT8"
    if re.fullmatch("standard_analog_output_[01]|speed_slider_fraction", name):
        return "DOUBLE"
    other_types = {"external_force_torque": "VECTOR6D", "speed_slider_mask": "UINT32"}
    return other_types.get(name, "")
