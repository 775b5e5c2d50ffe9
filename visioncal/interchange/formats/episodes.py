"""Episodes of a data set: LeRobot's, or a folder with a video or a folder of pictures for each."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2

from visioncal.core.errors import DataError
from visioncal.core.files import natural
from visioncal.core.number_format import some_of
from visioncal.core.types import Image
from visioncal.interchange.formats.lerobot import LEROBOT, FrameImages, episode_frames
from visioncal.session.images import IMAGE_ENDINGS
from visioncal.verification.scene_audit import Episode
from visioncal.vision.boards.imaging import decode_image, read_image

# Endings of videos; lists of other files, which FFmpeg would follow out of the folder, have others.
_VIDEOS = (".mp4", ".avi", ".mkv", ".mov")


def read_episodes(source: Path, image_key: str | None = None) -> tuple[Episode, ...]:
    """Reads which episodes a data set has, in their order.

    Args:
        source: A data set of LeRobot, or a folder with a video or a folder of pictures an episode.
        image_key: Which camera: the key of LeRobot, or what the paths of its videos and pictures
            contain; None for the only one.

    Raises:
        DataError: There are no episodes, or the data set has several cameras.
    """
    if not source.is_dir():
        raise DataError(f"{source} must be a data set's folder.", culprits=[str(source)])
    if LEROBOT.recognises(source):
        return tuple(
            Episode(f"episode {number}", count, partial(_frame, load), frames_a_second)
            for number, (count, load, frames_a_second) in episode_frames(source, image_key).items()
        )
    wanted = image_key or ""
    files = [path for path in source.rglob("*") if path.is_file() and wanted in str(path)]
    videos = [path for path in files if path.suffix.lower() in _VIDEOS]
    pictures: dict[Path, list[Path]] = {}
    for path in files:
        if path.suffix.lower() in IMAGE_ENDINGS:
            pictures.setdefault(path.parent, []).append(path)
    found = [_of_video(path, source) for path in sorted(videos, key=natural)]
    for folder in sorted(pictures, key=natural):
        paths = sorted(pictures[folder], key=natural)
        name = folder.relative_to(source).as_posix()
        found.append(Episode(name, len(paths), partial(_picture, paths)))
    if not found:
        raise DataError(
            f"{source} has no episodes{f' of {wanted}' if wanted else ''}: it must hold "
            f"meta/info.json of LeRobot, videos ({some_of(_VIDEOS)}) or folders of pictures.",
            culprits=[str(source)],
            next_step="Name the folder that holds an episode's video or pictures each.",
        )
    return tuple(found)


def _of_video(path: Path, source: Path) -> Episode:
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    count, frames_a_second = (
        float(video.get(part)) for part in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS)
    )
    video.release()
    if count < 1.0:
        words = f"{path} must be a video that FFmpeg decodes."
        raise DataError(words, culprits=[str(path)], next_step="Leave it out, or write it anew.")

    def load(at: int) -> bytes:
        return FrameImages({}).load((path, at))

    name = path.relative_to(source).as_posix()
    return Episode(name, int(count), partial(_frame, load), frames_a_second)


def _frame(load: Callable[[int], bytes], number: int) -> Image:
    image = decode_image(load(number))
    if isinstance(image, str):
        raise DataError(f"frame {number} of an episode is {image}.", culprits=[f"frame {number}"])
    return image


def _picture(paths: Sequence[Path], number: int) -> Image:
    return read_image(paths[number])
