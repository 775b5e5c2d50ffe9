"""What a simulated controller is made of."""

from dataclasses import dataclass, field

import numpy as np

from visioncal.simulation.arms import Arm, ArmErrors, disturb, ur_arm

# Elbow up, the tool looking down: clear of every singularity.
_HOME = (0.0, -1.45, 1.75, -1.9, -1.5708, 0.0)


@dataclass(frozen=True)
class ControllerOptions:
    """A simulated controller and its arm.

    Attributes:
        robot: `ur3e`, `ur5e` or `ur10e`.
        seed: Of everything random.
        errors: How the real arm departs from what its controller believes.
        q: Joint angles at the start [rad].
        tcp: The tool offset that is set: x, y, z [m] and a rotation vector [rad].
        payload_kg: The load that is set [kg].
        payload_m: Its centre in the flange frame [m].
        repeatability_rad: How far a joint stands beside what its encoder says, drawn anew at each
            arrival [rad].
        polyscope: What the dashboard answers when asked for its version.
        remote: Whether remote control is on.
        safety: `normal`, `protective-stop` or `emergency-stop`, at the start.
        mode: The robot's mode at the start, in the dashboard's words: `RUNNING`, `POWER_OFF`.
        rate_hz: States a second.
    """

    robot: str = "ur10e"
    seed: int = 0
    errors: ArmErrors = field(default_factory=lambda: ArmErrors(3e-4, 3e-4, 5e-4))
    q: tuple[float, ...] = _HOME
    tcp: tuple[float, ...] = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
    payload_kg: float = 0.6
    payload_m: tuple[float, ...] = (0.0, 0.0, 0.04)
    repeatability_rad: float = 1e-5
    polyscope: str = "URSoftware 5.11.6.1010000 (Aug 01 2024)"
    remote: bool = True
    safety: str = "normal"
    mode: str = "RUNNING"
    rate_hz: float = 125.0


def believed_arm(options: ControllerOptions) -> Arm:
    """The arm by which the controller reckons: its data sheet."""
    return ur_arm(options.robot)


def true_arm(options: ControllerOptions) -> Arm:
    """The arm that really stands there."""
    return disturb(believed_arm(options), options.errors, np.random.default_rng([options.seed, 2]))
