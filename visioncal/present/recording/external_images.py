"""Images of a recording that stores what was found in them, and faint copies to look at."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from visioncal.core.choices import ImagesKept
from visioncal.core.errors import DataError
from visioncal.core.types import Searched
from visioncal.session.images import ImageStore


@dataclass(frozen=True, eq=False)
class ExternalImages(ImageStore):
    """Images of a session whose recording was written without them."""

    path: Path  # The recording.
    kept: ImagesKept  # What the recording stores of them: `thumbnail` or `none`.
    digests: Mapping[str, str]  # SHA-256 of the images' bytes, by name.
    pictures: Mapping[str, Callable[[], bytes]]  # Readers of the faint copies, by image name.
    # What was found in each image, by its name and that of the board in the session's `boards`.
    searches: Mapping[tuple[str, str], Searched]

    def read(self, path: str) -> bytes:
        """Raises an error: the image is not in the recording.

        Raises:
            DataError: Always.
        """
        raise DataError(
            f"{path} {self.absence(path)}.",
            culprits=[path],
            next_step="Take the session's folder, which has its images; calibrate --images full "
            "writes recordings with all of them.",
        )

    def sha256(self, path: str) -> str:
        """Digest of an image's bytes; empty without an image."""
        return self.digests.get(path, "")

    def shown(self, path: str) -> bytes | None:
        """A faint copy of an image; None if there is none."""
        return self.pictures[path]() if path in self.pictures else None

    def search_of(self, path: str, board: str) -> Searched | None:
        """What was found of a board in an image; None where it was not searched."""
        return self.searches.get((path, board))

    def absence(self, path: str) -> str:
        """Why the image cannot be read, in words."""
        if path not in self.digests:
            return "is missing"
        return f"is not in {self.path.name}, which was written with --images {self.kept}"
