"""From what a controller recorded to motions and torques for a regression, by one low-pass."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.ndimage import binary_opening, median_filter, uniform_filter1d

from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.dynamics.clock import StampClock, clock_notes, even_parts, without_frozen
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

# Kaiser's design (1974): 60 dB of attenuation from 1.5 times the cut-off on.
_BETA, _SPAN = 5.65, 1.81
# Outputs of which no more than this share is there are not made whole.
_LEAST_WEIGHT = 0.1
# A motion's band ends where the power of its accelerations stays under this share of its peak,
# sought in parts of a quarter octave; joints count that move at least this share of the
# fastest one.
_OUT_OF_BAND, _PARTS, _MOVING = 0.03, 4, 0.05
# Polynomials of fourth order keep all within a sixth of their own band, to a few in ten thousand.
_ORDER, WIDER = 4, 6.0
# Reported speeds may depart from the angles' by this share, and by this much [rad/s].
_APART, _APART_RAD_S = 0.1, 0.005


@dataclass(frozen=True, eq=False)
class LowPass:
    """A symmetric finite filter, which shifts nothing in time, and every so manieth output of it.

    What leaves it is 6 dB down at the cut-off, to whose double rate it is thinned out: white noise
    stays nearly white. Only windows that lie wholly within the samples are kept, so there are no
    effects of their ends.

    Attributes:
        taps: (w,) weights, whose sum is 1; w - 1 is a multiple of twice `step`.
        step: Outputs are so many samples apart.
    """

    taps: FloatArray
    step: int

    @classmethod
    def of(cls, band_hz: float, rate_hz: float) -> Self:
        """Designs the filter for a cut-off and a rate of samples [Hz]."""
        step = max(int(rate_hz / (2.0 * band_hz)), 1)
        half = step * int(np.ceil(_SPAN * rate_hz / band_hz / step))
        at = np.arange(-half, half + 1)
        taps = np.sinc(2.0 * band_hz / rate_hz * at) * np.kaiser(len(at), _BETA)
        return cls(taps / taps.sum(), step)

    @property
    def half(self) -> int:
        """Samples on either side of an output that it rests on."""
        return len(self.taps) // 2

    @property
    def correlation(self) -> FloatArray:
        """(l,) correlations of one output with the next, and so on, where the input is white."""
        full = np.correlate(self.taps, self.taps, "full")[len(self.taps) - 1 :: self.step]
        return np.asarray(full[1:] / full[0])

    def count(self, samples: int) -> int:
        """How many outputs so many samples give."""
        return max((samples - len(self.taps)) // self.step + 1, 0)

    def __call__(self, values: FloatArray, there: Mask | None = None) -> FloatArray:
        """Filters (m, ...) values along their first axis: (k, ...), the first at `half`.

        Args:
            values: What is filtered.
            there: (m,) which of them count, all where None. Outputs are means over these; those
                for which hardly any is there are of no use.
        """
        if there is None or there.all():
            return self._summed(values, self.taps)
        axes = (-1,) + (1,) * (values.ndim - 1)
        weights = self._summed(there.astype(float), self.taps)
        weights = np.where(np.abs(weights) < _LEAST_WEIGHT, 1.0, weights)
        return self._summed(values * there.reshape(axes), self.taps) / weights.reshape(axes)

    def touched(self, bad: Mask) -> FloatArray:
        """(k, ...) what share of each output's weights rests on bad samples (m, ...)."""
        weights = np.abs(self.taps)
        return self._summed(bad.astype(float), weights / weights.sum())

    def _summed(self, values: FloatArray, taps: FloatArray) -> FloatArray:
        """Products of blocks of samples with blocks of taps, summed along the diagonals."""
        count, flat = self.count(len(values)), values.reshape(len(values), -1)
        if len(taps) == 1:
            return values
        blocks = (len(taps) - 1) // self.step
        kept = flat[: (count + blocks - 1) * self.step].reshape(-1, self.step, flat.shape[1])
        parts = taps[:-1].reshape(blocks, self.step) @ kept
        last = flat[blocks * self.step :: self.step][:count]
        total = taps[-1] * last
        for block in range(blocks):
            total += parts[block : block + count, block]
        return np.asarray(total.reshape(count, *values.shape[1:]))


