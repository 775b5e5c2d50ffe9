"""The joint fit of corners, lenses, boards and frames: its unknowns, and its linearisation.

Each view's corners are compressed to its pose and to how that moves with its lens and its board;
the chains of frames are closed over all stops with what is left open of these. Linearising anew at
the answer, until it stays, is Gauss-Newton's method on the whole problem.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from visioncal.core.errors import ConvergenceError
from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.corners import floored_sigma_px
from visioncal.estimation.effects.lenses import LENSES, CameraParameters, LinearisedCorners
from visioncal.estimation.linalg import covariance_among
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, Noise, State
from visioncal.estimation.scene import lens_prior
from visioncal.estimation.solve import (
    Solution,
    covariance_of,
    fit_problem,
    fitted_covariance,
    normal_equations,
    robot_likelihood,
)
from visioncal.estimation.variance import PriorInformation

# Freeing unknowns must gain more than noise does in one session of ten thousand.
_FALSE_ALARM = 1e-4
# Values that move by less than this share of their sigma have settled.
_SETTLED, _ROUNDS = 0.02, 8
# A step after which corners fit worse by this factor is too long; so often is it halved.
_FOLLOWS, _HALVINGS = 2.0, 12
# What is stated is contradicted by so many standard deviations.
_CONTRADICTION = 3.0
# Errors of an arm's links are taken to be of one size; those few that a board's scale looks like
# may well be so much larger.
_UNEVEN = 2.0
# A motion with so little information on a size, beside what is stated, has none: it is rounding.
_UNMEASURED = 1e-6


class FrameModel(Protocol):
    """The frames' side of the fit: all that is no corner."""

    @property
    def noise(self) -> Noise | None:
        """Levels to start from; None for those from above."""

    @property
    def errors(self) -> tuple[ArmErrors, ...]:
        """The errors of arms that were found."""

    @property
    def has_links(self) -> bool:
        """Whether errors of an arm's links are free, which a board's scale may look like."""

    @property
    def has_errors(self) -> bool:
        """Whether errors of an arm are free at all."""

    def problem(self, seen: LinearisedCorners) -> Problem:
        """The problem of what the fit uses, with lenses and boards as its first effect."""

    def rows(self, seen: LinearisedCorners) -> IntArray:
        """(n,) which view each observation of this problem is; -1 for none of them."""


@dataclass(frozen=True, eq=False)
class ConvergedFit:
    """The fit at rest: the linearisation, the problem of all frames, and what came out."""

    linearised: LinearisedCorners
    problem: Problem
    fit: Solution
    # Those that were last asked for; see `Scores.of`.
    _scores: list[tuple[FrameModel, "Scores"]] = field(default_factory=list, init=False, repr=False)

    @property
    def columns(self) -> slice:
        """The columns of lenses and boards: the first effect's."""
        first = 6 * len(self.problem.unknown)
        return slice(first, first + len(self.linearised.free))

    @property
    def frames(self) -> Mapping[str, FloatArray]:
        """Where the unknown frames are."""
        return self.problem.frames(self.fit.state)

    @property
    def others(self) -> FloatArray:
        """(k,) the values of all other effects."""
        mine = self.problem.effect_columns.get(LENSES, self.columns)
        return self.fit.state.values[mine.stop - self.columns.start :]

    @property
    def change(self) -> FloatArray:
        """(f,) by how much the free values moved from where they were linearised."""
        free = self.linearised.free
        return np.asarray(
            self.fit.state.values[: len(free)] - self.linearised.camera_parameters.values[free]
        )

    @property
    def camera_parameters(self) -> CameraParameters:
        """Lenses and boards as they came out; what was held is where it was."""
        free = self.linearised.free
        return self.linearised.camera_parameters.with_values(
            free, self.fit.state.values[: len(free)]
        )

    def covariance(self) -> FloatArray:
        """(p, p) covariance of what the fit moves, where it was measured."""
        return fitted_covariance(self.problem, self.fit.state, self.fit.noise)

    @property
    def moving(self) -> IntArray:
        """Places of the values that the fit moves."""
        return self.linearised.moving


