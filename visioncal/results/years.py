"""The years of a cell by its entries: steps, drift, and when a need will be missed.

Assumptions, all of them: an entry's transform errs by its own covariance, times a factor of 1, 2, 4
or 9 that all entries of a transform share (each half as likely as the one before). A transform
steps once in two years, and one in five drifts linearly. A step, and a year's drift, has an unknown
size: 0.1 to 10 mm, and 2 mrad for each mm. A step is before one of the entries.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from scipy.special import expit, logsumexp

from visioncal.core.quantiles import radius95
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray, IntArray
from visioncal.results.history import Entry

# Factors of an entry's covariance, with their probabilities; sizes in the values' units.
_INFLATIONS = np.array([1.0, 2.0, 4.0, 9.0])
_LOG_INFLATIONS = np.log([8 / 15, 4 / 15, 2 / 15, 1 / 15])
_SIZES = np.array([0.1, 0.3, 1.0, 3.0, 10.0])
# Units of values: rad and m of a transform.
_UNITS = np.array([2e-3] * 3 + [1e-3] * 3)
YEAR_DAYS = 365.25
_STEPS_A_YEAR, _DRIFTS = 0.5, 0.2  # Prior rate of steps, and chance of a drift.
# Changes are looked for as long as they are more probable than not.
_LIKELY = 0.5


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
    # (n, 6) where it was, as (rotation vector [rad], translation [m]) from the first entry, in the
    # axes of the parent frame; without rotation (n, 3).
    offsets: FloatArray
    sigmas: FloatArray  # (n, 6) or (n, 3) standard deviations of these.
    steps: tuple[Change, ...]  # Steps in the order of time.
    drift: Change | None  # The drift; None where there is probably none.
    sigma_steps: tuple[Change, ...]  # Steps of the logarithm of its sigma.

    def missed(self, drift: Change, need_mm: float) -> tuple[datetime, datetime, datetime]:
        """When a drift will miss a need [mm] if the latest entry's pose is used until then.

        It adds to what that entry is good for, or else to its own 95 %.

        Returns:
            The likeliest time, and the earliest and the latest of 95 %: a century on for never.
        """
        last = self.entries[-1]
        latest_mm = last.good_for_mm or 1e3 * radius95(last.edges[self.name].covariance[3:, 3:])
        drift_mm, covariance = 1e3 * drift.vector[-3:], 1e6 * drift.covariance[-3:, -3:]
        speed = max(float(np.linalg.norm(drift_mm)), 1e-9)
        reach = 1.96 * float(np.sqrt(drift_mm @ covariance @ drift_mm)) / speed
        likely, early, late = (
            last.time + timedelta(days=YEAR_DAYS * min(100.0, max(need_mm - latest_mm, 0.0) / rate))
            for rate in (speed, speed + reach, max(speed - reach, 1e-9))
        )
        return likely, early, late


def courses(entries: Sequence[Entry]) -> tuple[Course, ...]:
    """The years of all transforms of a cell but those of boards, from its entries by time.

    Bad results count for nothing.
    """
    by_name: dict[str, list[Entry]] = {}
    for entry in entries:
        left_out = entry.edges if entry.status == "bad" else entry.boards
        for name in entry.edges.keys() - {*left_out}:
            by_name.setdefault(name, []).append(entry)
    # The latest entries alone: the time grows with the square of their number.
    return tuple(_course(name, by_name[name][-200:]) for name in sorted(by_name))


def _course(name: str, entries: Sequence[Entry]) -> Course:
    edges = [entry.edges[name] for entry in entries]
    part = slice(0 if all(edge.oriented for edge in edges) else 3, 6)
    matrices = np.array([edge.matrix for edge in edges])
    rotations = log(matrices @ invert(matrices[:1]))[:, :3]
    offsets = np.hstack([rotations, matrices[:, :3, 3] - matrices[0, :3, 3]])[:, part]
    # Edges' covariances are in the axes of the child.
    turned = np.array([np.kron(np.eye(2), matrix[:3, :3]) for matrix in matrices])
    child_covariances = np.array([edge.covariance for edge in edges])
    covariances = (turned @ child_covariances @ turned.swapaxes(1, 2))[:, part, part]
    changes = sigma_changes = tuple[Change, ...]()
    if len(entries) > 1:
        days = np.array([(entry.time - entries[0].time) / timedelta(days=1) for entry in entries])
        changes = find_changes(days, offsets, covariances, _UNITS[part])
        log_sigmas = np.log([max(edge.sigma_mm, 1e-6) for edge in edges])[:, None]
        # Relative sigma of a sigma, which has about 20 degrees of freedom.
        noise = np.full((len(edges), 1, 1), 0.16**2)
        sigma_changes = find_changes(days, log_sigmas, noise, np.ones(1))
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    steps = tuple(change for change in changes if change.at)
    drift = next((change for change in changes if not change.at), None)
    return Course(name, tuple(entries), offsets, sigmas, steps, drift, sigma_changes)


def find_changes(
    days: FloatArray, values: FloatArray, covariances: FloatArray, units: FloatArray
) -> tuple[Change, ...]:
    """Finds a drift and steps by their Bayes factors, and returns them in this order.

    In every round each one is compared with none, beside those that were found; at the end each is
    compared without itself. All is normal, the level's prior is flat, and sizes and the factor of
    the covariance are summed over (Kass and Raftery 1995). See the module's assumptions.

    Args:
        days: (n,) ascending times, two at least.
        values: (n, d) values; what has one component does not drift.
        covariances: (n, d, d) their covariances.
        units: (d,) the unit of sizes in each.
    """
    count, gaps = len(days), np.diff(days) / YEAR_DAYS
    model = _Model(days, values / units, covariances / np.outer(units, units))
    # Four entries at least distinguish a drift from a step.
    drifts = _DRIFTS if len(units) > 1 and count >= 4 else 1e-12
    odds = [drifts, *np.clip(-np.expm1(-_STEPS_A_YEAR * gaps), 1e-6, 0.5)]
    log_odds = np.log(odds) - np.log1p(-np.array(odds))
    is_drift, found = np.arange(count) == 0, dict[int, float]()
    while len(found) < min(6, max(1, count // 2)):
        gains, sizes = model.gains(found)
        scores = np.where(np.isin(np.arange(count), [*found]), -np.inf, log_odds + gains)
        # A step's probability is that of one at any time.
        totals = [logsumexp(scores[kind]) for kind in (is_drift, ~is_drift)]
        if expit(max(totals)) < _LIKELY:
            break
        best = int(np.argmax(np.where(is_drift == (totals[0] > totals[1]), scores, -np.inf)))
        found[best] = float(sizes[best])
    probabilities = {}
    for at in [*found]:
        others = {other: size for other, size in found.items() if other != at}
        rivals = (is_drift == is_drift[at]) & ~np.isin(np.arange(count), [*others])
        probabilities[at] = float(expit(logsumexp((log_odds + model.gains(others)[0])[rivals])))
        found = found if probabilities[at] >= _LIKELY else others
    return tuple(
        Change(at, probabilities[at], vector * units, covariance * np.outer(units, units))
        for at, vector, covariance in model.estimates(sorted(found))
    )


class _Model:
    """A level and changes as normal vectors: 0 is the drift, k the step before entry k."""

    def __init__(self, days: FloatArray, values: FloatArray, covariances: FloatArray) -> None:
        count, self.dimension = values.shape
        self.size = values.size
        # A value that is exact to less than a thousandth of a unit, 1 um, does not stay so.
        weights = np.linalg.inv(covariances + 1e-6 * np.eye(self.dimension))
        weighted = np.einsum("nuv,nv->nu", weights, values)
        # The changes, the level, and none.
        drift = (days - days[-1]) / YEAR_DAYS
        shapes = np.concatenate(
            [[drift], np.tri(count)[:, 1:].T, [np.ones(count), np.zeros(count)]]
        )
        self.level, self.none = count, count + 1
        self.matrix = np.einsum("an,bn,nuv->aubv", shapes, shapes, weights, optimize=True)
        self.right = shapes @ weighted
        self.squares = float(np.sum(weighted * values))

    def _equations(self, columns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Normal equations (k, c d, c d), (k, c d) of the changes in each row of (k, c)."""
        side = columns.shape[1] * self.dimension
        blocks = self.matrix.swapaxes(1, 2)[columns[:, :, None], columns[:, None]]
        return blocks.swapaxes(2, 3).reshape(-1, side, side), self.right[columns].reshape(-1, side)

    def gains(self, found: Mapping[int, float]) -> tuple[FloatArray, FloatArray]:
        """Logarithms (n,) of the changes' Bayes factors beside those found, and their best sizes.

        Args:
            found: Sizes by change.
        """
        others = np.array([*range(self.level), self.none])
        found_columns = np.tile([self.level, *found], (len(others), 1))
        matrix, right = self._equations(np.column_stack([found_columns, others]))
        scores = np.empty((len(_SIZES), len(_INFLATIONS), len(others)))
        for at, size in enumerate(_SIZES):
            # A level within some metres: as good as flat.
            prior = np.repeat([1e-8, *(known**-2.0 for known in found.values()), size**-2.0],
                              self.dimension)  # fmt: skip
            for row, factor in enumerate(_INFLATIONS):
                normal = matrix / factor + np.diag(prior)
                solved = np.linalg.solve(normal, right[..., None] / factor)[..., 0]
                misfit = (self.squares - np.sum(right * solved, axis=1)) / factor
                scale = self.size * np.log(factor) + np.linalg.slogdet(normal)[1]
                scores[at, row] = -0.5 * (scale - np.log(prior).sum() + misfit)
        by_size = logsumexp(scores + _LOG_INFLATIONS[:, None], axis=1)
        gains = logsumexp(by_size, axis=0) - np.log(len(_SIZES))
        return gains[:-1] - gains[-1], _SIZES[by_size[:, :-1].argmax(axis=0)]

    def estimates(self, found: Sequence[int]) -> Iterator[tuple[int, FloatArray, FloatArray]]:
        """Each change with its vector (d,) and covariance (d, d), whatever its size.

        The factor of the covariance is the one that the residuals have.
        """
        (matrix,), (right,) = self._equations(np.array([[*found, self.level]]))
        covariance = np.linalg.inv(matrix)
        fitted = covariance @ right
        misfit = (self.squares - right @ fitted) / max(self.size - len(right), 1)
        covariance *= np.clip(misfit, 1.0, _INFLATIONS[-1])
        for row, at in enumerate(found):
            part = slice(row * self.dimension, (row + 1) * self.dimension)
            yield at, fitted[part], covariance[part, part]