def band_of(q: FloatArray, rate_hz: float) -> float:
    """Finds the highest frequency of note in (m, n) evenly sampled angles [Hz].

    Of a periodic motion that is its highest harmonic.
    """
    frequencies = np.asarray(np.fft.rfftfreq(len(q), 1.0 / rate_hz)[1:], dtype=float)
    spectrum = np.fft.rfft((q - q.mean(axis=0)) * np.hanning(len(q))[:, None], axis=0)[1:]
    speeds = np.sqrt(np.sum(np.abs(spectrum * frequencies[:, None]) ** 2, axis=0))
    moving = speeds >= _MOVING * speeds.max()
    power = np.abs(spectrum[:, moving] * frequencies[:, None] ** 2) ** 2
    octaves = np.log2(frequencies / frequencies[0])
    parts = (_PARTS * octaves).astype(np.int64)
    return max(_edge(column, parts, frequencies) for column in power.T)


def _edge(power: FloatArray, parts: IntArray, frequencies: FloatArray) -> float:
    """Where a joint's power, from its peak on upwards, falls out of the band."""
    slow = frequencies < 0.02 * frequencies[-1]
    peak = int(np.argmax(np.where(slow, power, 0.0)))
    limit = _OUT_OF_BAND * power[peak]
    for part in range(int(parts[peak]) + 1, int(parts[-1]) + 1):
        inside = parts == part
        if inside.any() and power[inside].max() < limit:
            before = parts < part
            within = before & (power >= limit)
            return float(frequencies[within][-1])
    return float(frequencies[-1])


def window_of(band_hz: float, rate_hz: float, longest: int) -> int:
    """Samples that a polynomial spans so that its output is 3 dB down at a frequency.

    Schafer 2011, What is a Savitzky-Golay filter, equation 12. At least two more than the order
    needs, and no more than there are.
    """
    half = ((_ORDER + 1) / (2.0 * band_hz / rate_hz) + 4.6) / 3.2
    return int(min(max(2 * round(half) + 1, _ORDER + 3), longest - 1 + longest % 2))


def smoothed_motion(
    times_s: FloatArray, q: FloatArray, dq: FloatArray | None, window: int
) -> tuple[JointMotion, bool]:
    """Smooths and differentiates evenly sampled angles (Savitzky and Golay 1964).

    Accelerations come from reported speeds where that is less noisy.

    Args:
        times_s: (m,) [s].
        q: (m, n) joint angles [rad].
        dq: (m, n) reported speeds [rad/s], if there are.
        window: Samples that a polynomial spans.

    Returns:
        The motion at all m times, which is good from half a window on from either end, and whether
        the reported speeds belong to the angles.
    """
    # With it comes scipy.stats, which no other command shall have to wait for.
    from scipy.signal import savgol_filter

    step = float(times_s[-1] - times_s[0]) / (len(times_s) - 1)

    def fitted(values: FloatArray, order: int) -> FloatArray:
        return np.asarray(savgol_filter(values, window, _ORDER, order, step, axis=0))

    smooth, speeds = fitted(q, 0), fitted(q, 1)
    derived = JointMotion(times_s, smooth, speeds, fitted(q, 2))
    if dq is None:
        return derived, True
    reported = fitted(dq, 0)
    inner = slice(window // 2, -(window // 2))
    apart = np.sqrt(np.mean((reported - speeds)[inner] ** 2, axis=0))
    if np.any(apart > _APART * np.sqrt(np.mean(speeds[inner] ** 2, axis=0)) + _APART_RAD_S):
        return derived, False
    noise = [_noise(q - smooth, window, 2, step), _noise(dq - reported, window, 1, step)]
    if noise[0] <= noise[1]:
        return derived, True
    return JointMotion(times_s, smooth, reported, fitted(dq, 1)), True


def _noise(residual: FloatArray, window: int, order: int, step: float) -> float:
    """How noisy a derivative of that order is, by what smoothing left [rad/s^2]."""
    from scipy.signal import savgol_coeffs

    taps = savgol_coeffs(window, _ORDER, order, step)
    return float(np.sqrt(np.mean(residual**2)) * np.linalg.norm(taps))


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
