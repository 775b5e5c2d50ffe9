"""Parts of a cell's problem: observations, effects, priors, state, noise, Jacobians."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Self

import numpy as np

from visioncal.core.transforms import exp, inverse_right_jacobian, log
from visioncal.core.types import FloatArray, IntArray, Mask, chosen_rows
from visioncal.estimation.mixed import PriorInformation
from visioncal.session.tree import PathStep

# Name of the only robot of a cell.
ROBOT = "robot"
# Uninformative variance of an error that was not observed [rad^2 and m^2].
ANYTHING = 1e4
# Where an observation's covariance is a guess, its errors are up to this many times larger: with
# tilt and distance.
UNEVEN = 3.0


@dataclass(frozen=True, eq=False)
class Observations:
    """n measured poses."""

    observers: tuple[str, ...]  # (n,) the observing frame.
    observed: tuple[str, ...]  # (n,) the observed frame.
    stops: IntArray  # (n,) the stop, numbered from 0.
    # (n,) index of the sensor's noise level; -1 where the covariance is absolute.
    sensors: IntArray
    measured: FloatArray  # (n, 4, 4) `observer_from_observed`.
    covariance: FloatArray  # (n, 6, 6) of its right perturbation, at a sensor's level of one.
    has_rotation: Mask  # (n,) whether its rotation was measured; else its position alone.
    # (n,) whether its covariance is a guess, with unknown differences between observations.
    is_uneven: Mask
    # (n, 6, 6) by which noise of one level acts on each, in its own axes; None where it acts on all
    # alike, or is of the flange.
    shapes: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.stops)

    @cached_property
    def directions(self) -> IntArray:
        """(n,) number of directions that each determines: six at most."""
        # Variances of undetermined directions are larger [rad^2].
        count = np.sum(np.linalg.eigvalsh(self.covariance) < 0.05, axis=1)
        return np.asarray(np.where(self.has_rotation, count, 3))

    def take(self, rows: IntArray) -> "Observations":
        """Returns the observations of (m,) rows."""
        return chosen_rows(self, rows)

    def renamed(self, frame: str, other: str, rows: Mask) -> "Observations":
        """Returns the observations with a frame renamed in the rows of an (n,) mask."""

        def names(old: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(
                other if name == frame and row else name
                for name, row in zip(old, rows.tolist(), strict=True)
            )

        return replace(self, observers=names(self.observers), observed=names(self.observed))

    def involves(self, frame: str) -> Mask:
        """(n,) mask of those with a frame as observer or observed."""
        pairs = zip(self.observers, self.observed, strict=True)
        return np.array([frame in pair for pair in pairs], dtype=bool)


def by_size(poses: FloatArray) -> FloatArray:
    """(n, 6) right perturbations of measured (n, 4, 4) poses by the relative size of a target."""
    shift = np.swapaxes(poses[:, :3, :3], 1, 2) @ poses[:, :3, 3:]
    return np.concatenate([np.zeros((len(poses), 3)), shift[:, :, 0]], axis=1)


@dataclass(frozen=True, eq=False)
class Effect:
    """A vector of k unknowns that acts on many observations together."""

    name: str  # Its name, as `lens and board` or `arm a`.
    values: FloatArray  # (k,) linearisation point.
    # Prior, as information (k, k) and half its gradient (k,) at these values.
    prior: PriorInformation
    held: Mask  # (k,) mask of the values that are held, and count in the covariance.
    # (n, 6, k) right Jacobian of the measured poses; None for zero.
    by_sensor: FloatArray | None = None
    # By robot, (s, 6, k) right Jacobian of its flange at each stop.
    flange_jacobian: Mapping[str, FloatArray] = field(default_factory=dict)
    # (n,) the observations to which `flange_jacobian` applies; None for all.
    rows_concerned: Mask | None = None
    # Indices of the values that are relative sizes of targets, with slopes at the measured poses.
    sizes: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @classmethod
    def free(
        cls,
        name: str,
        known: PriorInformation | None = None,
        by_sensor: FloatArray | None = None,
        flange_jacobian: Mapping[str, FloatArray] = MappingProxyType({}),
    ) -> Self:
        """An effect of free values, linearised at zero; without a prior where None is known."""
        jacobians = [*flange_jacobian.values(), *([] if by_sensor is None else [by_sensor])]
        size = jacobians[0].shape[2]
        known = PriorInformation.flat(size) if known is None else known
        return cls(
            name, np.zeros(size), known, np.zeros(size, dtype=bool), by_sensor, flange_jacobian
        )

    def __len__(self) -> int:
        return len(self.values)

    def take(self, rows: IntArray) -> Self:
        """Returns the effect for (m,) rows of the observations."""
        return replace(
            self,
            by_sensor=None if self.by_sensor is None else self.by_sensor[rows],
            rows_concerned=None if self.rows_concerned is None else self.rows_concerned[rows],
        )

    def carried(self, by: FloatArray) -> "Effect":
        """Returns the effect for poses of another point of the observed, by (n, 6, 6) adjoints."""
        return self if self.by_sensor is None else replace(self, by_sensor=by @ self.by_sensor)

    def of_stops(self, chosen: Mask) -> "Effect":
        """Returns the effect for the stops of an (s,) mask."""
        flange_jacobian = {name: array[chosen] for name, array in self.flange_jacobian.items()}
        return replace(self, flange_jacobian=flange_jacobian)

    def jacobian_of_flange(self, robot: str, stops: IntArray) -> FloatArray:
        """(n, 6, k) Jacobian of a robot's flange at observations of (n,) stops."""
        if robot not in self.flange_jacobian:
            return np.zeros((len(stops), 6, len(self)))
        jacobian, rows = self.flange_jacobian[robot][stops], self.rows_concerned
        return jacobian if rows is None else jacobian * rows[:, None, None]


