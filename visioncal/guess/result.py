"""What a guess gives: the readings by how well they close the chain, and what to make of it."""

from dataclasses import dataclass

from visioncal.conventions import UNITS_M, PoseNumbers, Reading
from visioncal.guess.given import CLOSES
from visioncal.guess.hypothesis import Hypothesis
from visioncal.types import Mount


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
        return self.score <= CLOSES

    @property
    def mount(self) -> Mount:
        """How the camera is mounted under this reading."""
        return self.hypothesis.mount

    @property
    def robot(self) -> Reading | None:
        """The robot's numbers as a reading of them as they stand; None where it takes more."""
        return self.hypothesis.robot.reading

    @property
    def camera(self) -> Reading | None:
        """The same of the camera's numbers."""
        return self.hypothesis.camera.reading

    @property
    def board_scale(self) -> float:
        """What the sizes of the board are to be multiplied with, where images were measured."""
        if not self.is_board:
            return 1.0
        return UNITS_M[self.hypothesis.camera.unit] / UNITS_M[self.declared.camera.unit]

    def robot_numbers(self, robot: PoseNumbers) -> PoseNumbers:
        """Corrects the robot's numbers: their `poses()` are right and in the camera's order."""
        return self.hypothesis.robot_numbers(robot)

    def camera_numbers(self, camera: PoseNumbers) -> PoseNumbers:
        """Corrects the camera's numbers; for images, scale the board instead."""
        return self.hypothesis.camera_numbers(camera)


@dataclass(frozen=True, eq=False)
class Guess:
    """Which reading of the poses is right.

    Attributes:
        declared: The reading that was declared.
        candidates: The readings that come near, the best first, the declared one among them; one
            stands for all that residuals cannot tell from it.
        best: The reading that stands out; the declared one where none does.
        stands_out: Whether another reading than the declared one is clearly right.
        sentence: What was found, with its figures.
        notes: What residuals cannot tell here, in sentences.
    """

    declared: Candidate
    candidates: tuple[Candidate, ...]
    best: Candidate
    stands_out: bool
    sentence: str
    notes: tuple[str, ...] = ()
