"""Groups of residuals: the fit, its noise, and which groups are wrong."""

from dataclasses import dataclass

import numpy as np
import pytest
from support.marks import slow

from visioncal.estimation.group_outliers import distances, find_inlier_groups
from visioncal.estimation.points import Groups, fit_groups
from visioncal.estimation.robust import small_sets

TRUTH = np.array([0.3, -0.2, 0.5, 0.1, 0.0, -0.4])
SIGMA = 1e-4


@dataclass(frozen=True, eq=False)
class Lines:
    """Groups `slopes @ x = values`, of which the last residual may be unobserved."""

    jacobian: np.ndarray
    values: np.ndarray
    observed: np.ndarray
    known: np.ndarray

    def guesses(self):
        """Solves for all groups, and for sets of three."""
        yield self._solve(np.arange(len(self.values)))
        yield from (self._solve(rows) for rows in small_sets(len(self.values), 3))

    def linearise(self, state):
        """Gives the residuals and their slopes."""
        residuals = np.where(self.observed, self.jacobian @ state - self.values, 0.0)
        return Groups(
            residuals, self.jacobian * self.observed[:, :, None], self.observed, self.known
        )

    def move(self, state, step):
        """Takes a step."""
        return state + step

    def _solve(self, rows):
        seen = self.observed[rows]
        return np.linalg.lstsq(self.jacobian[rows][seen], self.values[rows][seen], rcond=None)[0]


def lines(seed, count=10, sigma=SIGMA, known=0.0, partial=False):
    rng = np.random.default_rng(seed)
    jacobian = rng.standard_normal((count, 3, 6))
    noise = np.hypot(sigma, known) * rng.standard_normal((count, 3))
    observed = np.ones((count, 3), dtype=bool)
    observed[::2, 2] = not partial
    return Lines(
        jacobian, jacobian @ TRUTH + noise, observed, np.tile(known**2 * np.eye(3), (count, 1, 1))
    )


def shifted(problem, at, by):
    values = problem.values.copy()
    values[at] += by
    return Lines(problem.jacobian, values, problem.observed, problem.known)


def test_exact_groups_give_the_exact_answer():
    fit = fit_groups(lines(0, sigma=0.0))
    # Six unknowns of the order of one, in double precision.
    assert np.abs(fit.state - TRUTH).max() < 1e-12
    assert fit.sigma < 1e-9


@pytest.mark.parametrize("partial", [slow(False), True])
def test_the_covariance_is_the_scatter(partial):
    squared, levels = [], []
    for seed in range(200):
        problem = lines(seed, partial=partial)
        fit = fit_groups(problem)
        error = fit.state - TRUTH
        squared.append(error @ np.linalg.solve(fit.covariance, error))
        levels.append(fit.sigma**2)
    freedom = problem.observed.sum() - 6
    assert fit.freedom == freedom
    # Six times an F of (6, freedom): its mean over 200 fits stays within five standard errors.
    mean = 6 * freedom / (freedom - 2)
    covariance = np.sqrt(12 * (freedom + 4) / (freedom - 4)) * freedom / (freedom - 2)
    assert abs(np.mean(squared) - mean) < 5 * covariance / np.sqrt(200)
    # Restricted likelihood is unbiased here; a chi-square of so many has this standard error.
    assert abs(np.mean(levels) / SIGMA**2 - 1) < 5 * np.sqrt(2 / freedom / 200)


def test_what_is_known_beforehand_is_no_part_of_the_level():
    levels = [fit_groups(lines(seed, known=2 * SIGMA)).sigma for seed in range(100)]
    # Each fit knows the total of five units of variance to 29 % by its 24 degrees of freedom, all
    # hundred to 3 %; and a level that comes out below none counts as none, which adds a quarter.
    assert abs(np.mean(np.square(levels)) / SIGMA**2 - 1) < 0.8
    problem = lines(1, sigma=0.0, known=SIGMA)
    bare = Lines(problem.jacobian, problem.jacobian @ TRUTH, problem.observed, problem.known)
    fit = fit_groups(bare)
    assert fit.sigma < 0.01 * SIGMA
    expected = np.linalg.inv(np.einsum("mij,mik->jk", bare.jacobian, bare.jacobian)) * SIGMA**2
    assert fit.covariance == pytest.approx(expected, rel=1e-3, abs=1e-6 * expected.max())


