"""What the entries of a cell say of its years: steps, drift, and when a need will be missed.

Assumptions, all of them: an entry's transform errs by its own covariance, times a factor of 1, 2, 4
or 9 that all entries of a transform share (each half as likely as the one before). A transform
steps once in two years, and one in five drifts linearly. A step, and a year's drift, has an unknown
size: 0.1 to 10 mm, and 2 mrad for each mm. A step is before one of the entries.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from scipy.special import expit, logsumexp

from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.results.history import Entry

# Factors of an entry's covariance, with their probabilities; sizes in the values' units.
_INFLATIONS = np.array([1.0, 2.0, 4.0, 9.0])
_LOG_INFLATIONS = np.log([8 / 15, 4 / 15, 2 / 15, 1 / 15])
_SIZES = np.array([0.1, 0.3, 1.0, 3.0, 10.0])
# Units of values: rad and m of a transform.
_UNITS = np.array([2e-3] * 3 + [1e-3] * 3)
_YEAR = 365.25
_STEPS_A_YEAR, _DRIFTS = 0.5, 0.2
# A drift is told from a step by four entries at least; changes are looked for as long as they are
# more probable than not.
_DRIFT_ENTRIES, _LIKELY, _MOST_CHANGES = 4, 0.5, 6
# Entries of a transform that are looked at, the latest ones: the time grows with their square.
_MOST_ENTRIES = 200
# Relative sigma of a sigma, which has about 20 degrees of freedom.
_SIGMA_OF_SIGMA = 0.16
# 95 % of a normal vector's lengths, in root-mean-square lengths: sqrt(7.81 / 3).
_RADIUS95 = 1.614


@dataclass(frozen=True, eq=False)
class Change:
    """A step of a value between two entries, or its drift."""

    at: int  # Index of the first entry after the step; 0 for a drift.
    probability: float  # Its probability against all that is not this change.
    vector: FloatArray  # (d,) the step, or the drift in a year.
    covariance: FloatArray  # (d, d) its covariance.


@dataclass(frozen=True, eq=False)
class Course:
    """A transform's years."""

    name: str  # Name of the transform.
    entries: tuple[Entry, ...]  # Those that have it, in the order of time.
    # (n, 6) where it was, as (rotation [rad], translation [m]) from the first entry; without
    # rotation (n, 3).
    twists: FloatArray
    sigmas: FloatArray  # (n, 6) or (n, 3) standard deviations of these.
    steps: tuple[Change, ...]  # Steps in the order of time.
    drift: Change | None  # The drift; None where there is probably none.
    sigma_steps: tuple[Change, ...]  # Steps of the logarithm of its sigma.

    @property
    def days(self) -> FloatArray:
        """(n,) times since the first entry [days]."""
        return _days(self.entries)

    def missed(self, need_mm: float, good_for_mm: float | None) -> tuple[datetime, ...] | None:
        """When a need will be missed at the present drift; None without a drift.

        The drift adds to what the latest entry is good for: where nobody calibrates again, picks
        use it until then.

        Args:
            need_mm: The required accuracy [mm].
            good_for_mm: What the latest entry is good for [mm]; None for its own 95 %.

        Returns:
            The likeliest time, and the earliest and the latest one of 95 %; at the end of time
            where the drift may be none.
        """
        if self.drift is None:
            return None
        last = self.entries[-1]
        own_mm = _RADIUS95 * last.edges[self.name].sigma_mm
        left_mm = max(0.0, need_mm - (own_mm if good_for_mm is None else good_for_mm))
        drift_mm, covariance = 1e3 * self.drift.vector[-3:], 1e6 * self.drift.covariance[-3:, -3:]
        speed = float(np.linalg.norm(drift_mm))
        along = drift_mm / max(speed, 1e-12)
        reach = 1.96 * float(np.sqrt(along @ covariance @ along))
        times = (left_mm / max(rate, 1e-9) for rate in (speed, speed + reach, speed - reach))
        return tuple(last.time + timedelta(days=min(_YEAR * years, 36_500)) for years in times)