def fit_jointly(
    optics: CameraParameters,
    side: FrameModel,
    moving: IntArray,
    frames: Mapping[str, FloatArray],
    others: FloatArray | None = None,
    before: LinearisedCorners | None = None,
) -> ConvergedFit:
    """Linearises and fits in turn, until the values stay where they are.

    Args:
        optics: Corners, lenses and boards to start from.
        side: What is known of the frames.
        moving: Places of the values that the fit moves.
        frames: Where to start.
        others: The values of all other effects to start from; where they were linearised if None.
        before: Where corners were linearised before; see `CameraParameters.seen`.

    Raises:
        ConvergenceError: They run away: what the robot says has nothing to do with what is seen.
    """
    with diverging():
        return _settled(side, _fitted(side, optics.linearised(moving, before), frames, others))


@contextmanager
def diverging() -> Iterator[None]:
    """Says of what fails within that the fit diverges.

    Raises:
        ConvergenceError: Matrices were singular, or not finite.
    """
    try:
        # Numbers that run away overflow before they fail.
        with np.errstate(over="ignore", invalid="ignore"):
            yield
    except np.linalg.LinAlgError as error:
        raise ConvergenceError(
            "hand-eye: no frames explain both the robot's poses and what the camera saw: the fit "
            "runs away. The likeliest cause is poses of other views than the images.",
            culprits=["poses", "images"],
            next_step="Look at which image belongs to which pose; visioncal convert --guess tries "
            "other readings of the poses.",
        ) from error


def refit_jointly(
    fitted: ConvergedFit, side: FrameModel, moving: IntArray, optics: CameraParameters | None = None
) -> ConvergedFit:
    """Settles once more from an answer, with other values free, or by other priors."""
    return fit_jointly(
        optics or fitted.camera_parameters,
        side,
        moving,
        fitted.frames,
        fitted.others,
        before=fitted.linearised,
    )


def _settled(side: FrameModel, fitted: ConvergedFit) -> ConvergedFit:
    for _ in range(_ROUNDS):
        sigma = np.sqrt(np.diag(fitted.covariance())[fitted.columns])
        if np.all(np.abs(fitted.change) <= _SETTLED * sigma):
            break
        seen = _stepped(fitted)
        if seen is fitted.linearised:
            raise np.linalg.LinAlgError("the corners follow no part of the step")
        before, fitted = fitted, _fitted(side, seen, fitted.frames, fitted.others)
        if not (before.fit.settled or fitted.fit.settled):
            break
    return fitted


def _stepped(fitted: ConvergedFit) -> LinearisedCorners:
    """Linearises where the fit came to rest, or on the way there as far as the corners follow."""
    # Far from the answer, as where a lens was stated for images of another size, the whole step
    # leads to lenses that see nothing.
    limits = [_FOLLOWS * floored_sigma_px(sigma) for sigma in fitted.linearised.sigmas_px]
    optics, free, change = (
        fitted.linearised.camera_parameters,
        fitted.linearised.free,
        fitted.change,
    )
    for _ in range(_HALVINGS):
        there = optics.with_values(free, optics.values[free] + change)
        change = change / 2
        if there.has_lenses:
            seen = there.linearised(fitted.moving)
            if all(sigma <= limit for sigma, limit in zip(seen.sigmas_px, limits, strict=True)):
                return seen
    return fitted.linearised


def _fitted(
    side: FrameModel,
    seen: LinearisedCorners,
    frames: Mapping[str, FloatArray],
    others: FloatArray | None,
) -> ConvergedFit:
    problem = side.problem(seen)
    start = problem.start(frames)
    if others is not None:
        first = len(start.values) - len(others)
        start = State(start.edges, np.concatenate([start.values[:first], others]))
    return ConvergedFit(seen, problem, fit_problem(problem, start, side.noise))


