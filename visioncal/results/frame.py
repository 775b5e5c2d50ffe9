"""A tool's or a fixture's frame, and the file of frames that belong to no calibration."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self

from visioncal.core.codec import INLINE, KEPT, read, reading, write
from visioncal.core.documents import parse_stored
from visioncal.core.files import read_bytes, write_json
from visioncal.core.version import __version__
from visioncal.results.edge import StoredEdge
from visioncal.results.parts import StoredVerdict

_SCHEMA = 1


@dataclass(frozen=True)
class Observation:
    """One touch, point or view that a frame was placed by; what is unknown is None.

    Attributes:
        name: Which it is: the row's view number, or the point's name.
        used: Whether the fit used it.
        reason: What is wrong with it, in words; empty where nothing is.
        kind: What was touched, as `point`, `z`, `xz`; empty where it has no kinds.
        residual_mm: How far it is off from the frame [mm].
    """

    name: str
    used: bool
    reason: Annotated[str, KEPT] = ""
    kind: Annotated[str, KEPT] = ""
    residual_mm: float | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """Where a tool sits on the flange, or a fixture in the base.

    Attributes:
        edge: `flange_from_tool` or `base_from_fixture`, by its owner's name for it.
        oriented: Whether the rotation was measured; else it is the parent's own, by declaration,
            and has no covariance.
        method: How it was obtained, in words.
        source: What it was obtained from: a file's or a session's name.
        created: When, in ISO 8601.
        rms_mm: Root mean square of what the used observations are off [mm].
        noise_mm: Estimated standard deviation of one observation, per axis [mm].
        observations: One entry for each touch, point or view.
        verdict: Whether to trust it.
        details: Further figures of the method, as they stand on disk.
    """

    edge: Annotated[StoredEdge, INLINE]
    oriented: bool
    method: str
    source: str
    created: str
    rms_mm: float
    noise_mm: float
    observations: tuple[Observation, ...]
    verdict: StoredVerdict
    details: Annotated[Mapping[str, Any], KEPT] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class FrameFile:
    """Frames that belong to no calibration: of a robot without a camera.

    Attributes:
        frames: The frames by the transform that places them.
    """

    frames: Mapping[str, Frame]

    def save(self, path: Path | str) -> None:
        """Writes the file, whole or not at all."""
        document = {
            "schema": _SCHEMA,
            "visioncal": __version__,
            "frames": frames_document(self.frames),
        }
        write_json(path, document)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Reads such a file.

        Raises:
            DataError: It is missing, or no file of frames of a known schema.
        """
        with reading(str(path), "frames", "Run visioncal tcp or visioncal fixture again."):
            return cls(_read_file(parse_stored(read_bytes(path), str(path))))


def frames_document(frames: Mapping[str, Frame]) -> dict[str, Any]:
    """Writes frames as JSON has them."""
    return write(FrameFile, FrameFile(frames))["frames"]  # type: ignore[no-any-return]


def _read_file(document: Mapping[str, Any]) -> dict[str, Frame]:
    if "transforms" in document:
        raise ValueError("it is a calibration, whose folder is named with -c")
    if document.get("schema") != _SCHEMA:
        raise ValueError(f"schema is {document.get('schema')!r}, this version reads {_SCHEMA}")
    return dict(read(FrameFile, document, "").frames)
