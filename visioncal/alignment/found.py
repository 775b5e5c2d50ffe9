"""What the fit of a whole cell found of its lenses and boards, in sentences for the user."""

from collections.abc import Iterator

import numpy as np

from visioncal.alignment.solving import Solved
from visioncal.estimation.effects.lenses import Looks
from visioncal.estimation.joint import MeasuredScale, chance_limit, contradicts
from visioncal.estimation.scene import lens_prior
from visioncal.estimation.solve import held_shift
from visioncal.stages.found import (
    bend_words,
    contest_words,
    lens_words,
    noise_words,
    points_words,
    scale_words,
)
from visioncal.types import FloatArray, IntArray


def found_of_looks(solved: Solved, spread: FloatArray) -> Iterator[tuple[str, bool]]:
    """Says what was found, and whether each is a reason for doubt.

    Args:
        solved: The fit.
        spread: (p, p) covariance of its unknowns.
    """
    seen, looks = solved.seen, solved.looks
    if seen is None or looks is None:
        return
    for (camera, problem), it in zip(looks.problems.items(), seen.compressed, strict=True):
        free = np.flatnonzero(np.isin(looks.places(camera), seen.moving))
        words, is_doubt = noise_words(problem.stack, it.residuals, problem.unknowns(it, free))
        if words:
            yield _of(camera, words), is_doubt
    for camera in looks.problems:
        yield from _lens(solved, looks, spread, camera)
    boards = solved.cell.session.boards
    for board, (name, target) in enumerate(zip(boards, boards.values(), strict=True)):
        if target.kind == "points":
            yield from ((it, True) for it in points_words(target, looks.moved_points(board)))
            continue
        called = f"board {name}".strip()
        measured = _measured(solved, looks, spread, board)
        if measured is not None and measured.is_another:
            yield scale_words(called, target.square_m, measured)
        if _moved(solved, looks, spread, looks.shape_of(board)):
            yield bend_words(called, 1e3 * float(np.ptp(looks.corners[board][:, 2]))), True


def _of(camera: str, words: str) -> str:
    return f"{camera}: {words[0].lower()}{words[1:]}"


def _lens(
    solved: Solved, looks: Looks, spread: FloatArray, camera: str
) -> Iterator[tuple[str, bool]]:
    scene, lens = looks.problems[camera].scene, looks.lens_of(camera)
    if looks.problems[camera].contested:
        agreed = solved.agreed
        shift = held_shift(agreed.problem.subset(agreed.used), agreed.fit)
        yield _of(camera, contest_words(scene, shift[solved.columns_of(lens[:4])])), True
    free = lens[np.isin(lens, solved.seen.moving)] if solved.seen is not None else lens[:0]
    if scene.estimated or len(free) < 4 or not _moved(solved, looks, spread, free):
        return
    away, prior = (looks.values - looks.stated)[free], lens_prior(scene)[: len(free)]
    is_doubtful = scene.matrix_sigma_px is None or contradicts(away, prior)
    words, is_doubt = lens_words(away[:4], is_doubtful=is_doubtful)
    yield _of(camera, words), is_doubt


def _measured(solved: Solved, looks: Looks, spread: FloatArray, board: int) -> MeasuredScale | None:
    """What the robots' motion alone says of a board's size; None where that is nothing."""
    (place,) = looks.scale_of(board)
    (at,) = solved.columns_of(np.array([place]))
    stated, all_told = looks.prior_sigma[place] ** -2.0, 1.0 / spread[at, at]
    told = all_told - stated
    if told <= 0.0:
        return None
    scale = float(looks.values[place]) * all_told / told
    return MeasuredScale(board, scale, float(told**-0.5), float(looks.prior_sigma[place]))


def _moved(solved: Solved, looks: Looks, spread: FloatArray, places: IntArray) -> bool:
    """Whether values were moved from what is stated by more than chance."""
    if solved.seen is None or not np.isin(places, solved.seen.moving).all():
        return False
    at, away = solved.columns_of(places), (looks.values - looks.stated)[places]
    surprise = float(away @ np.linalg.solve(spread[np.ix_(at, at)], away))
    return surprise > chance_limit(len(places))
