"""Camera device whose frames come from any source through a depthai pipeline on this host."""

import threading
import time
from collections.abc import Callable, Mapping
from datetime import timedelta
from pathlib import Path
from types import MappingProxyType, ModuleType

from visioncal.core.errors import DriverError
from visioncal.core.types import Camera
from visioncal.live.drivers.extras import Handle, depthai
from visioncal.live.drivers.oak_frames import FrameEnd, began_after
from visioncal.live.drivers.protocols import Frame
from visioncal.live.drivers.stopwatch import Stopwatch

# Longest wait for a source that computes its pictures [s].
_PATIENCE_S = 10.0
_GLANCE_S = 0.05


class HostedOak:
    """Camera device whose pictures come from a source.

    The source is called on request, in a thread of the pipeline.

    Args:
        source: Returns a picture with its time, exposed after the call; None at its end. Its
            DriverError is raised to the caller of `frame`.
        resolution: (width, height) of its pictures [px].
        factory: Its known intrinsics.
        settings: Its settings.
        raw: File to record every frame into, `.avi` or `.mkv`.

    Raises:
        DriverError: depthai is not installed.
        DataError: Frames cannot be recorded into that file.
    """

    name = "OAK pipeline without a device"

    def __init__(
        self,
        source: Callable[[], Frame | None],
        resolution: tuple[int, int],
        *,
        factory: Camera | None = None,
        settings: Mapping[str, str | float] | None = None,
        raw: Path | None = None,
    ) -> None:
        dai = depthai()
        self.resolution, self.factory = resolution, factory
        self.settings = MappingProxyType(dict(settings or {}))
        self._feed = _Feed(source)
        pipeline = dai.Pipeline(createImplicitDevice=False)
        node = _source_node(dai, pipeline, self._feed)
        self._end = FrameEnd(dai, pipeline, node.out, self.name, raw=raw)

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns a picture whose exposure began after the call.

        Raises:
            DriverError: The source has none, failed, or was closed.
        """
        requested_at = time.monotonic()
        waiting, quiet = Stopwatch(), Stopwatch()
        self._end.drop_old()
        self._feed.ask()
        while True:
            frame = self._end.next(_GLANCE_S)
            if frame is not None and began_after(frame, requested_at):
                return self._check_resolution(frame)
            if frame is not None:
                # It was under way already when this one was requested.
                self._feed.ask()
            self._feed.raise_error()
            waited_s = waiting.read()
            if self._feed.is_busy:
                # The source's picture must still pass through the pipeline.
                quiet.restart()
            if waited_s > _PATIENCE_S or quiet.read() > timeout_s:
                raise DriverError(
                    f"The {self.name} gave no picture within {waited_s:.1f} s.",
                    culprits=[self.name],
                )

    def close(self) -> None:
        """Stops the pipeline; may be called twice."""
        self._end.close()

    def _check_resolution(self, frame: Frame) -> Frame:
        height, width = frame.image.shape[:2]
        if (width, height) != self.resolution:
            raise DriverError(
                f"The {self.name} gave a picture of {width}x{height}; "
                f"{self.resolution[0]}x{self.resolution[1]} was promised.",
                culprits=[self.name],
            )
        return frame


class _Feed:
    """State that the pipeline's thread shares with the caller of `frame`."""

    def __init__(self, source: Callable[[], Frame | None]) -> None:
        self._source = source
        self._wanted = threading.Event()
        self._error: DriverError | None = None
        self.is_busy = False

    def ask(self) -> None:
        """Requests a picture."""
        self._wanted.set()

    def answer(self) -> Frame | None:
        """Returns a picture where one was requested; called by the pipeline repeatedly."""
        if not self._wanted.wait(_GLANCE_S):
            return None
        self.is_busy = True
        self._wanted.clear()
        try:
            frame = self._source()
            if frame is None:
                self._error = DriverError("The source of pictures is at its end.")
        except DriverError as error:
            self._error = error
            return None
        finally:
            self.is_busy = False
        return frame

    def raise_error(self) -> None:
        """Raises the source's error, once: a camera may be plugged in again."""
        error, self._error = self._error, None
        if error is not None:
            raise error


def _source_node(dai: ModuleType, pipeline: Handle, feed: _Feed) -> Handle:
    """Creates the node that sends the feed's pictures; its class needs depthai to be imported."""

    class Source(dai.node.ThreadedHostNode):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            dai.node.ThreadedHostNode.__init__(self)
            self.out = self.createOutput()

        def run(self) -> None:
            number = 0
            while self.isRunning():
                frame = feed.answer()
                if frame is not None:
                    self.out.send(_message(dai, frame, number))
                    number += 1

    return pipeline.create(Source)


def _message(dai: ModuleType, frame: Frame, number: int) -> Handle:
    """Builds a device's message for a frame; depthai stamps the end of the exposure."""
    kinds = dai.ImgFrame.Type
    message = dai.ImgFrame()
    message.setCvFrame(frame.image, kinds.GRAY8 if frame.image.ndim == 2 else kinds.BGR888i)
    exposure_s = frame.exposure_s or 0.0
    message.cam.exposureTimeUs = round(1e6 * exposure_s)
    message.setTimestamp(timedelta(seconds=frame.stamp_s + 0.5 * exposure_s))
    message.setSequenceNum(number)
    return message
