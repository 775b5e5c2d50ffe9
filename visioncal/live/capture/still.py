"""Whether arm and image stand still between two moments."""

from dataclasses import dataclass

import cv2
import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, Image
from visioncal.live.capture.options import Stillness
from visioncal.live.drivers.protocols import ArmState, Frame

# Points by which the motion of an image is followed, over windows of so many pixels.
_POINTS, _WINDOW_PX = 80, 21
# Fewer points show nothing: the image shows nothing, and no view comes of it.
_FEWEST = 8
# Under this many grey levels from dark to light there is nothing but noise to follow.
_CONTRAST = 20
# Points that are lost count as moved where they are more than this share.
_LOST = 0.5
# Differences of grey levels between windows that show the same.
_ALIKE = 25.0


@dataclass(frozen=True, eq=False)
class StillFrame:
    """A frame with the states of the arm around its exposure."""

    frame: Frame
    before: ArmState
    after: ArmState

    @property
    def state(self) -> ArmState:
        """The state that is nearer to the middle of the exposure."""
        middle = self.frame.stamp_s
        ends = (self.before, self.after)
        return min(ends, key=lambda end: abs(end.stamp_s - middle))


def grey(image: Image) -> Image:
    """(h, w) grey levels of an image that may have colours."""
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def why_arm_moves(first: ArmState, then: ArmState, still: Stillness) -> str:
    """Says how an arm moved between two states, or moves now; empty where it stands still."""
    for state in (first, then):
        speed = 0.0 if state.dq is None else float(np.abs(state.dq).max())
        if speed > still.joint_speed:
            return f"a joint turns at {speed:.3g} rad/s (limit {still.joint_speed:g})"
    if first.q is not None and then.q is not None:
        turned = float(np.abs(then.q - first.q).max())
        if turned > still.joint_rad:
            return f"a joint turned by {figure(turned)} rad (limit {still.joint_rad:g})"
    moved = invert(first.base_from_flange) @ then.base_from_flange
    shift, angle = float(np.linalg.norm(moved[:3, 3])), float(rotation_angle(moved))
    if shift > still.flange_m:
        return f"the flange moved by {figure(1e3 * shift)} mm (limit {1e3 * still.flange_m:g})"
    if angle > still.flange_rad:
        return f"the flange turned by {figure(angle)} rad (limit {still.flange_rad:g})"
    return ""


def why_image_moves(first: Image, then: Image, still: Stillness) -> tuple[str, float]:
    """Says how an image moved, or nothing, and by how much [px]."""
    moved = image_motion_px(first, then)
    if moved <= still.image_px:
        return "", moved
    if not np.isfinite(moved):
        return "the image shows something else from frame to frame", moved
    return f"the image moved by {figure(moved)} px (limit {still.image_px:g})", moved


def image_motion_px(first: Image, then: Image) -> float:
    """Measures how far an image moved, by points that stand out (Lucas and Kanade 1981).

    Args:
        first: (h, w) grey image.
        then: (h, w) the one after it.

    Returns:
        The points' median shift [px]; zero where nothing stands out, infinite where most points
        are not found again.
    """
    low, high = np.percentile(first[::4, ::4], [1, 99])
    if high - low < _CONTRAST:
        return 0.0
    points = cv2.goodFeaturesToTrack(first, _POINTS, 0.05, _WINDOW_PX)
    if points is None or len(points) < _FEWEST:
        return 0.0
    found, status, error = cv2.calcOpticalFlowPyrLK(
        first, then, points, np.empty_like(points), winSize=(_WINDOW_PX, _WINDOW_PX)
    )
    kept = (status[:, 0] == 1) & (error[:, 0] < _ALIKE)
    if kept.mean() < _LOST:
        return float("inf")
    shifts: FloatArray = np.asarray((found - points)[kept, 0], dtype=float)
    return float(np.median(np.linalg.norm(shifts, axis=1)))
