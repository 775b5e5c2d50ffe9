"""Sources of a session's image files."""

import os
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, TypeVar

from visioncal.core.errors import DataError
from visioncal.core.files import ABSENT, MOST_IMAGE_BYTES, absence, is_inside, read_bytes, sha256
from visioncal.core.types import Searched

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
MISSING = "is missing"
CLOUD_ENDINGS = (".ply", ".pcd", ".npy")
_Place = TypeVar("_Place")


class ImageStore(ABC):
    """The images of a session, by the paths that views.csv gives them."""

    @abstractmethod
    def read(self, path: str) -> bytes:
        """Reads the bytes of one image file; raises DataError."""

    @abstractmethod
    def absence(self, path: str) -> str:
        """Why an image cannot be read, worded to follow its name; empty where it can."""

    def exists(self, path: str) -> bool:
        """Whether an image can be read."""
        return not self.absence(path)

    def sha256(self, path: str) -> str:
        """Digest of an image file, also of one whose bytes are elsewhere; empty where unknown."""
        return sha256(self.read(path)) if self.exists(path) else ""

    def search_of(self, path: str, board: str) -> Searched | None:
        """Corners of a board in an image that is elsewhere; None where it is to be searched.

        Args:
            path: The image's.
            board: The board's name in the session's `boards`.
        """
        del path, board
        return None

    def shown(self, path: str) -> bytes | None:
        """A faint copy of an image that is elsewhere, as JPEG; None where there is none."""
        del path
        return None


@dataclass(frozen=True)
class FolderImages(ImageStore):
    """Images in a session's folder, or in a folder beside it that one inside links to.

    Other links that lead out of it are not followed: a session may be a stranger's.
    """

    folder: Path
    # Digests by path: images are large, and a result and its recording both need them.
    _digests: dict[str, str] = field(default_factory=dict, compare=False, repr=False)

    def sha256(self, path: str) -> str:
        """Digest of an image file; empty where there is none."""
        if path not in self._digests:
            self._digests[path] = super().sha256(path)
        return self._digests[path]

    def read(self, path: str) -> bytes:
        """Reads the bytes of one image file."""
        why_not = self.absence(path)
        if why_not:
            raise DataError(f"{self.folder / inside_path(path)} {why_not}.", culprits=[path])
        return read_bytes(self.folder / inside_path(path), MOST_IMAGE_BYTES)

    def absence(self, path: str) -> str:
        """Why an image cannot be read, worded to follow its name; empty where it can."""
        file = self.folder / inside_path(path)
        why_not = absence(file)
        if why_not:
            return MISSING if why_not == ABSENT else why_not
        parent = self.folder.resolve().parent
        # Directly below the root, everything would be beside the folder.
        is_beside = parent != parent.parent and is_inside(file.parent, parent)
        if not is_inside(file, file.parent if is_beside else self.folder):
            return (
                "is a link that leads out of the session's folder, and is not followed: copy the "
                "images into the folder, or link to a folder beside the session's"
            )
        if file.stat().st_size > MOST_IMAGE_BYTES:
            return f"has more than {MOST_IMAGE_BYTES / 1e6:.0f} MB, as no image has"
        return "" if os.access(file, os.R_OK) else "cannot be read: permission denied"


@dataclass(frozen=True, eq=False)
class ListedImages(ImageStore, Generic[_Place]):
    """Images whose paths are known, each with the place that it is loaded from."""

    files: Mapping[str, _Place]  # The places, by path.

    def read(self, path: str) -> bytes:
        """Reads the bytes of one image file."""
        if path not in self.files:
            raise DataError(f"The session has no image {path}.", culprits=[path])
        return self.load(self.files[path])

    @abstractmethod
    def load(self, place: _Place) -> bytes:
        """The bytes of the image at a place; raises DataError."""

    def absence(self, path: str) -> str:
        """Why there is no such image; empty where there is one."""
        return "" if path in self.files else MISSING


class MemoryImages(ListedImages[bytes]):
    """Images held in memory."""

    def load(self, place: bytes) -> bytes:
        """The bytes themselves."""
        return place


def image_path(path: str) -> str:
    """Checks the path of an image: inside the session's folder, with a known ending.

    Raises:
        DataError: It leaves the folder, or its ending is none of `IMAGE_ENDINGS`.
    """
    inside = inside_path(path)
    if not inside.lower().endswith(IMAGE_ENDINGS):
        raise DataError(
            f"the image {path!r} is of a kind that is not read: it must be png, jpg, tif, bmp "
            "or webp.",
            culprits=[path],
            next_step="Convert the images without loss, to png.",
        )
    return inside


def depth_path(path: str) -> str:
    """Checks the path of a depth picture or cloud as `image_path` does; raises DataError."""
    inside, endings = inside_path(path), (".png", ".tif", ".tiff", *CLOUD_ENDINGS)
    if not inside.lower().endswith(endings):
        raise DataError(
            f"the depth {path!r} is of a kind that is not read; one of {', '.join(endings)} is "
            "needed.",
            culprits=[path],
            next_step="Save depth as a 16-bit .png, or an organised cloud as .ply (of Zivid's .zdf "
            "by its own program).",
        )
    return inside


def inside_path(path: str) -> str:
    """Checks that a path stays inside the session's folder; returns it with forward slashes.

    Raises:
        DataError: It is absolute, has a drive, or contains `..`.
    """
    slashed = path.replace("\\", "/")
    parts = [part for part in slashed.split("/") if part not in ("", ".")]
    if slashed.startswith("/") or re.match("[A-Za-z]:", slashed) or ".." in parts or not parts:
        raise DataError(
            f"the path {path!r} leaves the session's folder, but must be inside it, and relative "
            "to it.",
            culprits=[path],
            next_step="Copy the file into the session's folder, if it is not there, and write its "
            "path in that, as images/000.png.",
        )
    return "/".join(parts)
