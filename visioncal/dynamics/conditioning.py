"""Conditioning of recorded streams for the regression: cleaning, smoothing, low-pass filtering."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray, IntArray, Mask, interpolated
from visioncal.dynamics.model import JointMotion, Measured
from visioncal.dynamics.reading import RecordedSamples, StampClock, even_parts, gap_notes

# Cut-off of the low-pass: a rigid arm's torques, but for the corners of friction, lie within so
# many times the motion's bandwidth; below the least there is little to estimate noise from, above
# the most gears and links resonate [Hz]. The motion's smoothing is at most so many times wider.
_TORQUE_BAND, _LEAST_HZ, _MOST_HZ, _WIDEST = 10.0, 4.0, 10.0, 3.0
# Samples whose regressors are held in memory at a time.
_SAMPLES_AT_ONCE = 20_000
# Polynomials of fourth order pass a sixth of their own bandwidth to a few parts in ten thousand.
_ORDER, WIDER = 4, 6.0


@dataclass(frozen=True, eq=False)
class LowPass:
    """A decimating zero-phase FIR low-pass filter.

    Its response is 6 dB down at the cut-off, and outputs come at twice the cut-off's rate: white
    noise stays nearly white. Only full windows give outputs, so there are no end effects.
    """

    taps: FloatArray  # (w,) coefficients, whose sum is 1; w - 1 is a multiple of twice `step`.
    step: int  # Decimation: samples from one output to the next.

    @classmethod
    def of(cls, band_hz: float, rate_hz: float) -> Self:
        """Designs the filter for a cut-off and a sampling rate [Hz]."""
        step = max(int(rate_hz / (2.0 * band_hz)), 1)
        half = step * int(np.ceil(1.81 * rate_hz / band_hz / step))
        at = np.arange(-half, half + 1)
        # Kaiser's design (1974): with this length, 60 dB of attenuation from 1.5 times the cut-off.
        taps = np.sinc(2.0 * band_hz / rate_hz * at) * np.kaiser(len(at), 5.65)
        return cls(taps / taps.sum(), step)

    @property
    def half(self) -> int:
        """Samples of the window on either side of an output."""
        return len(self.taps) // 2

    @property
    def correlation(self) -> FloatArray:
        """(l,) autocorrelation of the outputs at lags 1, 2, ..., for white input."""
        full = np.correlate(self.taps, self.taps, "full")[len(self.taps) - 1 :: self.step]
        return np.asarray(full[1:] / full[0])

    def count(self, samples: int) -> int:
        """Number of outputs for a number of samples."""
        return max((samples - len(self.taps)) // self.step + 1, 0)

    def __call__(self, values: FloatArray, present: Mask | None = None) -> FloatArray:
        """Filters (m, ...) values along their first axis: (k, ...), the first at `half`.

        Args:
            values: The values.
            present: (m,) which of them count; all where None. Outputs are weighted means over
                these, and meaningless where hardly any is present.
        """
        if present is None or present.all():
            return self._weighted_sums(values, self.taps)
        axes = (-1,) + (1,) * (values.ndim - 1)
        weights = self._weighted_sums(present.astype(float), self.taps)
        # Outputs with less weight on present samples are not normalised.
        weights = np.where(np.abs(weights) < 0.1, 1.0, weights)
        return self._weighted_sums(values * present.reshape(axes), self.taps) / weights.reshape(
            axes
        )

    def share_of(self, invalid: Mask) -> FloatArray:
        """(k, ...) share of each output's weights that is on invalid samples (m, ...)."""
        weights = np.abs(self.taps)
        return self._weighted_sums(invalid.astype(float), weights / weights.sum())

    def _weighted_sums(self, values: FloatArray, taps: FloatArray) -> FloatArray:
        """Weighted sums of full windows."""
        from scipy.signal import upfirdn

        first = (len(taps) - 1) // self.step
        sums = upfirdn(taps, values, 1, self.step, axis=0)
        return np.asarray(sums[first : first + self.count(len(values))])


def bandwidth(q: FloatArray, rate_hz: float) -> float:
    """Bandwidth of (m, n) evenly sampled angles [Hz]; a periodic motion's highest harmonic."""
    frequencies = np.asarray(np.fft.rfftfreq(len(q), 1.0 / rate_hz)[1:], dtype=float)
    spectrum = np.fft.rfft((q - q.mean(axis=0)) * np.hanning(len(q))[:, None], axis=0)[1:]
    speeds = np.sqrt(np.sum(np.abs(spectrum * frequencies[:, None]) ** 2, axis=0))
    # Joints that move at least this share of the fastest one, in four bins an octave.
    moving = speeds >= 0.05 * speeds.max()
    power = np.abs(spectrum[:, moving] * frequencies[:, None] ** 2) ** 2
    octaves = np.log2(frequencies / frequencies[0])
    bins = (4 * octaves).astype(np.int64)
    return max(_band_edge(column, bins, frequencies) for column in power.T)


