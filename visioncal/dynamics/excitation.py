"""Search for exciting motions, which determine an arm's base parameters best.

Swevers, Verdonck and De Schutter (2007, Dynamic model identification for industrial robots): the
coefficients of finite Fourier series are optimised for the condition of the regressor, within the
limits of joints, drives and cell. Here a smooth approximation of the condition is sharpened from
round to round; descents start from random motions, and the best result that is within all limits at
a thousand samples a second is kept. Results depend on the computer's speed only if the request
limits the time.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import minimize

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import some_of
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, Progress
from visioncal.dynamics.base import BaseModel, condition_of, smooth_condition
from visioncal.dynamics.limits import CHECK_HZ, MotionExtremes, MotionLimits, motion_extremes
from visioncal.dynamics.model import DynamicModel, FrictionTerms, JointMotion

# Range of a motion's duration [s], and of its number of harmonics: fewer cannot determine the
# parameters of six joints, more shake the arm.
SHORTEST_S, LONGEST_S = 10.0, 30.0
FEWEST, MOST = 3, 10
# Sharpness of the smoothed condition and penalty weight of the limits, round by round.
_ROUNDS = ((1.0, 10.0), (4.0, 80.0), (15.0, 640.0))
# Sampling of the condition numbers, which do not change with more.
_FIGURES_HZ = 100.0

# How many times denser than the regressor limits and distances are sampled.
_LIMIT_DENSITY = 3
# Finite-difference steps of regressor and distances [rad and its rates], far above rounding.
_STEP, _STEP_CLEAR = 1e-6, 1e-5


@dataclass(frozen=True)
class Harmonics:
    """Basis functions of one joint's motion: `count` harmonics of the period `period_s` [s]."""

    period_s: float
    count: int

    @cached_property
    def resting(self) -> FloatArray:
        """(1 + 2 count, 2 count - 1) orthonormal basis of the coefficients that begin at rest."""
        _, speed, acceleration = self._functions(np.zeros(1))
        return np.asarray(null_space(np.vstack([speed, acceleration])))

    def basis(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Positions, speeds, accelerations (m, 2 count - 1) for a unit of each free coefficient."""
        q, dq, ddq = (function @ self.resting for function in self._functions(times_s))
        return q, dq, ddq

    def _functions(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(m, 1 + 2 count) constant, sines and cosines, and their first and second derivatives."""
        rates = 2.0 * np.pi / self.period_s * np.arange(1, self.count + 1)
        phases = np.asarray(times_s)[:, None] * rates
        sine, cosine = np.sin(phases), np.cos(phases)
        one = np.ones((len(phases), 1))
        return (
            np.hstack([one, sine, cosine]),
            np.hstack([0.0 * one, rates * cosine, -rates * sine]),
            np.hstack([0.0 * one, -(rates**2) * sine, -(rates**2) * cosine]),
        )


@dataclass(frozen=True, eq=False)
class Series:
    """Fourier series of n joints that begin and end at rest."""

    harmonics: Harmonics  # The basis functions.
    free: FloatArray  # (n, 2 count - 1) coefficients in the basis `Harmonics.resting` [rad].

    @property
    def coefficients(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean (n,), sines (n, count) and cosines (n, count) of each joint's position [rad]."""
        full, count = self.free @ self.harmonics.resting.T, self.harmonics.count
        return full[:, 0], full[:, 1 : 1 + count], full[:, 1 + count :]

    @property
    def start(self) -> FloatArray:
        """(n,) posture at beginning and end [rad]."""
        mean, _, cosines = self.coefficients
        return np.asarray(mean + cosines.sum(axis=1))

    def motion(self, times_s: FloatArray) -> JointMotion:
        """The motion at (m,) times [s]."""
        q, dq, ddq = (array @ self.free.T for array in self.harmonics.basis(times_s))
        return JointMotion(np.asarray(times_s, dtype=float), q, dq, ddq)

    def sampled(self, rate_hz: float) -> JointMotion:
        """The motion from its beginning to its end, evenly sampled."""
        return self.motion(even_times(self.harmonics.period_s, rate_hz))

    def shrunk(self, share: float) -> "Series":
        """The motion scaled by a factor about its mean."""
        # The mean is in the span of the free coefficients: the conditions of rest do not limit it.
        middle = np.outer(self.coefficients[0], self.harmonics.resting[0])
        return Series(self.harmonics, middle + share * (self.free - middle))


def even_times(duration_s: float, rate_hz: float) -> FloatArray:
    """(m,) times from zero to a duration, both included, at a rate or slightly more."""
    return np.linspace(0.0, duration_s, 1 + int(np.ceil(duration_s * rate_hz - 1e-9)))


class Objective:
    """Objective of a motion and its gradient, over the free coefficients of its series.

    Attributes:
        harmonics: Basis functions of the motion.
    """

    def __init__(
        self, allowed: MotionLimits, base: BaseModel, weights: FloatArray, harmonics: Harmonics
    ) -> None:
        """Prepares the samples; weights (n,) are the inverse of each joint's torque noise."""
        self.harmonics = harmonics
        self._allowed, self._weights = allowed, weights
        # Dry friction is smoothed over a share of the greatest speed, so that the objective is
        # smooth.
        terms = replace(base.model.terms, slow_rad_s=0.03 * float(allowed.speed.max()))
        self._base = replace(base, model=DynamicModel(base.model.robot, terms))
        # Samples of the regressor per period of the highest harmonic.
        count = 10 * harmonics.count
        # Between the ends, where speeds are zero and have no sign.
        self._times = (np.arange(count) + 0.5) * harmonics.period_s / count
        self._basis = harmonics.basis(self._times)
        dense = _LIMIT_DENSITY * count
        self._limit_basis = harmonics.basis((np.arange(dense) + 0.5) * harmonics.period_s / dense)
        self._nominal = None
        if allowed.inertias is not None:
            standard = np.zeros(len(base.model.names))
            standard[: allowed.inertias.values.size] = allowed.inertias.values.ravel()
            self._nominal = base.of(standard)

    def series(self, free: FloatArray) -> Series:
        """The motion of (k,) free coefficients."""
        return Series(self.harmonics, free.reshape(self._allowed.robot.joint_count, -1))

    def value(self, free: FloatArray, sharpness: float, price: float) -> tuple[float, FloatArray]:
        """Smoothed log condition number plus the penalty of exceeded limits, and the gradient (k,).

        Args:
            free: (k,) free coefficients of all joints.
            sharpness: Of `smooth_condition`.
            price: Weight of the penalty.
        """
        coefficients = self.series(free).free
        value, by_value = self._condition(coefficients, sharpness, price)
        penalty, by_penalty = self._penalty(coefficients)
        gradient = _chained(self._basis, by_value) + price * _chained(self._limit_basis, by_penalty)
        return value + price * penalty, gradient.ravel()

    def _condition(
        self, coefficients: FloatArray, sharpness: float, price: float
    ) -> tuple[float, list[FloatArray]]:
        """Log condition and torque penalty; gradients (m, n) over position, speed, acceleration."""
        states = [array @ coefficients.T for array in self._basis]
        rows, jacobian = self._regressors(states)
        weighted = (rows * self._weights[:, None]).reshape(-1, rows.shape[2])
        value, by_weighted = smooth_condition(weighted, sharpness)
        by_rows = by_weighted.reshape(rows.shape) * self._weights[:, None]
        if self._nominal is not None:
            penalty, by_torque = _hinge(rows @ self._nominal, self._allowed.torque)
            # The same weight as the limits, which are sampled more densely.
            value += price * _LIMIT_DENSITY * penalty
            by_rows = by_rows + price * _LIMIT_DENSITY * by_torque[:, :, None] * self._nominal
        by_states = np.einsum("kmjp,mjp->mk", jacobian, by_rows, optimize=True)
        return value, np.split(by_states, len(states), axis=1)

    def _regressors(self, states: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Regressor (m, n, b), and its derivatives (3 n, m, n, b) over the states' components."""
        # Forward differences; the rows are linear in the accelerations and quadratic in the speeds.
        count, joints = states[0].shape
        stepped = [np.repeat(state[None], 3 * joints + 1, axis=0) for state in states]
        for kind, values in enumerate(stepped):
            for joint in range(joints):
                values[1 + kind * joints + joint, :, joint] += _STEP
        times = np.tile(self._times, 3 * joints + 1)
        motion = JointMotion(times, *(array.reshape(-1, joints) for array in stepped))
        rows = self._base.regressor(motion).reshape(3 * joints + 1, count, joints, -1)
        return rows[0], (rows[1:] - rows[0]) / _STEP

    def _penalty(self, coefficients: FloatArray) -> tuple[float, list[FloatArray]]:
        """Penalty of exceeded limits and distances, with gradients (m, n)."""
        # A margin for peaks between samples: 3 % of the limits, 30 mm of the distances.
        allowed, less = self._allowed, 0.97
        q, dq, ddq = (array @ coefficients.T for array in self._limit_basis)
        position, by_q = _hinge(q - allowed.middle, less * allowed.half)
        speed, by_dq = _hinge(dq, less * allowed.speed)
        acceleration, by_ddq = _hinge(ddq, less * allowed.acceleration)
        distance = 0.0
        for row, posture in enumerate(q):
            short = self._shortfall(posture)
            if not short.any():
                continue
            distance += float(short @ short)
            for joint in range(len(posture)):
                moved = posture.copy()
                moved[joint] += _STEP_CLEAR
                slope = 2.0 * short @ (self._shortfall(moved) - short) / _STEP_CLEAR
                by_q[row, joint] += slope
        return position + speed + acceleration + distance, [by_q, by_dq, by_ddq]

    def _shortfall(self, posture: FloatArray) -> FloatArray:
        """(k,) shortfall of each pair's distance, over its scale; zero for those far apart."""
        collisions = self._allowed.collisions
        left = collisions.distances(posture) - collisions.needed_m() - 0.03
        # A shortfall of 0.1 m is as costly as exceeding a limit by its own size.
        return np.maximum(-left / 0.1, 0.0)


def _hinge(values: FloatArray, limits: FloatArray) -> tuple[float, FloatArray]:
    """Sum of squared relative excesses of (m, n) values over (n,) limits, with its gradient."""
    beyond = np.maximum(np.abs(values) / limits - 1.0, 0.0)
    return float(np.sum(beyond**2)), 2.0 * beyond * np.sign(values) / limits


def _chained(basis: tuple[FloatArray, ...], gradients: list[FloatArray]) -> FloatArray:
    """Gradient (n, k) over the free coefficients from that (m, n) over the states."""
    total = sum(values.T @ array for values, array in zip(basis, gradients, strict=True))
    return np.asarray(total).T


@dataclass(frozen=True)
class ExcitationRequest:
    """Options of the search for an exciting motion."""

    period_s: float = 20.0  # Duration of the motion [s].
    harmonics: int = 5  # Number of its harmonics.
    # The friction to be identified besides the inertias.
    terms: FrictionTerms = field(default_factory=FrictionTerms)
    starts: int = 4  # Number of random motions to start from.
    seed: int = 0  # Seed of these.
    steps: int = 80  # Greatest number of steps in each round of a descent.
    # Time limit [s of one core], at which the search ends once a motion is found.
    seconds: float = np.inf

    def __post_init__(self) -> None:
        if not SHORTEST_S <= self.period_s <= LONGEST_S:
            why = "is too short" if self.period_s < SHORTEST_S else "is too long"
            raise DataError(
                f"a motion of {self.period_s:g} s {why}; {SHORTEST_S:g} to {LONGEST_S:g} s is "
                "needed.",
                culprits=["--duration"],
            )
        if not FEWEST <= self.harmonics <= MOST:
            raise DataError(
                f"--harmonics is {self.harmonics}, but must be {FEWEST} to {MOST}.",
                culprits=["--harmonics"],
            )
        if not self.seconds >= 0.0 or min(self.starts, self.steps) < 1:
            raise DataError(
                f"a search has {self.seconds:g} s, {self.starts} starts and {self.steps} steps, "
                "but must have 0 s or more, a start and a step.",
                culprits=["--starts", "--seconds"],
            )


@dataclass(frozen=True, eq=False)
class Excitation:
    """An exciting motion."""

    request: ExcitationRequest  # The options of the search.
    base: BaseModel  # The parameters that it determines.
    # (n,) inverse of the joints' torque noise, taken to be proportional to their greatest torques;
    # ones where these are not known.
    weights: FloatArray
    series: Series  # The motion.
    condition: float  # Condition number of its regressor; see `condition_of`.
    random: float  # Median of those of random motions within the limits of joints and drives.
    extremes: MotionExtremes  # Its extremes, at a thousand samples a second.
    starts: int  # Number of descents made.


def excite(
    allowed: MotionLimits, request: ExcitationRequest, progress: Progress | None = None
) -> Excitation:
    """Searches for the motion that determines the base parameters best; raises DegenerateError."""
    with one_blas_thread():
        return _ExcitationSearch(allowed, request, progress).run()


class _ExcitationSearch:
    """Descents from random motions; the best result is kept."""

    def __init__(
        self, allowed: MotionLimits, request: ExcitationRequest, progress: Progress | None
    ) -> None:
        self._allowed, self._request, self._progress = allowed, request, progress
        self._begin = time.process_time()
        known = np.isfinite(allowed.torque).all()
        self._weights = 1.0 / allowed.torque if known else np.ones(len(allowed.torque))
        self._base = BaseModel.reduce(DynamicModel(allowed.robot, request.terms))
        self._harmonics = Harmonics(request.period_s, request.harmonics)
        self._objective = Objective(allowed, self._base, self._weights, self._harmonics)
        self._rng = np.random.default_rng(request.seed)
        self._best: tuple[float, Series, MotionExtremes] | None = None
        self._breaches: tuple[str, ...] = ()

    def run(self) -> Excitation:
        request, starts = self._request, 0
        while starts < request.starts and not self._is_over:
            motion = self._modest(self._posture())
            # A descent that begins inside a body may never come out of it.
            for _ in range(8):
                q = motion.sampled(10.0).q
                if (self._allowed.collisions.first_contact(q) < 0).all():
                    break
                motion = motion.shrunk(0.5)
            self._keep(self._descend(motion.free.ravel(), starts))
            starts += 1
        if self._best is None:
            raise DegenerateError(
                f"robot {self._allowed.robot.name}: no motion was found that keeps the limits; of "
                f"the last one tried, {some_of(self._breaches, 3)}.",
                culprits=self._breaches,
                next_step="Search from more starts (--starts), or leave the motion more room: "
                "--duration, --margin-deg, --clearance-mm, --floor.",
            )
        condition, series, kept = self._best
        drawn = [self._figures(self._modest(self._posture())) for _ in range(20)]
        result = (series, condition, float(np.median(drawn)), kept, starts)
        return Excitation(request, self._base, self._weights, *result)

    @property
    def _is_over(self) -> bool:
        """Whether the time limit is over; never before a motion is found."""
        taken_s = time.process_time() - self._begin
        return self._best is not None and taken_s > self._request.seconds

    def _descend(self, free: FloatArray, place: int) -> FloatArray:
        """Minimises the objective from start number `place`, round by round."""
        steps = len(_ROUNDS) * self._request.steps
        done = place * steps

        def report(_: FloatArray) -> None:
            nonlocal done
            done += 1
            if self._progress is not None:
                self._progress("excitation", done, self._request.starts * steps)
            if self._is_over:
                raise StopIteration

        for sharpness, price in _ROUNDS:
            if self._is_over:
                break
            found = minimize(
                self._objective.value,
                free,
                args=(sharpness, price),
                jac=True,
                method="BFGS",
                callback=report,
                options={"maxiter": self._request.steps},
            )
            free = found.x
        return free

    def _keep(self, free: FloatArray) -> None:
        """Keeps a motion if it is the best yet and within the limits, shrunk where needed."""
        series = self._objective.series(free)
        motion, middle = series.sampled(CHECK_HZ), series.coefficients[0]
        above, below = motion.q.max(axis=0) - middle, middle - motion.q.min(axis=0)
        with np.errstate(divide="ignore"):
            shares = [
                (self._allowed.upper - middle) / above,
                (middle - self._allowed.lower) / below,
                self._allowed.speed / np.abs(motion.dq).max(axis=0),
                self._allowed.acceleration / np.abs(motion.ddq).max(axis=0),
            ]
        series = series.shrunk(float(np.clip(np.min(shares), 0.0, 1.0)))
        for _ in range(5):
            condition = self._figures(series)
            if self._best is not None and condition >= self._best[0]:
                return
            kept = motion_extremes(self._allowed, series.sampled(CHECK_HZ))
            self._breaches = kept.breaches
            if not kept.breaches:
                self._best = condition, series, kept
                return
            series = series.shrunk(0.97)

    def _figures(self, series: Series) -> float:
        return condition_of(self._base, series.sampled(_FIGURES_HZ), self._weights)

    def _posture(self) -> FloatArray:
        """A random posture without collisions, (n,) [rad]."""
        allowed = self._allowed
        half = np.minimum(np.pi, allowed.half)
        contacts: Sequence[int] = ()
        drawn = self._rng.uniform(-half, half, (2000, len(half))) + allowed.middle
        for posture in drawn:
            contact = int(allowed.collisions.first_contact(posture[None])[0])
            if contact < 0:
                return np.asarray(posture)
            contacts = (*contacts, contact)
        names = allowed.collisions.names[int(np.bincount(contacts).argmax())]
        raise DegenerateError(
            f"robot {allowed.robot.name}: none of 2000 postures within the limits is clear; "
            f"{' and '.join(names)} are too near one another in most.",
            culprits=names,
            next_step="Look at --floor, --box and --clearance-mm, and at the base's frame.",
        )

    def _modest(self, posture: FloatArray) -> Series:
        """A random motion about a posture, well within the limits of joints and drives."""
        allowed, resting = self._allowed, self._harmonics.resting
        orders = np.arange(1.0, self._harmonics.count + 1.0)
        sizes = 1.0 / np.concatenate([[np.inf], orders, orders])
        free = self._rng.normal(size=(len(posture), len(sizes))) * sizes @ resting
        moved = Series(self._harmonics, free).sampled(_FIGURES_HZ)
        room = np.minimum(allowed.upper - posture, posture - allowed.lower)
        shares = [
            limit / np.abs(values).max(axis=0)
            for values, limit in (
                (moved.q, room),
                (moved.dq, allowed.speed),
                (moved.ddq, allowed.acceleration),
                (moved.q, np.full(len(posture), np.pi)),
            )
        ]
        scaled = 0.5 * np.min(shares, axis=0)[:, None] * free
        return Series(self._harmonics, scaled + np.outer(posture, resting[0]))