@dataclass(frozen=True)
class MeasuredScale:
    """What the chain alone says of a board's scale, as if no size had been stated.

    Attributes:
        board: Which board.
        scale: By which share the board is larger than stated.
        sigma: Its standard deviation.
        stated_sigma: What the stated size is known to.
    """

    board: int
    scale: float
    sigma: float
    stated_sigma: float

    @property
    def is_another(self) -> bool:
        """Whether it differs from the stated one by more than chance."""
        return (self.scale / self.sigma) ** 2 > chance_limit(1)

    @property
    def contradicts(self) -> bool:
        """Whether it differs by more than both uncertainties explain."""
        return abs(self.scale) > _CONTRADICTION * float(np.hypot(self.sigma, self.stated_sigma))


def measured_scale(side: FrameModel, fitted: ConvergedFit, board: int = 0) -> MeasuredScale:
    """Measures a board's size by the robots' motion; its sigma is infinite where that cannot."""
    optics = fitted.linearised.camera_parameters
    (place,) = optics.scale_of(board)
    stated, known = optics.stated_scale_sigma(board), float(optics.prior_sigma[place] ** -2.0)
    step, covariance = Scores.of(side, fitted).asked_for(np.array([place]), fitted.moving)
    # What was stated is taken away again: without it the rest may leave the size open.
    measured = 1.0 / float(covariance[0, 0]) - known
    if measured <= _UNMEASURED * known:
        return MeasuredScale(board, 0.0, np.inf, stated)
    with_stated = float(fitted.camera_parameters.values[place] + step[0])
    return MeasuredScale(
        board,
        with_stated * (1.0 + known / measured),
        (_UNEVEN if side.has_links else 1.0) * measured**-0.5,
        stated,
    )


def measured_rig(side: FrameModel, fitted: ConvergedFit, frame: str, rig: int) -> MeasuredScale:
    """Measures the size of a rig of points by the robots' motion; its table is taken for exact.

    A larger rig farther away looks the same: its views alone say nothing of that.

    Args:
        side: The frames' side of the fit.
        fitted: The fit.
        frame: The rig's.
        rig: Which target it is.
    """
    problem, state = fitted.problem, fitted.fit.state
    problem = problem.with_effects([*problem.effects, target_sizes(problem, [frame])])
    there = State(state.edges, np.append(state.values, 0.0))
    information, gradient = normal_equations(problem, there, fitted.fit.noise)
    covariance = covariance_among(information, problem.moving)
    sigma = (_UNEVEN if side.has_links else 1.0) * float(covariance[-1, -1] ** 0.5)
    return MeasuredScale(rig, -float(covariance[-1] @ gradient), sigma, 0.0)


def rig_by_stated_arms(
    fitted: ConvergedFit, stated: Problem, frame: str, rig: int
) -> MeasuredScale | None:
    """Measures the size of a rig by arms as they are stated; see `measured_rig`.

    Longer links explain a larger rig as well: one size is simpler than many links.

    Args:
        fitted: The fit, with arms that were calibrated.
        stated: The same observations, with arms as stated.
        frame: The rig's.
        rig: Which target it is.

    Returns:
        Its size; None where arms that err are likelier.
    """
    sized = stated.with_effects([*stated.effects, target_sizes(stated, [frame])])
    fit = fit_problem(sized, State(fitted.fit.state.edges, sized.start_values))

    def unlikely(problem: Problem, at: Solution) -> float:
        return robot_likelihood(problem, at.state, at.noise).white[1]

    if unlikely(sized, fit) > unlikely(fitted.problem, fitted.fit):
        return None
    sigma = float(covariance_of(sized, fit)[-1, -1] ** 0.5)
    return MeasuredScale(rig, float(fit.state.values[-1]), sigma, 0.0)


