"""Where a camera moved in the episodes of a data set, by the standing scene in their frames.

Some frames of each episode are looks of the guard by a standing scene (`scene_guard`). After its
alarm the move is located between two looks by comparison with the images before and after, and the
frame by bisection; the image of the alarm is then the reference.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import Camera, FloatArray, Image, Mask
from visioncal.verification.scene_guard import SceneWatch
from visioncal.vision.scene import Registration, register


@dataclass(frozen=True, eq=False)
class Episode:
    """An episode of a data set."""

    name: str
    count: int  # Number of frames.
    load: Callable[[int], Image]  # The (h, w) grey image of a frame; raises DataError.
    frames_a_second: float = 0.0  # Zero where it is not known.


@dataclass(frozen=True, eq=False)
class SceneMove:
    """A move of the camera, or of the scene before it."""

    episode: Episode
    frame: int  # Number of its first frame after the move.
    # Before to after; its `reason` says where the images have too little in common.
    found: Registration


def assumed_camera(image: Image) -> Camera:
    """A lens of 53 degrees without distortion: in pixels a small turn hardly depends on it."""
    height, width = image.shape
    centre = (0.5 * (width - 1), 0.5 * (height - 1))
    return Camera("brown", (width, height), np.array([width, width, *centre]), np.zeros(5))


def scene_moves(
    episodes: Sequence[Episode],
    camera: Camera,
    *,
    mask: Mask | None = None,
    looks: int = 4,
    steady_px: float = 0.1,
    false_alarm_looks: float = 10_000.0,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Iterator[SceneMove]:
    """Moves of a camera from episode to episode and within them, in their order.

    Args:
        episodes: All that the camera saw, in the order of time.
        camera: The camera's intrinsics.
        mask: (h, w) pixels that stand still; None for all.
        looks: Frames an episode that are compared; a move is named by its frame all the same.
        steady_px: Sigma of the image's harmless motion from look to look [px].
        false_alarm_looks: Mean number of looks from one false alarm to the next.
        progress: Called with the number of episodes that were compared.

    Raises:
        DataError: Fewer than three frames could be compared.
    """
    ends = np.cumsum([episode.count for episode in episodes])

    def image_at(frame: int) -> Image:
        index = int(np.searchsorted(ends, frame, side="right"))
        return episodes[index].load(frame - int(ends[index]) + episodes[index].count)

    def compared(reference: Image, image: Image) -> Registration:
        return register(reference, image, camera, mask)

    # A turn about the axis moves the image's corners.
    unit = np.append(1 / camera.matrix[:2], 2 / np.hypot(*camera.resolution))
    used, last = 0, len(episodes)
    reference: Image | None = None
    watch, places, lost = SceneWatch(unit, steady_px, false_alarm_looks), list[int](), list[int]()
    for number, episode in enumerate(episodes):
        progress("audit", number, last)
        first = int(ends[number]) - episode.count
        for at in np.unique(np.linspace(0, episode.count - 1, looks).round().astype(int)).tolist():
            image, current = image_at(first + at), first + at
            if reference is None:
                reference = None if compared(image, image).reason else image
                places = [current]
                continue
            found = compared(reference, image)
            if not found.reason:
                watch.update(0, found.turn, found.covariance)
                used, lost = used + 1, []
            else:
                # An image that agrees with others that are lost shows another part of the scene.
                lost.append(current)
                is_confirmed = len(lost) >= 3 and not compared(image_at(lost[0]), image).reason
                if not is_confirmed:
                    continue
            places.append(current)
            if watch.holds and not lost:
                continue
            half = 0.5 * float(np.linalg.norm(found.turn / unit)) if not found.reason else np.inf
            frame = _first_after(image, places, half, image_at, compared, unit)
            index = int(np.searchsorted(ends, frame, side="right"))
            begin = int(ends[index]) - episodes[index].count
            yield SceneMove(episodes[index], frame - begin, found)
            reference, watch = image, SceneWatch(unit, steady_px, false_alarm_looks)
            places, lost, used = [current], [], used + 1
    if used < 2:
        raise DataError(
            f"{used} frames of {last} episodes could be compared with an earlier one, "
            "but two are needed: the others show other things, or too little.",
            next_step="Audit a camera that stands still before the same scene, one at a time: "
            "--image-key; of one that moves with the arm, visioncal verify and guard do it.",
        )


def _first_after(
    after: Image,
    places: Sequence[int],
    half: float,
    image_at: Callable[[int], Image],
    compared: Callable[[Image, Image], Registration],
    unit: FloatArray,
) -> int:
    """The first frame that is nearer to the image after a move than to the one before it.

    `half` is half of the move in units of `unit`; infinite where images before and after have
    nothing in common.
    """

    def is_after(frame: int) -> bool:
        found = compared(after, image_at(frame))
        return not found.reason and float(np.linalg.norm(found.turn / unit)) < half

    at = len(places) - 1
    while at > 1 and is_after(places[at - 1]):
        at -= 1
    low, high = places[at - 1], places[at]
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_after(middle) else (middle, high)
    return high
