"""Reading of joint angles and torques from the streams of a session."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, Mask
from visioncal.session import Stream, too_far_apart

_NUMBERED = re.compile(r"(q|tau|current|dq)([1-9][0-9]*)_(rad|nm|a|rad_s)", re.ASCII)
# Least number of samples of a motion.
_LEAST_SAMPLES = 200
# Greatest usual step between samples [s].
_SLOWEST_S = 0.5
_HOW = (
    "A stream for dynamics has stamp_s, q1_rad ..., and tau1_nm ... or current1_a ... of every "
    "joint, from the base to the tip; dq1_rad_s ... where the controller reports speeds."
)


@dataclass(frozen=True, eq=False)
class RecordedSamples:
    """The complete samples of a stream."""

    label: str  # The stream's file, for messages: `streams/robot.csv`.
    times_s: FloatArray  # (m,) times [s].
    q: FloatArray  # (m, n) joint angles [rad].
    dq: FloatArray | None  # (m, n) reported speeds [rad/s]; None where the controller reports none.
    torques_nm: FloatArray  # (m, n) torques of the joints [N m].
    of_currents: bool = False  # Whether the torques are currents times gains.

    def __len__(self) -> int:
        return len(self.times_s)

    def part(self, begin: float, end: float) -> "RecordedSamples":
        """The samples between two fractions of the stream, 0 to 1."""
        return self.among(slice(round(begin * len(self)), round(end * len(self))))

    def among(self, rows: slice | Mask) -> "RecordedSamples":
        """The samples of given rows."""
        return replace(
            self,
            times_s=self.times_s[rows],
            q=self.q[rows],
            dq=None if self.dq is None else self.dq[rows],
            torques_nm=self.torques_nm[rows],
        )


def read_recorded(
    stream: Stream, label: str, count: int, gains_nm_a: Sequence[float] = ()
) -> RecordedSamples:
    """Reads the columns of a stream that identification needs.

    Args:
        stream: The stream.
        label: Its file, for messages.
        count: The robot's number of joints.
        gains_nm_a: (count,) joint torque per current, where currents were recorded instead of
            torques [N m/A].

    Raises:
        DataError: Columns of a joint are missing, there are columns of more joints than the robot
            has, currents have no gains, too few samples are complete, or stamps are not in seconds.
    """
    names = {name: _names(name, count) for name in ("q", "tau", "current", "dq")}
    present = {word: [name in stream for name in names[word]] for word in names}
    _check_joints(stream, label, count)
    of_currents = not any(present["tau"]) and any(present["current"])
    drive = "current" if of_currents else "tau"
    missing = [
        name
        for group in ("q", drive)
        for name, is_present in zip(names[group], present[group], strict=True)
        if not is_present
    ]
    if missing:
        raise DataError(
            f"{label} lacks {', '.join(missing)}: the robot has {count} joints.",
            culprits=[f"{label}, {name}" for name in missing],
            next_step=_HOW,
        )
    gains = _gains(label, count, gains_nm_a) if of_currents else np.ones(count)
    with_dq = all(present["dq"])
    columns = [*names["q"], *names[drive], *(names["dq"] if with_dq else [])]
    times_s, values = stream.group(columns)
    if len(times_s) < _LEAST_SAMPLES:
        raise DataError(
            f"{label} has {len(times_s)} samples with angles and torques of all joints, and at "
            f"least {_LEAST_SAMPLES} are needed.",
            culprits=[label],
            next_step=_HOW,
        )
    usual_s = float(np.median(np.diff(times_s)))
    if usual_s > _SLOWEST_S:
        raise too_far_apart(label, usual_s, _SLOWEST_S)
    q, torques, dq = (values[:, at * count : (at + 1) * count] for at in range(3))
    return RecordedSamples(label, times_s, q, dq if with_dq else None, gains * torques, of_currents)


def _names(kind: str, count: int) -> list[str]:
    unit = {"q": "rad", "dq": "rad_s", "tau": "nm", "current": "a"}[kind]
    return [f"{kind}{joint}_{unit}" for joint in range(1, count + 1)]


def _check_joints(stream: Stream, label: str, count: int) -> None:
    """Refuses columns of joints that the robot does not have."""
    known = {name for kind in ("q", "dq", "tau", "current") for name in _names(kind, count)}
    beyond = [
        column for column in stream.columns if _NUMBERED.fullmatch(column) and column not in known
    ]
    if beyond:
        raise DataError(
            f"{label} has {', '.join(beyond)}, but the robot has {count} joints.",
            culprits=[f"{label}, {name}" for name in beyond],
            next_step="Name the robot that was recorded under [robot] in session.toml, or leave "
            "the columns of other axes out.",
        )


def _gains(label: str, count: int, gains_nm_a: Sequence[float]) -> FloatArray:
    gains = np.asarray(gains_nm_a, dtype=float)
    if gains.shape == (count,) and np.isfinite(gains).all() and (gains > 0.0).all():
        return gains
    raise DataError(
        f"{label} holds currents and no torques; {count} gains above 0 [N m/A] are needed to turn "
        f"them into torques, not {list(gains_nm_a)}.",
        culprits=[label],
        next_step="Give them with --gains K1,K2,...: the motor's torque constant times the gear's "
        "ratio. From motion alone gains and masses cannot be separated; visioncal dynamics gains "
        "finds them by a known body on the flange.",
    )
