"""The linear mixed model: its likelihood against the covariance of all rows, written out."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from visioncal.estimation.mixed import CommonRows, MixedModel, SizePrior, Units, level_weight

# Sizes: the noise of the first units and of common rows, two errors of units, and of two groups of
# common unknowns, of which one has a share of the other, too.
SIZES, UNKNOWNS, COMMON_ROWS = 5, 9, 15


def positive(rng, *shape):
    root = rng.normal(size=(*shape, shape[-1]))
    return root @ np.swapaxes(root, -1, -2) + np.eye(shape[-1])


class _Example:
    """A model of two batches of units, common rows and a prior, beside its rows one by one."""

    def __init__(self, scale=1.0):
        rng = np.random.default_rng(0)
        first, second = (7, 5), (4, 2)
        self.units = (
            Units(
                scale * rng.normal(size=first),
                rng.normal(size=(*first, UNKNOWNS)),
                np.zeros((*first, 5)),
                positive(rng, 3, *first),
                np.arange(3),
            ),
            Units(
                scale * rng.normal(size=second),
                rng.normal(size=(*second, UNKNOWNS)),
                positive(rng, *second),
                positive(rng, 1, *second),
                np.array([2]),
            ),
        )
        self.rows = rng.normal(size=(COMMON_ROWS, UNKNOWNS))
        self.away = scale * rng.normal(size=COMMON_ROWS)
        self.known = np.pad(rng.normal(size=(2, 5)), ((0, 0), (0, UNKNOWNS - 5)))
        self.shares = np.zeros((UNKNOWNS, SIZES))
        self.shares[5:7, 3], self.shares[7:, 4], self.shares[8, 3] = 1.0, [1.0, 2.0], 0.5
        self.prior = SizePrior.of_ratios([(1, 2)], SIZES, 0.6, 1.5)
        self.model = MixedModel(
            self.units,
            (
                CommonRows(
                    self.rows.T @ self.rows,
                    self.rows.T @ self.away,
                    self.away @ self.away,
                    COMMON_ROWS,
                    noise=0,
                ),
                CommonRows(self.known.T @ self.known, np.zeros(UNKNOWNS)),
            ),
            self.shares,
            self.prior,
        )

    def covariance(self, logs):
        squares = np.exp(2.0 * logs)
        blocks = [
            unit.known[at] + np.tensordot(squares[unit.sizes], unit.parts[:, at], axes=1)
            for unit in self.units
            for at in range(len(unit.residuals))
        ]
        noise = block_diag(*blocks, squares[0] * np.eye(COMMON_ROWS), np.eye(2))
        return noise + (self.jacobian * (self.shares @ squares)) @ self.jacobian.T

    @property
    def jacobian(self):
        units = [unit.jacobian.reshape(-1, UNKNOWNS) for unit in self.units]
        return np.concatenate([*units, self.rows, self.known])

    @property
    def residuals(self):
        return np.concatenate(
            [*(unit.residuals.ravel() for unit in self.units), self.away, np.zeros(2)]
        )

    def projection(self, logs):
        """P of the restricted likelihood, and the information on the flat unknowns."""
        weights = np.linalg.inv(self.covariance(logs))
        flat = self.jacobian[:, ~self.shares.any(axis=1)]
        information = flat.T @ weights @ flat
        absorbed = weights @ flat @ np.linalg.solve(information, flat.T @ weights)
        return weights - absorbed, information

    def value(self, logs):
        matrix, information = self.projection(logs)
        determinants = sum(np.linalg.slogdet(it)[1] for it in (self.covariance(logs), information))
        squares = self.residuals @ matrix @ self.residuals
        return 0.5 * (determinants + squares) + self.prior.at(logs).value


LOGS = np.log([0.5, 0.8, 0.3, 1.2, 0.7])


def test_the_likelihood_is_that_of_all_rows():
    example = _Example()
    for logs in (LOGS, LOGS + 0.4):
        assert example.model.at(logs).value == pytest.approx(example.value(logs), abs=1e-9)


def test_the_slope_is_that_of_the_likelihood():
    example, step = _Example(), 1e-5
    here = example.model.at(LOGS)
    for size, shift in enumerate(step * np.eye(SIZES)):
        slope = (example.value(LOGS + shift) - example.value(LOGS - shift)) / (2 * step)
        assert here.gradient[size] == pytest.approx(slope, abs=1e-6)


def test_the_curvature_is_the_average_information():
    example, step = _Example(), 1e-6
    matrix, _ = example.projection(LOGS)
    pulled = matrix @ example.residuals
    working = np.array(
        [
            (example.covariance(LOGS + shift) - example.covariance(LOGS - shift)) @ pulled
            for shift in step * np.eye(SIZES)
        ]
    ) / (2 * step)
    expected = 0.5 * working @ matrix @ working.T + example.prior.at(LOGS).curvature
    np.testing.assert_allclose(example.model.at(LOGS).curvature, expected, atol=1e-6)


def test_the_unknowns_are_the_best_prediction_with_its_covariance():
    example = _Example()
    here = example.model.at(LOGS, is_sloped=False)
    squares, is_random = np.exp(2.0 * LOGS), example.shares.any(axis=1)
    own = np.where(is_random, example.shares @ squares, 0.0)
    jacobian = example.jacobian
    noise = example.covariance(LOGS) - (jacobian * own) @ jacobian.T
    information = jacobian.T @ np.linalg.solve(noise, jacobian)
    information[is_random, is_random] += 1.0 / own[is_random]
    gradient = jacobian.T @ np.linalg.solve(noise, example.residuals)
    np.testing.assert_allclose(here.values, np.linalg.solve(information, gradient), atol=1e-9)
    np.testing.assert_allclose(here.root @ here.root.T, np.linalg.inv(information), atol=1e-9)


def test_the_most_likely_sizes_have_no_slope_between_their_bounds():
    example = _Example(scale=3.0)
    found = example.model.maximised(LOGS, np.log(1e-3), np.log(1e3))
    inside = found.logs > np.log(2e-3)
    assert inside.sum() >= 3
    # The search ends where a step gains a millionth of log-likelihood.
    assert np.abs(found.gradient[inside]).max() < 1e-2
    assert example.value(found.logs) <= example.value(LOGS)


@pytest.mark.parametrize("true_size", [0.0, 3.0])
def test_the_likeliest_size_of_more_unknowns_is_that_of_the_likelihood(true_size):
    """In steps of a fifth, with all other sizes held, of errors that the first units share."""
    example, rng = _Example(), np.random.default_rng(1)
    units = example.units[0]
    moved = rng.normal(size=(*units.residuals.shape, 8))
    units.residuals[:] += moved @ (true_size * rng.normal(size=8))
    size, gain = example.model.at(LOGS).likely_size(moved, np.ones(len(moved), dtype=bool))
    without = example.value(LOGS)

    def beside(value):
        added = value**2 * np.einsum("uik,vjk->uivj", moved, moved).reshape(35, 35)
        original = example.covariance
        example.covariance = lambda logs: original(logs) + np.pad(added, (0, 8 + COMMON_ROWS + 2))
        try:
            return example.value(LOGS)
        finally:
            del example.covariance

    sizes = np.exp(np.arange(np.log(1e-4), np.log(1e2), 0.1))
    values = np.array([beside(value) for value in sizes])
    # Between two sizes that are tried, a value is hardly larger.
    assert gain == pytest.approx(max(without - values.min(), 0.0), abs=0.1)
    if true_size:
        assert size == pytest.approx(sizes[values.argmin()], rel=0.15)
    else:
        assert size < 0.5


def test_a_size_of_nothing_is_found_beside_a_large_one():
    """Only the first coordinate errs: what both have of their own is lost in the rounding."""
    common = np.random.default_rng(2).normal(0.0, 1.0, (40, 1))
    parts = np.zeros((2, 40, 2, 2))
    parts[0, :, 0, 0] = parts[1, :, 0, 0] = parts[1, :, 1, 1] = 1.0
    units = Units(
        np.hstack([common, np.zeros((40, 1))]),
        np.tile([[1.0], [0.0]], (40, 1, 1)),
        np.zeros((40, 2, 2)),
        parts,
        np.arange(2),
    )
    model = MixedModel((units,), (), np.zeros((1, 2)))
    found = model.maximised(np.log([3.0, 3.0]), np.log(1e-10), np.log(1e2))
    assert np.isfinite(found.value)
    # Forty of them tell a size to a ninth.
    assert np.exp(found.logs[0]) == pytest.approx(1.0, rel=0.4)
    assert np.exp(found.logs[1]) < 1e-5


def test_a_size_counts_by_its_evidence_and_its_prior():
    # Akaike: a parameter costs one in log-likelihood.
    assert level_weight(2.0) == pytest.approx(0.5)
    assert level_weight(2.0 + 2.0 * np.log(9.0), prior=0.1) == pytest.approx(0.5)
    assert (level_weight(1e5, prior=1e-3), level_weight(-1e5)) == pytest.approx((1.0, 0.0))
