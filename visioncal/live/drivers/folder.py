"""Pictures that a camera's own program saves into a folder."""

import time
from contextlib import suppress
from pathlib import Path

from visioncal.core.errors import DataError
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
        self.given, self.chosen, self._folder = set[str](), "", Path(path)
        # Sizes at the last two moments of comparison [bytes], and when the last was; the newest
        # picture that was decoded.
        self._listed_s = float("-inf")
        self._sizes, self._before = dict[str, int](), dict[str, int]()
        self._decoded: tuple[tuple[str, int, int], Image | str] | None = None
        refuse_settings(self.name, requested, "in the program that takes them")
        if not path or not self._folder.is_dir():
            step = "Give the folder in which the camera's program saves: --camera folder:PATH."
            is_file = bool(path) and self._folder.exists()
            words = "is a file, but must be one of pictures" if is_file else "does not exist"
            raise camera_error(self.name, words, step)
        self.resolution = requested.resolution or self._next()[1].shape[1::-1]

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns the next picture, stamped now, however old it is; ten seconds are its timeout.

        Raises:
            DriverError: None came in time, or it has another resolution.
        """
        del timeout_s
        name, image = self._next()
        check_resolution(f"{self.name}: {name}", image, self.resolution, "has")
        self.given.add(name)
        return Frame(image, time.monotonic(), name=name)

    def waiting(self) -> list[str]:
        """Returns the names of pictures that were not given, the next one first.

        Raises:
            DriverError: The folder cannot be read, or a name cannot be written into a table.
        """
        found = dict[Path, int]()
        try:
            for path in self._folder.iterdir():
                if path.suffix.lower() in IMAGE_ENDINGS:
                    # It may have been removed since the folder was read.
                    with suppress(FileNotFoundError):
                        found[path] = path.stat().st_size
        except OSError as error:
            step = "Connect its disk, and make it readable."
            raise camera_error(self.name, f"cannot be read: {error.strerror}", step) from error
        names = [path.name for path in sorted(found, key=natural) if path.name not in self.given]
        if wrong := [ascii(name) for name in names if not name.isprintable()]:
            step = "Rename it: letters, digits and signs of UTF-8 can be written."
            raise camera_error(self.name, f"holds a file named {wrong[0]}", step)
        sizes = {path.name: size for path, size in found.items()}
        if time.monotonic() - self._listed_s >= _POLL_S:
            self._before, self._sizes, self._listed_s = self._sizes, sizes, time.monotonic()
        return sorted(names, key=lambda name: name != self.chosen)

    def look(self, name: str) -> Image | str:
        """Returns a picture without giving it, or says why it is none."""
        path = self._folder / name
        try:
            now = path.stat()
            if not self._before.get(name) == self._sizes.get(name) == now.st_size:
                return "still being written"
            key = (name, now.st_size, now.st_mtime_ns)
            if self._decoded is None or self._decoded[0] != key:
                self._decoded = key, decode_image(read_bytes(path, MOST_IMAGE_BYTES))
        except (OSError, DataError):
            return "cannot be read"
        return self._decoded[1]

    def skip(self) -> None:
        """Counts the present pictures as given."""
        self.given |= {path.name for path in self._folder.glob("*")}

    def close(self) -> None:
        """Holds no resources."""

    def _next(self) -> tuple[str, Image]:
        """Waits for the next picture."""
        waiting = Stopwatch()
        why = f"has no further picture ({len(self.given)} were given)"
        step = f"Save one there ({', '.join(IMAGE_ENDINGS)}), or end the recording."
        while waiting.read() < _PATIENCE_S:
            for name in self.waiting()[:1]:
                image = self.look(name)
                if not isinstance(image, str):
                    return name, image
                why, step = f"holds {name}: {image}", "Remove it."
            time.sleep(_POLL_S)
        raise camera_error(self.name, why, step)
