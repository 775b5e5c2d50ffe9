"""A recording, as readings see it: poses of robot and camera, and how they close the chain."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from visioncal.calibration.guess.fit import KEPT_SHARE, Fit, robust_fits
from visioncal.calibration.guess.readings import Change, Hypothesis, SideReading, changes
from visioncal.core.conventions import UNITS_M, PoseNumbers
from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mount

# With fewer views too many readings agree; more than the second add time and no certainty.
FEWEST_ROWS, _FITTED_ROWS = 4, 30
# Share of the log-likelihood that counts: the errors of an arm, a lens and a board are common to
# the views, which count as half as many independent ones.
EVIDENCE = 0.5
# Log odds by which one reading is preferred to another, against each change of the declared one,
# and against a cell that cannot be.
CLEAR, _CHANGE, IMPOSSIBLE = 3.0, 4.0, 20.0


@dataclass(frozen=True, eq=False)
class Recording:
    """Declared poses of robot and camera as they were recorded."""

    robot: PoseNumbers
    camera: PoseNumbers
    mount: Mount
    is_measured: bool  # Whether the camera's poses were measured from images.
    chain: FloatArray | None = None  # (n, 4, 4) the robot's poses by its joints; NaN without.
    is_end: bool = False  # Whether it is one end of a longer one.

    @cached_property
    def declared(self) -> Hypothesis:
        """The declared reading."""
        robot, camera = (
            SideReading(side.reading.rotation, side.reading.unit, side.reading.inverse)
            for side in (self.robot, self.camera)
        )
        return Hypothesis(robot, camera, self.mount)

    @cached_property
    def common_rows(self) -> IntArray:
        """The rows with a pose of both sides, without those that repeat the robot's of before."""
        rows = np.flatnonzero(self.robot.present & self.camera.present)
        numbers = np.hstack([self.robot.positions, self.robot.rotations])[rows]
        changed = np.any(np.diff(numbers, axis=0) != 0.0, axis=1)
        others = rows[np.append(np.ones(min(len(rows), 1), dtype=bool), changed)]
        return others if len(others) >= FEWEST_ROWS else rows

    @cached_property
    def changes(self) -> tuple[Change, ...]:
        """All mistakes that are tried but rewritten rotations; an end keeps the order of rows."""
        count = 0 if self.is_end else len(self.robot)
        return (*changes(self.declared, self.is_measured, count),)

    @property
    def ends(self) -> "Iterator[Recording]":
        """The recording's first and its last rows, where these suffice to compare readings."""
        rows = self.common_rows
        # Share of the rows at either end in which a reading may be right alone: beside rows that
        # are apart from fewer than these on, most of the others agree in another order.
        count = int(np.ceil(0.4 * len(rows)))
        if count < FEWEST_STOPS:
            return
        for some in (slice(0, rows[count - 1] + 1), slice(rows[-count], len(self.robot))):
            at = np.arange(len(self.robot))[some]
            sides = self.robot.rows(at), self.camera.rows(at)
            chain = None if self.chain is None else self.chain[at]
            yield Recording(*sides, self.mount, self.is_measured, chain, is_end=True)

    def is_likely(self, tried: Hypothesis) -> bool:
        """Whether the unit of the camera's positions puts the target at a likely distance."""
        # Plausible distances between camera and board [m].
        low, high = (0.02, 30.0)
        unit_m = tried.camera.scale * UNITS_M[tried.camera.unit]
        return bool(low < unit_m * self._distance < high)

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
    def words(self) -> str:
        """The differences from the first reading, which the source may not state, in words."""
        return "; ".join(self.hypothesis.changes) or "as first read"

    @property
    def is_of_robot(self) -> bool:
        """Whether it changes how the robot's numbers are read, and nothing else."""
        found, declared = self.hypothesis, self.recording.declared
        return (found.camera, found.mount, found.order) == (
            declared.camera,
            declared.mount,
            declared.order,
        )

    @property
    def is_of_size(self) -> bool:
        """Whether it changes the size of what the camera sees, and nothing else."""
        found, declared = self.hypothesis, self.recording.declared
        scale = declared.camera.scale
        return replace(found, camera=replace(found.camera, scale=scale)) == declared

    @property
    def rows_apart(self) -> int:
        """Rows by which all views' poses stand later, where nothing else is read otherwise."""
        found, declared = self.hypothesis, self.recording.declared
        by = int(found.rows(FEWEST_ROWS)[1]) - 1
        return by if replace(found, order="", changes=(), cost=0) == declared else 0

    @property
    def log_posterior(self) -> float:
        """Log posterior of the reading, up to a constant of the views."""
        cost = self.hypothesis.cost
        impossible = IMPOSSIBLE * (not self.recording.is_likely(self.hypothesis))
        return EVIDENCE * self.fit.log_likelihood - _CHANGE * cost - impossible

    @property
    def misfit(self) -> float:
        """RMS distance of the kept rows in the robot's recorded unit, which no reading shrinks."""
        return self.fit.rms[0] / UNITS_M[self.hypothesis.robot.unit]

    @property
    def board_scale(self) -> float:
        """Factor for the board's sizes, where images were measured; else 1."""
        readings = self.hypothesis, self.recording.declared
        unit_m, declared_m = (UNITS_M[reading.camera.unit] for reading in readings)
        scale = self.hypothesis.camera.scale * unit_m / declared_m
        return scale if self.recording.is_measured else 1.0


