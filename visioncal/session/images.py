"""Where the bytes of a session's images come from."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from visioncal.errors import DataError
from visioncal.files import read_bytes

_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff")


class ImageStore(Protocol):
    """The images of a session, by the paths that views.csv gives them."""

    def read(self, path: str) -> bytes:
        """Reads the bytes of one image file.

        Raises:
            DataError: There is no such image, or it cannot be read.
        """

    def exists(self, path: str) -> bool:
        """Tells whether there is such an image."""


@dataclass(frozen=True)
class FolderImages:
    """Images below a session's folder."""

    folder: Path

    def read(self, path: str) -> bytes:
        """Reads the bytes of one image file."""
        return read_bytes(self.folder / inside_path(path))

    def exists(self, path: str) -> bool:
        """Tells whether there is such an image."""
        return (self.folder / inside_path(path)).is_file()


@dataclass(frozen=True, eq=False)
class MemoryImages:
    """Images held in memory."""

    files: Mapping[str, bytes]

    def read(self, path: str) -> bytes:
        """Reads the bytes of one image file."""
        if path not in self.files:
            raise DataError(f"The session has no image {path}.", culprits=[path])
        return self.files[path]

    def exists(self, path: str) -> bool:
        """Tells whether there is such an image."""
        return path in self.files


def image_path(path: str) -> str:
    """Checks the path of an image: inside the session's folder, and of a kind that is read.

    Raises:
        DataError: It leaves the folder, or its ending is none of `.png`, `.jpg`, `.tif`.
    """
    inside = inside_path(path)
    if not inside.lower().endswith(_ENDINGS):
        raise DataError(
            f"the image {path!r} is of a kind that is not read; png, jpg or tif is needed.",
            culprits=[path],
            next_step="Convert the images without loss, to png.",
        )
    return inside


def inside_path(path: str) -> str:
    """Checks that a path stays inside the session's folder, and writes it with forward slashes.

    Raises:
        DataError: It is absolute, has a drive, or climbs out with `..`.
    """
    slashed = path.replace("\\", "/")
    parts = [part for part in slashed.split("/") if part not in ("", ".")]
    if slashed.startswith("/") or re.match("[A-Za-z]:", slashed) or ".." in parts or not parts:
        raise DataError(
            f"the path {path!r} leaves the session's folder; a path inside it, relative to it, "
            "is needed.",
            culprits=[path],
            next_step="Copy the file into the session's folder.",
        )
    return "/".join(parts)
