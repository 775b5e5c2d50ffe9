"""What a problem of a cell is made of: observations, effects, priors, values and noise."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np

from visioncal.core.transforms import exp, inverse_right_jacobian, log
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.variance import Knowledge

# Variances of a direction that a pose leaves open are above this [rad^2].
_OPEN = 0.05
# What the only robot of a cell is called.
ROBOT = "robot"


# Where an observation's covariance is a guess, its errors are up to so many times larger than that:
# with tilt and distance.
UNEVEN = 3.0


@dataclass(frozen=True, eq=False)
class Observations:
    """What n observations measured.

    Attributes:
        observers: (n,) the frame that measured.
        observed: (n,) the frame whose place was measured.
        stops: (n,) the stop, numbered from 0.
        sensors: (n,) whose noise level it is, numbered from 0; -1 where the covariance is known.
        measured: (n, 4, 4) `observer_from_observed`.
        covariance: (n, 6, 6) of its right perturbation, at a sensor's level of one.
        has_rotation: (n,) whether its rotation was measured; else its place alone.
        is_uneven: (n,) whether its covariance is a guess: some are better than others, and nobody
            says how much.
    """

    observers: tuple[str, ...]
    observed: tuple[str, ...]
    stops: IntArray
    sensors: IntArray
    measured: FloatArray
    covariance: FloatArray
    has_rotation: Mask
    is_uneven: Mask

    def __len__(self) -> int:
        return len(self.stops)

    @cached_property
    def directions(self) -> IntArray:
        """(n,) in how many directions each was measured: six at most."""
        found = np.sum(np.linalg.eigvalsh(self.covariance) < _OPEN, axis=1)
        return np.asarray(np.where(self.has_rotation, found, 3))

    def take(self, rows: IntArray) -> "Observations":
        """Returns those of (m,) rows."""
        return Observations(
            tuple(self.observers[index] for index in rows.tolist()),
            tuple(self.observed[index] for index in rows.tolist()),
            self.stops[rows],
            self.sensors[rows],
            self.measured[rows],
            self.covariance[rows],
            self.has_rotation[rows],
            self.is_uneven[rows],
        )

    def renamed(self, frame: str, other: str, rows: Mask) -> "Observations":
        """Returns them with a frame that has another name in the rows of an (n,) mask."""

        def names(old: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(
                other if name == frame and row else name
                for name, row in zip(old, rows.tolist(), strict=True)
            )

        return replace(self, observers=names(self.observers), observed=names(self.observed))

    def involves(self, frame: str) -> Mask:
        """(n,) which of them a frame observed or was observed in."""
        pairs = zip(self.observers, self.observed, strict=True)
        return np.array([frame in pair for pair in pairs], dtype=bool)


@dataclass(frozen=True, eq=False)
class Effect:
    """A vector of k unknowns that moves many observations together.

    Attributes:
        name: What it is of, as `lens and board` or `arm a`.
        values: (k,) where the observations were linearised.
        known: What is known of them beside the observations, as information (k, k) and half its
            gradient (k,) at these values.
        held: (k,) which of them stay there, and count in the covariance.
        by_sensor: (n, 6, k) how the measured poses move with them, on their right; None for not.
        flange_jacobian: By robot, (s, 6, k) how its flange moves at each stop, on its right.
        concerned: (n,) the observations at which flanges move so; None for all.
        random: How many of the last values are random coefficients of what no stop determines.
    """

    name: str
    values: FloatArray
    known: Knowledge
    held: Mask
    by_sensor: FloatArray | None = None
    flange_jacobian: Mapping[str, FloatArray] = field(default_factory=dict)
    concerned: Mask | None = None
    random: int = 0

    @classmethod
    def free(
        cls,
        name: str,
        known: Knowledge,
        by_sensor: FloatArray | None = None,
        flange_jacobian: Mapping[str, FloatArray] = MappingProxyType({}),
    ) -> "Effect":
        """An effect of free values, linearised where they are zero."""
        size = len(known.gradient)
        return cls(
            name, np.zeros(size), known, np.zeros(size, dtype=bool), by_sensor, flange_jacobian
        )

    def __len__(self) -> int:
        return len(self.values)

    @property
    def determined(self) -> "Effect":
        """The effect as if its random coefficients were known."""
        kept = len(self) - self.random
        information = self.known.information[:kept, :kept]
        return replace(
            self,
            values=self.values[:kept],
            known=Knowledge(information, self.known.gradient[:kept]),
            held=self.held[:kept],
            by_sensor=None if self.by_sensor is None else self.by_sensor[:, :, :kept],
            random=0,
        )

    def take(self, rows: IntArray) -> "Effect":
        """Returns it for (m,) rows of the observations."""
        return replace(
            self,
            by_sensor=None if self.by_sensor is None else self.by_sensor[rows],
            concerned=None if self.concerned is None else self.concerned[rows],
        )

    def carried(self, by: FloatArray) -> "Effect":
        """Returns it for poses measured elsewhere on what was observed, by (n, 6, 6) adjoints."""
        return self if self.by_sensor is None else replace(self, by_sensor=by @ self.by_sensor)

    def of_stops(self, chosen: Mask) -> "Effect":
        """Returns it for the stops of an (s,) mask."""
        flange_jacobian = {name: array[chosen] for name, array in self.flange_jacobian.items()}
        return replace(self, flange_jacobian=flange_jacobian)

    def jacobian_of_flange(self, robot: str, stops: IntArray) -> FloatArray:
        """(n, 6, k) how a robot's flange moves at observations of (n,) stops."""
        if robot not in self.flange_jacobian:
            return np.zeros((len(stops), 6, len(self)))
        found = self.flange_jacobian[robot][stops]
        return found if self.concerned is None else found * self.concerned[:, None, None]


