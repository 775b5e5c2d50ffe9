"""Images of a recording that stores only their digests, or low-quality copies for display."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2

from visioncal.core.choices import ImagesKept
from visioncal.core.errors import DataError
from visioncal.session.images import ImageStore
from visioncal.vision.finders.imaging import decode_image

# At full size, so that overlaid corners fit: a twentieth of the bytes.
_FAINT_QUALITY = 15


@dataclass(frozen=True, eq=False)
class ExternalImages(ImageStore):
    """Images of a session whose recording was written without them."""

    path: Path  # The recording.
    kept: ImagesKept  # What the recording stores of them: `thumbnail` or `none`.
    digests: Mapping[str, str]  # SHA-256 of the images' bytes, by name.
    pictures: Mapping[str, Callable[[], bytes]]  # Readers of the low-quality copies, by image name.

    def read(self, path: str) -> bytes:
        """Raises an error: the image is not in the recording.

        Raises:
            DataError: Always.
        """
        raise DataError(
            f"{path} {self.absence(path)}.",
            culprits=[path],
            next_step="Take the session's folder, which has its images.",
        )

    def sha256(self, path: str) -> str:
        """Digest of an image's bytes; empty without an image."""
        return self.digests.get(path, "")

    def shown(self, path: str) -> bytes | None:
        """Low-quality copy of an image; None if there is none."""
        return self.pictures[path]() if path in self.pictures else None

    def absence(self, path: str) -> str:
        """Why the image cannot be read, in words."""
        if path not in self.digests:
            return "is missing"
        return f"is not in {self.path.name}, which was written with --images {self.kept}"


def low_quality_jpeg(image: bytes) -> bytes | None:
    """Low-quality JPEG at an image's size; None if the bytes are no image."""
    pixels = decode_image(image, colour=True)
    if isinstance(pixels, str):
        return None
    return bytes(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _FAINT_QUALITY])[1])
