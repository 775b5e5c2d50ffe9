"""Condition of a UR controller, and the remedy where it is not usable."""

import re
from dataclasses import dataclass

from visioncal.core.errors import DriverError
from visioncal.live.drivers.protocols import Safety
from visioncal.live.drivers.ur_net import Dashboard

_VERSION = re.compile(r"(\d+)\.(\d+)\.(\d+)\.\d+")
# Oldest versions with the floating-point registers that ur-rtde's control script needs.
_LEAST = {3: (3, 4), 5: (5, 4)}
# First version that reports whether it is in remote control.
_REPORTS_REMOTE = (5, 6)
_RUNNING = "RUNNING"
# Models that exist in two series, of which the dashboard reports only the size.
_MODELS_OF_TWO_SERIES = ("UR3", "UR5", "UR10", "UR16")
# Modes in which joints report their positions.
_REPORTING_MODES = (_RUNNING, "IDLE", "BACKDRIVE")
_MODE_STEPS = {
    "POWER_OFF": "Switch it on at the pendant: the circle at the lower left, then On and Start.",
    "IDLE": "Release its brakes at the pendant: the circle at the lower left, then Start.",
}
_EMERGENCY = (
    "Make sure that the cell is clear, pull out the emergency-stop button, and switch the arm on "
    "at the pendant."
)
_PROTECTIVE = (
    "Look what the arm touches or which limit it met, and free it; then press Enable Robot on the "
    "pendant, which waits 5 s, and go on."
)
_SAFETY_STEPS = {
    "PROTECTIVE_STOP": _PROTECTIVE,
    "SAFEGUARD_STOP": "Close the safety gate, or leave the scanner's field, and reset it.",
    "AUTOMATIC_MODE_SAFEGUARD_STOP": "Close the safety gate and reset it.",
    "RECOVERY": "Move the arm back within its safety limits by hand, in recovery mode.",
    "SYSTEM_EMERGENCY_STOP": _EMERGENCY,
    "ROBOT_EMERGENCY_STOP": _EMERGENCY,
    "SYSTEM_THREE_POSITION_ENABLING_STOP": "Hold the enabling switch, or go to automatic mode.",
}
_FAULT_STEP = "Read the pendant's log, and start the controller anew."
# RTDE's `safety_status_bits`, the gravest first.
_SAFETY_BITS: tuple[tuple[int, Safety], ...] = (
    (1 << 8 | 1 << 9, "fault"),
    (1 << 5 | 1 << 6 | 1 << 7, "emergency-stop"),
    (1 << 2 | 1 << 3 | 1 << 4, "protective-stop"),
    (1 << 1, "reduced"),
)


@dataclass(frozen=True)
class Condition:
    """The dashboard's answers."""

    host: str
    version: tuple[int, int, int]  # PolyScope's version: major, minor, bug fix.
    model: str  # The arm's name, such as `UR10e`.
    mode: str  # The robot's mode, such as `RUNNING`.
    safety: str  # The state of the safety system, such as `NORMAL`.
    remote: bool  # Whether it is in remote control; True where it does not report it.

    def check_moves(self) -> None:
        """Checks that it can be moved from outside.

        Raises:
            DriverError: It cannot, with the remedy.
        """
        if self.safety not in ("NORMAL", "REDUCED"):
            raise self._refuse(
                f"is stopped by its safety system: {self.safety}",
                _SAFETY_STEPS.get(self.safety, _FAULT_STEP),
            )
        self.check_reports()
        if self.mode != _RUNNING:
            raise self._refuse(f"is not ready to move: its mode is {self.mode}", self._mode_step)
        if not self.remote:
            raise self._refuse(
                "is in local control, and takes no orders from here",
                "Switch it to Remote Control at the upper right of the pendant; the mode is there "
                "once it is enabled under Settings > System > Remote Control.",
            )

    def check_reports(self) -> None:
        """Checks that it reports its joint positions.

        Raises:
            DriverError: It does not, with the remedy.
        """
        if self.mode not in _REPORTING_MODES:
            raise self._refuse(
                f"does not know where its joints are: its mode is {self.mode}", self._mode_step
            )

    @property
    def _mode_step(self) -> str:
        return _MODE_STEPS.get(self.mode, "Look at the pendant, and switch the arm on there.")

    def _refuse(self, why: str, step: str) -> DriverError:
        return DriverError(
            f"The {self.model} at {self.host} {why}.", culprits=[self.host], next_step=step
        )


def read_condition(host: str) -> Condition:
    """Reads the condition from the dashboard.

    Raises:
        DriverError: It cannot be reached, is not a UR's, or is too old.
    """
    with Dashboard(host) as dashboard:
        version = _read_version(host, dashboard.ask("PolyscopeVersion"))
        model = dashboard.ask("get robot model")
        mode = dashboard.ask("robotmode").rpartition(":")[2].strip()
        query = "safetystatus" if version >= (5, 4, 0) else "safetymode"
        safety = dashboard.ask(query).rpartition(":")[2].strip()
        remote = (
            version < _REPORTS_REMOTE or "true" in dashboard.ask("is in remote control").lower()
        )
    series = "e" if version[0] == 5 and model in _MODELS_OF_TWO_SERIES else ""
    return Condition(host, version, f"{model}{series}", mode, safety, remote)


def safety_of(bits: int) -> Safety:
    """Reads RTDE's `safety_status_bits`."""
    for mask, safety in _SAFETY_BITS:
        if bits & mask:
            return safety
    return "normal"


def _read_version(host: str, text: str) -> tuple[int, int, int]:
    match = _VERSION.search(text)
    version = tuple(map(int, match.groups())) if match else ()
    if len(version) != 3:
        raise DriverError(
            f"The controller at {host} answers {text[:60]!r} when asked for its version; four "
            "numbers are needed, as in URSoftware 5.11.0.108249.",
            culprits=[host],
            next_step="Check that the address is a UR's with PolyScope 3 or 5.",
        )
    major, minor, patch = version
    if major not in _LEAST or (major, minor) < _LEAST[major]:
        raise DriverError(
            f"The controller at {host} has PolyScope {major}.{minor}.{patch}; ur-rtde needs 3.4 or "
            "newer on the CB-series, and 5.4 or newer on the e-Series.",
            culprits=[host],
            next_step="Update PolyScope, or type poses by hand with the manual arm.",
        )
    return major, minor, patch
