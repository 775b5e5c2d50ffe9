"""A fixture's frame from touches of its origin, x axis and xy plane."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import f as f_distribution
from scipy.stats import kstest
from support.parts import away, even, jacobian, moved, pairs_of, placed, some_frame

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.types import FloatArray
from visioncal.estimation.pointfit import PointPairs, fit_features, fixture_problem
from visioncal.estimation.points import Placement, fit_groups


def some_touches(rng: np.random.Generator, frame: FloatArray, kinds: Sequence[str]) -> PointPairs:
    """Exact touches of a fixture's features, named 0, 1 ..."""
    ranges = {
        "origin": ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        "x": ([0.2, 0.0, 0.0], [0.4, 0.0, 0.0]),
        "xy": ([-0.1, 0.1, 0.0], [0.3, 0.3, 0.0]),
    }
    local = np.array([rng.uniform(*ranges[kind]) for kind in kinds])
    names = tuple(str(at) for at in range(len(kinds)))
    return replace(
        pairs_of(np.zeros_like(local), placed(frame, local)), labels=names, kinds=tuple(kinds)
    )


def feature_bound(frame: FloatArray, touches: PointPairs, sigma_m: float) -> FloatArray:
    """Least covariance (6, 6) of a frame from touches with even noise.

    Where a touch lies on the axis or in the plane is unknown beside the frame.
    """
    local = placed(np.linalg.inv(frame), touches.measured)
    free = {"origin": 0, "x": 1, "xy": 2}
    total = np.zeros((6, 6))
    for point, kind in zip(local, touches.kinds, strict=True):
        size = 6 + free[kind]

        def touched(step, point=point):
            return placed(
                moved(frame, step[:6]), (point + np.pad(step[6:], (0, 9 - len(step))))[None]
            )

        by_step = jacobian(touched, size)[0] / sigma_m
        whole = by_step.T @ by_step
        across = whole[:6, 6:]
        total += whole[:6, :6] - across @ np.linalg.solve(whole[6:, 6:], across.T)
    return np.linalg.inv(total)


NOISE_M = 1e-4
ONE_EACH = ("origin", "x", "xy")


def noisy(touches, rng, noise_m=NOISE_M):
    return replace(
        touches, measured=touches.measured + noise_m * rng.normal(size=(len(touches), 3))
    )


def touched(seed, kinds, noise_m=NOISE_M):
    """A frame, and touches of its features."""
    rng = np.random.default_rng(seed)
    frame = some_frame(rng)
    return frame, noisy(some_touches(rng, frame, kinds), rng, noise_m)


@pytest.mark.parametrize("each", [1, 3])
def test_exact_touches_give_the_exact_frame(each):
    frame, touches = touched(1, ONE_EACH * each, 0.0)
    found = fit_features(touches)
    # Rounding of coordinates near a metre, over a lever of 0.1 m.
    assert np.abs(found.fit.state.frame - frame).max() < 1e-13
    assert np.abs(found.fit.groups.residuals).max() < 1e-13
    assert found.mask.all()


def test_derivatives_are_those_of_the_residuals():
    rng = np.random.default_rng(2)
    _, touches = touched(2, ONE_EACH * 2)
    problem, state = fixture_problem(touches), Placement(some_frame(rng))
    found = jacobian(lambda step: problem.linearise(problem.move(state, step)).residuals, 6)
    # Central differences of lengths near a metre are exact to some 1e-9.
    assert np.abs(problem.linearise(state).jacobian - found).max() < 1e-8


@pytest.mark.slow
def test_the_error_over_its_sigma_is_distributed_as_it_should_be():
    shares = []
    kinds = ["origin", "x", "xy", "xy", "x", "xy", "origin", "x"]
    for seed in range(240):
        frame, touches = touched(seed, kinds[: 5 + seed % 4])
        fit = fit_groups(fixture_problem(touches))
        error = away(fit.state.frame, frame)
        square = error @ np.linalg.solve(fit.covariance, error) / 6
        shares.append(f_distribution.cdf(square, 6, fit.freedom))
    # With even noise of unknown level it is F, exactly but for the curvature of turns by 0.1 deg.
    assert kstest(shares, "uniform").pvalue > 1e-2


def test_the_covariance_is_the_bound():
    frame, touches = touched(3, ONE_EACH * 2, 0.0)
    found = fit_features(replace(touches, covariances=even(6, NOISE_M)))
    # The points are exact, so that no noise is estimated; differences are exact to 1e-8.
    assert np.allclose(found.fit.covariance, feature_bound(frame, touches, NOISE_M), rtol=1e-5)


