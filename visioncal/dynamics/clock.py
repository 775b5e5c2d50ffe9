"""From the stamps of a controller's samples to an even clock, over what is lost of them."""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np

from visioncal.core.number_format import figure, some_of
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.dynamics.reading import RecordedSamples

# Steps that differ by more than this share of the usual are resampled. Where they are whole
# multiples of it but for the second share, others are missing between them; on a clock that is more
# uneven, only where a step is so many times the usual and longer than so much [s].
_JITTER, _EVEN, _GAP, _GAP_S = 0.02, 0.1, 2.5, 0.02
# Angles that repeat for so long, and so many times, while their steps are others just before and
# after, are frozen; so far is just before and after [s], [samples].
_FROZEN_S, _FROZEN, _AROUND = 0.05, 5, 5
# Behind them angles are off by so many times their steps and what they are resolved to.
_JUMP = 4.0


@dataclass(frozen=True, eq=False)
class StampClock:
    """The steps of a stream's stamps.

    Attributes:
        usual_s: From one sample to the next [s].
        counts: (m - 1,) how many usual steps each step is; more than one where samples are missing.
        jitter: How far steps are from whole ones, as a standard deviation over the usual step.
    """

    usual_s: float
    counts: IntArray
    jitter: float

    @classmethod
    def of(cls, times_s: FloatArray) -> Self:
        """Reads it off (m,) stamps [s]."""
        steps = np.diff(times_s)
        usual = float(np.median(steps))
        counts = np.maximum(np.rint(steps / usual), 1.0)
        jitter = _jitter(steps, counts, usual)
        if jitter > _EVEN:
            counts[steps <= max(_GAP * usual, _GAP_S)] = 1.0
            jitter = _jitter(steps, counts, usual)
        return cls(usual, counts.astype(np.int64), jitter)

    @property
    def even(self) -> bool:
        """Whether its steps are whole ones."""
        return self.jitter <= _JITTER


@dataclass(frozen=True, eq=False)
class Even:
    """A part of a stream on an even clock.

    Attributes:
        recorded: Its samples; angles are interpolated where they are missing.
        bad: (m, n) torques without information.
        there: (m,) where torques were recorded.
    """

    recorded: RecordedSamples
    bad: Mask
    there: Mask

    def __len__(self) -> int:
        return len(self.recorded)

    @property
    def rate_hz(self) -> float:
        """Samples a second."""
        times_s = self.recorded.times_s
        return (len(times_s) - 1) / float(times_s[-1] - times_s[0])


def even_parts(
    recorded: RecordedSamples, bad: Mask, clock: StampClock, widest_s: float
) -> list[Even]:
    """The parts between gaps, each on an even clock.

    Args:
        recorded: The samples.
        bad: (m, n) torques without information.
        clock: Of their stamps.
        widest_s: Angles are interpolated where samples are missing for no longer [s].
    """
    bounds = [0, *(_gaps_of(clock, widest_s) + 1), len(recorded)]
    return [
        _even(recorded, bad, clock, slice(begin, end))
        for begin, end in pairwise(bounds)
        if end - begin > 2
    ]


def _gaps_of(clock: StampClock, widest_s: float) -> IntArray:
    """The samples behind which others are missing for longer than that [s]."""
    return np.flatnonzero((clock.counts > 1) & ((clock.counts - 1) * clock.usual_s > widest_s))


def clock_notes(recorded: RecordedSamples, clock: StampClock, widest_s: float) -> list[str]:
    """What is wrong with a stream's clock, and what was done about it, in words."""
    steps, notes = np.diff(recorded.times_s), []
    gaps = _gaps_of(clock, widest_s)
    if len(gaps):
        places = [f"{recorded.times_s[index] - recorded.times_s[0]:.2f} s" for index in gaps]
        notes.append(
            f"{recorded.label}: samples are missing for up to {steps[gaps].max():.3g} s behind "
            f"{some_of(places, 3)}; nothing is interpolated there."
        )
    lost = clock.counts - 1
    lost[gaps] = 0
    if lost.any():
        share = 100.0 * float(lost.sum() / (lost.sum() + len(recorded)))
        notes.append(
            f"{recorded.label}: {figure(share)} % of its samples are missing here and there, for "
            f"up to {figure(steps[lost > 0].max())} s; angles are interpolated, torques are not."
        )
    if not clock.even:
        inner = np.delete(steps, np.flatnonzero(clock.counts > 1))
        notes.append(
            f"{recorded.label}: steps of its clock differ by {100.0 * clock.jitter:.0f} % (from "
            f"{1e3 * inner.min():.3g} to {1e3 * inner.max():.3g} ms); it was resampled evenly."
        )
    return notes


