"""Exciting motions: those that determine an arm's base parameters best, and their objective.

Swevers, Verdonck and De Schutter (2007, Dynamic model identification for industrial robots): the
coefficients of finite Fourier series are optimised for the condition of the regressor, within the
limits of joints, drives and cell. Here the condition is made smooth, and sharper from round to
round; descents start from random motions, and the best one is kept that a look at a thousand
samples a second finds within all limits. The same request gives the same motion, on a slow computer
too, unless it limits the time.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import some_of
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, Progress
from visioncal.dynamics.base import BaseModel, Condition, condition_of, smooth_condition
from visioncal.dynamics.fourier import Harmonics, Series
from visioncal.dynamics.limits import CHECK_HZ, Allowed, Kept, kept_limits
from visioncal.dynamics.model import DynamicModel, FrictionTerms
from visioncal.dynamics.motion import JointMotion

# How long a motion may be [s], and of how many harmonics: fewer cannot determine the parameters of
# six joints, more have speeds that shake the arm.
SHORTEST_S, LONGEST_S = 10.0, 30.0
FEWEST, MOST = 3, 10
# Sharpness of the condition and price of breaches, round by round.
_ROUNDS = ((1.0, 10.0), (4.0, 80.0), (15.0, 640.0))
# Random motions use this share of the limits, and start from one of so many random postures.
_MODEST, _POSTURES = 0.5, 2000
# They are halved so many times, at most, until they are clear of everything: a descent that begins
# within a body may never come out of it.
_HALVINGS, _CLEAR_HZ = 8, 10.0
# A motion that breaks a limit is made smaller by this, so many times, before it is given up.
_SMALLER, _TRIES = 0.97, 5
# Figures do not change with more samples than these.
_FIGURES_HZ = 100.0
# Random motions whose condition is reported for comparison.
_COMPARED = 20
# Broken limits that a message names.
_NAMED = 3

# Samples for each of the highest harmonic's periods: torques hold products of few of them. Limits
# and distances are looked at more often.
_SAMPLES, _LOOKS = 10, 3
# Dry friction is spread over this share of the greatest speed: else its sense jumps at a sample.
_SPREAD = 0.03
# Steps of the derivatives [rad and its rates]: far above rounding, and the regressor bends little.
_STEP, _STEP_CLEAR = 1e-6, 1e-5
# Peaks lie between samples: limits end earlier by this share, distances by this [m].
_EARLIER, _BUFFER_M = 0.03, 0.03
# A distance that lacks this much costs as much as a limit that is exceeded by its own size [m].
_SHORT_M = 0.1


class Objective:
    """The criterion of a motion and its derivatives, by the free numbers of its series.

    Attributes:
        harmonics: What the motion is made of.
    """

    def __init__(
        self, allowed: Allowed, base: BaseModel, weights: FloatArray, harmonics: Harmonics
    ) -> None:
        """Prepares the samples.

        Args:
            allowed: What the motion must keep.
            base: The parameters that it is to determine.
            weights: (n,) inverse of each joint's torque noise.
            harmonics: What it is made of.
        """
        self.harmonics = harmonics
        self._allowed, self._weights = allowed, weights
        terms = replace(base.model.terms, slow_rad_s=_SPREAD * float(allowed.speed.max()))
        self._base = replace(base, model=DynamicModel(base.model.robot, terms))
        count = _SAMPLES * harmonics.count
        # Between the ends, at which speeds are zero and have no sense.
        self._times = (np.arange(count) + 0.5) * harmonics.period_s / count
        self._basis = harmonics.basis(self._times)
        looks = (np.arange(_LOOKS * count) + 0.5) * harmonics.period_s / (_LOOKS * count)
        self._looks = harmonics.basis(looks)
        self._nominal = None
        if allowed.inertias is not None:
            standard = np.zeros(len(base.model.names))
            standard[: allowed.inertias.values.size] = allowed.inertias.values.ravel()
            self._nominal = base.of(standard)

    def series(self, free: FloatArray) -> Series:
        """The motion of (k,) free numbers."""
        return Series(self.harmonics, free.reshape(self._allowed.robot.joint_count, -1))

    def value(self, free: FloatArray, sharpness: float, price: float) -> tuple[float, FloatArray]:
        """The criterion.

        Args:
            free: (k,) free numbers of all joints.
            sharpness: Of `smooth_condition`.
            price: Of what is beyond the limits.

        Returns:
            The value, and its derivatives (k,).
        """
        numbers = self.series(free).free
        value, by_value = self._condition(numbers, sharpness, price)
        lost, by_lost = self._beyond(numbers)
        jacobian = _back(self._basis, by_value) + price * _back(self._looks, by_lost)
        return value + price * lost, jacobian.ravel()

    def _condition(
        self, numbers: FloatArray, sharpness: float, price: float
    ) -> tuple[float, list[FloatArray]]:
        """Condition and torques, with derivatives (m, n) by positions, speeds, accelerations."""
        states = [array @ numbers.T for array in self._basis]
        rows, jacobian = self._regressors(states)
        weighted = (rows * self._weights[:, None]).reshape(-1, rows.shape[2])
        value, by_weighted = smooth_condition(weighted, sharpness)
        by_rows = by_weighted.reshape(rows.shape) * self._weights[:, None]
        if self._nominal is not None:
            lost, by_torque = _hinge(rows @ self._nominal, self._allowed.torque)
            # As dear as the limits that are looked at more often.
            value += price * _LOOKS * lost
            by_rows = by_rows + price * _LOOKS * by_torque[:, :, None] * self._nominal
        by_states = np.einsum("kmjp,mjp->mk", jacobian, by_rows, optimize=True)
        return value, np.split(by_states, len(states), axis=1)

    def _regressors(self, states: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Rows (m, n, b), and their derivatives (3 n, m, n, b) by the numbers of the states."""
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

    def _beyond(self, numbers: FloatArray) -> tuple[float, list[FloatArray]]:
        """What is beyond limits and distances, with derivatives (m, n)."""
        allowed, less = self._allowed, 1.0 - _EARLIER
        q, dq, ddq = (look @ numbers.T for look in self._looks)
        position, by_q = _hinge(q - allowed.middle, less * allowed.half)
        speed, by_dq = _hinge(dq, less * allowed.speed)
        hard, by_ddq = _hinge(ddq, less * allowed.acceleration)
        near, by_near = self._near(q)
        return position + speed + hard + near, [by_q + by_near, by_dq, by_ddq]

    def _near(self, q: FloatArray) -> tuple[float, FloatArray]:
        """What the distances fall short, squared, with derivatives (m, n) by the positions."""
        value, jacobian = 0.0, np.zeros_like(q)
        for row, posture in enumerate(q):
            short = self._shortfall(posture)
            if not short.any():
                continue
            value += float(short @ short)
            for joint in range(len(posture)):
                moved = posture.copy()
                moved[joint] += _STEP_CLEAR
                jacobian[row, joint] = 2.0 * short @ (self._shortfall(moved) - short) / _STEP_CLEAR
        return value, jacobian

    def _shortfall(self, posture: FloatArray) -> FloatArray:
        """(k,) how much each pair's distance lacks, in its unit; zero for those far apart."""
        collisions = self._allowed.collisions
        left = collisions.distances(posture) - collisions.needed_m() - _BUFFER_M
        return np.maximum(-left / _SHORT_M, 0.0)


