"""Search of the table of readings: at most two mistakes at once, all fitted together.

The angle of a relative motion between two views is the same for robot and camera, whatever the
unknown edges are (Chen 1991, "A screw motion approach to uniqueness analysis of head-eye
geometry"). So forms of rotations and orders of rows are screened without solving for anything. The
angle is also the same for a pose and its inverse: inverses, and all that concerns positions, are
distinguished by the fits.
"""

from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from visioncal.calibration.guess.fit import STARTS, Fit, no_fit, robust_fits
from visioncal.calibration.guess.readings import (
    Change,
    Hypothesis,
    SideReading,
    changes,
    of_another_size,
)
from visioncal.core.conventions import UNITS_M, PoseNumbers
from visioncal.core.number_format import figure
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray, IntArray, Mount

# With fewer views too many readings agree; more than the second add time and no certainty.
FEWEST_ROWS, _FITTED_ROWS = 4, 30
# Share of the log-likelihood that counts: the errors of an arm, a lens and a board are common to
# the views, which count as half as many independent ones.
EVIDENCE = 0.5
# Log prior odds against a change of the declared reading, and against a cell that cannot be.
_CHANGE, IMPOSSIBLE = 4.0, 20.0
# A right reading closes the chain to this share of the distance, or angle [rad]: poses with 10 mm
# and 1 degree of noise leave less, wrong readings ten times more.
CLOSING_SCORE = 0.05
# Plausible distances between camera and board [m].
_BOARD_DISTANCE_M = (0.02, 30.0)
# A stage hands on what is within this ratio of its best score, plus half a degree, which noisy
# poses of few views add to any bound; and at most so many.
_RATIO, _SLACK_RAD, _TURNED, _WITH_OTHERS, _REFINED = 3.0, 5e-3, 100, 16, 12
# Relative penalty of a score per mistake; rewritten angles are tried where no reading is sure.
_PENALTY, _FLOOR, _SURE = 0.3, 1e-4, 0.01
# Quantile of the pairs' mismatch: with a quarter of the views wrong, 56 % of pairs are right.
_PAIRS_SHARE = 0.35
# Limits of a target's size relative to the stated one, as logarithms: up to a half more or less is
# fitted elsewhere. Fewer views than the last number fit any size.
_SMALLEST, _LARGEST, _FEWEST_SIZED = np.log(1.5), np.log(20.0), 5
_LONG_MM, _WHOLE_FROM = 1000.0, 99.0


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
        readings = self.robot.reading, self.camera.reading
        robot, camera = (SideReading.as_declared(reading) for reading in readings)
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
    # Differences of an equally good and likely reading with the other mount; empty without one.
    other_mount: tuple[str, ...] = ()

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
    def agreeing(self) -> int:
        """Number of views that agree with each other."""
        return self.fit.agreeing

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
    def score(self) -> float:
        """Closing error without unit."""
        return self.fit.score

    @property
    def closes(self) -> bool:
        """Whether the chain closes as well as under a right reading."""
        return self.score <= CLOSING_SCORE

    @property
    def is_readable(self) -> bool:
        """Whether the numbers can be read as rotations at all."""
        return bool(np.isfinite(self.score))

    @property
    def figures(self) -> str:
        """The closing error, in words."""
        if not self.is_readable:
            return "no rotations"
        shift_m, angle = self.fit.rms
        is_long = 1e3 * shift_m > _LONG_MM
        length = f"{_short(shift_m)} m" if is_long else f"{_short(1e3 * shift_m)} mm"
        return f"{length} and {_short(float(np.rad2deg(angle)))} deg"

    @property
    def board_scale(self) -> float:
        """Factor for the board's sizes, where images were measured; else 1."""
        camera, unit = self.hypothesis.camera, self.declared.camera.unit
        return camera.scale * UNITS_M[camera.unit] / UNITS_M[unit] if self.is_measured else 1.0

    @property
    def is_measured(self) -> bool:
        """Whether the camera's poses were measured from images."""
        return self.recording.is_measured


def _short(value: float) -> str:
    """Formats two digits; whole numbers from a hundred on."""
    return f"{value:.0f}" if value > _WHOLE_FROM else figure(value)


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
    return len(rows) < FEWEST_ROWS or fitted(recording, [recording.declared], rows, 0)[0].closes


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
        readings = sorted(_readings(recording, rows, rewritten), key=lambda reading: reading.cost)
        classes: dict[Hashable, tuple[Hypothesis, ...]] = {}
        for reading in readings:
            key = reading.chain_class, recording.is_likely(reading)
            classes[key] = (*classes.get(key, ()), reading)
        labels = {of_class[0]: of_class for of_class in classes.values()}
        screened = fitted(recording, labels, rows, 0)
        least = min(item.score for item in screened)
        if least < _SURE:
            break
    limit = _RATIO * least + _SLACK_RAD
    near = [item for item in screened if item.score <= limit and item.hypothesis != declared]
    near.sort(key=lambda item: (item.score + _FLOOR) * (1.0 + _PENALTY * item.hypothesis.cost))
    singles = [reading for reading in readings if len(reading.changes) < 2]
    refined = [declared, *(item.hypothesis for item in near[:_REFINED])]
    refined += _of_other_sizes(recording, singles, rows)
    return [
        replace(item, labels=labels.get(item.hypothesis, ()))
        for item in fitted(recording, refined, rows, STARTS)
    ]


