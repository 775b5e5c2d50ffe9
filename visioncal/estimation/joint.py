"""Joint bundle adjustment of lenses, boards and frames.

The corners of each view are compressed to its pose and the Jacobian of that by lens and board
parameters; the closure of the frame chains over all stops is fitted with the free ones of these.
Relinearising at the solution until convergence is Gauss-Newton's method on the whole problem.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from visioncal.core.errors import ConvergenceError
from visioncal.core.limits import CONTRADICTION
from visioncal.core.linalg import ROUNDING, covariance_from
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.types import FloatArray, IntArray, Target
from visioncal.estimation.effects.lenses import LENSES, CameraParameters, LinearisedCorners
from visioncal.estimation.fit import Fit
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, Noise, State, by_size
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.solve import covariance_of, fit_problem, repeated_share
from visioncal.estimation.unknowns import BOARD, LENS, SIZE
from visioncal.vision.board_shape import SCALE, stated_board_sigma
from visioncal.vision.boards.kind import DEFAULT_RELATIVE_SIGMA
from visioncal.vision.corners import floored_sigma_px

# Values that change by less than this share of their sigma have converged.
_SETTLED = 0.02
# Largest share of a step that the next one is taken to repeat: it bounds extrapolation.
_MOST_SHARE = 0.75
# Most linearisations: a lens of another model leaves residuals beside which steps shrink by a
# fifth each.
_ROUNDS = 40
# A step is halved while it increases the corner residuals by this factor.
FOLLOWS = 2.0
# The prior assumes arm link errors of equal size; the few that mimic a board's scale may be larger
# by this factor.
UNEVEN_LINKS = 2.0
# Source of uncertainty: a board that a fit takes for far from stated, where the arm may be, too.
BOARD_OR_ARM = "board or arm"


class FrameModel(Protocol):
    """Frame part of the joint fit: everything but the corners."""

    @property
    def noise(self) -> Noise | None:
        """Initial noise levels; None for `starting_noise`."""

    @property
    def has_links(self) -> bool:
        """Whether arm link errors are free, which are correlated with a board's scale."""

    def problem(self, seen: LinearisedCorners) -> Problem:
        """Builds the problem of the used observations, with lenses and boards as first effect."""


def fit_jointly(
    optics: CameraParameters,
    model: FrameModel,
    frames: Mapping[str, FloatArray],
    others: FloatArray | None = None,
) -> Fit:
    """Alternates linearisation of the corners and the frame fit until the values converge.

    It starts at given parameters, (4, 4) poses of the frames, and (k,) values of all other effects
    (their linearisation point if None).

    Raises:
        ConvergenceError: The fit diverges: the robot's poses do not belong to the images.
    """
    with diverging():
        fitted = _fitted(model, optics.linearised(), frames, others, model.noise)
        last = np.zeros(len(fitted.linearised.free))
        for _ in range(_ROUNDS):
            sigma = np.sqrt(np.diag(fitted.absorbed)[fitted.lens_columns])
            change = _change(fitted)
            if np.all(np.abs(change) <= _SETTLED * sigma):
                break
            # Beside large residuals, steps shrink slowly: extrapolated.
            step = change / np.where(sigma > 0.0, sigma, np.inf)
            share, last = repeated_share(step, last, _MOST_SHARE)
            corners = _stepped(fitted, 1.0 / (1.0 - share))
            if corners is fitted.linearised:
                raise np.linalg.LinAlgError("the corners follow no part of the step")
            previous = fitted
            fitted = _fitted(model, corners, fitted.frames, others_of(fitted), fitted.noise)
            if not (previous.solution.settled or fitted.solution.settled):
                break
        return fitted


@contextmanager
def diverging() -> Iterator[None]:
    """Reports matrices that are singular or not finite as divergence of the fit."""
    try:
        # Diverging values overflow before linear algebra fails.
        with np.errstate(over="ignore", invalid="ignore"):
            yield
    except np.linalg.LinAlgError as error:
        raise ConvergenceError(
            "hand-eye: the fit diverges: no frames explain both the robot's poses and what the "
            "cameras saw. Likely causes are poses of other views than the images, or a lens or a "
            "board that is not the stated one.",
            culprits=["poses", "images"],
            next_step="Look at which image belongs to which pose (visioncal convert --guess tries "
            "other readings of the poses), and calibrate each camera alone.",
        ) from error


