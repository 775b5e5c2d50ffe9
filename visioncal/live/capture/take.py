"""Taking a view: wait for arm and image to settle, take frames, keep the sharpest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.number_format import counted, figure
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import Corners, FloatArray, Image, Rejection, Target
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.options import CaptureOptions, Stillness
from visioncal.live.drivers.protocols import ArmState, Frame, StoredPictures
from visioncal.vision.boards import blur_of
from visioncal.vision.boards.imaging import grey_of
from visioncal.vision.detection import find_corners

# Tolerance of a frame's stamp before it was requested, or after it arrived [s].
_EARLY_S = 0.02
# Window of tracked points, and their least distance [px].
_WINDOW_PX = 21


@dataclass(frozen=True, eq=False)
class TakenView:
    """A view."""

    frame: Frame  # The sharpest frame.
    state: ArmState  # The arm at its exposure.
    corners: Corners  # Corners detected in it.
    motion_px: float  # Image motion from the first to the last frame [px].


@dataclass(frozen=True)
class Missed:
    """Reason why there is no view, in words."""

    reason: str


@dataclass(frozen=True, eq=False)
class _StillFrame:
    """Frame with the states of the arm before and after its exposure."""

    frame: Frame
    before: ArmState
    after: ArmState

    @classmethod
    def of(cls, cell: LiveCell) -> "_StillFrame":
        """Takes a frame."""
        request_s, before = cell.clock.now(), cell.state()
        frame, after = cell.camera.frame(), cell.state()
        if frame.stamp_s < request_s - _EARLY_S or frame.stamp_s > cell.clock.now() + _EARLY_S:
            raise DriverError(
                f"{cell.camera.name}: its picture is of {frame.stamp_s - request_s:+.3f} s from "
                "the request, but must be exposed after it.",
                culprits=[cell.camera.name],
                next_step="The camera hands out old pictures, or its clock is not the host's.",
            )
        return cls(frame, before, after)

    def why_moved(self, latest: "_StillFrame", still: Stillness) -> tuple[str, float]:
        """Describes what moved until a later frame, if anything; with the image's motion [px]."""
        reason = why_arm_moves(self.before, latest.before, still)
        reason = reason or why_arm_moves(self.before, latest.after, still)
        if reason:
            return reason, 0.0
        motion_px = image_motion_px(grey_of(self.frame.image), grey_of(latest.frame.image))
        if motion_px <= still.image_px:
            return "", motion_px
        if not np.isfinite(motion_px):
            return "the image shows something else from frame to frame", motion_px
        return f"the image moved by {figure(motion_px)} px (limit {still.image_px:g})", motion_px


def take(cell: LiveCell, target: Target, view: int, options: CaptureOptions) -> TakenView | Missed:
    """Takes a view once arm and image are still.

    In all frames image and arm must be where they were when the rest began; otherwise the frames
    are discarded, and the next rest is waited for.

    Raises:
        DriverError: A device fails, or the arm is stopped.
    """
    if cell.is_stored:
        return _selected([_StillFrame.of(cell)], target, view, 0.0)
    reason = ""
    # Frames during which something moved are discarded.
    for _ in range(3):
        rest = _settled(cell, options)
        if isinstance(rest, Missed):
            return rest
        first, last = rest
        frames, motion_px, reason = [last], 0.0, ""
        while not reason and len(frames) < options.frames:
            frames.append(_StillFrame.of(cell))
            reason, motion_px = first.why_moved(frames[-1], options.still)
        if not reason:
            return _selected(frames, target, view, motion_px)
    return Missed(f"something moved during every exposure: {reason}")