@dataclass(frozen=True, eq=False)
class FramePrior:
    """Where one frame is in another that no robot parts from it, as a gauge or a drawing has it.

    Attributes:
        first: The frame in which it was measured.
        second: The frame whose place it is.
        axes: (c,) which components of its origin were measured, 0 for x, along the first's axes.
        values_m: (c,) what was measured [m].
        sigma_m: The standard deviation of each [m].
        rotation: (3, 3) `first_from_second`, where that was measured, too.
        sigma_rad: Its standard deviation about each axis [rad].
    """

    first: str
    second: str
    axes: tuple[int, ...]
    values_m: tuple[float, ...]
    sigma_m: float
    rotation: FloatArray | None = None
    sigma_rad: float = 0.0

    @property
    def name(self) -> str:
        """What `[prior.NAME]` calls it."""
        return f"{self.first}_from_{self.second}"

    @property
    def matrix(self) -> FloatArray | None:
        """(4, 4) `first_from_second`; None where it is not known whole."""
        if self.rotation is None or self.axes != (0, 1, 2):
            return None
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = self.rotation, self.values_m
        return found

    def without(self, axis: int) -> "FramePrior":
        """Returns the prior without one of its measured components."""
        kept = [
            (index, value)
            for index, value in zip(self.axes, self.values_m, strict=True)
            if index != axis
        ]
        return replace(
            self, axes=tuple(index for index, _ in kept), values_m=tuple(value for _, value in kept)
        )

    def whitened(self, found: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (d,) in units of sigma, and their slopes (d, 6).

        Args:
            found: (4, 4) `first_from_second` as it is estimated; the slopes are by its right
                perturbation.
        """
        rows = list(self.axes)
        away = (found[rows, 3] - np.array(self.values_m)) / self.sigma_m
        jacobian = np.concatenate(
            [np.zeros((len(rows), 3)), found[rows, :3] / self.sigma_m], axis=1
        )
        if self.rotation is None:
            return away, jacobian
        between = np.eye(4)
        between[:3, :3] = self.rotation.T @ found[:3, :3]
        turn = log(between[None])
        by_turn = inverse_right_jacobian(turn)[0, :3] / self.sigma_rad
        return (
            np.concatenate([turn[0, :3] / self.sigma_rad, away]),
            np.concatenate([by_turn, jacobian]),
        )


@dataclass(frozen=True, eq=False)
class State:
    """Values of the unknowns: (e, 4, 4) `parent_from_frame` of each unknown frame, and (k,)."""

    edges: FloatArray
    values: FloatArray

    def moved(self, step: FloatArray) -> "State":
        """Returns the unknowns after a (6 e + k,) step, on the right of the edges."""
        size = 6 * len(self.edges)
        by = exp(step[:size].reshape(-1, 6))
        return State(self.edges @ by, self.values + step[size:])


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations.

    Attributes:
        robots: (r, 2) of each robot's flange, of rotation [rad] and translation [m], per axis.
        sensors: (s,) by which each sensor's covariances are to be taken larger, as sigmas.
    """

    robots: FloatArray
    sensors: FloatArray

    @classmethod
    def of_robot(cls, sigma_rad: float, sigma_m: float) -> "Noise":
        """The noise of an only robot's flange, per axis, where that of all else is known."""
        return cls(np.array([[sigma_rad, sigma_m]]), np.zeros(0))
