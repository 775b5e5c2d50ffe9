"""Input of the search, its scored hypotheses, and what makes a cell plausible.

Inverting the robot's poses, inverting the camera's, and changing the mount all exchange the unknown
edges: no residual distinguishes them. The robot's joints do, and plausibility: what is mounted on
the flange is near it, and the target is in front of the camera.
"""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.guess.fit import Fit, no_fit, robust_fit
from visioncal.calibration.guess.hypothesis import Hypothesis, SideReading, differences, strangeness
from visioncal.core.conventions import UNITS_M, PoseNumbers
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mount

# With fewer views too many readings agree.
FEWEST_ROWS = 4
# Share of the log-likelihood that counts: the errors of an arm, a lens and a board are common to
# the views, which count as half as many independent ones.
EVIDENCE = 0.5
# Log prior odds against a change of the declared reading, and against a cell that cannot be; and
# the log posterior odds from which one reading is preferred to another.
CHANGE, IMPOSSIBLE, CLEAR = 4.0, 20.0, 3.0
# Log prior odds by the logarithm of the ratio of the edges' lengths, and their bound.
_BY_LENGTH, _MOST_BY_LENGTH = 10.0, 10.0
# A right reading closes the chain to this share of the distance, or angle [rad]: poses with 10 mm
# and 1 degree of noise leave less, wrong readings ten times more.
CLOSING_SCORE = 0.05
# Plausible distances between camera and board [m].
_BOARD_DISTANCE_M = (0.02, 30.0)


@dataclass(frozen=True, eq=False)
class Recording:
    """Declared poses of robot and camera as they were recorded."""

    robot: PoseNumbers
    camera: PoseNumbers
    mount: Mount
    is_measured: bool  # Whether the camera's poses were measured from images.
    chain: FloatArray | None = None  # (n, 4, 4) the robot's poses by its joints; NaN without.

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
        chain = None if self.chain is None else self.chain[rows]
        robot, camera = self.robot.rows(rows), self.camera.rows(rows)
        return replace(self, robot=robot, camera=camera, chain=chain)

    def common_rows(self) -> IntArray:
        """The rows with a pose of both sides."""
        return np.flatnonzero(self.robot.present & self.camera.present)


@dataclass(frozen=True, eq=False)
class Scored:
    """A hypothesis with its fit."""

    hypothesis: Hypothesis  # The reading.
    fit: Fit  # Its fit.
    rows: IntArray  # The camera's rows in the fit.
    log_prior: float = 0.0  # Log prior odds, by the changes that it implies.
    # Equivalent readings that close the chain in the same way: the simplest ones; of the declared
    # reading, those with a more plausible cell.
    labels: tuple[Hypothesis, ...] = ()
    # An equally plausible label with the other mount; None without one.
    other_mount: Hypothesis | None = None

    @property
    def log_posterior(self) -> float:
        """Log posterior of the reading, up to a constant of the views."""
        return EVIDENCE * self.fit.log_likelihood + self.log_prior

    @property
    def log_odds(self) -> float:
        """Log posterior odds of the reading against none."""
        return self.log_posterior - EVIDENCE * self.fit.unexplained

    @property
    def is_readable(self) -> bool:
        """Whether enough rotations can be read for a fit."""
        return bool(np.isfinite(self.fit.score))


def fitted(recording: Recording, tried: Hypothesis, rows: IntArray, starts: int) -> Scored:
    """Fits both edges under a hypothesis, by the rows that are readable under it."""
    robot, camera = tried.chain(recording.robot, recording.camera)
    kept = rows[np.isfinite(robot[rows]).all(axis=(1, 2))]
    kept = kept[np.isfinite(camera[kept]).all(axis=(1, 2))]
    impossible = IMPOSSIBLE * (not is_likely_unit(recording, tried.camera.unit))
    log_prior = -CHANGE * recording.cost(tried) - impossible
    # A shift leaves a row without its partner.
    if len(kept) < FEWEST_ROWS - 1:
        return Scored(tried, no_fit(len(kept)), kept, log_prior)
    fit = replace(robust_fit(robot[kept], camera[kept], starts), lost=len(rows) - len(kept))
    return Scored(tried, fit, kept, log_prior)


def closes(recording: Recording) -> bool:
    """Whether the chain closes as declared; true with too few rows to show it."""
    rows = recording.common_rows()
    few = len(rows) < FEWEST_ROWS
    return few or fitted(recording, recording.declared, rows, 0).fit.score <= CLOSING_SCORE


def is_likely_unit(recording: Recording, unit: str) -> bool:
    """Whether this unit of the camera's positions puts the target at a likely distance."""
    distance = np.nanmedian(np.linalg.norm(recording.camera.positions, axis=1))
    low, high = _BOARD_DISTANCE_M
    return bool(low < UNITS_M[unit] * distance < high)


def flange_and_cell_m(scored: Scored) -> tuple[float, float]:
    """Lengths of the unknown edge on the flange and of the one at the base [m]."""
    edges = (scored.fit.x, scored.fit.z)
    on_flange, at_base = edges if scored.hypothesis.mount == "eye-in-hand" else edges[::-1]
    return float(np.linalg.norm(on_flange[:3, 3])), float(np.linalg.norm(at_base[:3, 3]))


def plausibility(recording: Recording, scored: Scored) -> float:
    """Log odds of the cell that a reading gives, beside readings that close the chain alike."""
    if not scored.is_readable:
        return -np.inf
    cam_from_target = scored.hypothesis.camera.poses(recording.camera)
    in_front = IMPOSSIBLE * bool(np.median(cam_from_target[scored.rows, 2, 3]) > 0.0)
    on_flange_m, at_base_m = np.log(np.maximum(flange_and_cell_m(scored), 1e-6))
    by_length = _BY_LENGTH * (at_base_m - on_flange_m)
    fit = chain_fit(recording, scored.hypothesis)
    by_joints = 0.0 if fit is None else fit.log_likelihood
    return float(in_front + np.clip(by_length, -_MOST_BY_LENGTH, _MOST_BY_LENGTH) + by_joints)


def chain_fit(recording: Recording, hypothesis: Hypothesis) -> Fit | None:
    """Fits the poses of a reading to those of the joints; None with too few of these."""
    if recording.chain is None:
        return None
    poses, chain = hypothesis.robot.poses(recording.robot), recording.chain
    readable = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(chain).all(axis=(1, 2))
    if readable.sum() < FEWEST_ROWS:
        return None
    return robust_fit(invert(poses[readable]), chain[readable])
