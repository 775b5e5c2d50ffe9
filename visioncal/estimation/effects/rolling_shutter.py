"""Effect of a rolling shutter: the rows of an image are taken one after the other."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.estimation.effects.delays import Delay

# Sensors read an image out within some tens of milliseconds [s].
_READOUT_SIGMA_S = 0.02


@dataclass(frozen=True)
class Shutter:
    """When the rows of an image are taken.

    Attributes:
        kind: One after the other, or all at once.
        readout_s: By how much the last row is later than the first [s].
        readout_sigma_s: The standard deviation of that [s].
        line_s: By how much each row is later than the one before it [s].
    """

    kind: Literal["rolling", "global"]
    readout_s: float
    readout_sigma_s: float
    line_s: float


def _shares(px: FloatArray, resolution: tuple[int, int]) -> FloatArray:
    """By which share of the readout corners are taken later: the middle row has the stamp."""
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