def _readings(
    recording: Recording, rows: IntArray, rewritten: PoseNumbers | None
) -> Iterator[Hypothesis]:
    """The declared reading, and those with one or two mistakes that turn as the camera does."""
    declared, is_measured = recording.declared, recording.is_measured
    mismatch = _Mismatch(recording, rows)
    table = [*changes(declared, is_measured=is_measured, rewritten=rewritten)]
    of_rotations = [change for change in table if change.is_of_rotations]
    others = [change for change in table if not change.is_of_rotations]
    # Rewritten angles are strange enough.
    plain = [change for change in of_rotations if not change.is_rewritten]
    turned: dict[tuple[Change, ...], Hypothesis] = {(): declared}
    turned |= {(change,): change.of(declared) for change in of_rotations}
    turned.update(_pairs(declared, plain))
    away = {made: mismatch.of(reading) for made, reading in turned.items()}
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


class _Mismatch:
    """Differences between the angles by which robot and camera turn between two views."""

    def __init__(self, recording: Recording, rows: IntArray) -> None:
        self._recording, self._rows = recording, rows
        self._camera_numbers = recording.camera.rows(rows)
        self._angles: dict[Hashable, FloatArray] = {}

    def of(self, reading: Hypothesis) -> float:
        """Low quantile of the differences [rad]; infinite with too few to compare."""
        robot = self._angles.get((reading.robot.turns, reading.order))
        if robot is None:
            rows = reading.rows(len(self._recording.robot))[self._rows]
            numbers = self._recording.robot.rows(np.maximum(rows, 0))
            rotations = reading.robot.turns.rotations(numbers)
            rotations[rows < 0] = np.nan
            robot = _relative_angles(rotations)
            self._angles[reading.robot.turns, reading.order] = robot
        camera = self._angles.get(reading.camera.turns)
        if camera is None:
            camera = _relative_angles(reading.camera.turns.rotations(self._camera_numbers))
            self._angles[reading.camera.turns] = camera
        difference = np.nan_to_num(np.abs(robot - camera), nan=np.inf)
        rank = int(_PAIRS_SHARE * len(difference))
        return float(np.partition(difference, rank)[rank])


def _relative_angles(rotations: FloatArray) -> FloatArray:
    """(p,) angles [rad] of the relative rotations of all pairs of views."""
    flat = rotations.reshape(-1, 9)
    traces = (flat @ flat.T)[np.triu_indices(len(flat), 1)]
    return np.asarray(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))


def _of_other_sizes(
    recording: Recording, singles: Sequence[Hypothesis], rows: IntArray
) -> Iterator[Hypothesis]:
    """Readings with a target of the size that closes the chain, beside one other mistake."""
    # `R_i t_X + s R_i R_X c_i - t_Z = -p_i`. Sizes near the stated one are fitted elsewhere; here,
    # units would be mistaken for them.
    declared = recording.declared
    bases = [
        base
        for base in singles
        if (base.robot.unit, base.camera.unit) == (declared.robot.unit, declared.camera.unit)
        and not base.robot.signs
    ]
    robot, camera = chains(recording, bases, rows)
    whole = np.isfinite(robot).all(axis=(1, 2, 3)) & np.isfinite(camera).all(axis=(1, 2, 3))
    robot, camera, zero = robot[whole], camera[whole], np.zeros(3)
    fits = robust_fits(compose(robot[..., :3, :3], zero), compose(camera[..., :3, :3], zero))
    limit = _RATIO * min((fit.score for fit in fits), default=0.0) + _SLACK_RAD
    for at, (base, fit) in enumerate(zip(np.flatnonzero(whole), fits, strict=True)):
        kept, lever = fit.kept, float(np.median(np.linalg.norm(camera[at, :, :3, 3], axis=1)))
        if fit.score > limit or len(kept) < _FEWEST_SIZED or not lever > 0.0:
            continue
        turn = robot[at, kept, :3, :3]
        seen = turn @ fit.x[:3, :3] @ camera[at, kept, :3, 3, None] / lever
        columns = np.concatenate([turn, seen, robot[at, kept, :3, 3:]], axis=2)
        columns = (columns - columns.mean(axis=0)).reshape(-1, 5)
        size = np.linalg.lstsq(columns[:, :4], -columns[:, 4], rcond=1e-3)[0][3] / lever
        if size > 0.0 and _SMALLEST < abs(np.log(size)) < _LARGEST:
            yield of_another_size(float(size)).of(bases[base])
