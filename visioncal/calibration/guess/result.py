"""Result of a guess: the candidate readings, ranked, and the one that stands out."""

from dataclasses import dataclass

import numpy as np

from visioncal.calibration.guess.hypothesis import Hypothesis
from visioncal.calibration.guess.recording import CLOSING_SCORE
from visioncal.core.conventions import UNITS_M
from visioncal.core.number_format import figure

_LONG_MM, _WHOLE_FROM = 1000.0, 99.0


@dataclass(frozen=True, eq=False)
class Candidate:
    """A reading of the poses, and how well it closes the chain."""

    hypothesis: Hypothesis  # The reading.
    declared: Hypothesis  # The declared reading.
    differences: tuple[str, ...]  # Words for each difference from the declared reading.
    rms_mm: float  # Scatter of the target's position over the kept views [mm].
    rms_deg: float  # Scatter of its orientation [deg].
    score: float  # Both in one figure without unit.
    log_posterior: float  # By which readings are compared.
    agreeing: int  # Number of views that agree with each other.
    rows: int  # Number of views in the fit.
    is_board: bool = False  # Whether the camera's poses were measured from images.
    # Differences of an equally good and likely reading with the other mount; empty without one.
    other_mount: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The differences from the declared reading, in words."""
        return "; ".join(self.differences) or "as declared"

    @property
    def changes(self) -> int:
        """Number of differences from the declared reading."""
        return len(self.differences)

    @property
    def closes(self) -> bool:
        """Whether the chain closes as well as under a right reading."""
        return self.score <= CLOSING_SCORE

    @property
    def is_readable(self) -> bool:
        """Whether the numbers can be read as rotations at all."""
        return bool(np.isfinite(self.rms_mm))

    @property
    def figures(self) -> str:
        """The closing error, in words."""
        if not self.is_readable:
            return "no rotations"
        is_long = self.rms_mm > _LONG_MM
        length = f"{_short(1e-3 * self.rms_mm)} m" if is_long else f"{_short(self.rms_mm)} mm"
        return f"{length} and {_short(self.rms_deg)} deg"

    @property
    def board_scale(self) -> float:
        """Factor for the board's sizes, where images were measured; else 1."""
        if not self.is_board:
            return 1.0
        camera = self.hypothesis.camera
        return camera.scale * UNITS_M[camera.unit] / UNITS_M[self.declared.camera.unit]


def _short(value: float) -> str:
    """Formats two digits; whole numbers from a hundred on."""
    return f"{value:.0f}" if value > _WHOLE_FROM else figure(value)


@dataclass(frozen=True, eq=False)
class Guess:
    """The reading of the poses that is right, and its rivals."""

    declared: Candidate  # The declared reading.
    # The best readings, best first, with the declared one; each represents all readings that
    # residuals cannot distinguish from it.
    candidates: tuple[Candidate, ...]
    best: Candidate  # The reading that stands out; the declared one where none does.
    stands_out: bool  # Whether another reading than the declared one is clearly right.
    sentence: str  # The finding, with its figures.
    notes: tuple[str, ...] = ()  # What residuals cannot show here, in sentences.
