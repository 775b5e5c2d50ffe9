"""Frame of a tool or fixture, and the file of frames without a calibration."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self

from visioncal.core.codec import INLINE, KEPT, read, reading, write
from visioncal.core.documents.jsons import parse_stored
from visioncal.core.files import read_bytes, write_json
from visioncal.core.version import __version__
from visioncal.results.edge import StoredEdge
from visioncal.results.parts import StoredVerdict

_SCHEMA = 1  # Version of the file's form.


@dataclass(frozen=True)
class Observation:
    """One touch, point or view of a frame's fit."""

    name: str  # The row's view number, or the point's name.
    used: bool  # Whether the fit used it.
    reason: Annotated[str, KEPT] = ""  # Why it is an outlier or in doubt, in words; else empty.
    kind: Annotated[str, KEPT] = ""  # Kind of the touch, as `point`, `z`, `xz`; else empty.
    residual_mm: float | None = None  # Its residual [mm]; None where unknown.


@dataclass(frozen=True, eq=False)
class Frame:
    """Pose of a tool on the flange, or of a fixture in the base."""

    edge: Annotated[StoredEdge, INLINE]  # `flange_from_tool` or `base_from_fixture`.
    # Whether the rotation was measured; else it is declared as the parent's, and has no covariance.
    oriented: bool
    method: str  # Description of the method.
    source: str  # Name of the file or session it was estimated from.
    created: str  # Time of creation, ISO 8601.
    rms_mm: float  # Root mean square residual of the used observations [mm].
    noise_mm: float  # Estimated standard deviation of one observation, per axis [mm].
    observations: tuple[Observation, ...]  # One entry for each touch, point or view.
    verdict: StoredVerdict  # Verdict with its reasons.
    # Further figures of the method.
    details: Annotated[Mapping[str, Any], KEPT] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class FrameFile:
    """File of frames without a calibration, for a robot without a camera."""

    frames: Mapping[str, Frame]  # The frames by transform name.

    def save(self, path: Path | str) -> None:
        """Writes the file atomically."""
        document = {
            "schema": _SCHEMA,
            "visioncal": __version__,
            "frames": frames_document(self.frames),
        }
        write_json(path, document)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Reads a file of frames; raises DataError."""
        with reading(str(path), "frames", "Run visioncal tcp or visioncal fixture again."):
            document = parse_stored(read_bytes(path), str(path))
            if "transforms" in document:
                raise ValueError("it is a calibration, whose folder is named with -c")
            if document.get("schema") != _SCHEMA:
                raise ValueError(
                    f"schema is {document.get('schema')!r}, this version reads {_SCHEMA}"
                )
            return cls(dict(read(FrameFile, document, "").frames))


def frames_document(frames: Mapping[str, Frame]) -> dict[str, Any]:
    """JSON form of frames."""
    return write(FrameFile, FrameFile(frames))["frames"]  # type: ignore[no-any-return]
