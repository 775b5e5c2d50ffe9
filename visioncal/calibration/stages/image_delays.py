"""Times within images of moving targets: what they are, and what corners and poses become by them.

An image says its stamp, and its corners may have been taken before or after. Once it is known by
how much, they are set straight: to where they would have been at the stamp.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Camera, FloatArray
from visioncal.estimation.clock import ClockFit, DelayedFit, fit_delays
from visioncal.estimation.clock_correlation import ImageTimes
from visioncal.estimation.corners import CornerStack, floored_sigma_px, reproject
from visioncal.estimation.effects import EFFECTS
from visioncal.estimation.effects.delays import (
    Delay,
    compress_delayed,
    delayed_points,
    shares_of,
    target_twists,
)
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.parts import Effect
from visioncal.estimation.trajectory import Trajectory
from visioncal.estimation.variance import Knowledge


@dataclass(frozen=True, eq=False)
class FoundDelay:
    """A time within images.

    Attributes:
        of: The effect.
        time_s: How much it is [s].
        sigma_s: Its standard deviation [s].
        is_clear: Whether it is beyond chance, and was taken into account.
        resolution: Of the images [px].
        jacobian: (6,) how each view's `cam_from_target` moves with it, by view.
    """

    of: Delay
    time_s: float
    sigma_s: float
    is_clear: bool
    resolution: tuple[int, int]
    jacobian: Mapping[int, FloatArray] = field(default_factory=dict)

    def effect(self, views: Sequence[int], name: str = "") -> Effect:
        """Its error as an unknown of some views; see `Clock.effects`."""
        still = np.zeros(6)
        jacobian = np.array([self.jacobian.get(view, still) for view in views]).reshape(-1, 6, 1)
        known = Knowledge(np.array([[self.sigma_s**-2.0]]), np.zeros(1))
        return Effect.free(name or self.of.name, known, jacobian)

    def result(self) -> dict[str, Any]:
        """Fields of `results.ClockResult`."""
        return self.of.result(self.time_s, self.sigma_s, self.is_clear, self.resolution)

    @property
    def words(self) -> str:
        """Says what was found."""
        return self.of.words(self.time_s, self.sigma_s)


def find_delays(
    flange: Trajectory, frames: ImageTimes, camera: Camera | None, start: ClockFit
) -> tuple[DelayedFit | None, tuple[FoundDelay, ...]]:
    """Looks for times within images.

    Args:
        flange: `base_from_flange` over the robot's time.
        frames: What the camera saw.
        camera: Its intrinsics; None where its corners are not known.
        start: The fit without them.

    Returns:
        The fit with those that are beyond chance, None without any; and what was found of all.
    """
    whole = None if camera is None else fit_delays(flange, frames, camera, start, EFFECTS)
    if whole is None or camera is None:
        return None, ()
    found = tuple(
        FoundDelay(of, time_s, sigma_s, is_clear, camera.resolution)
        for of, time_s, sigma_s, is_clear in zip(
            EFFECTS,
            whole.times_s.tolist(),
            whole.sigmas_s.tolist(),
            whole.is_clear.tolist(),
            strict=True,
        )
    )
    clear = [delay.of for delay in found if delay.is_clear]
    if len(clear) in (0, len(found)):
        return (whole if clear else None), found
    return fit_delays(flange, frames, camera, whole.clock, clear), found


@dataclass(frozen=True, eq=False)
class Straight:
    """Views whose corners are where they would have been at the image's stamp.

    Attributes:
        poses: The views' poses, made anew where each has just one.
        jacobian: (6, k) how they move with the k times, by view.
    """

    poses: Mapping[int, ViewPoses]
    jacobian: Mapping[int, FloatArray]


def straighten(
    frames: ImageTimes,
    flange: tuple[FloatArray, FloatArray],
    seen: Sequence[ViewPoses],
    camera: Camera,
    fit: DelayedFit,
) -> Straight:
    """Sets corners straight.

    Args:
        frames: What the camera saw in v views, with corners.
        flange: (v, 4, 4) `base_from_flange` and (v, 6) its twists a second, in its own frame.
        seen: The same views.
        camera: The intrinsics.
        fit: The times, and the camera's edge.
    """
    stack, starts = frames.stack, frames.cam_from_target
    if stack is None or not len(seen):
        return Straight({}, {})
    with one_blas_thread():
        x = fit.clock.fit.state.edges[0]
        twists = target_twists(frames.mount, flange[0], x, starts, flange[1])
        shares = shares_of(fit.delays, stack, camera)
        found = compress_delayed(stack, camera, shares, twists, fit.times_s, starts)
        unknowns = 6 * len(seen) + len(fit.times_s)
        sigma_px = floored_sigma_px(stack.sigma_px(found.residuals, unknowns))
        there, _ = delayed_points(stack, shares, twists, fit.times_s)
        plain = replace(stack, weights=None)
        late_px = _projected(plain.with_points(there), camera, found.cam_from_target)
        px = stack.px + _projected(plain, camera, found.cam_from_target) - late_px
    covariance = sigma_px**2 * covariance_from(found.information)
    poses = {
        view.view: _with_corners(
            view, px[stack.view_of == at], found.cam_from_target[at], covariance[at]
        )
        for at, view in enumerate(seen)
    }
    return Straight(poses, dict(zip(poses, found.by_shared, strict=True)))


def _projected(stack: CornerStack, camera: Camera, poses: FloatArray) -> FloatArray:
    """(n, 2) where the corners are predicted [px]."""
    return reproject(stack, camera, poses, lens=False).residuals + stack.px


def _with_corners(
    view: ViewPoses, px: FloatArray, pose: FloatArray, covariance: FloatArray
) -> ViewPoses:
    if view.corners is None:
        return view
    view = replace(view, corners=replace(view.corners, px=px))
    if len(view.cam_from_target) > 1:
        return view
    return replace(view, cam_from_target=pose[None], covariance=covariance[None])