def test_known_noise_stands_where_no_touch_is_to_spare():
    frame, touches = touched(4, ONE_EACH)
    found = fit_features(replace(touches, covariances=even(3, NOISE_M)), expected_noise_m=0.0)
    assert np.allclose(
        found.fit.covariance, feature_bound(found.fit.state.frame, touches, NOISE_M), rtol=1e-5
    )
    expected = fit_features(touches, expected_noise_m=NOISE_M)
    assert expected.fit.sigma == NOISE_M
    assert np.allclose(expected.fit.covariance, found.fit.covariance, rtol=1e-3)
    error = away(found.fit.state.frame, frame)
    # Chi-square of 6 stays under 23 in all but one case of a thousand.
    assert error @ np.linalg.solve(found.fit.covariance, error) < 23.0


def test_one_touch_each_is_taken_for_careful():
    _, touches = touched(5, ONE_EACH)
    found, stated = fit_features(touches), fit_features(touches, expected_noise_m=2e-4)
    assert np.allclose(stated.fit.covariance, 4.0 * found.fit.covariance)


def test_each_kind_counts_by_what_it_says():
    """Sliding along the axis and in the plane changes nothing."""
    frame, touches = touched(6, ONE_EACH * 2)
    slid = touches.measured.copy()
    found = fit_features(touches)
    axes = found.fit.state.frame[:3, :3]
    slid[touches.rows("x")[0]] += 1e-3 * axes[:, 0]
    slid[touches.rows("xy")[0]] += 1e-3 * axes[:, 0] - 2e-3 * axes[:, 1]
    again = fit_features(replace(touches, measured=slid))
    # A millimetre more of some 0.3 m of lever changes the weights of 0.1 mm by less than 1 %.
    assert np.abs(away(found.fit.state.frame, again.fit.state.frame)).max() < 5e-6
    assert np.abs(away(frame, again.fit.state.frame)[3:]).max() < 1e-3


def test_the_wrong_one_of_two_is_not_guessed():
    _, touches = touched(7, ("origin", "origin", "x", "xy"))
    points = touches.measured.copy()
    points[1] += 3e-3 * np.array([0.6, 0.0, 0.8])
    found = fit_features(replace(touches, measured=points), expected_noise_m=NOISE_M)
    assert found.mask.all()
    assert not found.explained


def test_touches_that_contradict_each_other_wildly_are_refused():
    _, touches = touched(7, ("origin", "origin", "x", "xy"))
    points = touches.measured.copy()
    points[1] += 0.05 * np.array([0.6, 0.0, 0.8])
    # Half of 50 mm at each of the two, and nothing at the others: 25 mm / sqrt(2).
    with pytest.raises(
        DataError, match=r"contradict each other: they are 1[78]\.?\d* mm off"
    ) as caught:
        fit_features(replace(touches, measured=points))
    assert caught.value.culprits[0] in {"0", "1"}


def test_a_touch_that_tells_no_direction_does_no_harm():
    """One of the x touches is on the origin, which is on the x axis, too."""
    frame, touches = touched(12, (*ONE_EACH, "x", "xy", "origin"))
    points = touches.measured.copy()
    points[3] = points[0] + NOISE_M * np.array([-1.0, 0.5, 0.5])
    found = fit_features(replace(touches, measured=points))
    assert found.mask.all()
    # A few times 0.1 mm over 0.2 m.
    assert np.abs(away(frame, found.fit.state.frame)).max() < 3e-3
    points[3] = points[0]
    guesses = list(fixture_problem(replace(touches, measured=points)).guesses())
    # 2 x 2 x 2 sets of three touches, of which two are on one line, and the means.
    assert len(guesses) == 9
    turns = [guess.frame[:3, :3] for guess in guesses]
    assert all(np.allclose(turn @ turn.T, np.eye(3)) for turn in turns)


@pytest.mark.parametrize("off_m", [0.0, 2e-4])
def test_an_x_touch_on_the_origin_is_refused(off_m):
    frame = some_frame(np.random.default_rng(9))
    local = np.array([[0.0, 0.0, 0.0], [off_m, 0.0, 0.0], [0.1, 0.2, 0.0]])
    touches = replace(touched(9, ONE_EACH)[1], measured=placed(frame, local))
    with pytest.raises(DegenerateError, match="mm from the origin"):
        fit_features(touches)


@pytest.mark.parametrize("off_m", [0.0, 2e-4])
def test_an_xy_touch_on_the_x_axis_is_refused(off_m):
    frame = some_frame(np.random.default_rng(10))
    local = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.1, off_m, 0.0]])
    touches = replace(touched(10, ONE_EACH)[1], measured=placed(frame, local))
    with pytest.raises(DegenerateError, match=r"rotation about its x .*mm from the x axis"):
        fit_features(touches)


@pytest.mark.parametrize("kind", ["x", "xy"])
def test_touches_on_both_sides_are_refused(kind):
    frame, touches = touched(11, (*ONE_EACH, kind), 0.0)
    local = placed(np.linalg.inv(frame), touches.measured)
    local[3] *= [-1.0, -1.0, 1.0]
    with pytest.raises(DataError, match=f"kind {kind} lie on both sides") as caught:
        fit_features(replace(touches, measured=placed(frame, local)))
    assert "3" in caught.value.culprits
