"""Effects of time within an image: corners of a moving target with a delay of their own.

Each corner's delay from its image's stamp is a known share of one unknown time. A corner p delayed
by t lies at `exp(t w) p` in the target's frame, w being the target's right twist per second in the
camera's view.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from visioncal.core.transforms import adjoint, apply_each, exp, invert
from visioncal.core.types import Camera, FloatArray, Mount
from visioncal.estimation.appearance import Compressed, compress_points
from visioncal.estimation.corners import CornerStack


@dataclass(frozen=True)
class Delay:
    """An effect of time within an image."""

    name: str
    sigma_s: float  # Prior standard deviation of the time, about zero [s].
    # Of (n, 2) corners [px] in an image of some resolution, the (n,) shares.
    shares: Callable[[FloatArray, tuple[int, int]], FloatArray]
    # Fields of `results.ClockResult`, from a time, its sigma [s], whether it is significant, and
    # the image's resolution.
    result: Callable[[float, float, bool, tuple[int, int]], dict[str, Any]]
    # A sentence on a significant time, from the time and its sigma [s].
    words: Callable[[float, float], str]


def target_twists(
    mount: Mount, base_from_flange: FloatArray, x: FloatArray, poses: FloatArray, speeds: FloatArray
) -> FloatArray:
    """Twists of the views' targets relative to the camera.

    Args:
        mount: Mounting of the camera.
        base_from_flange: (v, 4, 4).
        x: (4, 4) the camera's edge.
        poses: (v, 4, 4) `cam_from_target`.
        speeds: (v, 6) twists per second of the flange, in its own frame.

    Returns:
        (v, 6) twists per second, in the target's frame.
    """
    hand = mount == "eye-in-hand"
    flange_from_target = x @ poses if hand else invert(base_from_flange) @ x @ poses
    twists = (adjoint(invert(flange_from_target)) @ speeds[:, :, None])[:, :, 0]
    return np.asarray(-twists if hand else twists)


def delayed_points(
    stack: CornerStack, shares: FloatArray, twists: FloatArray, times_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Target positions of the corners at the time of their exposure.

    Args:
        stack: The corners of v views.
        shares: (n, k) of the times.
        twists: (v, 6) of `target_twists`.
        times_s: (k,) the times [s].

    Returns:
        (n, 3) positions on the target [m], and (n, 3, k) their derivatives by the times [m/s].
    """
    of_corner = twists[stack.view_of]
    points = apply_each(exp((shares @ times_s)[:, None] * of_corner), stack.points)
    speeds = np.cross(of_corner[:, :3], points) + of_corner[:, 3:]
    return points, speeds[:, :, None] * shares[:, None, :]


def shares_of(delays: Sequence[Delay], stack: CornerStack, camera: Camera) -> FloatArray:
    """The (n, k) shares of all corners."""
    return np.stack([delay.shares(stack.px, camera.resolution) for delay in delays], axis=1)


def compress_delayed(
    stack: CornerStack,
    camera: Camera,
    shares: FloatArray,
    twists: FloatArray,
    times_s: FloatArray,
    starts: FloatArray,
) -> Compressed:
    """Compresses corners to normal equations in each view's pose and the times.

    Args:
        stack: The corners of v views.
        camera: The intrinsics, held.
        shares: (n, k) of `shares_of`.
        twists: (v, 6) of `target_twists`.
        times_s: (k,) linearisation point [s].
        starts: (v, 4, 4) starts of `cam_from_target`.
    """
    points, jacobian = delayed_points(stack, shares, twists, times_s)
    return compress_points(stack.with_points(points), camera, starts, jacobian, lens=False)
