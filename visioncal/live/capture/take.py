"""Taking a view: wait for arm and image to settle, take frames, keep one or their mean."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.detect import find_corners
from visioncal.core.errors import DriverError
from visioncal.core.types import Corners, Image, Rejection, Target
from visioncal.live.capture.live import LiveCell
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.still import StillFrame, grey, why_arm_moves, why_image_moves
from visioncal.live.drivers.protocols import ArmState, Frame
from visioncal.vision.finders import blur_of

# Tolerance of a frame's stamp before it was requested, or after it arrived [s].
_EARLY_S = 0.02
# Attempts per view, as frames during which something moved are discarded.
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class TakenView:
    """A view."""

    frame: Frame  # The sharpest frame, or the mean of all.
    state: ArmState  # The arm at its exposure.
    corners: Corners  # Corners detected in it.
    motion_px: float  # Image motion from the first to the last frame [px].


@dataclass(frozen=True)
class Missed:
    """Reason why there is no view, in words."""

    reason: str


@dataclass(frozen=True, eq=False)
class Settled:
    """First and latest frame of a rest that has lasted long enough."""

    first: StillFrame
    last: StillFrame


def _capture_still(cell: LiveCell) -> StillFrame:
    """Takes a frame, with the states of the arm around its exposure."""
    asked = cell.clock.now()
    before = cell.state()
    frame = cell.camera.frame()
    after = cell.state()
    if frame.stamp_s < asked - _EARLY_S or frame.stamp_s > cell.clock.now() + _EARLY_S:
        raise DriverError(
            f"{cell.camera.name}: its picture is stamped {frame.stamp_s - asked:+.3f} s from when "
            "it was asked for; a picture exposed after that is needed.",
            culprits=[cell.camera.name],
            next_step="The camera hands out old pictures, or its clock is not the host's.",
        )
    return StillFrame(frame, before, after)


def settle(cell: LiveCell, options: CaptureOptions) -> Settled | Missed:
    """Waits until arm and image are still.

    Raises:
        DriverError: A device fails, or the arm is stopped.
    """
    still = options.still
    start = cell.clock.now()
    first = _capture_still(cell)
    if options.single:
        return Settled(first, first)
    while True:
        latest = _capture_still(cell)
        reason = _why_moving(first, latest, options)[0]
        if reason:
            first = latest
        elif latest.after.stamp_s - first.before.stamp_s >= still.quiet_s:
            return Settled(first, latest)
        if cell.clock.now() - start > still.patience_s:
            return Missed(f"nothing came to rest in {still.patience_s:g} s: {reason or 'too slow'}")


def _why_moving(
    first: StillFrame, latest: StillFrame, options: CaptureOptions
) -> tuple[str, float]:
    """Describes what moved between two frames, if anything, and measures image motion [px]."""
    reason = why_arm_moves(first.before, latest.before, options.still)
    reason = reason or why_arm_moves(first.before, latest.after, options.still)
    if reason:
        return reason, 0.0
    return why_image_moves(grey(first.frame.image), grey(latest.frame.image), options.still)


def take(
    cell: LiveCell, settled: Settled, target: Target, view: int, options: CaptureOptions
) -> TakenView | Missed:
    """Takes a view of an arm at rest.

    In all frames image and arm must be where they were when the rest began; otherwise the frames
    are discarded, and the next rest is waited for.

    Raises:
        DriverError: A device fails, or the arm is stopped.
    """
    reason = ""
    for _ in range(_ROUNDS):
        frames, reason, motion_px = _frames(cell, settled, options)
        if not reason:
            return _select_frame(frames, target, view, options, motion_px)
        rest = settle(cell, options)
        if isinstance(rest, Missed):
            return rest
        settled = rest
    return Missed(f"something moved during every exposure: {reason}")


def _frames(
    cell: LiveCell, settled: Settled, options: CaptureOptions
) -> tuple[list[StillFrame], str, float]:
    """Takes the frames of a rest; none with the reason if something moved; image motion [px]."""
    frames, motion_px = [settled.last], 0.0
    while len(frames) < (1 if options.single else options.frames):
        latest = _capture_still(cell)
        reason, motion_px = _why_moving(settled.first, latest, options)
        if reason:
            return [], reason, motion_px
        frames.append(latest)
    return frames, "", motion_px


def _select_frame(
    frames: Sequence[StillFrame],
    target: Target,
    view: int,
    options: CaptureOptions,
    motion_px: float,
) -> TakenView | Missed:
    if options.keep == "mean":
        return _detect(_mean_frame(frames), target, view, motion_px)
    first = _detect(frames[0], target, view, motion_px)
    if isinstance(first, Missed):
        return first
    # Image and arm are still: the corners of one frame hold for all.
    corners = first.corners
    blurs = [blur_of(grey(frame.frame.image), target, corners.ids, corners.px) for frame in frames]
    sharpest = int(np.argmin(blurs))
    return first if sharpest == 0 else _detect(frames[sharpest], target, view, motion_px)


def _detect(still: StillFrame, target: Target, view: int, motion_px: float) -> TakenView | Missed:
    corners, _ = find_corners(grey(still.frame.image), target, view)
    if isinstance(corners, Rejection):
        return Missed(corners.reason)
    return TakenView(still.frame, still.state, corners, motion_px)


def _mean_frame(frames: Sequence[StillFrame]) -> StillFrame:
    """Mean of all frames, with the arm's state at the middle one."""
    middle = frames[len(frames) // 2]
    images = np.stack([frame.frame.image for frame in frames]).astype(np.float32)
    image: Image = np.asarray(np.rint(images.mean(axis=0)), dtype=np.uint8)
    stamp = float(np.mean([frame.frame.stamp_s for frame in frames]))
    return replace(middle, frame=replace(middle.frame, image=image, stamp_s=stamp))
