"""Reading of joint angles and torques from the streams of a session, on one even clock."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray, IntArray, Mask, chosen_rows, interpolated
from visioncal.robot.trajectory import GAP_RATIO, SHORT_GAP_S
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
# Clocks whose jitter exceeds this share of the usual step are resampled.
_JITTER = 0.02


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
        return chosen_rows(self, slice(round(begin * len(self)), round(end * len(self))))


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
    units = {"q": "rad", "tau": "nm", "current": "a", "dq": "rad_s"}
    joints = range(1, count + 1)
    names = {name: [f"{name}{joint}_{unit}" for joint in joints] for name, unit in units.items()}
    present = {word: [name in stream for name in names[word]] for word in names}
    known = {name for columns in names.values() for name in columns}
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
    gains = np.asarray(gains_nm_a if of_currents else np.ones(count), dtype=float)
    if gains.shape != (count,) or not (np.isfinite(gains) & (gains > 0.0)).all():
        raise DataError(
            f"{label} holds currents and no torques: it needs {count} gains above 0 [N m/A] to "
            f"turn them into torques, not {list(gains_nm_a)}.",
            culprits=[label],
            next_step="Give them with --gains K1,K2,...: the motor's torque constant times the "
            "gear's ratio. From motion alone gains and masses cannot be separated; visioncal "
            "dynamics gains finds them by a known body on the flange.",
        )
    with_dq = all(present["dq"])
    columns = [*names["q"], *names[drive], *(names["dq"] if with_dq else [])]
    times_s, values = stream.group(columns)
    if len(times_s) < _LEAST_SAMPLES:
        raise DataError(
            f"{label} has {len(times_s)} samples with angles and torques of all joints, but "
            f"needs at least {_LEAST_SAMPLES}.",
            culprits=[label],
            next_step=_HOW,
        )
    usual_s = float(np.median(np.diff(times_s)))
    if usual_s > _SLOWEST_S:
        raise too_far_apart(label, usual_s, _SLOWEST_S)
    q, torques, dq = (values[:, at * count : (at + 1) * count] for at in range(3))
    return RecordedSamples(label, times_s, q, dq if with_dq else None, gains * torques, of_currents)


@dataclass(frozen=True, eq=False)
class StampClock:
    """Sampling clock of a stream."""

    usual_s: float  # Median step from one sample to the next [s].
    counts: IntArray  # (m - 1,) each step in usual steps; more than one where samples are missing.
    jitter: float  # Standard deviation of the steps from whole multiples, over the usual step.

    @classmethod
    def of(cls, times_s: FloatArray) -> Self:
        """Determines the clock of (m,) stamps [s]."""
        steps = np.diff(times_s)
        usual = float(np.median(steps))
        counts = np.maximum(np.rint(steps / usual), 1.0)
        jitter = _jitter(steps, counts, usual)
        # Up to this share of jitter, a step of several usual ones means missing samples; on a less
        # even clock, only a gap as of a trajectory.
        if jitter > 0.1:
            counts[steps <= max(GAP_RATIO * usual, SHORT_GAP_S)] = 1.0
            jitter = _jitter(steps, counts, usual)
        return cls(usual, counts.astype(np.int64), jitter)

    @property
    def even(self) -> bool:
        """Whether the jitter is small enough to do without resampling."""
        return self.jitter <= _JITTER


@dataclass(frozen=True, eq=False)
class EvenPart:
    """A part of a stream without long gaps, on an even clock."""

    samples: RecordedSamples  # Its samples; angles are interpolated where they are missing.
    invalid: Mask  # (m, n) torques without information.
    present: Mask  # (m,) where torques were recorded.

    def __len__(self) -> int:
        return len(self.samples)

    @property
    def rate_hz(self) -> float:
        """Samples a second."""
        times_s = self.samples.times_s
        return (len(times_s) - 1) / float(times_s[-1] - times_s[0])


def even_parts(
    recorded: RecordedSamples, invalid: Mask, clock: StampClock, longest_gap_s: float
) -> list[EvenPart]:
    """Splits a stream at long gaps, and resamples each part to an even clock.

    Args:
        recorded: The samples.
        invalid: (m, n) torques without information.
        clock: Their clock.
        longest_gap_s: Longest gap over which angles are interpolated [s].
    """
    bounds = [0, *(_gaps_of(clock, longest_gap_s) + 1), len(recorded)]
    return [
        _resampled(recorded, invalid, clock, slice(begin, end))
        for begin, end in pairwise(bounds)
        if end - begin > 2
    ]


def _gaps_of(clock: StampClock, longest_gap_s: float) -> IntArray:
    """Indices of the samples before gaps that are longer than that [s]."""
    return np.flatnonzero((clock.counts > 1) & ((clock.counts - 1) * clock.usual_s > longest_gap_s))


def gap_notes(recorded: RecordedSamples, clock: StampClock, longest_gap_s: float) -> list[str]:
    """Message on the gaps of a stream."""
    gaps = _gaps_of(clock, longest_gap_s)
    if not len(gaps):
        return []
    places = [f"{recorded.times_s[index] - recorded.times_s[0]:.2f} s" for index in gaps]
    return [
        f"{recorded.label}: samples are missing for up to "
        f"{np.diff(recorded.times_s)[gaps].max():.3g} s behind {some_of(places, 3)}; nothing is "
        "interpolated there."
    ]


def _jitter(steps: FloatArray, counts: FloatArray, usual: float) -> float:
    without_gaps = counts * usual <= max(GAP_RATIO * usual, SHORT_GAP_S)
    return float(np.std((steps - counts * usual)[without_gaps])) / usual


def _resampled(
    recorded: RecordedSamples, invalid: Mask, clock: StampClock, rows: slice
) -> EvenPart:
    """Resamples rows to a sample at every usual step."""
    times_s, counts = recorded.times_s[rows], clock.counts[rows.start : rows.stop - 1]
    indices = np.concatenate([[0], np.cumsum(counts)])
    even_s = np.linspace(times_s[0], times_s[-1], indices[-1] + 1)
    if clock.even:
        times_s = even_s[indices]
    before = np.clip(np.searchsorted(times_s, even_s, "right") - 1, 0, len(counts) - 1)
    distance_s = np.minimum(np.abs(even_s - times_s[before]), np.abs(times_s[before + 1] - even_s))
    present = (counts[before] == 1) | (distance_s < _JITTER * clock.usual_s)

    def at(values: FloatArray) -> FloatArray:
        return interpolated(even_s, times_s, values[rows])

    part = replace(
        recorded,
        times_s=even_s,
        q=_bridged(even_s, at(recorded.q), present),
        dq=None if recorded.dq is None else _bridged(even_s, at(recorded.dq), present),
        torques_nm=at(recorded.torques_nm),
    )
    return EvenPart(part, np.asarray(at(invalid.astype(float)) > 0.0), present)


def _bridged(times_s: FloatArray, values: FloatArray, present: Mask) -> FloatArray:
    """Values (m, n) with the missing ones replaced by cubic splines."""
    if present.all():
        return values
    from scipy.interpolate import CubicSpline

    bridged = values.copy()
    bridged[~present] = CubicSpline(times_s[present], values[present])(times_s[~present])
    return bridged