def courses(entries: Sequence[Entry]) -> tuple[Course, ...]:
    """The years of all transforms of a cell but those of boards, from its entries by time.

    Bad results count for nothing.
    """
    by_name: dict[str, list[Entry]] = {}
    for entry in entries:
        left_out = entry.edges if entry.status == "bad" else entry.boards
        for name in entry.edges.keys() - {*left_out}:
            by_name.setdefault(name, []).append(entry)
    return tuple(_course(name, by_name[name][-_MOST_ENTRIES:]) for name in sorted(by_name))


def _course(name: str, entries: Sequence[Entry]) -> Course:
    edges = [entry.edges[name] for entry in entries]
    part = slice(0 if all(edge.oriented for edge in edges) else 3, 6)
    matrices = np.array([edge.matrix for edge in edges])
    twists = log(invert(matrices[:1]) @ matrices)[:, part]
    covariances = np.array([edge.covariance[part, part] for edge in edges])
    days = _days(entries)
    steps, drift = find_changes(days, twists, covariances, _UNITS[part], drifts=True)
    log_sigmas = np.log([max(edge.sigma_mm, 1e-6) for edge in edges])[:, None]
    noise = np.full((len(edges), 1, 1), _SIGMA_OF_SIGMA**2)
    sigma_steps, _ = find_changes(days, log_sigmas, noise, np.ones(1), drifts=False)
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return Course(name, tuple(entries), twists, sigmas, steps, drift, sigma_steps)


def _days(entries: Sequence[Entry]) -> FloatArray:
    first = entries[0].time
    return np.array([(entry.time - first) / timedelta(days=1) for entry in entries])