@dataclass(frozen=True, eq=False)
class FramePrior:
    """Prior of one frame's pose in another with no robot between, by a gauge or a drawing."""

    first: str  # The reference frame.
    second: str  # The frame whose pose it is.
    # (c,) measured components of its origin, 0 for x, along the first's axes.
    axes: tuple[int, ...]
    values_m: tuple[float, ...]  # (c,) their values [m].
    sigma_m: float  # The standard deviation of each [m].
    rotation: FloatArray | None = None  # (3, 3) `first_from_second`, if measured.
    sigma_rad: float = 0.0  # Its standard deviation about each axis [rad].

    @property
    def name(self) -> str:
        """NAME of the prior's table `[prior.NAME]`."""
        return f"{self.first}_from_{self.second}"

    @property
    def matrix(self) -> FloatArray | None:
        """(4, 4) `first_from_second`; None where some of it is unknown."""
        if self.rotation is None or self.axes != (0, 1, 2):
            return None
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.values_m
        return matrix

    def without(self, axis: int) -> "FramePrior":
        """Returns the prior without one of its measured components."""
        at = self.axes.index(axis)
        values_m = self.values_m[:at] + self.values_m[at + 1 :]
        return replace(self, axes=self.axes[:at] + self.axes[at + 1 :], values_m=values_m)

    def whitened(self, estimate: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (d,) of a (4, 4) estimate, and their Jacobian (d, 6)."""
        rows = list(self.axes)
        offset = (estimate[rows, 3] - np.array(self.values_m)) / self.sigma_m
        jacobian = np.concatenate(
            [np.zeros((len(rows), 3)), estimate[rows, :3] / self.sigma_m], axis=1
        )
        if self.rotation is None:
            return offset, jacobian
        between = np.eye(4)
        between[:3, :3] = self.rotation.T @ estimate[:3, :3]
        rotation = log(between[None])
        jacobian_rotation = inverse_right_jacobian(rotation)[0, :3] / self.sigma_rad
        return (
            np.concatenate([rotation[0, :3] / self.sigma_rad, offset]),
            np.concatenate([jacobian_rotation, jacobian]),
        )


@dataclass(frozen=True, eq=False)
class State:
    """Unknowns: (e, 4, 4) `parent_from_frame` of each unknown frame, and (k,) values."""

    edges: FloatArray
    values: FloatArray

    def moved(self, step: FloatArray) -> "State":
        """Returns the state after a (6 e + k,) step, on the right of the edges."""
        size = 6 * len(self.edges)
        motions = exp(step[:size].reshape(-1, 6))
        return State(self.edges @ motions, self.values + step[size:])


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise levels, as standard deviations."""

    # (r, 2) of each robot's flange, of rotation [rad] and translation [m], per axis.
    robots: FloatArray
    sensors: FloatArray  # (s,) scale of each sensor's stated sigmas.

    @classmethod
    def of_robot(cls, sigma_rad: float, sigma_m: float) -> "Noise":
        """Noise of a single robot's flange, per axis, without sensor levels."""
        return cls(np.array([[sigma_rad, sigma_m]]), np.zeros(0))

    def with_robot(self, at: int, level: FloatArray) -> "Noise":
        """Returns the noise with another level (2,) of the robot of an index."""
        robots = self.robots.copy()
        robots[at] = level
        return replace(self, robots=robots)


@dataclass(frozen=True, eq=False)
class PathGroup:
    """The observations of one pair of frames, and the path between the two."""

    rows: IntArray
    path: tuple[PathStep, ...]


@dataclass(frozen=True, eq=False)
class MovedGroup:
    """Jacobians of a group's m observations with respect to the effects' values."""

    values: IntArray  # (c,) indices of the effects' values that the group depends on.
    places: IntArray  # (s,) indices, among these, of the values that move the measured poses.
    by_sensor: FloatArray  # (m, 6, s) Jacobian of the measured poses with respect to those.
    # (m, 6, c) Jacobian of each path step's flange; None where no effect moves it.
    by_steps: tuple[FloatArray | None, ...]


@dataclass(frozen=True, eq=False)
class JacobianBlock:
    """Nonzero block (m, 6, c) of the Jacobian: m rows by the c columns they depend on."""

    rows: IntArray
    columns: IntArray
    jacobian: FloatArray


@dataclass(frozen=True, eq=False)
class Linear:
    """All residuals, linearised."""

    residuals: FloatArray  # (n, 6).
    # Jacobian with respect to the p unknowns, one block for each pair of frames.
    blocks: tuple[JacobianBlock, ...]
    # (n, 6, 6 w) Jacobian with respect to the flange errors, in the slots of the robots of the
    # observation's unit; see `Problem.units`.
    by_errors: FloatArray
    # (n, 6, 6 w) Jacobian with respect to the flange poses; equals `by_errors` unless errors are
    # those of the observed frame, see `Problem.is_combined`.
    by_flanges: FloatArray
    size: int  # Number of unknowns p.

    @property
    def jacobian(self) -> FloatArray:
        """Dense Jacobian (n, 6, p)."""
        return self.jacobian_of(np.arange(len(self.residuals)))

    def jacobian_of(self, rows: IntArray) -> FloatArray:
        """Dense Jacobian (m, 6, p) of m selected rows."""
        places = np.full(len(self.residuals), -1)
        places[rows] = np.arange(len(rows))
        jacobian = np.zeros((len(rows), 6, self.size))
        for block in self.blocks:
            selected_rows = places[block.rows]
            chosen = selected_rows >= 0
            jacobian[np.ix_(selected_rows[chosen], np.arange(6), block.columns)] = block.jacobian[
                chosen
            ]
        return jacobian

    def covariance(self, covariance: FloatArray) -> FloatArray:
        """Covariances (n, 6, 6) of the residuals, propagated from the unknowns' (p, p)."""
        predicted = np.zeros((len(self.residuals), 6, 6))
        for block in self.blocks:
            block_covariance = covariance[np.ix_(block.columns, block.columns)]
            predicted[block.rows] = (
                block.jacobian @ block_covariance @ np.swapaxes(block.jacobian, 1, 2)
            )
        return predicted


def units_of(
    groups: Sequence[PathGroup], stops: IntArray, robots: Sequence[str]
) -> tuple[IntArray, IntArray]:
    """Unit (n,) of each observation at a stop (n,), those that share errors of flanges there.

    The unit is -1 for none. And (u, w) the indices of each unit's robots, padded with -1.
    """
    count, joined = len(robots), []
    first = np.full(len(stops), -1, dtype=np.int64)
    for group in groups:
        robot_indices = [robots.index(step.robot) for step in group.path if step.robot]
        keys = stops[group.rows] * count
        if robot_indices:
            first[group.rows] = keys + robot_indices[0]
            joined += [
                np.stack([keys + robot_indices[0], keys + index], axis=1) for index in robot_indices
            ]
    if not joined:
        return first, np.zeros((0, 1), dtype=np.int64)
    used, pairs = np.unique(np.concatenate(joined), return_inverse=True)
    pairs = pairs.reshape(-1, 2)
    units, of_key = len(used), np.arange(len(used))
    if np.any(pairs[:, 0] != pairs[:, 1]):  # some paths contain several robots
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(used), len(used)))
        units, of_key = connected_components(links, directed=False)
    order = np.lexsort((used % count, of_key))
    rows, sizes = of_key[order], np.bincount(of_key)
    members = np.full((units, sizes.max()), -1, dtype=np.int64)
    members[rows, np.arange(len(rows)) - (np.cumsum(sizes) - sizes)[rows]] = used[order] % count
    of = np.where(first < 0, -1, of_key[np.searchsorted(used, np.maximum(first, used[0]))])
    return of, members


def rows_of(array: FloatArray, rows: IntArray) -> FloatArray:
    """Selects rows in ascending order; avoids a copy of a large array if that is all of them."""
    return array if len(rows) == len(array) else array[rows]


def place_slope(error: FloatArray) -> FloatArray:
    """Jacobian (n, 6, 6) of a position with respect to its frame's right perturbation."""
    jacobian = np.zeros((len(error), 6, 6))
    jacobian[:, 3:, 3:] = error[:, :3, :3]
    return jacobian
