"""The point-spread function of one image: a Gaussian, a disc, and a line, one after another.

In Fourier space, at angular frequencies w [rad/px], it is the product of

    exp(-w^2 sigma^2 / 2),   2 J1(R |w|) / (R |w|),   sin(t) / t with t = w . m / 2:

what every lens and pixel do, what lies out of focus, and what moves along m during the exposure.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.vision.dense.library import library

if TYPE_CHECKING:
    from torch import Tensor

# The Gaussian that prints are drawn with [px]; what is measured is not narrower.
DRAWN_PX = 0.3
# What can be measured at all [px].
_MOST_SIGMA_PX, _MOST_DISC_PX, _MOST_MOTION_PX = 8.0, 12.0, 24.0
# Below this, functions of t / t are series.
_TINY = 1e-4


@dataclass(frozen=True)
class Blur:
    """What blurs an image.

    Attributes:
        sigma_px: Of the Gaussian.
        disc_px: Radius of the disc.
        motion_px: Along u and v, how far everything moves during the exposure; its sign is free.
    """

    sigma_px: float
    disc_px: float
    motion_px: tuple[float, float]

    @classmethod
    def of(cls, values: FloatArray) -> Self:
        """From (4,) values, within what can be measured."""
        sigma, disc, u, v = values.tolist()
        motion = np.array([u, v]) * min(1.0, _MOST_MOTION_PX / max(np.hypot(u, v), 1e-9))
        return cls(
            float(np.clip(sigma, DRAWN_PX, _MOST_SIGMA_PX)),
            float(np.clip(abs(disc), 0.0, _MOST_DISC_PX)),
            (float(motion[0]), float(motion[1])),
        )

    @property
    def values(self) -> FloatArray:
        """(4,) sigma, radius, and the line's u and v [px]."""
        return np.array([self.sigma_px, self.disc_px, *self.motion_px])

    @property
    def length_px(self) -> float:
        """How far everything moves."""
        return float(np.hypot(*self.motion_px))

    @property
    def direction_deg(self) -> float:
        """Where to, from the image's rows towards its columns' ends, 0 to 180 deg."""
        return float(np.rad2deg(np.arctan2(self.motion_px[1], self.motion_px[0])) % 180.0)

    @property
    def width_px(self) -> float:
        """The width of edges as a Gaussian's sigma, in the direction in which they are wider."""
        squares = self.sigma_px**2 + self.disc_px**2 / 4 + self.length_px**2 / 12
        return float(np.sqrt(squares))

    @property
    def reach_px(self) -> float:
        """How far a point is spread."""
        return 3.0 * self.sigma_px + self.disc_px + 0.5 * self.length_px

    @property
    def cause(self) -> str:
        """What widens edges most: `motion`, `focus`, or empty for little."""
        moved, focus = self.length_px**2 / 12, self.disc_px**2 / 4 + self.sigma_px**2
        if self.width_px < 1.0:
            return ""
        return "motion" if moved > focus else "focus"


def transfer(blur: Blur, wu: "Tensor", wv: "Tensor") -> "Tensor":
    """The transfer function beyond the drawn Gaussian, and its derivatives.

    Args:
        blur: The point-spread function.
        wu: Angular frequencies along u [rad/px], double precision.
        wv: Along v, of a shape that goes with it.

    Returns:
        (5, ...) its value, and derivatives by the four `Blur.values`.
    """
    torch = library("torch")
    square = wu**2 + wv**2
    gauss = torch.exp(-0.5 * (blur.sigma_px**2 - DRAWN_PX**2) * square)
    w = torch.sqrt(square)
    z = torch.clamp(blur.disc_px * w, min=_TINY)
    one = torch.special.bessel_j1(z)
    disc = 2.0 * one / z
    second = 2.0 * one / z - torch.special.bessel_j0(z)
    t = 0.5 * (wu * blur.motion_px[0] + wv * blur.motion_px[1])
    t = torch.where(t.abs() < _TINY, torch.full_like(t, _TINY), t)
    line = torch.sin(t) / t
    slope = 0.5 * (torch.cos(t) - line) / t
    return torch.stack(
        [
            gauss * disc * line,
            -blur.sigma_px * square * gauss * disc * line,
            -2.0 * w * second / z * gauss * line,
            wu * slope * gauss * disc,
            wv * slope * gauss * disc,
        ]
    )
