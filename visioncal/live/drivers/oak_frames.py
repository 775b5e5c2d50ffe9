"""Output queue of a depthai pipeline on this host, and recording of its frames."""

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

# Formats that depthai's recorder writes without loss.
_RAW_ENDINGS = (".avi", ".mkv")
# Only for players of such a file: every frame's time is in the file beside it.
_NOMINAL_HZ = 30
# Longest wait for the recorder to write its queue [s].
_DRAIN_S = 5.0


class FrameEnd:
    """Output queue of a pipeline, which it starts and stops.

    Args:
        dai: The library.
        pipeline: The pipeline, not yet running.
        output: The output of a node to read.
        name: Name of the device in messages.
        raw: File to record every frame into, with its times in a file beside it.

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
        """Discards unread frames."""
        with worded(self._dai, self._name):
            self._queue.tryGetAll()

    def next(self, timeout_s: float) -> Frame | None:
        """Returns the next frame; None where there is none in time.

        Raises:
            DriverError: The pipeline has ended, or the device is gone.
        """
        message = self.message(timeout_s)
        return None if message is None else _frame(self._dai, message)

    def message(self, timeout_s: float) -> Handle | None:
        """Returns depthai's message of the next frame, with the camera's own data."""
        with worded(self._dai, self._name):
            return self._queue.get(timedelta(seconds=max(timeout_s, 0.0)))

    def close(self) -> None:
        """Stops the pipeline once its recording is written; may be called twice."""
        ends_s = time.monotonic() + _DRAIN_S
        while self._recorder is not None and self._stop.alive and time.monotonic() < ends_s:
            if self._recorder.input.getSize() == 0:
                break
            time.sleep(0.005)
        self._stop()


def _times_beside(raw: Path) -> Path:
    """File with the times of raw frames, beside theirs."""
    return raw.with_suffix(".mcap")


def began_after(frame: Frame, moment: float) -> bool:
    """Whether a frame's exposure began after a moment of the monotonic clock."""
    return frame.stamp_s - 0.5 * (frame.exposure_s or 0.0) >= moment


@contextmanager
def worded(dai: ModuleType, name: str, what: str = "gives no frames any more") -> Iterator[None]:
    """Translates depthai's exceptions of devices, pipelines and closed queues.

    Raises:
        DriverError: Depthai raised one.
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
    # Otherwise it is estimated from the first frames, which fails on ones sent at once.
    recorder.setFps(_NOMINAL_HZ)
    output.link(recorder.input)
    return recorder


def _frame(dai: ModuleType, message: Handle) -> Frame:
    """Converts a message; depthai's clock is this host's monotonic one."""
    image: Image = np.array(message.getCvFrame(), dtype=np.uint8)
    middle = message.getTimestamp(dai.CameraExposureOffset.MIDDLE).total_seconds()
    return Frame(image, middle, message.getExposureTime().total_seconds() or None)