def _settled(cell: LiveCell, options: CaptureOptions) -> tuple[_StillFrame, _StillFrame] | Missed:
    """Waits until arm and image are still: first and latest frame of a rest that lasts."""
    still, start = options.still, cell.clock.now()
    first = _StillFrame.of(cell)
    while True:
        latest = _StillFrame.of(cell)
        reason, _ = first.why_moved(latest, still)
        if reason:
            first = latest
        elif latest.after.stamp_s - first.before.stamp_s >= still.quiet_s:
            return first, latest
        if cell.clock.now() - start > still.patience_s:
            return Missed(f"nothing came to rest in {still.patience_s:g} s: {reason or 'too slow'}")


def _selected(
    frames: Sequence[_StillFrame], target: Target, view: int, motion_px: float
) -> TakenView | Missed:
    """The view of the sharpest frame."""

    def detected(still: _StillFrame) -> TakenView | Missed:
        corners, _ = find_corners(grey_of(still.frame.image), target, view)
        if isinstance(corners, Rejection):
            return Missed(corners.reason)
        # The state nearer to the middle of the exposure.
        nearer = min(
            (still.before, still.after), key=lambda end: abs(end.stamp_s - still.frame.stamp_s)
        )
        return TakenView(still.frame, nearer, corners, motion_px)

    first = detected(frames[0])
    if isinstance(first, Missed):
        return first
    # Image and arm are still: the corners of one frame hold for all.
    ids, px = first.corners.ids, first.corners.px
    blurs = [blur_of(grey_of(frame.frame.image), target, ids, px) for frame in frames]
    sharpest = int(np.argmin(blurs))
    return first if sharpest == 0 else detected(frames[sharpest])


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


def image_motion_px(first: Image, latest: Image) -> float:
    """Median motion of feature points between grey images (h, w) [px] (Lucas and Kanade 1981).

    It is zero without features, and infinite where most points are lost.
    """
    low, high = np.percentile(first[::4, ::4], [1, 99])
    # With less contrast there is only noise to track [grey levels].
    if high - low < 20:
        return 0.0
    points = cv2.goodFeaturesToTrack(first, 80, 0.05, _WINDOW_PX)
    # With fewer points the image is featureless, and gives no view anyway.
    if points is None or len(points) < 8:
        return 0.0
    moved, status, error = cv2.calcOpticalFlowPyrLK(
        first, latest, points, np.empty_like(points), winSize=(_WINDOW_PX, _WINDOW_PX)
    )
    # Grey levels of matching windows differ by less, and most points are found again.
    matched = (status[:, 0] == 1) & (error[:, 0] < 25.0)
    if matched.mean() < 0.5:
        return float("inf")
    shifts: FloatArray = np.asarray((moved - points)[matched, 0], dtype=float)
    return float(np.median(np.linalg.norm(shifts, axis=1)))


def pictured_views(
    cell: LiveCell, target: Target, states: Mapping[int, ArmState], due: str
) -> dict[int, TakenView] | str:
    """Views of a folder's next pictures at some states, by number; or why not.

    `due` is the picture that the first state is of.
    """
    camera, taken = cell.camera, dict[int, TakenView]()
    assert isinstance(camera, StoredPictures)
    names = camera.waiting()
    if len(names) < len(states):
        poses, pictures = counted(len(states), "pose"), counted(len(names), "picture")
        return f"{poses}, and {pictures} without one: save the pictures first, and press again."
    if due != names[0]:
        return f"The picture due is {names[0]} now: look at it, and press again."
    for (number, state), name in zip(states.items(), names, strict=False):
        image = camera.look(name)
        if isinstance(image, str):
            return f"{name}: {image}. Save it again, or leave it out; nothing was taken."
        size, needed = (" x ".join(map(str, of)) for of in (image.shape[1::-1], camera.resolution))
        found, _ = find_corners(grey_of(image), target, number)
        if size != needed or isinstance(found, Rejection):
            why = found.reason if isinstance(found, Rejection) else f"{size} px, not {needed}"
            return f"{name}: {why}. Save it again, or leave it out; nothing was taken."
        frame = Frame(image, cell.clock.now(), name=name)
        taken[number] = TakenView(frame, state, found, 0.0)
    return taken
