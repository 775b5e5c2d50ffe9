"""One linear mixed model: terms of rows, each with a size, and their restricted likelihood.

    -2 log L = sum_t (2 n_t log s_t + |rows_t|^2 / s_t^2) + log det(information)

A term's rows depend on errors of units (the flanges at one stop) and on common unknowns: noise of
corners, errors of flanges and priors of random unknowns are all treated alike. Its derivative by
log s_t is 2 (n_t - E|rows_t|^2 / s_t^2), with the expectation over the unknowns at their estimate
(Patterson and Thompson 1971; Harville 1977). As curvature serves the average of the observed and
the expected information, without traces of products (Gilmour, Thompson and Cullis 1995). Errors are
eliminated unit by unit, so that an evaluation is linear in units and sightings.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.mixed import SizePrior

# Shares of a unit diagonal that are added where a factor does not exist.
_RIDGES = (1e-12, 1e-9, 1e-6, 1e-3, 1.0)


@dataclass(frozen=True, eq=False)
class Part:
    """A term's rows by the errors of a body's units."""

    body: int
    columns: IntArray  # (c,) of the common unknowns.
    errors: FloatArray  # (u, m, m) Gram matrices of the errors of each unit.
    cross: FloatArray  # (u, m, c + 1) with the columns and the residual.
    # Numbers of these units, ascending; None for all of the body's.
    units: IntArray | None = None


@dataclass(frozen=True, eq=False)
class Term:
    """Rows of one size."""

    size: int  # Index of the size; -1 for rows that are whitened already.
    count: float  # Number n of rows.
    columns: IntArray  # (c,) of the common unknowns.
    common: FloatArray  # (c + 1, c + 1) Gram matrix of columns and residual, summed over all.
    parts: tuple[Part, ...] = ()


@dataclass(frozen=True, eq=False)
class Body:
    """Flanges whose errors sightings connect; a unit is what they err by at one stop."""

    flanges: tuple[str, ...]
    stops: IntArray  # (u,) of its units.
    columns: IntArray  # (c,) common unknowns on which rows with these errors depend.

    @property
    def width(self) -> int:
        """The number m of errors of a unit."""
        return 6 * len(self.flanges)

    def errors_of(self, flanges: Sequence[str]) -> IntArray:
        """(6 f,) places of the errors of f flanges among a unit's."""
        return np.concatenate([6 * self.flanges.index(name) + np.arange(6) for name in flanges])


@dataclass(frozen=True, eq=False)
class Eliminated:
    """The errors of one body, at given common unknowns."""

    covariance: FloatArray  # (u, m, m) of the errors.
    response: FloatArray  # (u, m, c) derivative of the errors by the body's columns.
    errors: FloatArray  # (u, m) at the estimate.


@dataclass(frozen=True, eq=False)
class Estimate:
    """The restricted likelihood at some sizes, and the estimate there."""

    logs: FloatArray  # (t,) logarithms of the sizes.
    value: float  # -2 log L, up to a constant.
    values: FloatArray  # (p,) common unknowns.
    covariance: FloatArray  # (p, p) theirs.
    bodies: tuple[Eliminated, ...]
    gradient: FloatArray  # (t,) of the value by the logarithms; zeros where not asked for.
    curvature: FloatArray  # (t, t) average information.


