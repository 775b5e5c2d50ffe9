"""Images that a recording has no more than the digests of, or faint copies to look at."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2

from visioncal.core.choices import ImagesKept
from visioncal.core.errors import DataError
from visioncal.session.images import ImageStore
from visioncal.vision.finders.imaging import decode_image

# Of the full size, so that corners lie over it where they were found: a twentieth of the bytes.
_FAINT_QUALITY = 15


@dataclass(frozen=True, eq=False)
class ImagesElsewhere(ImageStore):
    """Images of a session whose recording was written without them.

    Attributes:
        path: The recording.
        kept: What it has of them: `thumbnail` or `none`.
        digests: SHA-256 of the images' bytes by name.
        pictures: Reads the faint copies, by the names of their images.
    """

    path: Path
    kept: ImagesKept
    digests: Mapping[str, str]
    pictures: Mapping[str, Callable[[], bytes]]

    def read(self, path: str) -> bytes:
        """Refuses: the image is not here.

        Raises:
            DataError: Always.
        """
        raise DataError(
            f"{path} {self.absence(path)}.",
            culprits=[path],
            next_step="Take the session's folder, which has its images.",
        )

    def sha256(self, path: str) -> str:
        """Digest of the bytes of an image; empty where there was none."""
        return self.digests.get(path, "")

    def shown(self, path: str) -> bytes | None:
        """The faint copy of an image; None where there is none."""
        return self.pictures[path]() if path in self.pictures else None

    def absence(self, path: str) -> str:
        """Says why there is no such image to read."""
        if path not in self.digests:
            return "is missing"
        return f"is not in {self.path.name}, which was written with --images {self.kept}"


def faint_picture(image: bytes) -> bytes | None:
    """A JPEG to look at, of the size of an image; None where its bytes are none."""
    pixels = decode_image(image, colour=True)
    if isinstance(pixels, str):
        return None
    return bytes(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _FAINT_QUALITY])[1])
