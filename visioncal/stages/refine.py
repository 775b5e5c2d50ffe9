"""Stage 6: what all views share besides the edges: the lens, and the board as it really is."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.estimation.appearance import (
    Appearance,
    Compressed,
    Free,
    boards_basis,
    compress,
)
from visioncal.estimation.arm import ArmErrors, find_arm_errors
from visioncal.estimation.corners import CornerStack, floored_sigma_px
from visioncal.estimation.joint import (
    Arm,
    CornerProblem,
    Fitted,
    MeasuredScale,
    Scene,
    Seen,
    Start,
    chance_limit,
    contradicted_lens,
    gain,
    measured_scale,
    repeat_shares,
    seen_at,
    settle,
)
from visioncal.estimation.linalg import covariance
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.estimation.problem import ROBOT, Problem, State
from visioncal.estimation.solve import covariance_of, fit_problem, left_out_residuals
from visioncal.stages.found import findings, remarks
from visioncal.stages.pnp import ViewPoses
from visioncal.targets import numbered_positions
from visioncal.threads import one_blas_thread
from visioncal.types import Corners, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Refined:
    """The views under the lens and the board that fit all of them.

    Attributes:
        free: The appearance, and what is open about it.
        views: The views with their one pose each, made anew.
        sigma_px: Standard deviation of a corner's coordinate [px].
        arm: Errors that follow the arm's posture, at the same views; None where there are none.
        warnings: What was found and is a reason for doubt, in sentences.
        notes: What was found and is none.
    """

    free: Free
    views: tuple[ViewPoses, ...]
    sigma_px: float
    arm: ArmErrors | None
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def look(
    scene: Scene, views: Sequence[ViewPoses], stops: IntArray, *, closed_form: bool = False
) -> Refined:
    """Lens and board as they are given or were estimated, with what is open about them.

    Args:
        scene: What is looked at, and with what.
        views: The views, each with its one pose and its corners.
        stops: (m,) the stop of each.
        closed_form: Whether nothing will move, because the edges will come from a closed form.

    Returns:
        The views with how they move when lens and board do.
    """
    with one_blas_thread():
        problem = _problem(scene, views, stops)
        moving = problem.lens[:0] if closed_form else problem.first
        poses = np.array([view.cam_from_target[0] for view in views])
        seen = seen_at(problem, moving, problem.stated, poses)
    return _told(seen, views, None)


def refine(
    scene: Scene, views: Sequence[ViewPoses], arm: Arm, frames: Mapping[str, FloatArray]
) -> Refined:
    """Fits lens, board and edges to all corners together.

    Estimated intrinsics move with the edges. The board's bend, given intrinsics together with it,
    and the board's scale are set free where corners and chain speak for it with more than noise can
    say, and views that are left out do not speak against it. A scale that is held still counts, by
    its prior, in the covariance.

    Args:
        scene: What is looked at, and with what.
        views: The views in the fit, each with its one pose and its corners.
        arm: The robot's side.
        frames: Where the unknown frames are thought to be.
    """
    with one_blas_thread():
        problem = _problem(scene, views, arm.stops)
        poses = np.array([view.cam_from_target[0] for view in views])
        start = Start(problem.stated, poses, frames)
        answer = _chosen(problem, arm, settle(problem, arm, problem.first, start))
        errors = arm_errors(arm, answer.fitted.problem, answer.fitted.frames)
        if errors is not None and errors.is_significant:
            answer, arm, errors = _with_arm(problem, arm, start, errors)
        doubts = tuple(findings(answer.problem, arm, answer.fitted))
        notes = tuple(remarks(answer.problem, arm, answer.fitted))
    return replace(_told(answer.fitted.seen, views, errors), warnings=doubts, notes=notes)


@dataclass(frozen=True, eq=False)
class _Answer:
    """A fit, and the problem that it answers: priors that are contradicted have been dropped."""

    problem: CornerProblem
    fitted: Fitted


def _with_arm(
    problem: CornerProblem, arm: Arm, start: Start, errors: ArmErrors
) -> tuple[_Answer, Arm, ArmErrors | None]:
    """Fits again with errors of the arm, which may have passed for another lens or board.

    Errors of any arm's shape tell which values are free, but are not estimated. Their size is that
    under the stated lens and board: a board that changes its size with the arm hides a part of it.
    """
    stated = settle(problem, arm, problem.first, start)
    errors = arm_errors(arm, stated.problem, stated.frames) or errors
    erring = replace(arm, errors=errors)
    answer = _chosen(problem, erring, settle(problem, erring, problem.first, start))
    if arm.of_links:
        return answer, erring, errors
    fitted = settle(answer.problem, arm, answer.fitted.moving, answer.fitted.again())
    left = arm_errors(arm, fitted.problem, fitted.frames)
    return replace(answer, fitted=fitted), arm, left


def arm_errors(arm: Arm, problem: Problem, frames: Mapping[str, FloatArray]) -> ArmErrors | None:
    """Finds errors that follow the arm's posture.

    Args:
        arm: The robot's side.
        problem: What was observed at its stops.
        frames: Where the unknown frames are under white noise, or a start.

    Returns:
        The errors; None where white noise explains the residuals as well.
    """
    fit = fit_problem(problem, problem.start(frames))
    return find_arm_errors(problem, fit.state, fit.noise, ROBOT, arm.basis, of_links=arm.of_links)


def _told(seen: Seen, views: Sequence[ViewPoses], errors: ArmErrors | None) -> Refined:
    return Refined(
        seen.free,
        tuple(
            _remade(view, seen.compressed, seen.free.columns, seen.sigma_px, at)
            for at, view in enumerate(views)
        ),
        seen.sigma_px,
        errors,
    )


def _chosen(problem: CornerProblem, arm: Arm, fitted: Fitted) -> _Answer:
    """Sets free what the data speak for."""
    answer = _Answer(problem, fitted)
    for moving in _shapes(problem, arm, fitted):
        wider = _freed(problem, arm, moving, fitted)
        if _is_determined(wider.fitted) and not _predicts_worse(wider.fitted, fitted):
            answer = wider
            break
    if not np.isin(problem.lens, answer.fitted.moving).all() and _speaks_against_lens(answer, arm):
        contested = replace(answer.problem, contested=True)
        again = settle(contested, arm, answer.fitted.moving, answer.fitted.again())
        answer = _Answer(contested, again)
    return _resized(answer, arm)


def _freed(problem: CornerProblem, arm: Arm, moving: IntArray, fitted: Fitted) -> _Answer:
    """Fits with more values free; a confident wrong prior is worse than none."""
    wider = settle(problem, arm, moving, fitted.again())
    if not np.isin(problem.lens, moving).all() or not contradicted_lens(problem, wider):
        return _Answer(problem, wider)
    unknown = problem.without_prior(problem.lens)
    return _Answer(unknown, settle(unknown, arm, moving, wider.again()))


def _resized(answer: _Answer, arm: Arm) -> _Answer:
    """Sets the boards' scales free where the robot measures others than are stated.

    One after the other: a board that is off misleads about the others, too.
    """
    for _ in answer.problem.printed:
        other = _wrongly_sized(answer, arm)
        if other is None:
            return answer
        problem, fitted = answer.problem, answer.fitted
        place = problem.scale_of(other.board)
        if other.contradicts:
            problem = problem.without_prior(place)
        moving = np.union1d(fitted.moving, place)
        resized = _Answer(problem, settle(problem, arm, moving, fitted.again()))
        if not _is_determined(resized.fitted):
            return answer
        answer = resized
    return answer


def _wrongly_sized(answer: _Answer, arm: Arm) -> MeasuredScale | None:
    """The board whose size is held and farthest from what the robot measures, if any is beyond."""
    problem, fitted = answer.problem, answer.fitted
    held = [it for it in problem.printed if problem.scale_of(it)[0] not in fitted.moving]
    measured = [measured_scale(problem, arm, fitted, board) for board in held]
    # An arm whose links may all be too long is hard to tell from a board that is too large.
    other = [it for it in measured if (it.is_another if arm.errors is None else it.contradicts)]
    return max(other, key=lambda it: abs(it.scale) / it.sigma, default=None)


def _is_determined(fitted: Fitted) -> bool:
    """Whether the views still determine both edges to what is accepted, errors of the arm aside."""
    looks, fit = fitted.problem.effects[:1], fitted.fit
    problem = fitted.problem.with_effects(looks)
    values = fit.state.values[: sum(map(len, looks))]
    spread = covariance_of(problem, replace(fit, state=State(fit.state.edges, values)))
    size = 6 * len(problem.unknown)
    limits = np.tile(np.repeat([SIGMA_LIMIT_RAD, SIGMA_LIMIT_M], 3), len(problem.unknown))
    blocks = np.split(spread[:size, :size], size // 3)
    worst = [np.linalg.eigvalsh(it[:, 3 * at : 3 * at + 3])[-1] for at, it in enumerate(blocks)]
    return bool(np.all(np.sqrt(worst) < limits[::3]))


def _speaks_against_lens(answer: _Answer, arm: Arm) -> bool:
    """Whether given intrinsics that are held explain the corners worse than chance does."""
    problem, fitted = answer.problem, answer.fitted
    if not problem.has_spare_corners:
        return False
    bent = np.union1d(fitted.moving, problem.shape)
    everything = np.union1d(bent, problem.lens)
    more = gain(problem, arm, fitted, everything) - gain(problem, arm, fitted, bent)
    return more > chance_limit(len(problem.lens))


def held(scene: Scene) -> Free:
    """Lens and board as they are stated, with nothing free."""
    nothing, basis = np.zeros(0), boards_basis(scene.targets)
    return Free(
        Appearance(scene.camera, np.zeros(basis.shape[2])),
        basis,
        numbered_positions(scene.targets),
        nothing.astype(np.int64),
        nothing.astype(bool),
        np.zeros((0, 0)),
        nothing,
    )


def remade(views: Sequence[ViewPoses], free: Free, sigma_px: float) -> tuple[ViewPoses, ...]:
    """Makes the poses of views anew that had no part in the fit.

    Args:
        views: The views, each with its one pose and its corners.
        free: Lens and board.
        sigma_px: Noise of a corner's coordinate [px].
    """
    if not views:
        return ()
    stack = CornerStack.of(_corners(views), free.positions)
    starts = np.array([view.cam_from_target[0] for view in views])
    with one_blas_thread():
        compressed = compress(stack, free.basis, free.appearance, starts)
    return tuple(
        _remade(view, compressed, free.columns, sigma_px, at) for at, view in enumerate(views)
    )


def _shapes(problem: CornerProblem, arm: Arm, fitted: Fitted) -> Iterator[IntArray]:
    """The bend, with given intrinsics or without, where it explains significantly more."""
    now = fitted.moving
    if not problem.has_spare_corners:
        return
    bent = np.union1d(now, problem.shape)
    everything = np.union1d(bent, problem.lens)
    gain_bent, gain_all = gain(problem, arm, fitted, bent), gain(problem, arm, fitted, everything)
    may_refine = problem.scene.mode != "hold" and len(everything) > len(bent)
    if may_refine and gain_all - gain_bent > chance_limit(len(everything) - len(bent)):
        yield everything
    if len(bent) > len(now) and gain_bent > chance_limit(len(bent) - len(now)):
        yield bent


def _predicts_worse(wider: Fitted, fitted: Fitted) -> bool:
    """Whether views that are left out are predicted worse, in position and in rotation."""
    errors = [
        left_out_residuals(it.problem, it.fit.state, it.fit.noise).reshape(-1, 2, 3)
        for it in (wider, fitted)
    ]
    more, less = (np.mean(it**2, axis=(0, 2)) for it in errors)
    return bool(np.all(more > less))


def _problem(scene: Scene, views: Sequence[ViewPoses], stops: IntArray) -> CornerProblem:
    """The corners, of which those of one stop and one board count as one view."""
    shown = {it.view: (stop, it.board) for it, stop in zip(views, stops.tolist(), strict=True)}
    return CornerProblem.of(scene, _corners(views), repeat_shares(shown))


def _corners(views: Sequence[ViewPoses]) -> dict[int, Corners]:
    return {it.view: it.corners for it in views if it.corners is not None}


def _remade(
    view: ViewPoses, compressed: Compressed, columns: IntArray, sigma_px: float, at: int
) -> ViewPoses:
    spread = floored_sigma_px(sigma_px) ** 2 * covariance(compressed.information[at])
    return replace(
        view,
        cam_from_target=compressed.cam_from_target[at][None],
        covariance=spread[None],
        by_shared=compressed.by_shared[at][None, :, columns],
    )
