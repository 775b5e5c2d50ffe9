"""Taking a view: wait until all stands still, take several frames, keep one or their mean."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.detect import look_for
from visioncal.core.errors import DriverError
from visioncal.core.types import Corners, Image, Rejection, Target
from visioncal.live.capture.live import LiveCell
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.still import StillFrame, grey, why_arm_moves, why_image_moves
from visioncal.live.drivers.protocols import ArmState, Frame
from visioncal.vision.finders import blur_of

# Stamps of a frame may lie so far before the moment at which it was asked for [s].
_EARLY_S = 0.02
# Frames that something moved in are thrown away, and taken again so often.
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class TakenView:
    """A view.

    Attributes:
        frame: What is kept: the sharpest frame, or the mean of all.
        state: The arm at its exposure.
        corners: What is seen of the target in it.
        motion_px: How far the image moved from the first to the last frame [px].
    """

    frame: Frame
    state: ArmState
    corners: Corners
    motion_px: float


@dataclass(frozen=True)
class Missed:
    """Why there is no view, in words."""

    reason: str


@dataclass(frozen=True, eq=False)
class Settled:
    """The first look of a rest, and the last by which it was long enough."""

    first: StillFrame
    last: StillFrame


def _take_look(cell: LiveCell) -> StillFrame:
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
    """Waits until arm and image stand still.

    Raises:
        DriverError: A device fails, or the arm is stopped.
    """
    still = options.still
    begun = cell.clock.now()
    first = _take_look(cell)
    if options.single:
        return Settled(first, first)
    while True:
        then = _take_look(cell)
        why = _why_moving(first, then, options)[0]
        if why:
            first = then
        elif then.after.stamp_s - first.before.stamp_s >= still.quiet_s:
            return Settled(first, then)
        if cell.clock.now() - begun > still.patience_s:
            return Missed(f"nothing came to rest in {still.patience_s:g} s: {why or 'too slow'}")


def _why_moving(first: StillFrame, then: StillFrame, options: CaptureOptions) -> tuple[str, float]:
    """Says what moved from one look to another, or nothing; and the image's motion [px]."""
    why = why_arm_moves(first.before, then.before, options.still)
    why = why or why_arm_moves(first.before, then.after, options.still)
    if why:
        return why, 0.0
    return why_image_moves(grey(first.frame.image), grey(then.frame.image), options.still)


def take(
    cell: LiveCell, settled: Settled, target: Target, view: int, options: CaptureOptions
) -> TakenView | Missed:
    """Takes a view of an arm at rest.

    All frames, and the arm around each of them, must stand where they stood when the rest began;
    else they are thrown away, and the rest is waited for again.

    Args:
        cell: The devices.
        settled: The rest.
        target: What is to be seen.
        view: The view's number.
        options: How many frames, and what becomes of them.

    Raises:
        DriverError: A device fails, or the arm is stopped.
    """
    why = ""
    for _ in range(_ROUNDS):
        looks, why, moved = _frames(cell, settled, options)
        if not why:
            return _chosen(looks, target, view, options, moved)
        again = settle(cell, options)
        if isinstance(again, Missed):
            return again
        settled = again
    return Missed(f"something moved during every exposure: {why}")


def _frames(
    cell: LiveCell, settled: Settled, options: CaptureOptions
) -> tuple[list[StillFrame], str, float]:
    """Frames of one rest, the reason why they are none, and how far the image moved [px]."""
    looks, moved = [settled.last], 0.0
    while len(looks) < (1 if options.single else options.frames):
        then = _take_look(cell)
        why, moved = _why_moving(settled.first, then, options)
        if why:
            return [], why, moved
        looks.append(then)
    return looks, "", moved


def _chosen(
    looks: Sequence[StillFrame], target: Target, view: int, options: CaptureOptions, moved: float
) -> TakenView | Missed:
    if options.keep == "mean":
        return _taken(_mean(looks), target, view, moved)
    first = _taken(looks[0], target, view, moved)
    if isinstance(first, Missed):
        return first
    # The board stands still: the corners of one frame are those of all.
    found = first.corners
    blurs = [blur_of(grey(look.frame.image), target, found.ids, found.px) for look in looks]
    sharpest = int(np.argmin(blurs))
    return first if sharpest == 0 else _taken(looks[sharpest], target, view, moved)


def _taken(kept: StillFrame, target: Target, view: int, moved: float) -> TakenView | Missed:
    found, _ = look_for(grey(kept.frame.image), target, view)
    if isinstance(found, Rejection):
        return Missed(found.reason)
    return TakenView(kept.frame, kept.state, found, moved)


def _mean(looks: Sequence[StillFrame]) -> StillFrame:
    """The mean of all frames, with the arm as it was at the middle one."""
    middle = looks[len(looks) // 2]
    images = np.stack([look.frame.image for look in looks]).astype(np.float32)
    image: Image = np.asarray(np.rint(images.mean(axis=0)), dtype=np.uint8)
    stamp = float(np.mean([look.frame.stamp_s for look in looks]))
    return replace(middle, frame=replace(middle.frame, image=image, stamp_s=stamp))
