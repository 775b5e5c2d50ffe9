"""Cache of detected corners beside the session.

It can be deleted. Each entry is named by the digests of the image's bytes and of the board, so that
entries of another image or board are not found; a file of another version of visioncal or OpenCV,
or an unreadable one, counts as none.
"""

import json
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import read_text, sha256, write_atomically
from visioncal.core.types import Corners, Rejection, Target
from visioncal.core.version import __version__
from visioncal.session import Session
from visioncal.session.images import FolderImages

FOLDER, FILE = ".visioncal", "corners.json"
_MADE_BY = {"visioncal": __version__, "opencv": cv2.__version__}


@dataclass(frozen=True, eq=False)
class Searched:
    """Result of searching one image.

    Attributes:
        found: The corners, or why there are none.
        size: (width, height) of the image [px]; None where it cannot be read.
        misfit: Whether markers were seen whose layout is not the target's.
    """

    found: Corners | Rejection
    size: tuple[int, int] | None
    misfit: bool = False


@dataclass(frozen=True, eq=False)
class CornerCache:
    """Cached searches by the digests of what was searched.

    Attributes:
        file: The cache; None for a session without a folder.
        grows: Whether new entries are saved.
        entries: The entries of the file.
        new: Entries that were added.
    """

    file: Path | None
    grows: bool
    entries: dict[str, Any]
    new: dict[str, Any] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    @classmethod
    def beside(cls, session: Session, *, grows: bool) -> "CornerCache":
        """Reads a session's cache; empty for one without a folder."""
        if not isinstance(session.images, FolderImages):
            return cls(None, grows, {})
        file = session.images.folder / FOLDER / FILE
        document: Any = None
        if file.exists():
            with suppress(DataError, ValueError):
                document = json.loads(read_text(file))
        is_current = isinstance(document, dict) and document.get("made_by") == _MADE_BY
        entries = document.get("searches") if is_current else None
        return cls(file, grows, entries if isinstance(entries, dict) else {})

    def key(self, image: bytes, target: Target, name: str) -> str:
        """The name of an entry: of an image's bytes and a board."""
        board = json.dumps([asdict(target), name], default=_jsonable, sort_keys=True)
        return f"{sha256(image)}-{sha256(board.encode())}"

    def get(self, key: str, view: int) -> Searched | None:
        """The cached result for a view, by its number; None without one."""
        try:
            return _from_document(self.entries[key], view)
        except (KeyError, TypeError, ValueError):
            return None

    def put(self, key: str, searched: Searched) -> None:
        """Adds a result, from any thread, where new entries are saved."""
        if not self.grows:
            return
        with self._lock:
            self.new[key] = _document(searched)

    def save(self) -> None:
        """Writes the file with the new entries; does nothing where it cannot be written."""
        if self.file is None or not self.new:
            return
        document = {"made_by": _MADE_BY, "searches": {**self.entries, **self.new}}
        with suppress(DataError, OSError):
            self.file.parent.mkdir(exist_ok=True)
            write_atomically(self.file, json.dumps(document))


def _document(searched: Searched) -> dict[str, Any]:
    found, common = searched.found, {"size": searched.size, "misfit": searched.misfit}
    if isinstance(found, Rejection):
        return {**common, "reason": found.reason}
    return {
        **common,
        "ids": found.ids.tolist(),
        "px": found.px.tolist(),
        "blur_px": found.blur_px,
        "weights": None if found.weights is None else found.weights.tolist(),
    }


def _from_document(entry: Any, view: int) -> Searched:  # noqa: ANN401 - as it was read
    width, height = (int(value) for value in entry["size"])
    if "reason" in entry:
        reason = Rejection(view, str(entry["reason"]))
        return Searched(reason, (width, height), bool(entry["misfit"]))
    weights = entry["weights"]
    corners = Corners(
        view,
        np.array(entry["ids"], dtype=np.int64),
        np.array(entry["px"], dtype=np.float64).reshape(-1, 2),
        float(entry["blur_px"]),
        None if weights is None else np.array(weights, dtype=np.float64),
    )
    return Searched(corners, (width, height), bool(entry["misfit"]))


def _jsonable(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else str(value)
