"""From what a controller recorded to motions and torques that a regression can take."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.ndimage import binary_opening, median_filter, uniform_filter1d

from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.core.types import FloatArray, Mask
from visioncal.dynamics.clock import StampClock, clock_notes, even_parts, without_frozen
from visioncal.dynamics.lowpass import WIDER, LowPass, band_of, smoothed_motion, window_of
from visioncal.dynamics.motion import JointMotion, Measured
from visioncal.dynamics.reading import RecordedSamples

# Torques of a rigid arm have all but their friction's corners within so many times the band of its
# motion; below so many a second there is little to estimate noise from, and beyond the other gears
# and links swing by themselves [Hz]. Motions are smoothed no less than so many times wider.
_TORQUE_BAND, _LEAST_HZ, _MOST_HZ, _WIDEST = 10.0, 4.0, 10.0, 3.0
# Angles are interpolated where no more than this share of a smoothing polynomial's samples is
# missing on end: there the others determine it.
_BRIDGED = 0.25
# Torques at rest on an extreme for so many samples on end, within this share of it, are cut off.
_FLAT_SAMPLES, _FLAT = 5, 1e-6
_MOST_AT_LIMIT = 0.2
# A joint that is slower than this in the mean of so long, for so long, stands still [rad/s], [s].
_REST_RAD_S, _REST_S = 1e-3, 0.1
# Torques that stand out from their neighbours by so many times what is usual, and by this share of
# their range, are slips of the line.
_SPIKE, _SPIKE_SHARE, _NEIGHBOURS = 10.0, 0.02, 5
# So many samples' regressors are held at a time.
_SAMPLES_AT_ONCE = 20_000
# An output that rests on bad samples by more than this share is not used.
_TOUCHED = 0.02
# Nor is one for which more than this share of its samples is missing.
_MOST_MISSING = 0.5


@dataclass(frozen=True, eq=False)
class Piece:
    """Evenly sampled motion and torques without a gap, and how they are to be filtered.

    Attributes:
        measured: The samples.
        bad: (m, n) torques without information: cut off, or of a joint that stands still.
        there: (m,) where torques were recorded; the filter takes the regressor's rows from there,
            too, so that both are sums over the same samples.
        lowpass: For torques and regressor alike.
    """

    measured: Measured
    bad: Mask
    there: Mask
    lowpass: LowPass

    @property
    def times_s(self) -> FloatArray:
        """(k,) when the filtered samples are [s]."""
        begin, count = self.lowpass.half, self.lowpass.count(len(self.measured))
        return self.measured.motion.times_s[begin :: self.lowpass.step][:count]

    @property
    def torques_nm(self) -> FloatArray:
        """(k, n) filtered torques [N m]."""
        return self.lowpass(self.measured.torques_nm, self.there)

    def filtered(self, columns: Callable[[JointMotion], FloatArray]) -> FloatArray:
        """Filters what is computed of a motion (m, ...), a part of it at a time: (k, ...)."""
        step, width = self.lowpass.step, len(self.lowpass.taps)
        total, parts = self.lowpass.count(len(self.measured)), []
        at_once = max(_SAMPLES_AT_ONCE // step, 1)
        for begin in range(0, total, at_once):
            end = min(begin + at_once, total)
            rows = slice(begin * step, (end - 1) * step + width)
            values = columns(self.measured.motion.chosen(rows))
            parts.append(self.lowpass(values, self.there[rows]))
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    @property
    def used(self) -> Mask:
        """(k, n) which of the filtered torques rest on good samples."""
        used = np.ones((len(self.times_s), self.bad.shape[1]), dtype=bool)
        if self.bad.any():
            used &= self.lowpass.touched(self.bad) <= _TOUCHED
        if not self.there.all():
            used &= self.lowpass.touched(~self.there)[:, None] <= _MOST_MISSING
        return used

    def advanced(self, lag_s: float) -> Self:
        """The same with torques of so much later in the place of theirs [s]."""
        times_s = self.measured.motion.times_s
        later = times_s + lag_s

        def at(values: FloatArray) -> FloatArray:
            return np.stack([np.interp(later, times_s, column) for column in values.T], axis=1)

        lost = at((~self.there)[:, None].astype(float))[:, 0] > 0.0
        there = ~lost & (later >= times_s[0]) & (later <= times_s[-1])
        measured = replace(self.measured, torques_nm=at(self.measured.torques_nm))
        # Of joints at rest both what was recorded then and what stands there now says nothing.
        bad = self.bad | (at(self.bad.astype(float)) > 0.0)
        return replace(self, measured=measured, bad=np.asarray(bad), there=np.asarray(there))


@dataclass(frozen=True, eq=False)
class Conditioned:
    """A stream, ready for a regression.

    Attributes:
        label: Its place, for messages.
        pieces: What lies between its gaps.
        band_hz: Highest frequency of the motion [Hz].
        cutoff_hz: Where the low-pass is 6 dB down [Hz].
        rate_hz: Samples a second.
        notes: What was found in the samples and done about it, in words.
        of_currents: Whether the torques are currents times gains.
    """

    label: str
    pieces: tuple[Piece, ...]
    band_hz: float
    cutoff_hz: float
    rate_hz: float
    notes: tuple[str, ...]
    of_currents: bool = False

    @property
    def count(self) -> int:
        """How many filtered samples there are."""
        return sum(len(piece.times_s) for piece in self.pieces)

    @property
    def times_s(self) -> FloatArray:
        """(k,) when the filtered samples are [s]."""
        return np.concatenate([piece.times_s for piece in self.pieces])

    @property
    def torques_nm(self) -> FloatArray:
        """(k, n) filtered torques [N m]."""
        return np.concatenate([piece.torques_nm for piece in self.pieces])

    @property
    def used(self) -> Mask:
        """(k, n) which of the filtered torques rest on good samples."""
        return np.concatenate([piece.used for piece in self.pieces])

    @property
    def correlation(self) -> FloatArray:
        """What the filter leaves of white noise from one sample to the next, and so on."""
        return self.pieces[0].lowpass.correlation

    def filtered(self, columns: Callable[[JointMotion], FloatArray]) -> FloatArray:
        """Filters what is computed of the motion, as the torques are: (k, ...)."""
        parts = [piece.filtered(columns) for piece in self.pieces]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def advanced(self, lag_s: float) -> Self:
        """The same with torques of so much later in the place of theirs [s]."""
        return replace(self, pieces=tuple(piece.advanced(lag_s) for piece in self.pieces))


def condition(
    recorded: RecordedSamples, cutoff_hz: float | None = None, limits_nm: FloatArray | None = None
) -> Conditioned:
    """Resamples, differentiates and filters a stream.

    Torques and regressor go through the same low-pass, which therefore moves no parameter (Gautier
    1997, parallel filtering). It shifts nothing in time.

    Args:
        recorded: The stream's samples.
        cutoff_hz: Where the low-pass is 6 dB down [Hz]; ten times the motion's band, 4 to 10 Hz,
            where None.
        limits_nm: (n,) torques beyond which the drives give none [N m], where known.

    Raises:
        DataError: No part without gaps is as long as the filters.
    """
    notes: list[str] = []
    recorded = without_frozen(recorded, notes)
    torques, bad = _cleaned(recorded, limits_nm, notes)
    recorded = replace(recorded, torques_nm=torques)
    clock = StampClock.of(recorded.times_s)
    # Of how slow a motion may be, until its band is known.
    slowest = min(_LEAST_HZ if cutoff_hz is None else cutoff_hz, 0.25 / clock.usual_s)
    widest_s = _widest(slowest, 1.0 / clock.usual_s, clock.usual_s)
    parts = even_parts(recorded, bad, clock, widest_s)
    longest = max(parts, key=len)
    rate_hz = longest.rate_hz
    band_hz = band_of(longest.recorded.q, rate_hz)
    usual = min(max(_TORQUE_BAND * band_hz, _LEAST_HZ), _MOST_HZ)
    cutoff = min(usual if cutoff_hz is None else cutoff_hz, 0.25 * rate_hz)
    lowpass = LowPass.of(cutoff, rate_hz)
    smoothing = min(max(WIDER * band_hz, cutoff), _WIDEST * cutoff)
    if _widest(smoothing, rate_hz, clock.usual_s) < widest_s:
        widest_s = _widest(smoothing, rate_hz, clock.usual_s)
        parts = even_parts(recorded, bad, clock, widest_s)
        longest = max(parts, key=len)
    notes += clock_notes(recorded, clock, widest_s)
    window = window_of(smoothing, rate_hz, len(longest))
    pieces, good = [], True
    for part in parts:
        if len(part) < len(lowpass.taps) + 2 * window:
            continue
        whole = part.recorded
        motion, agree = smoothed_motion(whole.times_s, whole.q, whole.dq, window)
        good &= agree
        inner = slice(window // 2, -(window // 2))
        measured = Measured(motion.chosen(inner), whole.torques_nm[inner])
        resting = _resting(measured.motion, rate_hz)
        pieces.append(Piece(measured, part.bad[inner] | resting, part.there[inner], lowpass))
    if not pieces:
        span_s = (len(lowpass.taps) + 2 * window) / rate_hz
        raise DataError(
            f"{recorded.label}: the longest part without gaps lasts {len(longest) / rate_hz:.3g} s,"
            f" and {span_s:.3g} s are needed to filter at {cutoff:.3g} Hz.",
            culprits=[recorded.label],
            next_step="Record for longer without losing samples; 10 to 30 s are usual.",
        )
    if not good:
        notes.append(
            f"{recorded.label}: dq1_rad_s ... are not the speeds at which q1_rad ... change; they "
            "were left out. Are they in rad/s, measured, and not delayed?"
        )
    return Conditioned(
        recorded.label,
        tuple(pieces),
        band_hz,
        cutoff,
        rate_hz,
        tuple(notes),
        recorded.of_currents,
    )


def _resting(motion: JointMotion, rate_hz: float) -> Mask:
    """(m, n) where a joint stands: there friction holds it by any torque up to its bound."""
    samples = max(round(_REST_S * rate_hz), 1)
    slow = np.abs(uniform_filter1d(motion.dq, samples, axis=0)) < _REST_RAD_S
    return np.asarray(binary_opening(slow, np.ones((samples, 1), dtype=bool)))


def _widest(smoothing_hz: float, rate_hz: float, usual_s: float) -> float:
    """For how long samples may be missing where polynomials of that cut-off smooth angles [s]."""
    return _BRIDGED * usual_s * window_of(smoothing_hz, rate_hz, _SAMPLES_AT_ONCE)


def _cleaned(
    recorded: RecordedSamples, limits_nm: FloatArray | None, notes: list[str]
) -> tuple[FloatArray, Mask]:
    """Torques with single slips taken out, and which of them are none."""
    torques = recorded.torques_nm.copy()
    flat = np.stack([_flat_tops(column) for column in torques.T], axis=1)
    if limits_nm is not None:
        beyond = np.abs(torques) >= 0.999 * limits_nm
        # Drives that are at their limits all the time are none: the torques are of another unit.
        flat |= beyond & (beyond.mean(axis=0) < _MOST_AT_LIMIT)
    around = median_filter(torques, (_NEIGHBOURS, 1), mode="nearest")
    away = np.abs(torques - around)
    # Of normal noise three in four samples depart from the median of five by less than this.
    usual = np.quantile(away, 0.75, axis=0)
    range_nm = np.quantile(torques, 0.999, axis=0) - np.quantile(torques, 0.001, axis=0)
    spikes = (away > np.maximum(_SPIKE * usual, _SPIKE_SHARE * range_nm)) & ~flat
    spikes &= spikes.mean(axis=0) < _TOUCHED
    torques[spikes] = around[spikes]
    for what, wrong, done in (
        ("at rest on an extreme value (saturated)", flat, "what rests on them is left out"),
        ("far off from their neighbours", spikes, "the median around is used in their place"),
    ):
        if wrong.any():
            joints = [f"tau{at + 1} ({n} times)" for at, n in enumerate(wrong.sum(axis=0)) if n]
            notes.append(f"{recorded.label}: torques are {what}: {some_of(joints)}; {done}.")
    return torques, np.asarray(flat)


def _flat_tops(values: FloatArray) -> Mask:
    """Where torques (m,) stay at their highest or lowest for longer than anywhere else."""
    flat = np.zeros(len(values), dtype=bool)
    span = float(np.ptp(values))
    same = np.abs(np.diff(values)) <= _FLAT * span
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    runs = bounds.reshape(-1, 2)
    lengths = runs[:, 1] - runs[:, 0] + 1
    if not len(runs):
        return flat
    top = np.minimum(values.max() - values[runs[:, 0]], values[runs[:, 0]] - values.min())
    extreme = top <= 1e-3 * span
    others = int(lengths[~extreme].max(initial=1))
    for begin, end in runs[extreme & (lengths >= max(_FLAT_SAMPLES, 3 * others))]:
        flat[begin : end + 1] = True
    return flat