def _hinge(values: FloatArray, limits: FloatArray) -> tuple[float, FloatArray]:
    """Squares of what (m, n) values exceed (n,) limits by, as shares of these; derivatives."""
    beyond = np.maximum(np.abs(values) / limits - 1.0, 0.0)
    return float(np.sum(beyond**2)), 2.0 * beyond * np.sign(values) / limits


def _back(basis: tuple[FloatArray, ...], jacobian: list[FloatArray]) -> FloatArray:
    """(n, k) derivatives by the free numbers, of those (m, n) by the states."""
    found = sum(values.T @ array for values, array in zip(basis, jacobian, strict=True))
    return np.asarray(found).T


@dataclass(frozen=True)
class ExcitationRequest:
    """What motion is wished.

    Attributes:
        period_s: How long it lasts [s].
        harmonics: How many harmonics of that period it has.
        terms: The friction to be identified besides the inertias.
        starts: How many random motions the search starts from.
        seed: Of these.
        steps: The most of each round of a descent.
        seconds: A limit of the search [s of one core's time], at which no more descents are begun
            and the last one is ended, once a motion is found.
    """

    period_s: float = 20.0
    harmonics: int = 5
    terms: FrictionTerms = field(default_factory=FrictionTerms)
    starts: int = 4
    seed: int = 0
    steps: int = 80
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
                f"a motion of {self.harmonics} harmonics is wished; {FEWEST} to {MOST} is needed.",
                culprits=["--harmonics"],
            )
        if not self.seconds >= 0.0 or min(self.starts, self.steps) < 1:
            raise DataError(
                f"a search of {self.seconds:g} s from {self.starts} starts with {self.steps} steps "
                "is wished; 0 s or more, a start and a step are needed.",
                culprits=["--starts", "--seconds"],
            )