def _jitter(steps: FloatArray, counts: FloatArray, usual: float) -> float:
    near = counts * usual <= max(_GAP * usual, _GAP_S)
    return float(np.std((steps - counts * usual)[near])) / usual


def _even(recorded: RecordedSamples, bad: Mask, clock: StampClock, rows: slice) -> Even:
    """A part with a sample at every usual step."""
    times_s, counts = recorded.times_s[rows], clock.counts[rows.start : rows.stop - 1]
    places = np.concatenate([[0], np.cumsum(counts)])
    even = np.linspace(times_s[0], times_s[-1], places[-1] + 1)
    if clock.even:
        times_s = even[places]
    behind = np.clip(np.searchsorted(times_s, even, "right") - 1, 0, len(counts) - 1)
    near = np.minimum(np.abs(even - times_s[behind]), np.abs(times_s[behind + 1] - even))
    seen = (counts[behind] == 1) | (near < _JITTER * clock.usual_s)

    def at(values: FloatArray) -> FloatArray:
        return np.stack([np.interp(even, times_s, column) for column in values[rows].T], axis=1)

    part = replace(
        recorded,
        times_s=even,
        q=_bridged(even, at(recorded.q), seen),
        dq=None if recorded.dq is None else _bridged(even, at(recorded.dq), seen),
        torques_nm=at(recorded.torques_nm),
    )
    return Even(part, np.asarray(at(bad.astype(float)) > 0.0), seen)


def _bridged(times_s: FloatArray, values: FloatArray, seen: Mask) -> FloatArray:
    """Values (m, n) with cubic splines in place of those that were not seen."""
    if seen.all():
        return values
    from scipy.interpolate import CubicSpline

    bridged = values.copy()
    bridged[~seen] = CubicSpline(times_s[seen], values[seen])(times_s[~seen])
    return bridged


def without_frozen(recorded: RecordedSamples, notes: list[str]) -> RecordedSamples:
    """The stream without the rows in which angles of a joint repeat while it moves.

    A joint that stops, and one that sets off, has short steps just before and after; one whose
    angles are frozen has as long ones as ever, and a far longer one behind.
    """
    rows = np.ones(len(recorded), dtype=bool)
    for angles in recorded.q.T:
        rows &= ~_frozen(recorded.times_s, angles)
    if rows.all():
        return recorded
    begins = np.flatnonzero(rows[:-1] & ~rows[1:])
    ends = np.flatnonzero(~rows & np.append(rows[1:], True))
    lasted = recorded.times_s[ends] - recorded.times_s[begins]
    places = [f"{recorded.times_s[begin] - recorded.times_s[0]:.2f} s" for begin in begins]
    notes.append(
        f"{recorded.label}: angles are frozen for up to {figure(float(lasted.max()))} s behind "
        f"{some_of(places, 3)}, though the joints move; these {(~rows).sum()} rows are left out."
    )
    return recorded.among(rows)


def _frozen(times_s: FloatArray, angles: FloatArray) -> Mask:
    """(m,) which of a joint's angles are those of the last sample before a longer step."""
    frozen = np.zeros(len(angles), dtype=bool)
    steps = np.abs(np.diff(angles))
    if not steps.any():
        return frozen
    resolved = float(steps[steps > 0.0].min())
    edges = np.diff(np.concatenate([[False], steps == 0.0, [False]]).astype(np.int8))
    for begin, end in np.flatnonzero(edges).reshape(-1, 2):
        if end - begin < _FROZEN or times_s[end] - times_s[begin] < _FROZEN_S or end == len(steps):
            continue
        before, after = steps[max(begin - _AROUND, 0) : begin], steps[end + 1 : end + 1 + _AROUND]
        around = max(float(np.median(array)) if len(array) else 0.0 for array in (before, after))
        if steps[end] > _JUMP * max(around, resolved):
            frozen[begin + 1 : end + 1] = True
    return frozen