@dataclass(frozen=True, eq=False)
class Mixed:
    """Terms with t sizes, p common unknowns and the errors of some bodies."""

    terms: tuple[Term, ...]
    bodies: tuple[Body, ...]
    count: int  # p.
    sizes: int  # t.
    prior: SizePrior | None = None  # Of the sizes.

    @cached_property
    def places(self) -> dict[int, IntArray]:
        """(p + 1,) place of each common unknown, and the residual, among a body's columns."""
        found = {}
        for at, body in enumerate(self.bodies):
            found[at] = np.zeros(self.count + 1, dtype=np.int64)
            found[at][np.append(body.columns, self.count)] = np.arange(len(body.columns) + 1)
        return found

    @cached_property
    def with_residual(self) -> list[tuple[IntArray, list[IntArray]]]:
        """(c + 1,) places of each term's columns and residual; and of each part's, of its body."""
        p = self.count
        return [
            (
                np.append(term.columns, p),
                [self.places[part.body][np.append(part.columns, p)] for part in term.parts],
            )
            for term in self.terms
        ]

    def assembled(self, logs: FloatArray) -> tuple[list[tuple[FloatArray, FloatArray]], FloatArray]:
        """Information: of each body's units (u, m, m) and (u, m, c + 1); common (p + 1, p + 1)."""
        weights, p = weights_at(logs), self.count
        common = np.zeros((p + 1, p + 1))
        units = [
            (
                np.zeros((len(body.stops), body.width, body.width)),
                np.zeros((len(body.stops), body.width, len(body.columns) + 1)),
            )
            for body in self.bodies
        ]
        for term, (at, of_parts) in zip(self.terms, self.with_residual, strict=True):
            _add(common, at, weights[term.size] * term.common)
            for part, where in zip(term.parts, of_parts, strict=True):
                errors, cross = units[part.body]
                errors += weights[term.size] * part.errors
                _add_columns(cross, where, weights[term.size] * part.cross)
        return units, common

    def at(self, logs: FloatArray, *, is_sloped: bool = True) -> Estimate:
        """The estimate at (t,) logarithms of the sizes; without slopes, these are zero."""
        p = self.count
        units, common = self.assembled(logs)
        value, inner = 2.0 * sum(t.count * logs[t.size] for t in self.terms if t.size >= 0), []
        for body, (errors, cross) in zip(self.bodies, units, strict=True):
            root = np.linalg.inv(factors_of(errors))
            value -= 2.0 * float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())
            solved = (root @ cross).reshape(-1, cross.shape[2])
            at = np.append(body.columns, p)
            _add(common, at, -(solved.T @ solved))
            inner.append(np.swapaxes(root, 1, 2) @ root)
        covariance, log_det = inverse(common[:p, :p])
        values = covariance @ common[:p, p]
        value += float(common[p, p] - common[:p, p] @ values) + log_det
        eliminated = []
        for body, (_, cross), error_covariance in zip(self.bodies, units, inner, strict=True):
            by = error_covariance @ cross
            response = -by[:, :, :-1]
            solved = by[:, :, -1] + response @ values[body.columns]
            eliminated.append(Eliminated(error_covariance, response, solved))
        none = np.zeros(self.sizes)
        found = Estimate(
            logs, float(value), values, covariance, tuple(eliminated), none, np.diag(none)
        )
        found = self._sloped(found) if is_sloped else found
        if self.prior is None:
            return found
        prior = self.prior.at(logs)
        return replace(
            found,
            value=found.value + 2.0 * prior.value,
            gradient=found.gradient + 2.0 * prior.gradient,
            curvature=found.curvature + 2.0 * prior.curvature,
        )

    def _sloped(self, found: Estimate) -> Estimate:
        """An estimate with its gradient and curvature."""
        weights, p, values = weights_at(found.logs), self.count, np.append(found.values, -1.0)
        gradient, diagonal = np.zeros(self.sizes), np.zeros(self.sizes)
        # Gradients of each size's squares by the common unknowns, errors eliminated; and by these.
        pulls = np.zeros((self.sizes, p))
        inner = np.zeros((self.sizes, self.sizes))
        # Of the residual, the last column of rows, nothing is uncertain.
        covariance, spreads, insides = _widened(_widened(found.covariance.T).T), [], []
        for body, by in zip(self.bodies, found.bodies, strict=True):
            c = body.columns
            of_body = found.covariance if len(c) == p else found.covariance[c[:, None], c]
            flat = by.response.reshape(-1, len(c)) @ of_body
            spread = flat.reshape(by.response.shape)
            spreads.append(_widened(spread))
            insides.append(by.covariance + spread @ np.swapaxes(by.response, 1, 2))
        at_errors = [
            np.zeros((self.sizes, *eliminated.errors.shape)) for eliminated in found.bodies
        ]
        for term, (columns, of_parts) in zip(self.terms, self.with_residual, strict=True):
            if term.size < 0:
                continue
            x = values[columns]
            pull = term.common @ x
            square = float(x @ pull)
            absorbed = float(np.vdot(term.common, covariance[columns[:, None], columns]))
            for part, where in zip(term.parts, of_parts, strict=True):
                e, cross = found.bodies[part.body].errors, part.cross.reshape(-1, len(where))
                by_error = (part.errors @ e[:, :, None])[:, :, 0]
                by_common = (cross @ np.append(values[part.columns], -1.0)).reshape(e.shape)
                square += float(np.vdot(e, by_error + 2.0 * by_common))
                absorbed += float(np.vdot(part.errors, insides[part.body]))
                spread = np.take(spreads[part.body], where, axis=2)
                absorbed += 2.0 * float(np.vdot(part.cross, spread))
                at_errors[part.body][term.size] += by_error + by_common
                pulls[term.size, part.columns] += (e.ravel() @ cross)[:-1]
            pulls[term.size, term.columns] += pull[:-1]
            weight = weights[term.size]
            gradient[term.size] += 2.0 * (term.count - weight * (square + absorbed))
            diagonal[term.size] += 2.0 * (weight * (square - absorbed) + term.count)
        for body, by, each in zip(self.bodies, found.bodies, at_errors, strict=True):
            flat = each.reshape(self.sizes, -1)
            solved = (by.covariance @ each[:, :, :, None])[:, :, :, 0].reshape(self.sizes, -1)
            inner += flat @ solved.T
            pulls[:, body.columns] += np.tensordot(each, by.response, axes=([1, 2], [0, 1]))
        inner += pulls @ found.covariance @ pulls.T
        scale = weights[:-1]
        curvature = np.diag(diagonal) - 4.0 * inner * np.outer(scale, scale)
        return replace(found, gradient=gradient, curvature=curvature)


