"""What the search is given, how it keeps what it finds, and which of it is a cell as cells are.

The inverse of the robot's poses, that of the camera's, and another mount exchange the unknown
edges: no residual distinguishes them, but what sits on the flange is near it, and a camera looks at
what is before it.
"""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.guess.fit import Fit, no_fit, robust_fit
from visioncal.calibration.guess.hypothesis import Hypothesis, SideReading, differences, strangeness
from visioncal.core.conventions import UNITS_M, PoseNumbers
from visioncal.core.types import IntArray, Mount

# Fewer views than these agree with too many readings.
FEWEST_ROWS = 4
# Scores under this [rad, or share of the distance] are as good as each other: a tenth of a
# millimetre at one metre.
SCORE_FLOOR = 1e-4
# A chain that closes to this share of the distance, or angle [rad], is closed by the right reading:
# poses with 10 mm and 1 degree of noise leave less, wrong readings ten times more.
CLOSING_SCORE = 0.05
# How many times better than the declared reading another has to close the chain. Where views turn
# about two axes a sound reading is beaten by none, and a wrong one by ten times and more: see
# tests/benchmarks/guess.py.
STANDS_OUT = 3.0
# Cameras look at boards from here [m].
_SEEN_FROM_M = (0.02, 30.0)
# Of edges whose lengths differ by less either may be the one on the flange.
_CLEARLY = 1.5


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
            SideReading.as_declared(self.robot.reading),
            SideReading.as_declared(self.camera.reading),
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

    def part(self, rows: IntArray) -> "Recording":
        """The same of some rows alone."""
        return replace(self, robot=self.robot.rows(rows), camera=self.camera.rows(rows))

    def common_rows(self) -> IntArray:
        """The rows in which both sides have numbers."""
        return np.flatnonzero(self.robot.there & self.camera.there)


@dataclass(frozen=True, eq=False)
class Scored:
    """A hypothesis with its fit.

    Attributes:
        hypothesis: The reading.
        fit: Its fit.
        rows: The camera's rows in the fit.
        labels: Readings that close the chain in the same way: all that are as simple; of the
            declared reading those under which the cell is likelier.
        cost: How unlikely the reading is beside the declared one.
        other_mount: Of the labels, one with the other mount that is as likely; None where there is
            none.
    """

    hypothesis: Hypothesis
    fit: Fit
    rows: IntArray
    labels: tuple[Hypothesis, ...] = ()
    cost: float = 0.0
    other_mount: Hypothesis | None = None

    @property
    def score(self) -> float:
        """The fit's score, not under what makes no difference."""
        return max(self.fit.score, SCORE_FLOOR)

    @property
    def is_readable(self) -> bool:
        """Whether enough rotations can be read for a fit."""
        return bool(np.isfinite(self.fit.score))


def fitted(recording: Recording, tried: Hypothesis, rows: IntArray, starts: int) -> Scored:
    """Fits a hypothesis in full, by those of the rows that can be read in its way."""
    robot, camera = tried.chain(recording.robot, recording.camera)
    there = np.isfinite(robot[rows]).all(axis=(1, 2)) & np.isfinite(camera[rows]).all(axis=(1, 2))
    rows = rows[there]
    # A shift leaves a row without its partner.
    if len(rows) < FEWEST_ROWS - 1:
        return Scored(tried, no_fit(len(rows)), rows)
    return Scored(tried, robust_fit(robot[rows], camera[rows], starts), rows)


def closes(recording: Recording) -> bool:
    """Whether the chain closes as declared; also where too few rows could show it."""
    rows = recording.common_rows()
    if len(rows) < FEWEST_ROWS:
        return True
    return fitted(recording, recording.declared, rows, 0).score <= CLOSING_SCORE


def is_likely_unit(recording: Recording, unit: str) -> bool:
    """Whether the target is at a likely distance where the camera's positions have this unit."""
    seen_from = np.nanmedian(np.linalg.norm(recording.camera.positions, axis=1))
    low, high = _SEEN_FROM_M
    return bool(low < UNITS_M[unit] * seen_from < high)


def _is_before(recording: Recording, scored: Scored) -> bool:
    """Whether the target is before the camera."""
    camera = scored.hypothesis.camera.poses(recording.camera)
    return bool(np.median(camera[scored.rows, 2, 3]) > 0.0)


def flange_and_cell_m(scored: Scored) -> tuple[float, float]:
    """Lengths of the unknown edge on the flange and of the one at the base [m]."""
    edges = (scored.fit.x, scored.fit.z)
    on_flange, at_base = edges if scored.hypothesis.mount == "eye-in-hand" else edges[::-1]
    return float(np.linalg.norm(on_flange[:3, 3])), float(np.linalg.norm(at_base[:3, 3]))


def likeness(recording: Recording, scored: Scored) -> tuple[bool, bool]:
    """A key by which likely cells come last."""
    on_flange_m, at_base_m = flange_and_cell_m(scored)
    return _is_before(recording, scored), on_flange_m < at_base_m


def is_far_likelier(recording: Recording, scored: Scored, other: Scored) -> bool:
    """Whether a reading is that of a cell and another, with its edges exchanged, is not."""
    before, other_before = _is_before(recording, scored), _is_before(recording, other)
    if before != other_before:
        return before
    on_flange_m, at_base_m = flange_and_cell_m(scored)
    other_on_flange_m, other_at_base_m = flange_and_cell_m(other)
    return _CLEARLY * on_flange_m < at_base_m and other_on_flange_m > other_at_base_m
