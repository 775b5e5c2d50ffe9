"""The gain of further columns, from the factorisation of a fit: nothing is fitted again.

With the columns A, and P what the fit leaves of the rows' information, A'P y is the score of their
values and A'P A their information; the likelihood of values ~ N(0, s^2) at the fit's other sizes
follows for any s (Rao 1948; for variances Verbeke and Molenberghs 2003).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag, eigvalsh_tridiagonal, lapack

from visioncal.core.transforms import apply_each
from visioncal.core.types import FloatArray
from visioncal.fit.fit import Fit
from visioncal.fit.lens_field import Field, fields_of_lengths, orders_of_waves, waves
from visioncal.fit.linearise import CornerRows, Gram, corner_rows, of_pose_alone
from visioncal.fit.mixed import body_with, weights_at
from visioncal.fit.pairs import Pair, images_of
from visioncal.model.effects import Displacement, Effect, RowMotion
from visioncal.vision.camera import project_with_jacobian

# Sizes that are tried, over one that the data would just show.
_TRIED = np.exp(np.linspace(-3.0, 5.0, 17))


@dataclass(frozen=True, eq=False)
class Added:
    """c more columns on the rows of some sightings, which the fit uses."""

    gram: Gram
    local: FloatArray  # (k, c, d + 1) products with the sightings' local columns and residual.
    inner: FloatArray  # (c, c) of the columns with each other, summed over the sightings.


@dataclass(frozen=True, eq=False)
class Score:
    """Score and information of c further columns; `gains` takes many, (..., c) and (..., c, c)."""

    pull: FloatArray  # (c,) A'P y.
    information: FloatArray  # (c, c) A'P A.
    freedom: float  # Of the residuals by which noise is known; infinite where it is.

    def best(self, sigmas: FloatArray, low: float, high: float) -> tuple[float, float]:
        """The most likely of some sizes of columns with (c,) relative sigmas, and its gain."""
        # Columns of a millionth of the variance of others add nothing to see.
        at = np.flatnonzero(sigmas > 1e-3 * sigmas.max(initial=0.0))
        scaled = self.information[at[:, None], at] * np.outer(sigmas[at], sigmas[at])
        pull = (sigmas * self.pull)[at]
        # Columns from which on no eigenvectors are worked out.
        if len(at) > 64:
            return _best_of_many(scaled, pull, low, high, self._student)
        values, vectors = np.linalg.eigh(scaled)
        sizes = _sizes_of(float(values.max(initial=0.0)), low, high)
        gains, _ = self._gains(values, vectors.T @ pull, sizes)
        return float(sizes[gains.argmax()]), float(gains.max())

    def posterior(self, low: float, high: float) -> tuple[FloatArray, FloatArray]:
        """Sizes (k,) that the data would hardly show to clearly show, and their gains (k,)."""
        sizes = _sizes_of(float(np.linalg.eigvalsh(self.information)[-1]), low, high)
        return sizes, self.gains(sizes)[0]

    def gains(self, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(..., k) gains of columns with equal sigmas, of k sizes; of many scores at once, too.

        The second are at the estimates of the columns, with nothing off for their number.
        """
        values, vectors = np.linalg.eigh(self.information)
        return self._gains(values, (self.pull[..., None, :] @ vectors)[..., 0, :], sizes)

    def _gains(
        self, values: FloatArray, pull: FloatArray, sizes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        within = 1.0 + sizes[:, None] ** 2 * np.maximum(values, 0.0)[..., None, :]
        squares = np.sum(sizes[:, None] ** 2 * pull[..., None, :] ** 2 / within, axis=-1)
        explained = self._student(squares)
        return explained - 0.5 * np.log(within).sum(axis=-1), explained

    def _student(self, squares: npt.ArrayLike) -> FloatArray:
        """Log-likelihood that some squares gain, with the level of the noise integrated out."""
        if not np.isfinite(self.freedom):
            return 0.5 * np.asarray(squares)
        # Of two that explain next to all, the one that explains more is likelier.
        share = np.asarray(squares) / self.freedom
        beyond = np.maximum(share - 0.999, 0.0)
        return np.asarray(0.5 * self.freedom * (beyond - np.log1p(beyond - share)))


def _sizes_of(most: float, low: float, high: float) -> FloatArray:
    """Sizes about the one of which a direction of most information is as large as its sigma."""
    return np.unique(np.clip(_TRIED / np.sqrt(max(most, 1e-300)), low, high))


def _best_of_many(
    information: FloatArray,
    pull: FloatArray,
    low: float,
    high: float,
    student: Callable[[float], FloatArray],
) -> tuple[float, float]:
    """The same as `Score.best` by a tridiagonal matrix: half the time of eigenvectors."""
    lower, diagonal, off_diagonal, reflectors, _ = lapack.dsytrd(information, lower=1)
    turned, _, _ = lapack.dormqr("L", "T", lower[1:, :-1], reflectors, pull[1:, None], 64)
    pull = np.append(pull[:1], turned)
    (most,) = eigvalsh_tridiagonal(diagonal, off_diagonal, "i", (len(pull) - 1, len(pull) - 1))
    sizes, gains = _sizes_of(float(most), low, high), list[float]()
    for square in np.square(sizes).tolist():
        pivots, factors, _ = lapack.dpttrf(1.0 + square * diagonal, square * off_diagonal)
        solved, _ = lapack.dpttrs(pivots, factors, pull)
        gains.append(float(student(square * float(pull @ solved))) - np.log(pivots).sum() / 2.0)
    best = int(np.argmax(gains))
    return float(sizes[best]), gains[best]


@dataclass(frozen=True, eq=False)
class Products:
    """Weighted products of c more columns with all rows."""

    pull: FloatArray  # (c,) with the residuals.
    inner: FloatArray  # (c, c) with each other.
    common: FloatArray  # (p, c) with the unknowns.
    errors: list[FloatArray]  # (u, m, c) with the errors of each body's units.


def products(fit: Fit, added: Iterable[Added], count: int) -> Products:
    """Weighted products of `count` more columns with all rows."""
    p = fit.unknowns.count
    pull, inner, with_common = np.zeros(count), np.zeros((count, count)), np.zeros((p, count))
    with_errors = [np.zeros((len(body.stops), body.width, count)) for body in fit.mixed.bodies]
    for part in added:
        gram, f = part.gram, 6 * len(part.gram.flanges)
        by_errors, common = gram.by_errors_and_sum(part.local[:, :, :-1])
        pull += part.local[:, :, -1].sum(axis=0)
        inner += part.inner
        np.add.at(with_common, gram.columns, common.T)
        if f:
            at = body_with(fit.mixed.bodies, gram.flanges)
            body = fit.mixed.bodies[at]
            units = np.searchsorted(body.stops, gram.stops)
            rows = units[:, None], body.errors_of(gram.flanges)
            np.add.at(with_errors[at], rows, np.swapaxes(by_errors, 1, 2))
    return Products(pull, inner, with_common, with_errors)


def score(fit: Fit, added: Iterable[Added], count: int, freedom: float) -> Score:
    """The score of `count` more columns, on rows whose noise is known by so many residuals."""
    with_rows, estimate = products(fit, added, count), fit.estimate
    pull, inner = with_rows.pull - with_rows.common.T @ estimate.values, with_rows.inner
    reduced = with_rows.common
    for body, solved, cross in zip(
        fit.mixed.bodies, estimate.bodies, with_rows.errors, strict=True
    ):
        pull -= np.einsum("umc,um->c", cross, solved.errors)
        flat = cross.reshape(-1, count)
        inner -= flat.T @ (solved.covariance @ cross).reshape(-1, count)
        reduced[body.columns] += solved.response.reshape(len(flat), -1).T @ flat
    information = inner - reduced.T @ estimate.covariance @ reduced
    return Score(pull, (information + information.T) / 2, freedom)


def of_effect(fit: Fit, effect: Effect, pairs: Sequence[Pair] = ()) -> Score:
    """The score of an effect that is not among the unknowns."""
    freedom = fit.freedom if effect.place == "edge" else fit.of_corners
    return score(fit, added_by(fit, effect, pairs), effect.count, freedom)


def added_by(fit: Fit, effect: Effect, pairs: Sequence[Pair] = ()) -> list[Added]:
    """The columns of an effect; of a displacement that has one, by the sightings in pairs."""
    if isinstance(effect, Displacement):
        return added_by_displacements(fit, pairs, (effect,))
    added = []
    for gram, heads in fit.used_heads:
        if effect.place == "edge" and effect.frame in gram.by_effects:
            columns = effect.columns(gram.moments, np.ones(len(gram.rows)))
            first, moves = 0, gram.by_effects[effect.frame] @ columns
        elif effect.place == "lens" and effect.frame == gram.pair[0]:
            first, moves = 6, effect.columns(gram.moments, gram.distances)
        else:
            continue
        # Poses that were measured depend on no lens.
        if gram.head < first + moves.shape[1]:
            continue
        rows = slice(first, first + moves.shape[1])
        local = np.swapaxes(moves, 1, 2) @ heads[:, rows]
        inner = np.tensordot(local[:, :, rows], moves, ((0, 2), (0, 1)))
        added.append(Added(gram, local, inner))
    return added


def of_rows(fit: Fit, pairs: Sequence[Pair], motion: RowMotion) -> Score:
    """The score of a motion of rows, by what each image shows beside a pose of its own.

    The part of it that lens and board may absorb counts as if they did.
    """
    count, images = len(motion.stops), images_of(pairs, motion.frame)
    pull, information = np.zeros((count, 4)), np.zeros((count, 4, 4))
    for gram, pair, rows in _of_images(fit, images):
        kept = np.flatnonzero(fit.used[gram.rows] & np.isin(gram.stops, motion.stops))
        if not len(kept):
            continue
        moved = motion.shifts(pair.px) * pair.weights[:, None, None]
        by_pose, moved, residual = (
            pair.padded(part)[kept].reshape(len(kept), -1, part.shape[2])
            for part in (rows.head[:, :, :6], moved, rows.residual[:, :, None])
        )
        turned = np.swapaxes(by_pose, 1, 2)
        moved = moved - by_pose @ (of_pose_alone(turned @ by_pose) @ (turned @ moved))
        weighted = _weight(fit, gram) * np.swapaxes(moved, 1, 2)
        at = np.searchsorted(motion.stops, gram.stops[kept])
        np.add.at(pull, at, (weighted @ residual)[:, :, 0])
        np.add.at(information, at, weighted @ moved)
    return Score(pull.ravel(), np.asarray(block_diag(*information)), fit.of_corners)


def best_displacement(
    fit: Fit, pairs: Sequence[Pair], tried: Sequence[Displacement]
) -> tuple[Displacement, float, float]:
    """The likeliest of one camera's displacements, its size, and its log-likelihood ratio.

    By the first of its values.
    """
    count = len(tried)
    found = score(fit, added_by_displacements(fit, pairs, tried), count, fit.of_corners)
    # The thickness of a pane is positive.
    pull = np.where(found.pull > 0.0, found.pull, 0.0) if tried[0].is_positive else found.pull
    single_bests = [
        Score(pull[[at]], found.information[[at]][:, [at]], found.freedom).best(
            np.ones(1), *tried[at].bounds[1:]
        )
        for at in range(count)
    ]
    best = max(range(count), key=lambda at: single_bests[at][1])
    return tried[best], single_bests[best][0], single_bests[best][1] - float(np.log(count))


def added_by_displacements(
    fit: Fit, pairs: Sequence[Pair], tried: Sequence[Displacement]
) -> list[Added]:
    """The columns of the first value of each of one camera's displacements."""
    camera, count, added = tried[0].frame, len(tried), list[Added]()
    lens = fit.unknowns.camera(fit.linearised, camera)
    for gram, pair, rows in _of_images(fit, images_of(pairs, camera)):
        kept = fit.used[gram.rows]
        shape = pair.basis[pair.ids] @ fit.linearised.values["shape", pair.names[1]]
        poses = gram.poses[pair.owner]
        points = apply_each(poses, pair.points[pair.ids] + shape)
        slopes = project_with_jacobian(lens, points).jacobian_point
        moved = np.stack([one.moved_first(points, poses) for one in tried], axis=2)
        shares = tried[0].columns(gram.moments, gram.distances)[pair.owner, 0, 0] * pair.weights
        each = slopes @ moved * shares[:, None, None]
        by_field = np.stack([np.kron(axis, rows.functions) for axis in np.eye(2)], axis=1)
        full = np.concatenate([rows.head, by_field, rows.residual[:, :, None]], axis=2)
        left, right = (
            pair.padded(part)[kept].reshape(int(kept.sum()), -1, part.shape[2])
            for part in (each, full)
        )
        local, weight = np.swapaxes(left, 1, 2) @ right, _weight(fit, gram)
        inner, taken = left.reshape(-1, count), gram if kept.all() else gram.take(kept)
        added.append(_beside_poses(fit, taken, local, weight * inner.T @ inner))
    return added


def _beside_poses(fit: Fit, gram: Gram, local: FloatArray, product: FloatArray) -> Added:
    """Columns of corners with the weights of their noise.

    Args:
        fit: The fit.
        gram: The (k,) sightings.
        local: (k, c, h + 1) products of the columns with the sightings' own, and with residuals.
        product: (c, c) of the columns with themselves, weighted.
    """
    weight = _weight(fit, gram)
    if len(gram.parts) > 1:
        # The part that poses explain has another noise than the rest.
        more, by_pose = _weight(fit, gram, 1) - weight, np.swapaxes(local[:, :, :6], 1, 2)
        raw = np.asarray(sum(part.heads for part in gram.parts))
        solved, count = of_pose_alone(raw) @ by_pose, len(product)
        product = product + more * by_pose.reshape(-1, count).T @ solved.reshape(-1, count)
        local = local + more / weight * np.swapaxes(solved, 1, 2) @ raw[:, :6]
    return Added(gram, weight * local, product)


def of_waves(fit: Fit, pairs: Sequence[Pair], camera: str) -> Score:
    """The score of all waves of a lens's field, along both axes."""
    added = _by_waves(fit, images_of(pairs, camera), camera)
    return score(fit, added, 2 * len(orders_of_waves()), fit.of_corners)


def _by_waves(fit: Fit, images: Sequence[Pair], camera: str) -> Iterator[Added]:
    """The waves' columns, of some images at a time: those of all would fill the memory."""
    orders, width = orders_of_waves(), float(fit.unknowns.lenses[camera].resolution[0])
    for gram, pair, rows in _of_images(fit, images):
        kept = fit.used[gram.rows]
        predicted = pair.px - rows.residual / pair.weights[:, None]
        each = waves(predicted, width, orders) * pair.weights[:, None]
        full = np.concatenate([rows.head, rows.residual[:, :, None]], axis=2)
        padded, of_rows = np.swapaxes(pair.padded(each), 1, 2), pair.padded(full)
        local = np.concatenate([padded @ of_rows[:, :, axis] for axis in (0, 1)], axis=1)
        inner = each[kept[pair.owner]]
        weight, local = _weight(fit, gram), local[kept]
        product = weight * np.asarray(np.kron(np.eye(2), inner.T @ inner))
        taken = gram if kept.all() else gram.take(kept)
        yield _beside_poses(fit, taken, local, product)


def _of_images(fit: Fit, images: Sequence[Pair]) -> Iterator[tuple[Gram, Pair, CornerRows]]:
    """The rows of the corners of some images, of which the fit uses any."""
    for gram in fit.grams:
        pair = next((one for one in images if np.array_equal(one.rows, gram.rows)), None)
        if pair is not None and fit.used[gram.rows].any():
            twists = pair.twists(gram.by_effects)
            yield gram, pair, corner_rows(fit.unknowns, fit.linearised, pair, gram.poses, twists)


def best_field(
    fit: Fit, pairs: Sequence[Pair], camera: str, limit: float
) -> tuple[Field, float, float] | None:
    """The most likely field of a lens, its size [px], and its log-likelihood against none.

    None where twice that is below a limit.
    """
    found, options = of_waves(fit, pairs, camera), list[tuple[float, float, Field]]()
    px = np.concatenate([pair.px for pair in images_of(pairs, camera)])
    weight = max(_weight(fit, gram) for gram in fit.grams if gram.pair[0] == camera)
    for field in fields_of_lengths(float(fit.unknowns.lenses[camera].resolution[0]), px):
        size, gain = found.best(np.tile(field.sigmas, 2), 1e-4, 5.0)
        options.append((gain, size, field))
    gain, size, field = max(options, key=lambda option: option[0])
    if 2.0 * gain < limit:
        return None
    # Of a function below this, all corners together show nothing. Least size of a function of the
    # field, over the uncertainty with which all corners show it.
    return field.shown(px, 0.5**2 / (size**2 * weight)), size, gain


def _weight(fit: Fit, gram: Gram, part: int = 0) -> float:
    """Inverse variance of the noise of some sightings' rows."""
    return float(weights_at(fit.estimate.logs)[gram.parts[part].size])
