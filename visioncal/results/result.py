"""Result of a calibration: its selection, its file, its places."""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.arguments import typed
from visioncal.core.codec import reading
from visioncal.core.documents.jsons import parse_stored
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes, write_atomically
from visioncal.core.number_format import figure
from visioncal.core.summaries import html_card, text_card
from visioncal.core.types import FloatArray
from visioncal.results.content import CalibrationContent
from visioncal.results.document import fields_from_document, to_document
from visioncal.results.selecting import selected
from visioncal.session.selecting import PARTS, Choice, Part

if TYPE_CHECKING:
    from visioncal.frames.located import Located


@dataclass(frozen=True, eq=False)
class Calibration(CalibrationContent):
    """Result of calibrating one session; `save` writes it as calibration.json.

    One camera, one robot and their targets have no names; those of a whole cell are in `cell`.

    It also has all attributes of `CalibrationContent`, `CalibrationSections` and `ArmSections`.
    """

    @typed
    def of(
        self, camera: str | None = None, robot: str | None = None, target: str | None = None
    ) -> Self:
        """Selects one camera, one robot and one target of a whole cell.

        Both transforms are composed along the cell's frames, with covariance. A calibration of one
        camera and robot is returned as it is.

        Args:
            camera: Name of the camera or its frame; optional where unambiguous.
            robot: Name of the robot between camera and target; optional where unambiguous.
            target: Name of the target; optional where unambiguous.

        Raises:
            DataError: There is none of that name, the choice is ambiguous, or this robot is not
                between camera and target.
        """
        return self.chosen(Choice(camera, robot, target))

    def chosen(self, choice: Choice, needs: Collection[Part] = PARTS) -> Self:
        """Selects as `of`, where only some of the three must be unambiguous.

        Args:
            choice: Names of the parts.
            needs: Parts that must be unambiguous; for the others, any that fits is taken, or none.

        Raises:
            DataError: See `of`.
        """
        return selected(self, choice, needs)

    def __repr__(self) -> str:
        title = f"Calibration of {self.session_name!r}: {self.verdict.status}"
        return text_card(title, self._facts)

    def _repr_html_(self) -> str:
        steps = (f"Next: {step}" for step in self.verdict.next_steps[:1])
        says = (*self.verdict.top, *self.unstated_conditions, *steps)
        title = f"Calibration of {self.session_name}"
        return html_card(title, self._facts, self.verdict.status, says)

    @property
    def _facts(self) -> dict[str, str]:
        used = sum(view.used for view in self.views)
        left_out = self.validation.held_out
        turned = "" if left_out.deg is None else f", {figure(left_out.deg)} deg"
        return {
            "views used": f"{used} of {len(self.views)}",
            "views not used in the fit agree to": f"{figure(left_out.mm)} mm{turned}",
            **{
                name: f"{edge.place_words()}, {self.rotation_words(name, edge)}, "
                f"{self.verdict.accuracy(edge.sigma_words)}"
                for name, edge in [*self.placed.items()][:8]
            },
        }

    def locate(
        self,
        pixel: FloatArray | Sequence[float],
        depth_m: float,
        base_from_flange: FloatArray | RigidTransform | None = None,
    ) -> "Located":
        """Position in the base of a pixel at a measured depth; see `frames.locate_by_depth`.

        Args:
            pixel: (2,) in the image [px].
            depth_m: Its distance as the sensor measured it [m].
            base_from_flange: The flange's pose at the image; only for a camera on the flange.

        Raises:
            DataError: See `locate_by_depth`.
        """
        # Imported here, since picks depend on results.
        from visioncal.frames.locate import locate_by_depth

        px = np.asarray(pixel, dtype=float)[None]
        return locate_by_depth(self, px, np.array([depth_m]), base_from_flange)[0]

    @typed
    def save(self, path: Path | str) -> None:
        """Writes calibration.json atomically."""
        write_atomically(Path(path), self.text + "\n")

    @cached_property
    def text(self) -> str:
        """Content of calibration.json, which recordings also contain."""
        return json.dumps(to_document(self), indent=2, allow_nan=False)

    @classmethod
    @typed
    def load(cls, path: Path | str) -> Self:
        """Reads a calibration.json, or the one in a folder.

        Raises:
            DataError: The file is missing or is not a calibration of a known schema.
        """
        file = Path(path)
        if file.is_dir():
            file = file / "calibration.json"
        if file.suffix.lower() == ".rrd":
            raise DataError(
                f"{path} is a recording, but must be a calibration.json or the folder with one.",
                culprits=[str(path)],
                next_step="Name the output folder of visioncal calibrate. Of a recording alone, "
                "visioncal.present.recording.read_calibration reads the result.",
            )
        return cls.from_json(read_bytes(file), str(file))

    @classmethod
    def from_json(cls, text: bytes | str, label: str) -> Self:
        """Reads the content of a calibration.json.

        Args:
            text: The content.
            label: Name of its source, for messages.

        Raises:
            DataError: It is not a calibration of a known schema.
        """
        with reading(label, "a calibration", "Calibrate the session again."):
            return cls(**fields_from_document(parse_stored(text, label)))
