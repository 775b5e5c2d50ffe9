"""One low-pass for torques and regressor; and speeds and accelerations from noisy angles."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.dynamics.motion import JointMotion

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