def target_sizes(problem: Problem, frames: Sequence[str], sigma: float = np.inf) -> Effect:
    """The sizes of targets as unknowns, which move all that is seen of each towards the camera.

    Args:
        problem: The observations.
        frames: The targets' k frames.
        sigma: What each size is known to, as a share of itself.
    """
    # A target that was moved has a frame for each place where it was.
    observed = np.array([name.partition("@")[0] for name in problem.observations.observed])
    poses = problem.observations.measured
    by_size = np.zeros((len(observed), 6, len(frames)))
    by_size[:, 3:] = np.swapaxes(poses[:, :3, :3], 1, 2) @ poses[:, :3, 3:]
    by_size *= (observed[:, None] == np.array(frames))[:, None]
    known = PriorInformation(sigma**-2.0 * np.eye(len(frames)), np.zeros(len(frames)))
    return Effect.free("sizes of targets", known, by_size)


def moved_mahalanobis_sq(fitted: ConvergedFit, places: IntArray) -> float:
    """Squared distance of some values from the stated ones, in units of their covariance.

    Args:
        fitted: A fit that moves these values among others.
        places: (k,) where they stand among the values.
    """
    at = fitted.columns.start + np.searchsorted(fitted.linearised.free, places)
    away = (fitted.camera_parameters.values - fitted.camera_parameters.stated)[places]
    return float(away @ np.linalg.solve(fitted.covariance()[np.ix_(at, at)], away))


def contradicted_lens(fitted: ConvergedFit, camera: str) -> bool:
    """Whether given intrinsics are farther off than what they are known to explains."""
    optics = fitted.camera_parameters
    away = (optics.values - optics.stated)[optics.lenses[camera]]
    return contradicts(away, lens_prior(optics.problems[camera].scene))


def contradicts(away: FloatArray, prior_sigma: FloatArray) -> bool:
    """Whether (k,) values are farther from the stated ones than what is known of them explains."""
    return bool(np.any(np.abs(away) > _CONTRADICTION * prior_sigma))


def chance_limit(freedom: int) -> float:
    """What a squared error may fall by chance when so many more values are free (chi-square)."""
    return float(chi2_limit(_FALSE_ALARM, freedom))


@dataclass(frozen=True, eq=False)
class Scores:
    """What the data ask of values that a fit holds (Rao's score test).

    Attributes:
        information: (p, p) with all values free.
        gradient: (p,) of half the squared error, at the fit.
        moving: (p,) which columns a fit moves.
        columns: Those of lenses and boards.
        places: Which values these are of.
    """

    information: FloatArray
    gradient: FloatArray
    moving: Mask
    columns: slice
    places: IntArray

    @classmethod
    def of(cls, side: FrameModel, fitted: ConvergedFit) -> "Scores":
        """The scores of all values, at a fit."""
        for asked, found in fitted._scores:
            if asked is side:
                return found
        seen = fitted.linearised.freed(np.arange(len(fitted.linearised.camera_parameters.values)))
        values = fitted.fit.state.values[len(fitted.linearised.free) :]
        values = np.concatenate([fitted.camera_parameters.values, values])
        problem, there = side.problem(seen), State(fitted.fit.state.edges, values)
        first = fitted.columns.start
        found = cls(
            *normal_equations(problem, there, fitted.fit.noise),
            problem.moving,
            slice(first, first + len(seen.free)),
            seen.free,
        )
        fitted._scores[:] = [(side, found)]
        return found

    def gain(self, moving: IntArray) -> float:
        """How much the squared error falls when these values are free (Rao's score test)."""
        among = self.moving.copy()
        among[self.columns] = np.isin(self.places, moving)
        return float(self.gradient @ covariance_among(self.information, among) @ self.gradient)

    def asked_for(self, places: IntArray, moving: IntArray) -> tuple[FloatArray, FloatArray]:
        """By how much (k,) held values would move if they were free, and its (k, k) covariance.

        Args:
            places: Which values.
            moving: Those that are free beside them.
        """
        among = self.moving.copy()
        among[self.columns] = np.isin(self.places, np.union1d(moving, places))
        covariance = covariance_among(self.information, among)
        at = self.columns.start + np.searchsorted(self.places, places)
        return -covariance[at] @ self.gradient, covariance[np.ix_(at, at)]