def chains(
    recording: Recording, tried: Sequence[Hypothesis], rows: IntArray
) -> tuple[FloatArray, FloatArray]:
    """(k, m, 4, 4) the robot's part of the chain and `cam_from_target` at rows; NaN without."""
    of_robot = np.array([reading.rows(len(recording.robot))[rows] for reading in tried])
    looked, at = np.unique(of_robot, return_inverse=True)
    robot, camera = recording.robot.rows(np.maximum(looked, 0)), recording.camera.rows(rows)
    by_robot = _poses_by({reading.robot for reading in tried}, robot)
    by_camera = _poses_by({reading.camera for reading in tried}, camera)
    pairs = zip(tried, at.reshape(of_robot.shape), strict=True)
    poses = np.array([by_robot[reading.robot][index] for reading, index in pairs])
    outside = np.array([reading.mount == "eye-to-hand" for reading in tried])
    poses[outside] = invert(poses[outside])
    poses[of_robot < 0] = np.nan
    return poses, np.array([by_camera[reading.camera] for reading in tried])


def _poses_by(sides: Iterable[SideReading], numbers: PoseNumbers) -> dict[SideReading, FloatArray]:
    """(n, 4, 4) poses by readings of one side; rotations that several share are read once."""
    rotations, found = dict[object, FloatArray](), dict[SideReading, FloatArray]()
    for side in sides:
        if side.of_rotations not in rotations:
            rotations[side.of_rotations] = side.rotations(numbers)
        found[side] = side.poses(numbers, rotations[side.of_rotations])
    return found


def fitted(
    recording: Recording,
    tried: Iterable[Hypothesis],
    rows: IntArray,
    starts: int,
    share: float = KEPT_SHARE,
) -> list[Candidate]:
    """Fits both edges under each of some readings, by the rows that are readable under it."""
    tried = [*tried]
    robot, camera = chains(recording, tried, rows)
    readable = np.isfinite(robot).all(axis=(2, 3)) & np.isfinite(camera).all(axis=(2, 3))
    masks, groups = np.unique(readable, axis=0, return_inverse=True)
    found: dict[int, Candidate] = {}
    for group, mask in enumerate(masks):
        members, count = np.flatnonzero(groups.ravel() == group), int(mask.sum())
        # A shift leaves a row without its partner.
        if count < FEWEST_ROWS - 1:
            away = np.full(count, np.inf)
            fits = [Fit(np.eye(4), np.eye(4), away, away, lever=1.0)] * len(members)
        else:
            part = np.ix_(members, np.flatnonzero(mask))
            fits = robust_fits(robot[part], camera[part], starts, share)
        for member, fit in zip(members.tolist(), fits, strict=True):
            of_all = replace(fit, lost=len(rows) - count)
            found[member] = Candidate(tried[member], recording, of_all, rows[mask])
    return [found[at] for at in range(len(tried))]


def thinned(rows: IntArray) -> IntArray:
    """At most as many rows as are fitted, evenly spread."""
    spread = np.linspace(0, len(rows) - 1, _FITTED_ROWS).round().astype(int)
    return rows if len(rows) <= _FITTED_ROWS else np.asarray(rows[spread])