def others_of(fitted: Fit) -> FloatArray:
    """(k,) values of all effects but lenses and boards."""
    first = fitted.lens_columns.start
    lens_columns = fitted.problem.effect_columns.get(LENSES, slice(first, first))
    return fitted.state.values[lens_columns.stop - first :]


def _change(fitted: Fit) -> FloatArray:
    """(f,) change of the free values of lenses and boards from the linearisation point."""
    seen = fitted.linearised
    return fitted.state.values[: len(seen.free)] - seen.camera_parameters.values[seen.free]


def _stepped(fitted: Fit, factor: float) -> LinearisedCorners:
    """Linearises the corners after a step's multiple, or a shorter step if they fit worse."""
    # Far from the solution, as with a lens stated for another image size, the full step leads to
    # lenses that image nothing.
    limits = [FOLLOWS * floored_sigma_px(sigma) for sigma in fitted.linearised.sigmas_px]
    optics, free = fitted.linearised.camera_parameters, fitted.linearised.free
    change = factor * _change(fitted)
    for _ in range(12):
        candidate = optics.with_values(free, optics.values[free] + change)
        change = change / 2
        # Focal lengths are positive.
        lenses = (candidate.parts[LENS, name] for name in candidate.problems)
        if all(candidate.values[at][:2].min() > 0.0 for at in lenses):
            corners = candidate.linearised()
            if all(sigma <= limit for sigma, limit in zip(corners.sigmas_px, limits, strict=True)):
                return corners
    return fitted.linearised


def _fitted(
    model: FrameModel,
    corners: LinearisedCorners,
    frames: Mapping[str, FloatArray],
    others: FloatArray | None,
    noise: Noise | None,
) -> Fit:
    problem = model.problem(corners)
    start = problem.start(frames)
    if others is not None:
        first = len(start.values) - len(others)
        start = State(start.edges, np.concatenate([start.values[:first], others]))
    problem = problem.sized_at(start)
    return Fit(problem, fit_problem(problem, start, noise), corners)


@dataclass(frozen=True)
class MeasuredScale:
    """Scale of a board (or rig) measured by the chain alone, without the prior of its size."""

    scale: float  # Relative deviation from the stated size, positive if larger.
    sigma: float  # Its standard deviation.
    stated_sigma: float  # Relative standard deviation of the stated size.

    @property
    def is_another(self) -> bool:
        """Whether it differs significantly from the stated size, taken as exact."""
        return bool((self.scale / self.sigma) ** 2 > chi2_limit(FALSE_ALARM, 1))

    @property
    def contradicts(self) -> bool:
        """Whether it differs by more than both uncertainties combined explain."""
        return abs(self.scale) > CONTRADICTION * float(np.hypot(self.sigma, self.stated_sigma))

    @property
    def leaves_stated(self) -> bool:
        """Whether a result with it goes far from what is stated, as one that takes it for wrong."""
        return abs(self.scale) > CONTRADICTION * max(self.sigma, self.stated_sigma)


def estimated_scale(fitted: Fit, name: str, target: Target) -> MeasuredScale | None:
    """Scale of a board in a fit, by its name in the session; None where the fit does not move it.

    The sigma is without `BOARD_OR_ARM`.
    """
    board = BOARD, name
    if target.is_rig or SCALE not in fitted.unknowns.values_of(board, moved=True):
        return None
    other_sources = {
        source: part for source, part in fitted.by_source.items() if source != BOARD_OR_ARM
    }
    sigma = float(replace(fitted, by_source=other_sources).sigmas(board)[SCALE])
    stated = float(stated_board_sigma(target)[SCALE])
    return MeasuredScale(float(fitted.values(board)[SCALE]), sigma, stated)


def between_boards_and_arm(fitted: Fit, targets: Mapping[str, Target]) -> FloatArray:
    """(p, p) covariance of a fit with boards far from stated, which an arm's lengths may be, too.

    An arm that is longer by a share looks like a board that is larger, and neither is known to be
    right: the fit with the board as stated is as good. `targets` are by their names in the session.
    """
    total = np.zeros((fitted.problem.size,) * 2)
    for name, target in targets.items():
        scale, board = estimated_scale(fitted, name, target), (BOARD, name)
        if scale is not None and scale.leaves_stated:
            columns = fitted.unknowns.columns(board)
            (at,) = columns[fitted.unknowns.values_of(board) == SCALE]
            step = scale.scale * fitted.by_noise[:, at] / fitted.by_noise[at, at]
            total += np.outer(step, step)
    return total


