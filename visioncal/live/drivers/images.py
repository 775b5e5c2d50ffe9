"""Camera device that returns the images of a folder in order."""

import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from visioncal.core.errors import DataError, DriverError
from visioncal.core.files import natural
from visioncal.core.types import Camera
from visioncal.live.drivers.protocols import Frame
from visioncal.session.images import IMAGE_ENDINGS
from visioncal.vision.boards.imaging import read_image


class FolderCamera:
    """Camera device whose next picture is the folder's next file, in the order of the numbers.

    It replaces a camera that another program triggers: the files are listed on opening, read in
    grey, and each is stamped when it is requested.

    Raises:
        DataError: The folder is missing or holds no images, or the first cannot be read.
    """

    # A folder has no intrinsics.
    factory: Camera | None = None

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        if not folder.is_dir():
            raise DataError(f"There is no folder {folder}.", culprits=[str(folder)])
        self._files = sorted(
            (path for path in folder.iterdir() if path.suffix.lower() in IMAGE_ENDINGS), key=natural
        )
        if not self._files:
            raise DataError(
                f"{folder} holds no images ({', '.join(IMAGE_ENDINGS)}).", culprits=[str(folder)]
            )
        self.name = f"images of {folder.name}"
        self.settings: Mapping[str, str | float] = MappingProxyType({"folder": folder.name})
        self._next = 0
        height, width = read_image(self._files[0]).shape[:2]
        self.resolution = (width, height)

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns the next image, stamped now; the timeout is ignored.

        Raises:
            DriverError: There is none.
            DataError: It cannot be read, or has another resolution than the first.
        """
        del timeout_s
        if self._next == len(self._files):
            raise DriverError(
                f"The {self.name} are at their end: all {len(self._files)} were given.",
                culprits=[str(self._folder)],
                next_step="Add images to the folder, or end the recording.",
            )
        file = self._files[self._next]
        image = read_image(file)
        height, width = image.shape[:2]
        if (width, height) != self.resolution:
            raise DataError(
                f"{file} has {width}x{height} pixels; {self.resolution[0]}x{self.resolution[1]} "
                f"are needed, as {self._files[0].name} has.",
                culprits=[str(file)],
            )
        self._next += 1
        return Frame(image, time.monotonic())

    def close(self) -> None:
        """Holds no resources."""
