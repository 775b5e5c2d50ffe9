"""Steps and drifts of a cell's years: against brute force, and against what was planted."""

from datetime import timedelta

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal
from support.site import CREEP_M, NOW, SIGMA_M, acts

from visioncal.results import years
from visioncal.results.years import courses, find_changes


def test_bayes_factors_are_those_of_dense_normal_distributions():
    """The evidence beside a change that was found, with the level's prior as it is, 1e4 units."""
    rng = np.random.default_rng(0)
    count, dimension = 6, 2
    roots = rng.normal(size=(count, dimension, dimension))
    covariances = roots @ roots.transpose(0, 2, 1) + np.eye(dimension)
    days = np.sort(rng.uniform(0.0, 700.0, count))
    shapes = np.array([(days - days[-1]) / 365.25, *np.tri(count)[:, 1:].T])
    values = rng.normal(size=(count, dimension)) + np.outer(shapes[2], [3.0, -2.0])
    gains, _ = years._Model(days, values, covariances).gains({0: 1.0})
    noise = np.zeros((count, dimension, count, dimension))
    noise[np.arange(count), :, np.arange(count)] = covariances + 1e-6 * np.eye(dimension)
    noise = noise.reshape(count * dimension, -1)

    def evidence(*changes):
        """Logarithm summed over the factor of the noise; changes are shapes with their sizes."""
        known = [(np.ones(count), 1e4), (shapes[0], 1.0), *changes]
        spread = sum(np.kron(size**2 * np.outer(x, x), np.eye(dimension)) for x, size in known)
        return np.logaddexp.reduce(
            [
                multivariate_normal.logpdf(values.ravel(), cov=factor * noise + spread) + weight
                for factor, weight in zip(years._INFLATIONS, years._LOG_INFLATIONS, strict=True)
            ]
        )

    for at, gain in enumerate(gains[1:], 1):
        by_size = [evidence((shapes[at], size)) for size in years._SIZES]
        expected = np.logaddexp.reduce(by_size) - np.log(len(by_size)) - evidence()
        # The level's precision of 1e-8 costs half of the digits.
        assert gain == pytest.approx(expected, abs=1e-5)


def world(seed, step_mm=0.0, drift_mm=0.0, looser=1.0):
    """24 entries in two years, with a step before the thirteenth."""
    rng = np.random.default_rng(seed)
    days = np.sort(rng.uniform(0.0, 730.0, 24))
    sigmas = np.array([1.5 * SIGMA_M] * 3 + [SIGMA_M] * 3)
    twists = looser * sigmas * rng.normal(size=(24, 6))
    twists[12:, 3] += 1e-3 * step_mm
    twists[:, 4] += 1e-3 * drift_mm * days / 365.25
    covariances = np.broadcast_to(np.diag(sigmas**2), (24, 6, 6))
    found = find_changes(days, twists, covariances, years._UNITS)
    drifts = [change for change in found if not change.at]
    return [change for change in found if change.at], next(iter(drifts), None)


def test_what_is_planted_is_found_and_nothing_else():
    quiet = [world(seed) for seed in range(60)]
    # Covariances that are too small by four look like no change, either.
    quiet += [world(seed, looser=2.0) for seed in range(60)]
    # One false alarm in a hundred years' courses would be a cell's in a site of fifty, each year.
    assert sum(bool(steps) or drift is not None for steps, drift in quiet) <= 1
    for seed in range(20):
        steps, drift = world(seed, step_mm=0.4)
        assert [step.at for step in steps] == [12]
        assert drift is None
        sigma = np.sqrt(steps[0].covariance[3, 3])
        # Four sigma, of twenty steps.
        assert abs(steps[0].vector[3] - 0.4e-3) < 4.0 * sigma
        steps, drift = world(seed, step_mm=0.5, drift_mm=0.5)
        assert [step.at for step in steps] == [12]
        assert abs(drift.vector[4] - 0.5e-3) < 4.0 * np.sqrt(drift.covariance[4, 4])
    (step,) = find_changes(
        np.array([0.0, 100.0]),
        np.array([np.zeros(6), [0, 0, 0, 1e-3, 0, 0]]),
        np.broadcast_to(SIGMA_M**2 * np.eye(6), (2, 6, 6)),
        years._UNITS,
    )
    # Two entries are enough for a step, and too few for a drift.
    assert step.at == 1
    assert step.vector[3] == pytest.approx(1e-3)


def test_the_time_of_a_miss_is_within_its_interval():
    # The need less 95 % of the latest entry itself, by the chi-square of three dimensions.
    inside, left_m = 0, 0.5e-3 - np.sqrt(chi2.ppf(0.95, 3)) * SIGMA_M
    for seed in range(40):
        jig = next(
            course
            for course in courses([*acts("creeping jig", seed)])
            if course.name == "base_from_jig"
        )
        true = jig.entries[-1].time + timedelta(days=365.25 * left_m / CREEP_M)
        likely, early, late = jig.missed(jig.drift, 0.5)
        assert NOW < early < likely < late
        inside += early <= true <= late
    # Of 40 intervals of 95 % fewer than 34 have the truth once in a thousand times.
    assert inside >= 34
