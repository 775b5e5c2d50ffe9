"""What the search is given, and how it keeps what it finds."""

from dataclasses import dataclass

import numpy as np

from visioncal.conventions import UNITS_M, PoseNumbers
from visioncal.guess.fit import Fit, no_fit, robust_fit
from visioncal.guess.hypothesis import Hypothesis, Taken, differences, strangeness
from visioncal.types import IntArray, Mount

# Fewer views than these agree with too many readings.
FEWEST_ROWS = 4
# Scores under this [rad, or share of the distance] are as good as each other: a tenth of a
# millimetre at one metre.
FLOOR = 1e-4
# A chain that closes to this share of the distance, or angle [rad], is closed by the right reading:
# poses with 10 mm and 1 degree of noise leave less, wrong readings ten times more.
CLOSES = 0.05
# Cameras look at boards from here [m].
_SEEN_FROM_M = (0.02, 30.0)


@dataclass(frozen=True, eq=False)
class Recording:
    """What the search looks at.

    Attributes:
        robot: The robot's numbers, as declared.
        camera: The camera's.
        mount: The mount, as declared.
        is_measured: Whether the camera's poses were measured from images.
    """

    robot: PoseNumbers
    camera: PoseNumbers
    mount: Mount
    is_measured: bool

    @property
    def declared(self) -> Hypothesis:
        """What was declared."""
        return Hypothesis(
            Taken.as_declared(self.robot.reading),
            Taken.as_declared(self.camera.reading),
            self.mount,
        )

    def changes(self, tried: Hypothesis) -> tuple[str, ...]:
        """Words for each thing in which a hypothesis departs from what was declared."""
        return differences(tried, self.declared, self.robot.places, is_board=self.is_measured)

    def cost(self, tried: Hypothesis) -> float:
        """How unlikely a hypothesis is beside what was declared: its changes, strange ones more."""
        declared = self.declared
        sides = ((tried.robot, declared.robot), (tried.camera, declared.camera))
        strange = sum(strangeness(a.turns) for a, b in sides if a.turns != b.turns)
        return len(self.changes(tried)) + strange

    def common_rows(self) -> IntArray:
        """The rows in which both sides have numbers."""
        sides = (self.robot, self.camera)
        whole = [
            np.isfinite(it.positions).all(axis=1) & np.isfinite(it.rotations).all(axis=1)
            for it in sides
        ]
        return np.flatnonzero(whole[0] & whole[1])


@dataclass(frozen=True, eq=False)
class Scored:
    """A hypothesis with its fit.

    Attributes:
        hypothesis: The reading.
        fit: Its fit.
        rows: The camera's rows in the fit.
        labels: Readings that are as simple and close the chain in the same way.
        cost: How unlikely the reading is beside the declared one.
    """

    hypothesis: Hypothesis
    fit: Fit
    rows: IntArray
    labels: tuple[Hypothesis, ...] = ()
    cost: float = 0.0

    @property
    def score(self) -> float:
        """The fit's score, not under what makes no difference."""
        return max(self.fit.score, FLOOR)


def fitted(recording: Recording, tried: Hypothesis, rows: IntArray, starts: int) -> Scored:
    """Fits a hypothesis in full, by those of the rows that can be read in its way."""
    robot, camera = tried.chain(recording.robot, recording.camera)
    there = np.isfinite(robot[rows]).all(axis=(1, 2)) & np.isfinite(camera[rows]).all(axis=(1, 2))
    rows = rows[there]
    # A shift leaves a row without its partner.
    if len(rows) < FEWEST_ROWS - 1:
        return Scored(tried, no_fit(len(rows)), rows)
    return Scored(tried, robust_fit(robot[rows], camera[rows], starts), rows)


def is_plausible(recording: Recording, tried: Hypothesis) -> bool:
    """Whether the camera sees the target from where cameras can."""
    return is_likely_unit(recording, tried.camera.unit)


def is_likely_unit(recording: Recording, unit: str) -> bool:
    """Whether the target is at a likely distance where the camera's positions have this unit."""
    seen_from = np.nanmedian(np.linalg.norm(recording.camera.positions, axis=1))
    low, high = _SEEN_FROM_M
    return bool(low < UNITS_M[unit] * seen_from < high)
