"""Effects of time within an image: corners of a moving target that are taken later than others.

Such an effect takes each corner later than its image's stamp by a share of one time, which is
unknown. A corner p that is taken by t later lies at `exp(t w) p` in the target's frame, w being the
twist a second at which the target moves in the camera's view, on its right.
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
    """One such effect.

    Attributes:
        name: What it is called.
        sigma_s: What the time is known to without any view, about zero [s].
        shares: Of (n, 2) corners [px] in an image of some resolution, the (n,) shares.
        result: Fields of `results.ClockResult`, from a time, its sigma [s], whether it is beyond
            chance, and the image's resolution.
        words: The same in a sentence, of a time and its sigma [s] that are beyond chance.
    """

    name: str
    sigma_s: float
    shares: Callable[[FloatArray, tuple[int, int]], FloatArray]
    result: Callable[[float, float, bool, tuple[int, int]], dict[str, Any]]
    words: Callable[[float, float], str]


def target_twists(
    mount: Mount, base_from_flange: FloatArray, x: FloatArray, poses: FloatArray, speeds: FloatArray
) -> FloatArray:
    """How views' targets move in front of the camera.

    Args:
        mount: Where the camera is.
        base_from_flange: (v, 4, 4).
        x: (4, 4) the camera's edge.
        poses: (v, 4, 4) `cam_from_target`.
        speeds: (v, 6) twists a second of the flange, in its own frame.

    Returns:
        (v, 6) twists a second, in the target's frame.
    """
    hand = mount == "eye-in-hand"
    flange_from_target = x @ poses if hand else invert(base_from_flange) @ x @ poses
    twists = (adjoint(invert(flange_from_target)) @ speeds[:, :, None])[:, :, 0]
    return np.asarray(-twists if hand else twists)


def delayed_points(
    stack: CornerStack, shares: FloatArray, twists: FloatArray, times_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where the corners were when they were taken.

    Args:
        stack: The corners of v views.
        shares: (n, k) of the times.
        twists: (v, 6) of `target_twists`.
        times_s: (k,) the times [s].

    Returns:
        (n, 3) places on the target [m], and (n, 3, k) how they move with the times [m/s].
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
        times_s: (k,) where to linearise [s].
        starts: (v, 4, 4) `cam_from_target` to start from.
    """
    points, jacobian = delayed_points(stack, shares, twists, times_s)
    return compress_points(stack.with_points(points), camera, starts, jacobian, lens=False)
