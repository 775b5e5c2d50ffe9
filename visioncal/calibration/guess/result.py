"""What a guess gives: the readings by how well they close the chain, and what to make of it."""

from dataclasses import dataclass

import numpy as np

from visioncal.calibration.guess.given import CLOSING_SCORE
from visioncal.calibration.guess.hypothesis import Hypothesis
from visioncal.core.conventions import UNITS_M
from visioncal.core.number_format import figure

_LONG_MM, _WHOLE_FROM = 1000.0, 99.0


@dataclass(frozen=True, eq=False)
class Candidate:
    """A way to read the poses, and how well it closes the chain.

    Attributes:
        hypothesis: The reading.
        declared: What was declared.
        differences: Words for each thing that is not as declared.
        rms_mm: Scatter of the target's place over the views that agree best [mm].
        rms_deg: The same of its orientation [deg].
        score: The same without unit, by which readings compare.
        agreeing: How many views agree with each other.
        rows: How many views were looked at.
        is_board: Whether the camera's poses were measured from images.
        other_mount: Words for what is different in a reading with the other mount that is as good
            and as likely; none where there is none.
    """

    hypothesis: Hypothesis
    declared: Hypothesis
    differences: tuple[str, ...]
    rms_mm: float
    rms_deg: float
    score: float
    agreeing: int
    rows: int
    is_board: bool = False
    other_mount: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """What is different from what was declared."""
        return "; ".join(self.differences) or "as declared"

    @property
    def changes(self) -> int:
        """How many things are different from what was declared."""
        return len(self.differences)

    @property
    def closes(self) -> bool:
        """Whether the chain closes as well as it does under a right reading."""
        return self.score <= CLOSING_SCORE

    @property
    def is_readable(self) -> bool:
        """Whether rotations can be read of the numbers at all."""
        return bool(np.isfinite(self.rms_mm))

    @property
    def figures(self) -> str:
        """How well the chain closes, in words."""
        if not self.is_readable:
            return "no rotations"
        is_long = self.rms_mm > _LONG_MM
        length = f"{_short(1e-3 * self.rms_mm)} m" if is_long else f"{_short(self.rms_mm)} mm"
        return f"{length} and {_short(self.rms_deg)} deg"

    @property
    def board_scale(self) -> float:
        """What the sizes of the board are to be multiplied with, where images were measured."""
        if not self.is_board:
            return 1.0
        camera = self.hypothesis.camera
        return camera.scale * UNITS_M[camera.unit] / UNITS_M[self.declared.camera.unit]


def _short(value: float) -> str:
    """Two digits; whole numbers from a hundred on."""
    return f"{value:.0f}" if value > _WHOLE_FROM else figure(value)


@dataclass(frozen=True, eq=False)
class Guess:
    """Which reading of the poses is right.

    Attributes:
        declared: The reading that was declared.
        candidates: The readings that come near, the best first, the declared one among them; one
            stands for all that residuals cannot distinguish from it.
        best: The reading that stands out; the declared one where none does.
        stands_out: Whether another reading than the declared one is clearly right.
        sentence: What was found, with its figures.
        notes: What residuals cannot show here, in sentences.
    """

    declared: Candidate
    candidates: tuple[Candidate, ...]
    best: Candidate
    stands_out: bool
    sentence: str
    notes: tuple[str, ...] = ()
