"""Search of the table of readings: at most two mistakes at once, all fitted together.

The angle of a relative motion between two views is the same for robot and camera, whatever the
unknown edges are (Chen 1991, "A screw motion approach to uniqueness analysis of head-eye
geometry"). So forms of rotations and orders of rows are screened without solving for anything. The
angle is also the same for a pose and its inverse: inverses, and all that concerns positions, are
distinguished by the fits.
"""

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import combinations

import numpy as np

from visioncal.calibration.guess.fit import STARTS, Fit, no_fit, robust_fits
from visioncal.calibration.guess.readings import (
    ROW_ORDERS,
    Change,
    Hypothesis,
    SideReading,
    Turns,
    changes,
)
from visioncal.core.conventions import UNITS_M, PoseNumbers
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mount

# With fewer views too many readings agree; more than the second add time and no certainty.
FEWEST_ROWS, _FITTED_ROWS = 4, 30
# Share of the log-likelihood that counts: the errors of an arm, a lens and a board are common to
# the views, which count as half as many independent ones.
EVIDENCE = 0.5
# Log prior odds against a change of the declared reading, and against a cell that cannot be.
_CHANGE, IMPOSSIBLE = 4.0, 20.0
# Plausible distances between camera and board [m].
_BOARD_DISTANCE_M = (0.02, 30.0)
# A stage hands on what is within this ratio of its best score, plus half a degree, which noisy
# poses of few views add to any bound; and at most so many.
_RATIO, _SLACK_RAD, _TURNED, _WITH_OTHERS, _REFINED = 3.0, 5e-3, 100, 16, 12
# Relative penalty of a score per mistake; rewritten angles are tried where no reading is sure.
_PENALTY, _FLOOR, _SURE = 0.3, 1e-4, 0.01
# Quantile of the pairs' mismatch: with a quarter of the views wrong, 56 % of pairs are right.
_PAIRS_SHARE = 0.35


@dataclass(frozen=True, eq=False)
class Recording:
    """Declared poses of robot and camera as they were recorded."""

    robot: PoseNumbers
    camera: PoseNumbers
    mount: Mount
    is_measured: bool  # Whether the camera's poses were measured from images.
    chain: FloatArray | None = None  # (n, 4, 4) the robot's poses by its joints; NaN without.

    @cached_property
    def declared(self) -> Hypothesis:
        """The declared reading."""
        robot, camera = (
            SideReading(Turns(side.reading.rotation), side.reading.unit, side.reading.inverse)
            for side in (self.robot, self.camera)
        )
        return Hypothesis(robot, camera, self.mount)

    @cached_property
    def common_rows(self) -> IntArray:
        """The rows with a pose of both sides."""
        return np.flatnonzero(self.robot.present & self.camera.present)

    def is_likely(self, tried: Hypothesis) -> bool:
        """Whether the unit of the camera's positions puts the target at a likely distance."""
        low, high = _BOARD_DISTANCE_M
        return bool(low < UNITS_M[tried.camera.unit] * self._distance < high)

    @cached_property
    def _distance(self) -> float:
        return float(np.nanmedian(np.linalg.norm(self.camera.positions, axis=1)))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A reading of the poses, and how well it closes the chain."""

    hypothesis: Hypothesis  # The reading.
    recording: Recording  # The poses as declared.
    fit: Fit  # Both edges, and the residuals.
    of_rows: IntArray  # The camera's rows in the fit.
    # All readings that close the chain in the same way.
    labels: tuple[Hypothesis, ...] = field(default=(), repr=False)

    @property
    def declared(self) -> Hypothesis:
        """The declared reading."""
        return self.recording.declared

    @property
    def differences(self) -> tuple[str, ...]:
        """Words for each difference from the declared reading."""
        return self.hypothesis.changes

    @property
    def words(self) -> str:
        """The differences from the declared reading, in words."""
        return "; ".join(self.differences) or "as declared"

    @property
    def rows(self) -> int:
        """Number of views in the fit."""
        return len(self.of_rows)

    @property
    def log_prior(self) -> float:
        """Log prior odds, by the changes that it implies."""
        impossible = IMPOSSIBLE * (not self.recording.is_likely(self.hypothesis))
        return -_CHANGE * self.hypothesis.cost - impossible

    @property
    def log_posterior(self) -> float:
        """Log posterior of the reading, up to a constant of the views."""
        return EVIDENCE * self.fit.log_likelihood + self.log_prior

    @property
    def log_odds(self) -> float:
        """Log posterior odds of the reading against none."""
        return self.log_posterior - EVIDENCE * self.fit.unexplained

    @property
    def board_scale(self) -> float:
        """Factor for the board's sizes, where images were measured; else 1."""
        units = (side.camera.unit for side in (self.hypothesis, self.declared))
        unit_m, declared_m = (UNITS_M[unit] for unit in units)
        return unit_m / declared_m if self.recording.is_measured else 1.0


