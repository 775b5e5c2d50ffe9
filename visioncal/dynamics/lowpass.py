"""One low-pass for torques and regressor, and as many samples as it leaves independent."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from visioncal.core.types import FloatArray, Mask

# Kaiser's design (1974): 60 dB of attenuation from 1.5 times the cut-off on.
_BETA, _SPAN = 5.65, 1.81
# Outputs of which no more than this share is there are not made whole.
_LEAST_WEIGHT = 0.1


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

    @classmethod
    def none(cls) -> Self:
        """Lets all pass as it is."""
        return cls(np.ones(1), 1)

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
