"""Statistics of identified streams: noise, prediction errors, lag of the torques."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from visioncal.core.codec import KEPT, Key, Vector
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray


@dataclass(frozen=True, eq=False)
class StreamStatistics:
    """Statistics of a fitted stream."""

    label: Annotated[str, Key("stream")]  # Its file.
    samples: int  # Number of filtered samples.
    left_out: int  # Number of their torques that were not used: outliers and invalid ones.
    band_hz: float  # Bandwidth of the motion [Hz].
    cutoff_hz: float  # Where the low-pass is 6 dB down [Hz].
    rate_hz: float  # Sampling rate before the filter [Hz].
    noise_nm: Vector  # (n,) noise of the filtered torques [N m].
    rms_nm: Vector  # (n,) root mean square of the residuals [N m].
    torque_nm: Vector  # (n,) standard deviation of the torques, as their range [N m].
    notes: Annotated[tuple[str, ...], KEPT] = ()  # Messages on faults of its samples.


@dataclass(frozen=True, eq=False)
class TorqueValidation:
    """Prediction errors of torques that were not fitted."""

    label: Annotated[str, Key("samples")]  # The samples, for messages.
    rms_nm: Vector  # (n,) root mean square error [N m].
    torque_nm: Vector  # (n,) standard deviation of the torques, as their range [N m].
    noise_nm: Vector  # (n,) noise of the torques by the fit [N m].
    # (n,) error with the consistent standard parameters; None without these.
    consistent_rms_nm: Vector | None = None

    @property
    def shares(self) -> FloatArray:
        """(n,) error over the range of the torque."""
        return np.asarray(self.rms_nm / np.maximum(self.torque_nm, 1e-12))


@dataclass(frozen=True)
class Lag:
    """Delay of the torques behind the angles."""

    seconds: float  # The delay; negative where torques are ahead [s].
    sigma_s: float  # Its standard deviation [s].
    share: float  # Greatest change of a joint's torques by it, over their range.

    @property
    def words(self) -> str:
        """Message on the lag and its correction."""
        late = self.seconds > 0.0
        return (
            f"The torques {'lag' if late else 'are ahead of'} the angles by "
            f"{figure(1e3 * abs(self.seconds))} ms (sigma {figure(1e3 * self.sigma_s)}): they were "
            f"taken so much {'earlier' if late else 'later'}."
        )