def _band_edge(power: FloatArray, bins: IntArray, frequencies: FloatArray) -> float:
    """Frequency above its peak at which a joint's power falls below the limit [Hz]."""
    slow = frequencies < 0.02 * frequencies[-1]
    peak = int(np.argmax(np.where(slow, power, 0.0)))
    # The bandwidth ends where the power of the accelerations stays under 3 % of its peak.
    limit = 0.03 * power[peak]
    for bin_ in range(int(bins[peak]) + 1, int(bins[-1]) + 1):
        inside = bins == bin_
        if inside.any() and power[inside].max() < limit:
            before = bins < bin_
            within = before & (power >= limit)
            return float(frequencies[within][-1])
    return float(frequencies[-1])


def window_of(band_hz: float, rate_hz: float, longest: int) -> int:
    """Window of a Savitzky-Golay filter that is 3 dB down at a frequency, in samples.

    Schafer 2011, What is a Savitzky-Golay filter, equation 12. At least two more than the order
    needs, and no more than there are.
    """
    half = ((_ORDER + 1) / (2.0 * band_hz / rate_hz) + 4.6) / 3.2
    return int(min(max(2 * round(half) + 1, _ORDER + 3), longest - 1 + longest % 2))


def _smoothed_motion(samples: RecordedSamples, window: int) -> tuple[JointMotion, bool]:
    """Smooths and differentiates evenly sampled angles (Savitzky and Golay 1964).

    Accelerations are derivatives of the reported speeds where that is less noisy. A smoothing
    polynomial has `window` samples.

    Returns:
        The motion at all times, valid from half a window on from either end, and whether the
        reported speeds agree with the angles.
    """
    # It imports scipy.stats, for which no other command shall wait.
    from scipy.signal import savgol_filter

    times_s, q, dq = samples.times_s, samples.q, samples.dq
    step = float(times_s[-1] - times_s[0]) / (len(times_s) - 1)

    def fitted(values: FloatArray, order: int) -> FloatArray:
        return np.asarray(savgol_filter(values, window, _ORDER, order, step, axis=0))

    smooth, speeds = fitted(q, 0), fitted(q, 1)
    derived = JointMotion(times_s, smooth, speeds, fitted(q, 2))
    if dq is None:
        return derived, True
    reported = fitted(dq, 0)
    inner = slice(window // 2, -(window // 2))
    deviation = np.sqrt(np.mean((reported - speeds)[inner] ** 2, axis=0))
    # Reported speeds may deviate from the angles' derivatives by a tenth, and 5 mrad/s.
    if np.any(deviation > 0.1 * np.sqrt(np.mean(speeds[inner] ** 2, axis=0)) + 0.005):
        return derived, False
    noise = [
        _derivative_noise(q - smooth, window, 2, step),
        _derivative_noise(dq - reported, window, 1, step),
    ]
    if noise[0] <= noise[1]:
        return derived, True
    return JointMotion(times_s, smooth, reported, fitted(dq, 1)), True


def _derivative_noise(residual: FloatArray, window: int, order: int, step: float) -> float:
    """Noise of a derivative of that order, from the smoothing residuals [rad/s^2]."""
    from scipy.signal import savgol_coeffs

    taps = savgol_coeffs(window, _ORDER, order, step)
    return float(np.sqrt(np.mean(residual**2)) * np.linalg.norm(taps))


@dataclass(frozen=True, eq=False)
class Piece:
    """Evenly sampled motion and torques without a long gap, and their filter."""

    measured: Measured  # The samples.
    invalid: Mask  # (m, n) torques without information: saturated, or of a joint that stands still.
    # (m,) where torques were recorded; regressors are filtered over the same samples.
    present: Mask
    lowpass: LowPass  # Filter of torques and regressors alike.

    @property
    def times_s(self) -> FloatArray:
        """(k,) times of the filtered samples [s]."""
        begin, count = self.lowpass.half, self.lowpass.count(len(self.measured))
        return self.measured.motion.times_s[begin :: self.lowpass.step][:count]

    @property
    def torques_nm(self) -> FloatArray:
        """(k, n) filtered torques [N m]."""
        return self.lowpass(self.measured.torques_nm, self.present)

    def filtered(self, columns: Callable[[JointMotion], FloatArray]) -> FloatArray:
        """Filters (m, ...) functions of the motion, a part of it at a time: (k, ...)."""
        step, width = self.lowpass.step, len(self.lowpass.taps)
        total, parts = self.lowpass.count(len(self.measured)), []
        at_once = max(_SAMPLES_AT_ONCE // step, 1)
        for begin in range(0, total, at_once):
            end = min(begin + at_once, total)
            rows = slice(begin * step, (end - 1) * step + width)
            values = columns(self.measured.motion.chosen(rows))
            parts.append(self.lowpass(values, self.present[rows]))
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    @property
    def used(self) -> Mask:
        """(k, n) which of the filtered torques can be used."""
        used = np.ones((len(self.times_s), self.invalid.shape[1]), dtype=bool)
        if self.invalid.any():
            # Outputs are not used that weigh invalid or missing samples too much.
            used &= self.lowpass.share_of(self.invalid) <= 0.02
        if not self.present.all():
            used &= self.lowpass.share_of(~self.present)[:, None] <= 0.5
        return used

    def advanced(self, lag_s: float) -> Self:
        """The samples with torques shifted earlier by a lag [s]."""
        times_s = self.measured.motion.times_s
        later_s = times_s + lag_s

        def at(values: FloatArray) -> FloatArray:
            return interpolated(later_s, times_s, values)

        lost = at((~self.present)[:, None].astype(float))[:, 0] > 0.0
        present = ~lost & (later_s >= times_s[0]) & (later_s <= times_s[-1])
        measured = replace(self.measured, torques_nm=at(self.measured.torques_nm))
        # Of joints at rest neither the torque recorded then nor the one shifted there is
        # informative.
        bad = self.invalid | (at(self.invalid.astype(float)) > 0.0)
        return replace(
            self, measured=measured, invalid=np.asarray(bad), present=np.asarray(present)
        )


@dataclass(frozen=True, eq=False)
class Conditioned:
    """A conditioned stream, ready for the regression."""

    label: str  # Its file, for messages.
    pieces: tuple[Piece, ...]  # The parts between its gaps.
    band_hz: float  # Bandwidth of the motion [Hz].
    cutoff_hz: float  # Where the low-pass is 6 dB down [Hz].
    rate_hz: float  # Sampling rate before the filter [Hz].
    notes: tuple[str, ...]  # Messages on faults of the samples, and how they were handled.
    of_currents: bool = False  # Whether the torques are currents times gains.

    @property
    def count(self) -> int:
        """Number of filtered samples."""
        return sum(len(piece.times_s) for piece in self.pieces)

    @property
    def times_s(self) -> FloatArray:
        """(k,) times of the filtered samples [s]."""
        return np.concatenate([piece.times_s for piece in self.pieces])

    @property
    def torques_nm(self) -> FloatArray:
        """(k, n) filtered torques [N m]."""
        return np.concatenate([piece.torques_nm for piece in self.pieces])

    @property
    def used(self) -> Mask:
        """(k, n) which of the filtered torques can be used."""
        return np.concatenate([piece.used for piece in self.pieces])

    @property
    def correlation(self) -> FloatArray:
        """Autocorrelation of filtered white noise, at lags 1, 2, ..."""
        return self.pieces[0].lowpass.correlation

    def filtered(self, columns: Callable[[JointMotion], FloatArray]) -> FloatArray:
        """Filters (m, ...) functions of the motion as the torques are filtered: (k, ...)."""
        parts = [piece.filtered(columns) for piece in self.pieces]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def scaled(self, factors: FloatArray) -> Self:
        """The same with each joint's torques times one of (n,) factors."""
        pieces = []
        for piece in self.pieces:
            torques_nm = factors * piece.measured.torques_nm
            pieces.append(replace(piece, measured=replace(piece.measured, torques_nm=torques_nm)))
        return replace(self, pieces=tuple(pieces))

    def lag_corrected(self, lag_s: float) -> Self:
        """The samples with torques shifted earlier by a lag [s]."""
        return replace(self, pieces=tuple(piece.advanced(lag_s) for piece in self.pieces))


def condition(
    recorded: RecordedSamples, cutoff_hz: float | None = None, limits_nm: FloatArray | None = None
) -> Conditioned:
    """Resamples, differentiates and filters a stream.

    Torques and regressor go through the same zero-phase low-pass, which therefore biases no
    parameter (Gautier 1997, parallel filtering).

    Args:
        recorded: The stream's samples.
        cutoff_hz: Where the low-pass is 6 dB down [Hz]; ten times the motion's bandwidth, 4 to
            10 Hz, where None.
        limits_nm: (n,) the drives' greatest torques [N m], where known.

    Raises:
        DataError: No part without gaps is as long as the filters.
    """
    notes: list[str] = []
    flat = np.stack([_flat_tops(column) for column in recorded.torques_nm.T], axis=1)
    if limits_nm is not None:
        beyond = np.abs(recorded.torques_nm) >= 0.999 * limits_nm
        # Torques that are beyond the limits often are not saturated, but in another unit.
        flat |= beyond & (beyond.mean(axis=0) < 0.2)
    if flat.any():
        joints = [f"tau{at + 1} ({n} times)" for at, n in enumerate(flat.sum(axis=0)) if n]
        notes.append(
            f"{recorded.label}: torques are at rest on an extreme value (saturated): "
            f"{some_of(joints)}; what rests on them is left out."
        )
    invalid = np.asarray(flat)
    clock = StampClock.of(recorded.times_s)
    # For the slowest motion, until the bandwidth is known.
    slowest = min(_LEAST_HZ if cutoff_hz is None else cutoff_hz, 0.25 / clock.usual_s)
    longest_gap_s = _longest_gap(slowest, 1.0 / clock.usual_s, clock.usual_s)
    parts = even_parts(recorded, invalid, clock, longest_gap_s)
    longest = max(parts, key=len)
    rate_hz = longest.rate_hz
    band_hz = bandwidth(longest.samples.q, rate_hz)
    usual = min(max(_TORQUE_BAND * band_hz, _LEAST_HZ), _MOST_HZ)
    cutoff = min(usual if cutoff_hz is None else cutoff_hz, 0.25 * rate_hz)
    lowpass = LowPass.of(cutoff, rate_hz)
    smoothing = min(max(WIDER * band_hz, cutoff), _WIDEST * cutoff)
    if _longest_gap(smoothing, rate_hz, clock.usual_s) < longest_gap_s:
        longest_gap_s = _longest_gap(smoothing, rate_hz, clock.usual_s)
        parts = even_parts(recorded, invalid, clock, longest_gap_s)
        longest = max(parts, key=len)
    notes += gap_notes(recorded, clock, longest_gap_s)
    window = window_of(smoothing, rate_hz, len(longest))
    from scipy.ndimage import binary_opening, uniform_filter1d

    pieces, speeds_agree = [], True
    for part in parts:
        if len(part) < len(lowpass.taps) + 2 * window:
            continue
        samples = part.samples
        motion, part_agrees = _smoothed_motion(samples, window)
        speeds_agree &= part_agrees
        inner = slice(window // 2, -(window // 2))
        measured = Measured(motion.chosen(inner), samples.torques_nm[inner])
        # A joint stands still at a mean speed of under 1 mrad/s over 0.1 s, for as long: friction
        # then holds it by any torque up to its bound.
        least = max(round(0.1 * rate_hz), 1)
        slow = np.abs(uniform_filter1d(measured.motion.dq, least, axis=0)) < 1e-3
        resting = binary_opening(slow, np.ones((least, 1), dtype=bool))
        pieces.append(Piece(measured, part.invalid[inner] | resting, part.present[inner], lowpass))
    if not pieces:
        span_s = (len(lowpass.taps) + 2 * window) / rate_hz
        raise DataError(
            f"{recorded.label}: the longest part without gaps lasts {len(longest) / rate_hz:.3g} s,"
            f" and {span_s:.3g} s are needed to filter at {cutoff:.3g} Hz.",
            culprits=[recorded.label],
            next_step="Record for longer without losing samples; 10 to 30 s are usual.",
        )
    if not speeds_agree:
        notes.append(
            f"{recorded.label}: dq1_rad_s ... are not the speeds at which q1_rad ... change; they "
            "were left out. Are they in rad/s, measured, and not delayed?"
        )
    return Conditioned(
        recorded.label, tuple(pieces), band_hz, cutoff, rate_hz, tuple(notes), recorded.of_currents
    )


def _longest_gap(smoothing_hz: float, rate_hz: float, usual_s: float) -> float:
    """Longest gap over which polynomials of that cut-off may interpolate angles [s]."""
    # Over so short gaps the other samples of a polynomial's window determine the angles.
    return 0.25 * usual_s * window_of(smoothing_hz, rate_hz, _SAMPLES_AT_ONCE)


def _flat_tops(values: FloatArray) -> Mask:
    """(m,) where torques stay at their extremes for longer than anywhere else: saturation."""
    flat = np.zeros(len(values), dtype=bool)
    span = float(np.ptp(values))
    # Within this share of the range they are the same.
    same = np.abs(np.diff(values)) <= 1e-6 * span
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    runs = bounds.reshape(-1, 2)
    lengths = runs[:, 1] - runs[:, 0] + 1
    if not len(runs):
        return flat
    top = np.minimum(values.max() - values[runs[:, 0]], values[runs[:, 0]] - values.min())
    extreme = top <= 1e-3 * span
    # At least five samples, and three times as long as anywhere else.
    others = int(lengths[~extreme].max(initial=1))
    for begin, end in runs[extreme & (lengths >= max(5, 3 * others))]:
        flat[begin : end + 1] = True
    return flat
