"""Recorded raw frames, replayed by depthai as a camera device."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np

from visioncal.core.errors import DataError, DriverError
from visioncal.core.types import Camera
from visioncal.live.drivers.oak_frames import FrameEnd, times_beside
from visioncal.live.drivers.oak_library import depthai
from visioncal.live.drivers.protocols import Frame


class ReplayedOak:
    """A camera device that gives the frames of a file one after the other, with their own times.

    Unlike a camera it waits for whoever takes its frames, and none begins after the call.

    Args:
        raw: The file, as `OakCamera` or `HostedOak` record it; its times are beside it.
        factory: The intrinsics that are known of the camera.

    Raises:
        DriverError: depthai is not installed.
        DataError: The file or its times are missing, or hold no frames.
    """

    def __init__(self, raw: Path, *, factory: Camera | None = None) -> None:
        dai = depthai()
        self._raw, self._factory = raw, factory
        self._left, self._resolution, self._is_grey = _look_into(raw)
        pipeline = dai.Pipeline(createImplicitDevice=False)
        node = pipeline.create(dai.node.ReplayVideo)
        node.setReplayVideoFile(raw)
        node.setReplayMetadataFile(times_beside(raw))
        node.setOutFrameType(dai.ImgFrame.Type.BGR888i)
        # At the end of a file the pipeline stops, often before its last frame is taken: so it goes
        # round, and the frames are counted.
        node.setLoop(True)
        self._end = FrameEnd(dai, pipeline, node.out, self.name, keeps_all=True)

    @property
    def name(self) -> str:
        """What it is."""
        return f"frames of {self._raw.name}"

    @property
    def resolution(self) -> tuple[int, int]:
        """(width, height) of its pictures [px]."""
        return self._resolution

    @property
    def factory(self) -> Camera | None:
        """The intrinsics that are known of the camera."""
        return self._factory

    @property
    def settings(self) -> Mapping[str, str | float]:
        """Where the frames come from."""
        return MappingProxyType({"file": self._raw.name})

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns the next frame, grey where it was recorded so.

        Raises:
            DriverError: There are no more, or it does not come in time.
        """
        if self._left == 0:
            raise DriverError(f"The {self.name} are at their end.", culprits=[str(self._raw)])
        frame = self._end.next(timeout_s)
        if frame is None:
            raise DriverError(
                f"The {self.name} did not come within {timeout_s:g} s.", culprits=[str(self._raw)]
            )
        self._left -= 1
        image = np.ascontiguousarray(frame.image[..., 0]) if self._is_grey else frame.image
        return Frame(image, frame.stamp_s, frame.exposure_s)

    def close(self) -> None:
        """Stops the pipeline; may be called twice."""
        self._end.close()


def _look_into(raw: Path) -> tuple[int, tuple[int, int], bool]:
    """Tells how many frames a file has, their resolution, and whether they are grey."""
    for path in (raw, times_beside(raw)):
        if not path.is_file():
            raise DataError(
                f"There is no {path}; raw frames are a video and their times beside it.",
                culprits=[str(path)],
            )
    video = cv2.VideoCapture(str(raw))
    read, first = video.read()
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    video.release()
    if not read or count < 1:
        raise DataError(
            f"{raw} holds no frames that can be read.",
            culprits=[str(raw)],
            next_step="Its recording was perhaps not closed.",
        )
    height, width = first.shape[:2]
    return count, (width, height), bool((first == first[..., :1]).all())
