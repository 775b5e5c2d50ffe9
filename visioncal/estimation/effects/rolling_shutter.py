"""Effect of a rolling shutter: the rows of an image are exposed one after the other.

A corner's delay from its image's stamp is its row's share of the readout. A corner p delayed by t
lies at `exp(t w) p` in the target's frame, w being the target's right twist per second in the
camera's view.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from visioncal.core.transforms import adjoint, apply_each, exp, invert
from visioncal.core.types import Camera, FloatArray, Mount
from visioncal.estimation.appearance import Compressed, compress_points
from visioncal.vision.corners import CornerStack

# Prior of the readout time of an image, about zero [s].
READOUT_SIGMA_S = 0.02


@dataclass(frozen=True)
class Shutter:
    """Shutter of a camera."""

    kind: Literal["rolling", "global"]  # Rows exposed one after the other, or all at once.
    readout_s: float  # Delay of the last row behind the first [s].
    readout_sigma_s: float  # Its standard deviation [s].
    line_s: float  # Delay of each row behind the one before it [s].

    @property
    def is_rolling(self) -> bool:
        """Whether the readout is significant, and was corrected."""
        return self.kind == "rolling"

    def corrected(self, change_s: float, sigma_s: float) -> "Shutter":
        """The shutter by a correction of the readout, with a sigma [s]."""
        readout_s = self.readout_s + change_s
        line_s = self.line_s * readout_s / self.readout_s
        return Shutter(self.kind, readout_s, sigma_s, line_s)


def target_twists(
    mount: Mount, base_from_flange: FloatArray, x: FloatArray, poses: FloatArray, speeds: FloatArray
) -> FloatArray:
    """Twists (v, 6) per second of the views' targets relative to the camera, in their own frames.

    The (4, 4) camera's edge is `x`, (v, 4, 4) `poses` are `cam_from_target`, and (v, 6) `speeds`
    the flange's twists per second, in its own frame.
    """
    hand = mount == "eye-in-hand"
    flange_from_target = x @ poses if hand else invert(base_from_flange) @ x @ poses
    twists = (adjoint(invert(flange_from_target)) @ speeds[:, :, None])[:, :, 0]
    return np.asarray(-twists if hand else twists)


def delayed_points(
    stack: CornerStack, camera: Camera, twists: FloatArray, readout_s: float
) -> tuple[FloatArray, FloatArray]:
    """Target positions of the corners at the time of their exposure; the middle row has the stamp.

    For (v, 6) `target_twists` and a readout time [s], (n, 3) positions on the target [m], and
    (n, 3, 1) their derivatives by the readout [m/s].
    """
    shares, of_corner = stack.px[:, 1] / (camera.resolution[1] - 1) - 0.5, twists[stack.view_of]
    points = apply_each(exp((readout_s * shares)[:, None] * of_corner), stack.points)
    speeds = np.cross(of_corner[:, :3], points) + of_corner[:, 3:]
    return points, (speeds * shares[:, None])[:, :, None]


def compress_delayed(
    stack: CornerStack, camera: Camera, twists: FloatArray, readout_s: float, starts: FloatArray
) -> Compressed:
    """Compresses corners to normal equations in each view's pose and the readout time [s].

    They are linearised at the readout time and (v, 4, 4) starts of `cam_from_target`.
    """
    points, jacobian = delayed_points(stack, camera, twists, readout_s)
    return compress_points(replace(stack, points=points), camera, starts, jacobian, lens=False)