def measured_scale(
    model: FrameModel, fitted: Fit, frame: str, name: str, target: Target
) -> MeasuredScale:
    """Measures the scale of a target by the robots' motion, without the prior of its size.

    Its views alone cannot determine it: a larger target farther away looks the same. `name` is that
    of the target in the session, and `frame` its frame.
    """
    widened = fitted.with_columns(target_sizes(fitted.problem, {frame: np.inf}))
    widened = replace(widened, problem=widened.problem.sized_at(widened.state))
    covariance, (_, gradient) = widened.absorbed, widened.equations
    board, total, scale, stated = (BOARD, name), np.zeros(len(gradient)), 0.0, 0.0
    total[-1] = 1.0
    if not target.is_rig and SCALE in fitted.unknowns.values_of(board):
        scale = float(fitted.values(board)[SCALE])
        stated = float(stated_board_sigma(target)[SCALE])
        total[fitted.unknowns[board].start] = 1.0
    scale -= float(total @ covariance @ gradient)
    sigma = float(total @ covariance @ total) ** 0.5
    return MeasuredScale(scale, (UNEVEN_LINKS if model.has_links else 1.0) * sigma, stated)


def size_of_measured(model: FrameModel, fitted: Fit) -> MeasuredScale | None:
    """Size of the first target whose poses a program measured; None where it is no unknown."""
    for effect in fitted.problem.effects:
        if effect.name == SIZE:
            scale, total = fitted.values((SIZE, ""))[0], fitted.sigmas((SIZE, ""))[0] ** -2.0
            by_motion = float(total - effect.prior.information[0, 0])
            if 2.0 * by_motion < total:
                # Beside errors that last, the motion says less than the prior.
                return MeasuredScale(0.0, np.inf, DEFAULT_RELATIVE_SIGMA)
            sigma = (UNEVEN_LINKS if model.has_links else 1.0) * by_motion**-0.5
            return MeasuredScale(float(scale * total) / by_motion, sigma, DEFAULT_RELATIVE_SIGMA)
    return None


def scale_by_stated_arms(fitted: Fit, stated: Problem, frame: str) -> MeasuredScale | None:
    """Measures the scale of an exact target with nominal arms; None where errors are likelier.

    Longer links explain a larger target as well, but one scale is simpler than many link errors.
    """
    widened = stated.with_effects([*stated.effects, target_sizes(stated, {frame: np.inf})])
    fit = fit_problem(widened, State(fitted.state.edges, widened.start_values))
    pairs = ((fitted.problem, fitted.solution), (widened, fit))
    calibrated, sized = (robot_likelihood(at, by.state, by.noise).white[1] for at, by in pairs)
    if sized > calibrated:
        return None
    sigma = float(covariance_of(widened, fit)[-1, -1] ** 0.5)
    return MeasuredScale(float(fit.state.values[-1]), sigma, 0.0)


def target_sizes(problem: Problem, sigmas: Mapping[str, float]) -> Effect:
    """Effect of targets' scales, which change their measured distances, with sigmas by frame."""
    # A target that was moved has a frame for each of its locations, named with a suffix.
    observed = np.array([name.partition("@")[0] for name in problem.observations.observed])
    of_frames = (observed[:, None] == np.array([*sigmas]))[:, None]
    jacobian = by_size(problem.observations.measured)[:, :, None] * of_frames
    information = np.diag(np.array([*sigmas.values()]) ** -2.0)
    prior = PriorInformation(information, np.zeros(len(sigmas)))
    effect = Effect.free(SIZE, prior, jacobian)
    return replace(effect, sizes=np.arange(len(sigmas)))


def moved_mahalanobis_sq(fitted: Fit, columns: IntArray) -> float:
    """Squared Mahalanobis distance of lens and board values, of (k,) columns, from the stated."""
    optics = fitted.camera_parameters
    places = fitted.linearised.free[columns - fitted.lens_columns.start]
    # The prior of these values given the others draws them towards the stated ones.
    prior = optics.prior_information[np.ix_(places, places)]
    information = covariance_from(fitted.absorbed[np.ix_(columns, columns)])
    offset = information @ (optics.values - optics.stated)[places]
    values, vectors = np.linalg.eigh(information - prior)
    kept = values > ROUNDING * np.diag(information).max()
    return float(np.sum((offset @ vectors[:, kept]) ** 2 / values[kept]))