def chains(
    recording: Recording, tried: Sequence[Hypothesis], rows: IntArray
) -> tuple[FloatArray, FloatArray]:
    """(k, m, 4, 4) the robot's part of the chain and `cam_from_target` at rows; NaN without."""
    of_robot = np.array([reading.rows(len(recording.robot))[rows] for reading in tried])
    looked, at = np.unique(of_robot, return_inverse=True)
    robot, camera = recording.robot.rows(np.maximum(looked, 0)), recording.camera.rows(rows)
    by_robot = {side: side.poses(robot) for side in {reading.robot for reading in tried}}
    by_camera = {side: side.poses(camera) for side in {reading.camera for reading in tried}}
    poses = np.empty((len(tried), len(rows), 4, 4))
    for part, reading, index in zip(poses, tried, at.reshape(of_robot.shape), strict=True):
        part[:] = by_robot[reading.robot][index]
    outside = np.array([reading.mount == "eye-to-hand" for reading in tried])
    poses[outside] = invert(poses[outside])
    poses[of_robot < 0] = np.nan
    return poses, np.array([by_camera[reading.camera] for reading in tried])


def fitted(
    recording: Recording, tried: Iterable[Hypothesis], rows: IntArray, starts: int
) -> list[Candidate]:
    """Fits both edges under each of some readings, by the rows that are readable under it."""
    tried = [*tried]
    if not tried:
        return []
    robot, camera = chains(recording, tried, rows)
    readable = np.isfinite(robot).all(axis=(2, 3)) & np.isfinite(camera).all(axis=(2, 3))
    masks, groups = np.unique(readable, axis=0, return_inverse=True)
    found: dict[int, Candidate] = {}
    for group, mask in enumerate(masks):
        members, count = np.flatnonzero(groups.ravel() == group), int(mask.sum())
        # A shift leaves a row without its partner.
        if count < FEWEST_ROWS - 1:
            fits = [no_fit(count)] * len(members)
        else:
            part = np.ix_(members, np.flatnonzero(mask))
            fits = robust_fits(robot[part], camera[part], starts)
        for member, fit in zip(members.tolist(), fits, strict=True):
            of_all = replace(fit, lost=len(rows) - count)
            found[member] = Candidate(tried[member], recording, of_all, rows[mask])
    return [found[at] for at in range(len(tried))]


def closes(recording: Recording) -> bool:
    """Whether the chain closes as declared; true with too few rows to show it."""
    rows = recording.common_rows
    return len(rows) < FEWEST_ROWS or fitted(recording, [recording.declared], rows, 0)[0].fit.closes


def thinned(rows: IntArray, most: int = _FITTED_ROWS) -> IntArray:
    """At most `most` rows, evenly spread."""
    spread = np.linspace(0, len(rows) - 1, most).round().astype(int)
    return rows if len(rows) <= most else np.asarray(rows[spread])


