"""The end of a depthai pipeline on this host: its frames, and their recording."""

import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from types import ModuleType

import numpy as np

from visioncal.core.errors import DataError, DriverError
from visioncal.core.files import check_free
from visioncal.core.types import Image
from visioncal.live.drivers.extras import Handle
from visioncal.live.drivers.protocols import Frame

# What depthai's recorder keeps without loss; into others it encodes.
_RAW_ENDINGS = (".avi", ".mkv")
# Only players of such a file care: every frame's own time is in the file beside it.
_NOMINAL_HZ = 30
# Longest wait for the recorder to write what it was given [s].
_DRAIN_S = 5.0


class FrameEnd:
    """The queue at the end of a pipeline, which it runs.

    Args:
        dai: The library.
        pipeline: The pipeline, not yet running.
        output: The output of a node whose frames are wanted.
        name: Whose they are, for messages.
        raw: A file to record every frame into, and its times beside it.

    Raises:
        DriverError: The pipeline does not start.
        DataError: Frames cannot be recorded into that file.
    """

    def __init__(
        self,
        dai: ModuleType,
        pipeline: Handle,
        output: Handle,
        name: str,
        *,
        raw: Path | None = None,
    ) -> None:
        self._dai, self._name = dai, name
        self._recorder = None if raw is None else _recorder(dai, pipeline, output, raw)
        self._queue = output.createOutputQueue(maxSize=4, blocking=False)
        with worded(dai, name, "does not start"):
            pipeline.start()
        # A pipeline that still runs when Python ends aborts the process.
        self._stop = weakref.finalize(self, _stop, pipeline)

    def drop_old(self) -> None:
        """Forgets the frames that nobody has taken."""
        with worded(self._dai, self._name):
            self._queue.tryGetAll()

    def next(self, timeout_s: float) -> Frame | None:
        """Takes the next frame; None where there is none in time.

        Raises:
            DriverError: The pipeline has ended, or the device is gone.
        """
        message = self.message(timeout_s)
        return None if message is None else _frame(self._dai, message)

    def message(self, timeout_s: float) -> Handle | None:
        """Takes the next frame as depthai has it, with all that the camera says of it."""
        with worded(self._dai, self._name):
            return self._queue.get(timedelta(seconds=max(timeout_s, 0.0)))

    def close(self) -> None:
        """Stops the pipeline once all that it records is written; may be called twice."""
        until = time.monotonic() + _DRAIN_S
        while self._recorder is not None and self._stop.alive and time.monotonic() < until:
            if self._recorder.input.getSize() == 0:
                break
            time.sleep(0.005)
        self._stop()


def _times_beside(raw: Path) -> Path:
    """Where the times of raw frames are: a file beside theirs."""
    return raw.with_suffix(".mcap")


def began_after(frame: Frame, asked: float) -> bool:
    """Tells whether a frame's exposure began after a moment of the monotonic clock."""
    return frame.stamp_s - 0.5 * (frame.exposure_s or 0.0) >= asked


@contextmanager
def worded(dai: ModuleType, name: str, what: str = "gives no frames any more") -> Iterator[None]:
    """Words what depthai raises: RuntimeError of devices and pipelines, and of closed queues.

    Raises:
        DriverError: It did.
    """
    try:
        yield
    except (RuntimeError, dai.MessageQueue.QueueException) as error:
        raise DriverError(
            f"{name} {what}: {error}.",
            culprits=[name],
            next_step="Look at its cable and its power; then go on with --resume.",
        ) from error


def _stop(pipeline: Handle) -> None:
    pipeline.stop()
    pipeline.wait()


def _recorder(dai: ModuleType, pipeline: Handle, output: Handle, raw: Path) -> Handle:
    if raw.suffix.lower() not in _RAW_ENDINGS:
        raise DataError(
            f"{raw} cannot hold raw frames: its ending is {raw.suffix!r}; "
            f"{' or '.join(_RAW_ENDINGS)} is needed.",
            culprits=[str(raw)],
        )
    for path in (raw, _times_beside(raw)):
        check_free(path, force=False)
    recorder = pipeline.create(dai.node.RecordVideo)
    recorder.setRecordVideoFile(raw)
    recorder.setRecordMetadataFile(_times_beside(raw))
    # Where none is said it is reckoned from the first frames, and fails on ones sent at once.
    recorder.setFps(_NOMINAL_HZ)
    output.link(recorder.input)
    return recorder


def _frame(dai: ModuleType, message: Handle) -> Frame:
    """Takes a frame over; depthai's clock is this host's monotonic one."""
    image: Image = np.array(message.getCvFrame(), dtype=np.uint8)
    middle = message.getTimestamp(dai.CameraExposureOffset.MIDDLE).total_seconds()
    return Frame(image, middle, message.getExposureTime().total_seconds() or None)
