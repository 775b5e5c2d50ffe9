"""Input of the search, its scored hypotheses, and what makes a cell plausible.

Inverting the robot's poses, inverting the camera's, and changing the mount all exchange the unknown
edges: no residual distinguishes them. Plausibility does: what is mounted on the flange is near it,
and the target is in front of the camera.
"""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.guess.fit import Fit, no_fit, robust_fit
from visioncal.calibration.guess.hypothesis import Hypothesis, SideReading, differences, strangeness
from visioncal.core.conventions import UNITS_M, PoseNumbers
from visioncal.core.types import IntArray, Mount

# With fewer views too many readings agree.
FEWEST_ROWS = 4
# Scores below this [rad, or share of the distance] are equivalent: a tenth of a millimetre at one
# metre.
SCORE_FLOOR = 1e-4
# A right reading closes the chain to this share of the distance, or angle [rad]: poses with 10 mm
# and 1 degree of noise leave less, wrong readings ten times more.
CLOSING_SCORE = 0.05
# Ratio of the declared reading's score to that of a reading that replaces it. Where views turn
# about two axes a sound reading is beaten by none, and a wrong one by ten times and more: the
# worlds `guess` of tests/benchmarks/compare.py.
STANDS_OUT = 3.0
# Plausible distances between camera and board [m].
_BOARD_DISTANCE_M = (0.02, 30.0)
# Edges whose lengths have a smaller ratio may be exchanged.
_CLEAR_RATIO = 1.5


@dataclass(frozen=True, eq=False)
class Recording:
    """Declared poses of robot and camera as they were recorded.

    `is_measured` is whether the camera's poses were measured from images.
    """

    robot: PoseNumbers
    camera: PoseNumbers
    mount: Mount
    is_measured: bool

    @property
    def declared(self) -> Hypothesis:
        """The declared reading."""
        readings = self.robot.reading, self.camera.reading
        robot, camera = (SideReading.as_declared(reading) for reading in readings)
        return Hypothesis(robot, camera, self.mount)

    def changes(self, tried: Hypothesis) -> tuple[str, ...]:
        """Words for each difference between a hypothesis and the declared reading."""
        places, is_board = self.robot.places, self.is_measured
        return tuple(differences(tried, self.declared, places, is_board=is_board))

    def cost(self, tried: Hypothesis) -> float:
        """Number of changes of the declared reading, strange ones weighted more."""
        declared = self.declared
        sides = ((tried.robot, declared.robot), (tried.camera, declared.camera))
        strange = sum(strangeness(a.turns) for a, b in sides if a.turns != b.turns)
        return len(self.changes(tried)) + strange

    def part(self, rows: IntArray) -> "Recording":
        """The recording restricted to some rows."""
        return replace(self, robot=self.robot.rows(rows), camera=self.camera.rows(rows))

    def common_rows(self) -> IntArray:
        """The rows with a pose of both sides."""
        return np.flatnonzero(self.robot.present & self.camera.present)


@dataclass(frozen=True, eq=False)
class Scored:
    """A hypothesis with its fit."""

    hypothesis: Hypothesis  # The reading.
    fit: Fit  # Its fit.
    rows: IntArray  # The camera's rows in the fit.
    # Equivalent readings that close the chain in the same way: the simplest ones; of the declared
    # reading, those with a more plausible cell.
    labels: tuple[Hypothesis, ...] = ()
    cost: float = 0.0  # See `Recording.cost`.
    # An equally plausible label with the other mount; None without one.
    other_mount: Hypothesis | None = None

    @property
    def score(self) -> float:
        """The fit's score, not below `SCORE_FLOOR`."""
        return max(self.fit.score, SCORE_FLOOR)

    @property
    def is_readable(self) -> bool:
        """Whether enough rotations can be read for a fit."""
        return bool(np.isfinite(self.fit.score))


def fitted(recording: Recording, tried: Hypothesis, rows: IntArray, starts: int) -> Scored:
    """Fits both edges under a hypothesis, by the rows that are readable under it."""
    robot, camera = tried.chain(recording.robot, recording.camera)
    rows = rows[np.isfinite(robot[rows]).all(axis=(1, 2))]
    rows = rows[np.isfinite(camera[rows]).all(axis=(1, 2))]
    # A shift leaves a row without its partner.
    if len(rows) < FEWEST_ROWS - 1:
        return Scored(tried, no_fit(len(rows)), rows)
    return Scored(tried, robust_fit(robot[rows], camera[rows], starts), rows)


def closes(recording: Recording) -> bool:
    """Whether the chain closes as declared; true with too few rows to show it."""
    rows = recording.common_rows()
    few = len(rows) < FEWEST_ROWS
    return few or fitted(recording, recording.declared, rows, 0).score <= CLOSING_SCORE


def is_likely_unit(recording: Recording, unit: str) -> bool:
    """Whether this unit of the camera's positions puts the target at a likely distance."""
    distance = np.nanmedian(np.linalg.norm(recording.camera.positions, axis=1))
    low, high = _BOARD_DISTANCE_M
    return bool(low < UNITS_M[unit] * distance < high)


def _is_in_front(recording: Recording, scored: Scored) -> bool:
    """Whether the target is in front of the camera."""
    cam_from_target = scored.hypothesis.camera.poses(recording.camera)
    return bool(np.median(cam_from_target[scored.rows, 2, 3]) > 0.0)


def flange_and_cell_m(scored: Scored) -> tuple[float, float]:
    """Lengths of the unknown edge on the flange and of the one at the base [m]."""
    edges = (scored.fit.x, scored.fit.z)
    on_flange, at_base = edges if scored.hypothesis.mount == "eye-in-hand" else edges[::-1]
    return float(np.linalg.norm(on_flange[:3, 3])), float(np.linalg.norm(at_base[:3, 3]))


def likeness(recording: Recording, scored: Scored) -> tuple[bool, bool]:
    """Sort key by which plausible cells come last."""
    on_flange_m, at_base_m = flange_and_cell_m(scored)
    return _is_in_front(recording, scored), on_flange_m < at_base_m


def is_far_likelier(recording: Recording, scored: Scored, other: Scored) -> bool:
    """Whether a reading gives a plausible cell and another, with edges exchanged, none."""
    in_front, other_in_front = _is_in_front(recording, scored), _is_in_front(recording, other)
    if in_front != other_in_front:
        return in_front
    on_flange_m, at_base_m = flange_and_cell_m(scored)
    other_on_flange_m, other_at_base_m = flange_and_cell_m(other)
    return _CLEAR_RATIO * on_flange_m < at_base_m and other_on_flange_m > other_at_base_m
