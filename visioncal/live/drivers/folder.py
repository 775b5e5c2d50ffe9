"""Pictures that a camera's own program saves into a folder."""

import time
from pathlib import Path

from visioncal.core.files import MOST_IMAGE_BYTES, natural, read_bytes
from visioncal.core.types import Camera, Image
from visioncal.live.drivers.protocols import DeviceSetup, Frame, Stopwatch
from visioncal.live.drivers.stream import camera_error, check_resolution, refuse_settings
from visioncal.session.images import IMAGE_ENDINGS
from visioncal.vision.boards.imaging import decode_image

# How long the next picture is waited for, and the interval at which its size is read [s].
_PATIENCE_S, _POLL_S = 10.0, 0.1


class FolderCamera:
    """Camera device that gives each picture of a folder once, in grey and in natural order.

    The next one is waited for until it is there, whole, and no longer grows.

    Args:
        path: The folder.
        requested: The resolution that the pictures must have, by default that of the first.

    Raises:
        DriverError: There is no such folder, no picture comes, or other settings are requested.
    """

    factory: Camera | None = None

    def __init__(self, path: str, requested: DeviceSetup | None = None) -> None:
        requested = requested or DeviceSetup()
        self.name, self.settings = f"folder {path}", dict[str, str | float]()
        self._folder, self._given = Path(path), set[Path]()
        refuse_settings(self.name, requested, "in the program that takes them")
        if not path or not self._folder.is_dir():
            step = "Give the folder in which the camera's program saves: --camera folder:PATH."
            raise camera_error(self.name, "does not exist", step)
        self.resolution = requested.resolution or self._next()[1].shape[1::-1]

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns the next picture, stamped now, however old it is; ten seconds are its timeout.

        Raises:
            DriverError: None came in time, or it has another resolution.
        """
        del timeout_s
        path, image = self._next()
        check_resolution(f"{self.name}: {path.name}", image, self.resolution, "has")
        self._given.add(path)
        return Frame(image, time.monotonic())

    def skip(self) -> None:
        """Counts the pictures that are there as given."""
        self._given |= {*self._folder.glob("*")}

    def close(self) -> None:
        """Holds no resources."""

    def _next(self) -> tuple[Path, Image]:
        """Waits for the next picture."""
        waiting, seen = Stopwatch(), None
        why = f"has no further picture ({len(self._given)} were given)"
        step = f"Save one there ({', '.join(IMAGE_ENDINGS)}), or end the recording."
        while waiting.read() < _PATIENCE_S:
            paths = [path for path in self._folder.glob("*") if path not in self._given]
            paths = [path for path in paths if path.suffix.lower() in IMAGE_ENDINGS]
            if paths:
                path = min(paths, key=natural)
                data = read_bytes(path, MOST_IMAGE_BYTES)
                image = decode_image(data) if seen == (path, len(data)) else "still growing"
                if not isinstance(image, str):
                    return path, image
                seen, why, step = (path, len(data)), f"holds {path.name}: {image}", "Remove it."
            time.sleep(_POLL_S)
        raise camera_error(self.name, why, step)