def _add(whole: FloatArray, at: IntArray, more: FloatArray) -> None:
    """Adds to some rows and columns (c + 1,), in ascending order, of a matrix; the last is last."""
    if len(at) == len(whole):
        whole += more
    elif run := _run(at):
        # Several times as fast as by indices.
        whole[run, run] += more[:-1, :-1]
        whole[run, -1] += more[:-1, -1]
        whole[-1, run] += more[-1, :-1]
        whole[-1, -1] += more[-1, -1]
    else:
        whole[at[:, None], at] += more


def _add_columns(whole: FloatArray, at: IntArray, more: FloatArray) -> None:
    """Adds to some columns (c + 1,) of an array (u, m, n); the last is last."""
    if len(at) == whole.shape[2] and _run(at):
        whole += more
    elif run := _run(at):
        whole[:, :, run] += more[:, :, :-1]
        whole[:, :, -1] += more[:, :, -1]
    else:
        whole[:, :, at] += more


def _run(at: IntArray) -> slice | None:
    """The run that (c + 1,) ascending indices but the last are, if they are one."""
    count = len(at) - 1
    if count < 1 or at[-2] - at[0] != count - 1:
        return None
    return slice(int(at[0]), int(at[0]) + count)


def _widened(array: FloatArray) -> FloatArray:
    """An array (..., c + 1) with zeros for the residual."""
    return np.concatenate([array, np.zeros((*array.shape[:-1], 1))], axis=-1)


def weights_at(logs: FloatArray) -> FloatArray:
    """(t + 1,) inverse variances of rows by their size; of size -1, one: these are whitened."""
    return np.append(np.exp(-2.0 * logs), 1.0)


def body_with(bodies: Sequence[Body], flanges: Sequence[str]) -> int:
    """Index of the body of some flanges; -1 where they err in none."""
    return next((at for at, body in enumerate(bodies) if set(flanges) & set(body.flanges)), -1)


def inverse(information: FloatArray) -> tuple[FloatArray, float]:
    """Inverse (p, p) of an information matrix, and its log-determinant.

    Directions that nothing determines, or that elimination leaves slightly indefinite, get a large
    variance.

    Raises:
        LinAlgError: It is not finite: a search diverges.
    """
    if not len(information):
        return information, 0.0
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled, diagonal = information * scale * scale[:, None], np.arange(len(scale))
    for ridge in _RIDGES:
        ridged = scaled.copy()
        ridged[diagonal, diagonal] += ridge
        # By columns, as LAPACK has it.
        root, failed = lapack.dpotrf(ridged.T, lower=1, overwrite_a=1)
        if not failed:
            break
    if failed:
        raise np.linalg.LinAlgError("information that is not finite")
    half, _ = lapack.dpotri(root, lower=1)
    half[diagonal, diagonal] /= 2.0
    covariance = half.T + half
    covariance *= scale
    covariance *= scale[:, None]
    log_det = 2.0 * float(np.log(np.diag(root)).sum() - np.log(scale).sum())
    return np.asarray(covariance), log_det


def factors_of(errors: FloatArray) -> FloatArray:
    """Cholesky factors of (u, m, m) information about errors; wild rows may cancel to nothing."""
    diagonal = np.diagonal(errors, axis1=1, axis2=2)[:, :, None] * np.eye(errors.shape[1])
    for ridge in (0.0, *_RIDGES):
        try:
            return np.asarray(np.linalg.cholesky(errors + ridge * diagonal), dtype=float)
        except np.linalg.LinAlgError:
            continue
    return np.sqrt(diagonal)


def prior_term(size: int, columns: IntArray, offsets: FloatArray, sigma: float) -> Term:
    """Rows of a prior: columns whose offsets (n,) from zero are one noise each."""
    rows = np.column_stack([np.eye(len(columns)), -offsets]) / sigma
    return Term(size, len(columns), columns, rows.T @ rows)


def summed(terms: Sequence[Term], bodies: Sequence[Body]) -> Term:
    """Terms of one size as one, with all of their columns."""
    columns = np.unique(np.concatenate([term.columns for term in terms]))
    common = np.zeros((len(columns) + 1, len(columns) + 1))
    for term in terms:
        at = np.append(np.searchsorted(columns, term.columns), len(columns))
        common[at[:, None], at] += term.common
    parts = []
    for body in sorted({part.body for term in terms for part in term.parts}):
        body_parts = [part for term in terms for part in term.parts if part.body == body]
        union = np.unique(np.concatenate([part.columns for part in body_parts]))
        units, width = len(bodies[body].stops), bodies[body].width
        errors, cross = np.zeros((units, width, width)), np.zeros((units, width, len(union) + 1))
        for part in body_parts:
            at = np.append(np.searchsorted(union, part.columns), len(union))
            if part.units is None or len(part.units) == units:
                errors += part.errors
                cross[:, :, at] += part.cross
            else:
                errors[part.units] += part.errors
                cross[part.units[:, None, None], np.arange(width)[:, None], at] += part.cross
        parts.append(Part(body, union, errors, cross))
    count = sum(term.count for term in terms)
    return Term(terms[0].size, count, columns, common, tuple(parts))
