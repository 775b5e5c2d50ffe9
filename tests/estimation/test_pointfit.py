"""A fixture's frame from the coordinates of its points: the fit, its sigma, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import f as f_distribution
from scipy.stats import kstest
from support.parts import (
    away,
    even,
    jacobian,
    moved,
    noise_of,
    pairs_of,
    placed,
    some_drawing,
    some_frame,
)

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.estimation.pointfit import fit_points, fixture_problem
from visioncal.estimation.points import Placement, fit_groups
from visioncal.estimation.procrustes import align


def uneven(rng: np.random.Generator, count: int) -> FloatArray:
    """Covariances (n, 3, 3) of points that a camera saw: ten times worse along some direction."""
    root = 5e-5 * np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    root[:, :, 0] *= 10.0
    return root @ np.swapaxes(root, 1, 2)


def point_bound(frame: FloatArray, nominal: FloatArray, spreads: FloatArray) -> FloatArray:
    """Least covariance (6, 6) of a frame from points with (n, 3, 3) covariances (Cramer-Rao)."""
    by_step = jacobian(lambda array: placed(moved(frame, array), nominal), 6)
    return np.linalg.inv(np.einsum("nij,nik,nkl->jl", by_step, np.linalg.inv(spreads), by_step))


NOISE_M = 1e-4


def measured_part(seed, count, noise_m=NOISE_M):
    """A frame and the points of a part that lies there."""
    rng = np.random.default_rng(seed)
    frame, nominal = some_frame(rng), some_drawing(rng, count)
    return frame, pairs_of(nominal, placed(frame, nominal) + noise_m * rng.normal(size=(count, 3)))


@pytest.mark.parametrize("count", [3, 4, 12])
def test_exact_points_give_the_exact_frame(count):
    frame, pairs = measured_part(1, count, 0.0)
    found = fit_points(pairs)
    # Rounding of coordinates near a metre.
    assert np.abs(found.agreement.fit.state.frame - frame).max() < 1e-13
    assert found.scale.value == pytest.approx(1.0, abs=1e-13)
    assert not found.scale.differs
    assert found.agreement.mask.all()
    assert np.abs(found.agreement.fit.groups.residuals).max() < 1e-13


@pytest.mark.parametrize("scaled", [False, True])
def test_derivatives_are_those_of_the_residuals(scaled):
    rng = np.random.default_rng(2)
    problem = fixture_problem(
        pairs_of(some_drawing(rng, 5), rng.normal(size=(5, 3))), scaled=scaled
    )
    state = Placement(some_frame(rng), scale=1.3 if scaled else 1.0)
    found = jacobian(
        lambda step: problem.linearise(problem.move(state, step)).residuals, 7 if scaled else 6
    )
    # Central differences of lengths near a metre are exact to some 1e-9.
    assert np.abs(problem.linearise(state).jacobian - found).max() < 1e-8


def test_the_error_over_its_sigma_is_distributed_as_it_should_be():
    shares = []
    for seed in range(240):
        frame, pairs = measured_part(seed, 3 + seed % 6)
        fit = fit_groups(fixture_problem(pairs))
        error = away(fit.state.frame, frame)
        square = error @ np.linalg.solve(fit.covariance, error) / 6
        shares.append(f_distribution.cdf(square, 6, fit.freedom))
    # With even noise of unknown level it is F, exactly but for the curvature of turns by 0.1 deg.
    assert kstest(shares, "uniform").pvalue > 1e-2


def test_known_and_unknown_noise_add_up():
    squares, levels = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        frame, nominal, known = some_frame(rng), some_drawing(rng, 10), uneven(rng, 10)
        noise = noise_of(known + even(10, 2 * NOISE_M), rng)
        pairs = pairs_of(nominal, placed(frame, nominal) + noise, known)
        fit = fit_groups(fixture_problem(pairs))
        error = away(fit.state.frame, frame)
        squares.append(error @ np.linalg.solve(fit.covariance, error))
        levels.append(fit.sigma)
    # Of a chi-square with six degrees, a little widened by some twenty residuals' noise level: the
    # mean of F is 6 * 20 / 18 = 6.7, and 200 draws scatter by 0.3.
    assert 5.6 < np.mean(squares) < 7.6
    assert np.median(levels) == pytest.approx(2 * NOISE_M, rel=0.1)


def test_weights_reach_the_bound():
    errors, plain, bounds = [], [], []
    for seed in range(120):
        rng = np.random.default_rng(seed)
        frame, nominal, known = some_frame(rng), some_drawing(rng, 6), uneven(rng, 6)
        pairs = pairs_of(nominal, placed(frame, nominal) + noise_of(known, rng), known)
        fit = fit_groups(fixture_problem(pairs))
        errors.append(away(frame, fit.state.frame) ** 2)
        plain.append(away(frame, align(pairs.measured, nominal)) ** 2)
        bounds.append(np.diag(point_bound(frame, nominal, known)))
    share = np.sqrt(np.mean(errors, axis=0) / np.mean(bounds, axis=0))
    # A sum of 120 squares scatters by 6 % in its root, and the noise's level costs a little.
    assert share.max() < 1.2
    # Even weights ignore that each point is ten times better in two directions.
    assert np.sqrt(np.mean(plain, axis=0) / np.mean(bounds, axis=0)).min() > 1.5


def test_the_covariance_is_the_bound_where_the_noise_is_known():
    rng = np.random.default_rng(4)
    frame, nominal, known = some_frame(rng), some_drawing(rng, 8), uneven(rng, 8)
    pairs = replace(
        pairs_of(nominal, placed(frame, nominal), known), nominal_sigma_m=np.full(8, NOISE_M)
    )
    bound = point_bound(frame, nominal, known + even(8, NOISE_M))
    # The points are exact, so that no noise is estimated; differences are exact to 1e-8.
    assert np.allclose(fit_points(pairs).agreement.fit.covariance, bound, rtol=1e-5, atol=1e-14)


def test_shifted_numbers_are_refused():
    _, pairs = measured_part(6, 9)
    with pytest.raises(DataError, match="points are exchanged: P0 is P1"):
        fit_points(replace(pairs, measured=np.roll(pairs.measured, -1, axis=0)))


@pytest.mark.parametrize("flip", [[-1, 1, 1], [1, 1, -1], [-1, -1, -1]])
@pytest.mark.parametrize("count", [4, 8])
def test_a_mirrored_drawing_is_refused(flip, count):
    _, pairs = measured_part(8, count)
    with pytest.raises(DataError, match="mirror image of the drawing"):
        fit_points(replace(pairs, nominal=pairs.nominal * flip))


def test_a_mirrored_part_that_other_names_nearly_explain_is_mirrored():
    """A box but for one corner: its corners renamed nearly fit the mirrored one."""
    drawn = np.array([[x, y, z] for x in (0.0, 0.3) for y in (0.0, 0.2) for z in (0.0, 0.1)])
    drawn[0] = 0.025, 0.02, 0.0
    with pytest.raises(DataError, match="mirror image of the drawing"):
        fit_points(pairs_of(drawn, drawn * [-1.0, 1.0, 1.0]))


def test_points_in_one_place_are_refused():
    points = np.tile([0.1, 0.2, 0.3], (4, 1))
    with pytest.raises(DataError, match="do not fit the drawing"):
        fit_points(pairs_of(some_drawing(np.random.default_rng(1), 4), points))


@pytest.mark.parametrize("factor", [1000.0, 25.4])
@pytest.mark.parametrize("count", [3, 9])
def test_another_unit_is_another_scale(factor, count):
    _, pairs = measured_part(11, count)
    scale = fit_points(replace(pairs, measured=factor * pairs.measured)).scale
    assert scale.differs
    assert scale.value == pytest.approx(factor, rel=1e-2)
    with pytest.raises(DataError, match="times as large as drawn"):
        fit_points(replace(pairs, nominal=pairs.nominal / factor))


def test_another_drawing_is_refused_with_the_scale_that_would_fit():
    _, pairs = measured_part(12, 6)
    with pytest.raises(DataError, match=r"do not fit the drawing.*1\.\d+ times as large as drawn"):
        fit_points(replace(pairs, nominal=pairs.nominal / 1.3))


def test_the_expected_noise_is_compared_with_what_is_seen():
    _, pairs = measured_part(13, 4, 1e-3)
    assert fit_points(pairs).agreement.explained
    assert not fit_points(pairs, expected_noise_m=NOISE_M).agreement.explained
    assert fit_points(pairs, expected_noise_m=1e-3).agreement.explained


def test_the_frame_moves_with_each_point_as_it_says():
    frame, pairs = measured_part(5, 5, 0.0)
    pairs = replace(pairs, covariances=uneven(np.random.default_rng(5), 5))
    found = fit_points(pairs).agreement.fit.by_points

    def moved(step):
        measured = pairs.measured + step.reshape(5, 3)
        return away(frame, fit_points(replace(pairs, measured=measured)).agreement.fit.state.frame)

    # Of exact points; the steps of a micrometre leave 1e-8 of a gain near one, and some of its
    # slope: a frame turns by radians a metre over points of 0.1 m.
    expected = np.moveaxis(jacobian(moved, 15).reshape(6, 5, 3), 0, 1)
    assert np.abs(found - expected).max() < 1e-4
