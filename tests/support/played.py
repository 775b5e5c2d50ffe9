"""visioncal's command line with one more camera: `played:SESSION`, a session's images.

The file `shown` beside them says whose view is seen; without it the camera is unplugged.
"""

import time
from pathlib import Path

from visioncal.core.errors import DriverError
from visioncal.live.capture import devices
from visioncal.live.drivers.protocols import Frame
from visioncal.session import Session
from visioncal.vision.boards.imaging import read_image


class PlayedCamera:
    """A camera that sees what a simulated one saw."""

    def __init__(self, folder: Path) -> None:
        session = Session.load(folder)
        self._folder, self._images = folder, {view.number: view.image for view in session.views}
        self.name, self.factory, self.settings = "played camera", None, {}
        height, width = read_image(folder / next(iter(self._images.values()))).shape
        self.resolution = (width, height)

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """The image of the shown view, exposed now."""
        del timeout_s
        at_s = time.monotonic()
        try:
            # Empty for the moment in which it is written.
            while not (shown := (self._folder / "shown").read_text()):
                pass
            number = int(shown)
        except OSError:
            raise DriverError(
                "The played camera gives no picture.", next_step="Look at its cable."
            ) from None
        # A camera's pace.
        time.sleep(0.02)
        return Frame(read_image(self._folder / self._images[number]), at_s + 0.01, 0.01)

    def close(self) -> None:
        """Holds no resources."""


if __name__ == "__main__":
    devices.CAMERAS = {**devices.CAMERAS, "played": lambda folder, _: PlayedCamera(Path(folder))}
    from visioncal.cli.app import main

    main()
