"""Detection of motion of arm and image between two moments."""

from dataclasses import dataclass

import cv2
import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, Image
from visioncal.live.capture.options import Stillness
from visioncal.live.drivers.protocols import ArmState, Frame

# Number of tracked points, and their window [px].
_POINTS, _WINDOW_PX = 80, 21
# With fewer points the image is featureless, and gives no view anyway.
_FEWEST = 8
# With less contrast [grey levels] there is only noise to track.
_CONTRAST = 20
# Least share of points that must be found again.
_FOUND_SHARE = 0.5
# Greatest difference of grey levels between matching windows.
_GREY_DIFFERENCE = 25.0


@dataclass(frozen=True, eq=False)
class StillFrame:
    """Frame with the states of the arm before and after its exposure."""

    frame: Frame
    before: ArmState
    after: ArmState

    @property
    def state(self) -> ArmState:
        """State nearer to the middle of the exposure."""
        middle = self.frame.stamp_s
        ends = (self.before, self.after)
        return min(ends, key=lambda end: abs(end.stamp_s - middle))


def grey(image: Image) -> Image:
    """Grey image (h, w) of an image that may be coloured."""
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def why_arm_moves(first: ArmState, latest: ArmState, still: Stillness) -> str:
    """Describes how an arm moved between two states, or moves now; empty where it is still."""
    for state in (first, latest):
        speed = 0.0 if state.dq is None else float(np.abs(state.dq).max())
        if speed > still.joint_speed:
            return f"a joint turns at {speed:.3g} rad/s (limit {still.joint_speed:g})"
    if first.q is not None and latest.q is not None:
        turned = float(np.abs(latest.q - first.q).max())
        if turned > still.joint_rad:
            return f"a joint turned by {figure(turned)} rad (limit {still.joint_rad:g})"
    motion = invert(first.base_from_flange) @ latest.base_from_flange
    shift, angle = float(np.linalg.norm(motion[:3, 3])), float(rotation_angle(motion))
    if shift > still.flange_m:
        return f"the flange moved by {figure(1e3 * shift)} mm (limit {1e3 * still.flange_m:g})"
    if angle > still.flange_rad:
        return f"the flange turned by {figure(angle)} rad (limit {still.flange_rad:g})"
    return ""


def why_image_moves(first: Image, latest: Image, still: Stillness) -> tuple[str, float]:
    """Describes how an image moved, if it did, and measures by how much [px]."""
    motion_px = image_motion_px(first, latest)
    if motion_px <= still.image_px:
        return "", motion_px
    if not np.isfinite(motion_px):
        return "the image shows something else from frame to frame", motion_px
    return f"the image moved by {figure(motion_px)} px (limit {still.image_px:g})", motion_px


def image_motion_px(first: Image, latest: Image) -> float:
    """Median motion of feature points between grey images (h, w) [px] (Lucas and Kanade 1981).

    It is zero without features, and infinite where most points are lost.
    """
    low, high = np.percentile(first[::4, ::4], [1, 99])
    if high - low < _CONTRAST:
        return 0.0
    points = cv2.goodFeaturesToTrack(first, _POINTS, 0.05, _WINDOW_PX)
    if points is None or len(points) < _FEWEST:
        return 0.0
    moved, status, error = cv2.calcOpticalFlowPyrLK(
        first, latest, points, np.empty_like(points), winSize=(_WINDOW_PX, _WINDOW_PX)
    )
    matched = (status[:, 0] == 1) & (error[:, 0] < _GREY_DIFFERENCE)
    if matched.mean() < _FOUND_SHARE:
        return float("inf")
    shifts: FloatArray = np.asarray((moved - points)[matched, 0], dtype=float)
    return float(np.median(np.linalg.norm(shifts, axis=1)))