def search(recording: Recording) -> list[Candidate]:
    """Finds the readings that close the chain best.

    Returns:
        The declared reading first; then others, one for each class of readings that residuals
        cannot distinguish.
    """
    rows, declared = thinned(recording.common_rows), recording.declared
    for rewritten in (None, recording.robot.rows(rows)):
        classes: dict[Hashable, tuple[Hypothesis, ...]] = {}
        readings = _readings(recording, rows, rewritten)
        for reading in sorted(readings, key=lambda reading: reading.cost):
            key = reading.chain_class, recording.is_likely(reading)
            classes[key] = (*classes.get(key, ()), reading)
        labels = {of_class[0]: of_class for of_class in classes.values()}
        screened = fitted(recording, labels, rows, 0)
        least = min(item.fit.score for item in screened)
        if least < _SURE:
            break
    limit = _RATIO * least + _SLACK_RAD
    near = [item for item in screened if item.fit.score <= limit and item.hypothesis != declared]
    near.sort(key=lambda item: (item.fit.score + _FLOOR) * (1.0 + _PENALTY * item.hypothesis.cost))
    refined = [declared, *(item.hypothesis for item in near[:_REFINED])]
    return [
        replace(item, labels=labels.get(item.hypothesis, ()))
        for item in fitted(recording, refined, rows, STARTS)
    ]


def _readings(
    recording: Recording, rows: IntArray, rewritten: PoseNumbers | None
) -> Iterator[Hypothesis]:
    """The declared reading, and those with one or two mistakes that turn as the camera does."""
    declared, is_measured = recording.declared, recording.is_measured
    mismatch = _mismatch(recording, rows)
    table = [*changes(declared, is_measured=is_measured, rewritten=rewritten)]
    of_rotations = [change for change in table if change.is_of_rotations]
    others = [change for change in table if not change.is_of_rotations]
    # Rewritten angles are strange enough.
    plain = [change for change in of_rotations if not change.is_rewritten]
    turned: dict[tuple[Change, ...], Hypothesis] = {(): declared}
    turned |= {(change,): change.of(declared) for change in of_rotations}
    turned.update(_pairs(declared, plain))
    away = {made: mismatch(reading) for made, reading in turned.items()}
    limit = _RATIO * min(away.values()) + _SLACK_RAD
    near = [made for made in turned if made and away[made] <= limit]
    near.sort(key=lambda made: (away[made] + _FLOOR) * (1.0 + _PENALTY * turned[made].cost))
    for rank, made in enumerate(((), *near[:_TURNED])):
        reading = turned[made]
        yield reading
        if len(made) < 2 and rank <= _WITH_OTHERS:
            with_made = (other for other in others if all(item.goes_with(other) for item in made))
            yield from (other.of(reading) for other in with_made)
    yield from (reading for _, reading in _pairs(declared, others))


def _pairs(
    declared: Hypothesis, table: Sequence[Change]
) -> Iterator[tuple[tuple[Change, Change], Hypothesis]]:
    for first, second in combinations(table, 2):
        if first.goes_with(second):
            yield (first, second), second.of(first.of(declared))


def _mismatch(recording: Recording, rows: IntArray) -> Callable[[Hypothesis], float]:
    """Low quantile of the differences [rad] by which robot and camera turn under a reading."""
    of_camera = recording.camera.rows(rows)

    @cache
    def by_robot(turns: Turns, order: str) -> FloatArray:
        at = ROW_ORDERS[order](len(recording.robot))[rows]
        rotations = turns.rotations(recording.robot.rows(np.maximum(at, 0)))
        rotations[at < 0] = np.nan
        return _relative_angles(rotations)

    @cache
    def by_camera(turns: Turns) -> FloatArray:
        return _relative_angles(turns.rotations(of_camera))

    def mismatch(reading: Hypothesis) -> float:
        robot = by_robot(reading.robot.turns, reading.order)
        difference = np.nan_to_num(np.abs(robot - by_camera(reading.camera.turns)), nan=np.inf)
        rank = int(_PAIRS_SHARE * len(difference))
        return float(np.partition(difference, rank)[rank])

    return mismatch


def _relative_angles(rotations: FloatArray) -> FloatArray:
    """(p,) angles [rad] of the relative rotations of all pairs of views."""
    flat = rotations.reshape(-1, 9)
    traces = (flat @ flat.T)[np.triu_indices(len(flat), 1)]
    return np.asarray(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))
