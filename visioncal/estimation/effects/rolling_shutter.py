"""Effect of a rolling shutter: the rows of an image are exposed one after the other."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.estimation.effects.delays import Delay

# Typical readout time of an image [s].
_READOUT_SIGMA_S = 0.02


@dataclass(frozen=True)
class Shutter:
    """Shutter of a camera."""

    kind: Literal["rolling", "global"]  # Rows exposed one after the other, or all at once.
    readout_s: float  # Delay of the last row behind the first [s].
    readout_sigma_s: float  # Its standard deviation [s].
    line_s: float  # Delay of each row behind the one before it [s].


def _shares(px: FloatArray, resolution: tuple[int, int]) -> FloatArray:
    """Delays of corners as shares of the readout; the middle row has the stamp."""
    return np.asarray(px[:, 1] / (resolution[1] - 1) - 0.5)


def _result(
    readout_s: float, sigma_s: float, is_clear: bool, resolution: tuple[int, int]
) -> dict[str, Any]:
    kind: Literal["rolling", "global"] = "rolling" if is_clear else "global"
    return {"shutter": Shutter(kind, readout_s, sigma_s, readout_s / (resolution[1] - 1))}


def _words(readout_s: float, sigma_s: float) -> str:
    late = "after" if readout_s > 0.0 else "before"
    return (
        f"The camera has a rolling shutter, which is taken into account: the image's last line is "
        f"taken {1e3 * abs(readout_s):.2f} ms {late} the first (sigma {figure(1e3 * sigma_s)} ms)."
    )


ROLLING_SHUTTER = Delay("rolling shutter", _READOUT_SIGMA_S, _shares, _result, _words)