def test_without_freedom_the_expected_level_stands():
    problem = lines(0, count=2)
    fit = fit_groups(problem, expected_sigma=3e-4)
    assert fit.freedom == 0
    assert fit.sigma == 3e-4
    blind = find_inlier_groups(problem, 3e-4)
    assert blind.mask.all()
    # Nothing predicts either group from the other.
    assert not blind.beyond.any()


@pytest.mark.parametrize(("count", "wrong"), [(5, 1), (10, 1), (10, 3), (20, 6)])
def test_just_the_wrong_groups_are_left_out(count, wrong):
    for seed in range(10):
        problem = lines(seed, count)
        # Thirty times the noise: the least distance that five groups can tell for certain.
        for at in range(wrong):
            problem = shifted(problem, at, 3e-3 * np.array([1.0, -1.0, 1.0]))
        found = find_inlier_groups(problem)
        assert np.flatnonzero(~found.mask).tolist() == list(range(wrong))
        assert not found.doubtful.any()
        assert (found.beyond[:wrong] > 1.0).all()


def test_a_mahalanobis_sq_is_the_distance_from_what_the_others_predict():
    problem = lines(3)
    found = find_inlier_groups(problem)
    others = np.arange(10) != 4
    jacobian, values = problem.jacobian[others].reshape(-1, 6), problem.values[others].ravel()
    predicted = np.linalg.lstsq(jacobian, values, rcond=None)[0]
    away = problem.jacobian[4] @ predicted - problem.values[4]
    covariance = np.eye(3) + problem.jacobian[4] @ np.linalg.solve(
        jacobian.T @ jacobian, problem.jacobian[4].T
    )
    squared = away @ np.linalg.solve(covariance, away) / found.fit.sigma**2
    assert distances(found.fit).squares[4] == pytest.approx(squared, rel=1e-6)


def test_a_group_that_alone_determines_a_direction_is_not_accused():
    problem = lines(5)
    jacobian = problem.jacobian.copy()
    jacobian[1:, :, 5] = 0.0
    alone = Lines(jacobian, jacobian @ TRUTH, problem.observed, problem.known)
    noise = SIGMA * np.random.default_rng(6).standard_normal((10, 3))
    alone = shifted(alone, slice(None), noise)
    # An error along the direction that only the first group sees is a change of the unknown.
    found = find_inlier_groups(shifted(alone, 0, jacobian[0] @ np.array([0, 0, 0, 0, 0, 0.05])))
    assert found.mask.all()
    assert found.fit.state[5] == pytest.approx(TRUTH[5] + 0.05, abs=20 * SIGMA)


def test_where_nothing_tells_which_is_wrong_both_stay_and_are_doubtful():
    problem = lines(7)
    jacobian = problem.jacobian.copy()
    jacobian[2:, :, 3:] = 0.0
    jacobian[:2] = 0.0
    jacobian[:2, :, 3:] = np.eye(3)
    # Two groups see three unknowns that no other does, and disagree about them.
    values = jacobian @ TRUTH + SIGMA * np.random.default_rng(8).standard_normal((10, 3))
    values[0] += 0.01
    found = find_inlier_groups(Lines(jacobian, values, problem.observed, problem.known))
    assert found.mask.all()
    assert np.flatnonzero(found.doubtful).tolist() == [0, 1]
    assert not found.explained


def test_noise_beyond_the_expected_is_told():
    assert find_inlier_groups(lines(2), SIGMA).explained
    assert not find_inlier_groups(lines(2), SIGMA / 3).explained


def test_sound_sets_keep_all_their_groups():
    lost = [seed for seed in range(60) if not find_inlier_groups(lines(seed, 8)).mask.all()]
    # One in a thousand loses one by design: more than two of 60 have a probability of 3e-5.
    assert len(lost) <= 2


def test_small_sets_are_all_that_there_are_or_sixty():
    assert len(list(small_sets(5, 3))) == 10
    assert len(list(small_sets(30, 3))) == 60