def find_changes(
    days: FloatArray,
    values: FloatArray,
    covariances: FloatArray,
    units: FloatArray,
    *,
    drifts: bool,
) -> tuple[tuple[Change, ...], Change | None]:
    """Finds steps and a linear drift by their Bayes factors, the most probable change first.

    In every round each step, and a drift, is compared with none, beside the changes that were
    found; at the end each one is compared without itself. Likelihoods are exact: all is normal,
    the level's prior is flat, sizes and the factor of the covariance are summed over (Kass and
    Raftery 1995). See the module's assumptions.

    Args:
        days: (n,) ascending times.
        values: (n, d) values.
        covariances: (n, d, d) their covariances.
        units: (d,) sizes of one of `_SIZES` in the values' units.
        drifts: Whether they may drift.

    Returns:
        The steps in the order of time, and the drift.
    """
    count = len(days)
    if count < 2:
        return (), None
    years = (days - days[-1]) / _YEAR
    # A change per row: the drift, and a step before each entry but the first.
    shapes = np.concatenate([[years], np.tri(count)[:, 1:].T])
    chance = -np.expm1(-_STEPS_A_YEAR * np.diff(days) / _YEAR)
    is_drift_possible = drifts and count >= _DRIFT_ENTRIES
    odds = np.concatenate([[_DRIFTS if is_drift_possible else 0.0], np.clip(chance, 1e-6, 0.5)])
    with np.errstate(divide="ignore"):
        log_odds = np.log(odds / (1.0 - odds))
    model = _Model(shapes, values / units, covariances / np.outer(units, units))
    found: dict[int, int] = {}
    is_drift = np.arange(count) == 0
    while len(found) < min(_MOST_CHANGES, max(1, count // 2)):
        scores = np.where([at in found for at in range(count)], -np.inf, log_odds)
        gains, sizes = model.gains(found)
        scores = scores + gains
        totals = [logsumexp(scores[kind]) for kind in (is_drift, ~is_drift)]
        if expit(max(totals)) < _LIKELY:
            break
        best = int(np.argmax(np.where(is_drift == (totals[0] > totals[1]), scores, -np.inf)))
        found[best] = int(sizes[best])
    probabilities = {}
    for at in [*found]:
        others = {other: size for other, size in found.items() if other != at}
        gains, _ = model.gains(others)
        rivals = (is_drift == is_drift[at]) & ~np.isin(np.arange(count), [*others])
        probabilities[at] = float(expit(logsumexp((log_odds + gains)[rivals])))
        if probabilities[at] < _LIKELY:
            found = others
    vectors, covariance = model.estimate(found)
    changes = {
        at: Change(at, probabilities[at], vectors[row] * units, matrix * np.outer(units, units))
        for row, (at, matrix) in enumerate(zip(found, covariance, strict=True))
    }
    return tuple(changes[at] for at in sorted(changes) if at), changes.get(0)


class _Model:
    """The linear model of a level and changes, each of a shape over time and a normal vector."""

    def __init__(self, shapes: FloatArray, values: FloatArray, covariances: FloatArray) -> None:
        self.shapes = shapes  # (m, n) the course of each change.
        self.values = values  # (n, d) in units of the sizes.
        # (n, d, d). What is exact to less than a thousandth of a unit, 1 um, does not stay so.
        self.weights = np.linalg.inv(covariances + 1e-6 * np.eye(values.shape[1]))
        self.weighted = np.einsum("nuv,nv->nu", self.weights, values)

    def _normal(
        self, found: dict[int, int], shapes: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normal equations (k, c d, c d), (k, c d), and prior precisions (c - 1,) of `found`.

        Columns are the level, the changes found, and one of `shapes` (k, n).
        """
        base = np.concatenate([np.ones((1, self.shapes.shape[1])), self.shapes[[*found]]])
        columns = np.concatenate(
            [np.broadcast_to(base, (len(shapes), *base.shape)), shapes[:, None]], axis=1
        )
        count, dimension = columns.shape[1], self.values.shape[1]
        matrix = np.einsum("kan,kbn,nuv->kaubv", columns, columns, self.weights, optimize=True)
        side = count * dimension
        right = np.einsum("kan,nu->kau", columns, self.weighted)
        # A level within some metres of the first entry: as good as flat.
        precisions = np.array([1e-8, *(_SIZES[size] ** -2.0 for size in found.values())])
        return matrix.reshape(-1, side, side), right.reshape(-1, side), precisions

    def gains(self, found: dict[int, int]) -> tuple[FloatArray, FloatArray]:
        """Logarithms (m,) of each change's Bayes factor beside those found, and its best size."""
        shapes = np.concatenate([np.zeros((1, self.shapes.shape[1])), self.shapes])
        matrix, right, known = self._normal(found, shapes)
        dimension = self.values.shape[1]
        total = float(np.einsum("nu,nu->", self.weighted, self.values))
        scores = np.empty((len(_SIZES), len(_INFLATIONS), len(shapes)))
        for at, size in enumerate(_SIZES):
            prior = np.repeat([*known, size**-2.0], dimension)
            for row, factor in enumerate(_INFLATIONS):
                normal = matrix / factor + np.diag(prior)
                solved = np.linalg.solve(normal, right[..., None] / factor)[..., 0]
                fit = total / factor - np.einsum("ku,ku->k", right, solved) / factor
                scale = self.values.size * np.log(factor) + np.linalg.slogdet(normal)[1]
                evidence = -0.5 * (scale - np.log(prior).sum() + fit)
                scores[at, row] = evidence + _LOG_INFLATIONS[row]
        by_size = logsumexp(scores, axis=1)
        gains = logsumexp(by_size, axis=0) - np.log(len(_SIZES))
        return gains[1:] - gains[0], by_size[:, 1:].argmax(axis=0)

    def estimate(self, found: dict[int, int]) -> tuple[FloatArray, FloatArray]:
        """Estimates (c, d) of the changes found, in their order, and their covariances (c, d, d).

        Of any size, and with the factor of the covariance that the residuals have.
        """
        matrix, right, _ = self._normal(found, np.zeros((1, self.shapes.shape[1])))
        dimension, count = self.values.shape[1], len(found)
        # The empty column of `_normal` is left out.
        side = (1 + count) * dimension
        covariance = np.linalg.inv(matrix[0, :side, :side])
        fitted = covariance @ right[0, :side]
        misfit = float(np.sum(self.weighted * self.values) - right[0, :side] @ fitted)
        factor = np.clip(misfit / max(self.values.size - side, 1), 1.0, _INFLATIONS[-1])
        blocks = covariance.reshape(1 + count, dimension, 1 + count, dimension)
        own = [factor * blocks[at, :, at] for at in range(1, 1 + count)]
        return fitted.reshape(-1, dimension)[1:], np.array(own).reshape(-1, dimension, dimension)