@dataclass(frozen=True, eq=False)
class Excitation:
    """An exciting motion.

    Attributes:
        request: What was wished.
        base: The parameters that it determines.
        weights: (n,) inverse of the joints' torque noise: the share that they have of the greatest
            torque, or one each where that is not known.
        series: The motion.
        condition: Of its regressor.
        random: The median of random motions within the limits of joints and drives.
        kept: What it uses of the limits, at a thousand samples a second.
        starts: How many descents were made.
        seconds: How long the search took [s of one core's time].
    """

    request: ExcitationRequest
    base: BaseModel
    weights: FloatArray
    series: Series
    condition: Condition
    random: Condition
    kept: Kept
    starts: int
    seconds: float


def excite(
    allowed: Allowed, request: ExcitationRequest, progress: Progress | None = None
) -> Excitation:
    """Searches for the motion that determines the base parameters best.

    Args:
        allowed: What it must keep.
        request: What is wished.
        progress: Called as the search goes on.

    Returns:
        The best motion found that keeps all limits.

    Raises:
        DegenerateError: No motion was found that does.
    """
    with one_blas_thread():
        return _ExcitationSearch(allowed, request, progress).run()


class _ExcitationSearch:
    """Descents from random motions, and the best of their ends."""

    def __init__(
        self, allowed: Allowed, request: ExcitationRequest, progress: Progress | None
    ) -> None:
        self._allowed, self._request, self._progress = allowed, request, progress
        self._begin = time.process_time()
        known = np.isfinite(allowed.torque).all()
        self._weights = 1.0 / allowed.torque if known else np.ones(len(allowed.torque))
        self._base = BaseModel.reduce(DynamicModel(allowed.robot, request.terms))
        self._harmonics = Harmonics(request.period_s, request.harmonics)
        self._objective = Objective(allowed, self._base, self._weights, self._harmonics)
        self._rng = np.random.default_rng(request.seed)
        self._best: tuple[Condition, Series, Kept] | None = None
        self._breaches: tuple[str, ...] = ()

    def run(self) -> Excitation:
        request, starts = self._request, 0
        while starts < request.starts and not self._is_over:
            self._keep(self._descend(self._start(), starts))
            starts += 1
        if self._best is None:
            raise DegenerateError(
                f"robot {self._allowed.robot.name}: no motion was found that keeps the limits; of "
                f"the last one tried, {some_of(self._breaches, _NAMED)}.",
                culprits=self._breaches,
                next_step="Search from more starts (--starts), or leave the motion more room: "
                "--duration, --margin-deg, --clearance-mm, --floor.",
            )
        condition, series, kept = self._best
        found = (series, condition, self._random(), kept, starts)
        return Excitation(
            request, self._base, self._weights, *found, time.process_time() - self._begin
        )

    @property
    def _is_over(self) -> bool:
        """Whether the time is up; never before a motion is found."""
        taken_s = time.process_time() - self._begin
        return self._best is not None and taken_s > self._request.seconds

    def _descend(self, free: FloatArray, place: int) -> FloatArray:
        """Goes down from the start at `place`, round by round, until the time is up."""
        steps = len(_ROUNDS) * self._request.steps
        done = place * steps

        def look(_: FloatArray) -> None:
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
                callback=look,
                options={"maxiter": self._request.steps},
            )
            free = found.x
        return free

    def _keep(self, free: FloatArray) -> None:
        """Takes a motion for the best one if it is, and keeps the limits or can be made to."""
        series = _within(self._allowed, self._objective.series(free))
        for _ in range(_TRIES):
            condition = self._figures(series)
            if self._best is not None and condition.weighted >= self._best[0].weighted:
                return
            kept = kept_limits(self._allowed, series.sampled(CHECK_HZ))
            self._breaches = kept.breaches
            if not kept.breaches:
                self._best = condition, series, kept
                return
            series = series.shrunk(_SMALLER)

    def _figures(self, series: Series) -> Condition:
        return condition_of(self._base, series.sampled(_FIGURES_HZ), self._weights)

    def _start(self) -> FloatArray:
        """A random motion (k,) that is clear of everything, or nearly at rest."""
        motion = self._modest(self._posture())
        for _ in range(_HALVINGS):
            way = motion.sampled(_CLEAR_HZ).q
            if (self._allowed.collisions.first_contact(way) < 0).all():
                break
            motion = motion.shrunk(0.5)
        return motion.free.ravel()

    def _posture(self) -> FloatArray:
        """A random posture that is clear of everything (n,) [rad]."""
        allowed = self._allowed
        turn = np.minimum(np.pi, allowed.half)
        seen: Sequence[int] = ()
        drawn = self._rng.uniform(-turn, turn, (_POSTURES, len(turn))) + allowed.middle
        for posture in drawn:
            contact = int(allowed.collisions.first_contact(posture[None])[0])
            if contact < 0:
                return np.asarray(posture)
            seen = (*seen, contact)
        names = allowed.collisions.names[int(np.bincount(seen).argmax())]
        raise DegenerateError(
            f"robot {allowed.robot.name}: none of {_POSTURES} postures within the limits is clear; "
            f"{' and '.join(names)} are too near one another in most.",
            culprits=names,
            next_step="Look at --floor, --box and --clearance-mm, and at the base's frame.",
        )

    def _modest(self, posture: FloatArray) -> Series:
        """A random motion from a posture, well within the limits of joints and drives."""
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
        scaled = _MODEST * np.min(shares, axis=0)[:, None] * free
        return Series(self._harmonics, scaled + np.outer(posture, resting[0]))

    def _random(self) -> Condition:
        """The median condition of random motions, which nobody optimised."""
        drawn = [self._figures(self._modest(self._posture())) for _ in range(_COMPARED)]
        figures = np.median(
            [(condition.weighted, condition.scaled, condition.raw) for condition in drawn], axis=0
        )
        return Condition(*figures.tolist())


def _within(allowed: Allowed, series: Series) -> Series:
    """Makes a motion smaller until it keeps the limits of joints' ranges, speeds, accelerations."""
    motion, middle = series.sampled(CHECK_HZ), series.coefficients[0]
    far, low = motion.q.max(axis=0) - middle, middle - motion.q.min(axis=0)
    with np.errstate(divide="ignore"):
        shares = [
            (allowed.upper - middle) / far,
            (middle - allowed.lower) / low,
            allowed.speed / np.abs(motion.dq).max(axis=0),
            allowed.acceleration / np.abs(motion.ddq).max(axis=0),
        ]
    return series.shrunk(float(np.clip(np.min(shares), 0.0, 1.0)))
