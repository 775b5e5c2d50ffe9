"""Point-spread function of an image: a Gaussian, a disc and a line, convolved.

In Fourier space, at angular frequencies w [rad/px], it is the product of

    exp(-w^2 sigma^2 / 2),   2 J1(R |w|) / (R |w|),   sin(t) / t with t = w . m / 2:

the blur of lens and pixels, defocus, and motion along m during the exposure.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.vision.dense.library import library

if TYPE_CHECKING:
    from torch import Tensor

# Sigma of the Gaussian that prints are rendered with, and the smallest estimated one [px].
DRAWN_PX = 0.3
# Largest blur that can be estimated [px].
_MOST_SIGMA_PX, _MOST_DISC_PX, _MOST_MOTION_PX = 8.0, 12.0, 24.0
# Smallest argument, against division by zero.
_TINY = 1e-4


@dataclass(frozen=True)
class Blur:
    """Parameters of the point-spread function.

    Attributes:
        sigma_px: Sigma of the Gaussian.
        disc_px: Radius of the defocus disc.
        motion_px: Motion along u and v during the exposure; its sign is arbitrary.
    """

    sigma_px: float
    disc_px: float
    motion_px: tuple[float, float]

    @classmethod
    def of(cls, values: FloatArray) -> Self:
        """Blur with (4,) parameters, clipped to what can be estimated."""
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
        """Length of the motion."""
        return float(np.hypot(*self.motion_px))

    @property
    def direction_deg(self) -> float:
        """Direction of the motion from u towards v, 0 to 180 deg."""
        return float(np.rad2deg(np.arctan2(self.motion_px[1], self.motion_px[0])) % 180.0)

    @property
    def width_px(self) -> float:
        """Edge width as a Gaussian's sigma, in the direction of the widest edges."""
        squares = self.sigma_px**2 + self.disc_px**2 / 4 + self.length_px**2 / 12
        return float(np.sqrt(squares))

    @property
    def reach_px(self) -> float:
        """Radius of the point-spread function."""
        return 3.0 * self.sigma_px + self.disc_px + 0.5 * self.length_px

    @property
    def cause(self) -> str:
        """Main cause of blur: `motion`, `focus`, or empty for little blur."""
        motion, focus = self.length_px**2 / 12, self.disc_px**2 / 4 + self.sigma_px**2
        if self.width_px < 1.0:
            return ""
        return "motion" if motion > focus else "focus"


def transfer(blur: Blur, wu: "Tensor", wv: "Tensor") -> "Tensor":
    """Transfer function relative to the rendered Gaussian, and its derivatives.

    Args:
        blur: Point-spread function.
        wu: Angular frequencies along u [rad/px], double precision.
        wv: Angular frequencies along v, of a shape that broadcasts.

    Returns:
        (5, ...) value, and derivatives with respect to the four `Blur.values`.
    """
    torch = library("torch")
    square = wu**2 + wv**2
    gauss = torch.exp(-0.5 * (blur.sigma_px**2 - DRAWN_PX**2) * square)
    w = torch.sqrt(square)
    z = torch.clamp(blur.disc_px * w, min=_TINY)
    bessel = torch.special.bessel_j1(z)
    disc = 2.0 * bessel / z
    second = 2.0 * bessel / z - torch.special.bessel_j0(z)
    t = 0.5 * (wu * blur.motion_px[0] + wv * blur.motion_px[1])
    t = torch.where(t.abs() < _TINY, torch.full_like(t, _TINY), t)
    line = torch.sin(t) / t
    line_derivative = 0.5 * (torch.cos(t) - line) / t
    return torch.stack(
        [
            gauss * disc * line,
            -blur.sigma_px * square * gauss * disc * line,
            -2.0 * w * second / z * gauss * line,
            wu * line_derivative * gauss * disc,
            wv * line_derivative * gauss * disc,
        ]
    )
