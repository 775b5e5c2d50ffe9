"""Frames and tools from points and touches: the fit, its noise and numbering, what is refused."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.marks import seeds
from support.misfits import misfit
from support.parts import even, noise_of, pairs_of, placed, some_drawing, some_frame
from support.refusals import raised
from support.slopes import jacobian
from support.touched import POINTS, TIP, TURN, Job, error_of, relabelled, slipped
from support.touched import touched as touches_of

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.robust import small_sets
from visioncal.core.transforms import compose, exp, invert, log
from visioncal.core.types import FloatArray
from visioncal.estimation.points import Groups, Placement, fit_groups
from visioncal.estimation.problem_parts import Noise
from visioncal.frames.group_outliers import distances, find_inlier_groups
from visioncal.frames.pivot import fit_pivot, tool_problem
from visioncal.frames.pointfit import PointPairs, fit_features, fit_points, fixture_problem
from visioncal.results import Edge

TRUTH = np.array([0.3, -0.2, 0.5, 0.1, 0.0, -0.4])
SIGMA = 1e-4
NOISE_M = 1e-4
ONE_EACH = ("origin", "x", "xy")
ROBOT = Noise.of_robot(5e-5, 3e-5)


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


def lines(seed, count=10, sigma=SIGMA, partial=False):
    rng = np.random.default_rng(seed)
    slopes = rng.standard_normal((count, 3, 6))
    observed = np.ones((count, 3), dtype=bool)
    observed[::2, 2] = not partial
    values = slopes @ TRUTH + sigma * rng.standard_normal((count, 3))
    return Lines(slopes, values, observed, np.zeros((count, 3, 3)))


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
                frame @ exp(step[:6]), (point + np.pad(step[6:], (0, 9 - len(step))))[None]
            )

        by_step = jacobian(touched, size)[0] / sigma_m
        whole = by_step.T @ by_step
        across = whole[:6, 6:]
        total += whole[:6, :6] - across @ np.linalg.solve(whole[6:, 6:], across.T)
    return np.linalg.inv(total)


def uneven(rng: np.random.Generator, count: int) -> FloatArray:
    """Covariances (n, 3, 3) of points that a camera saw: ten times worse along some direction."""
    root = 5e-5 * np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    root[:, :, 0] *= 10.0
    return root @ np.swapaxes(root, 1, 2)


def point_bound(frame: FloatArray, nominal: FloatArray, spreads: FloatArray) -> FloatArray:
    """Least covariance (6, 6) of a frame from points with (n, 3, 3) covariances (Cramer-Rao)."""
    by_step = jacobian(lambda array: placed(frame @ exp(array), nominal), 6)
    return np.linalg.inv(np.einsum("nij,nik,nkl->jl", by_step, np.linalg.inv(spreads), by_step))


def featured(seed, kinds, noise_m=NOISE_M):
    """A frame, and touches of its features."""
    rng = np.random.default_rng(seed)
    frame = some_frame(rng)
    return frame, noisy(some_touches(rng, frame, kinds), rng, noise_m)


def of_features():
    rng = np.random.default_rng(2)
    return fixture_problem(featured(2, ONE_EACH * 2)[1]), Placement(some_frame(rng))


def of_points(scaled):
    rng = np.random.default_rng(2)
    pairs = pairs_of(some_drawing(rng, 5), rng.normal(size=(5, 3)))
    state = Placement(some_frame(rng), scale=1.3 if scaled else 1.0)
    return fixture_problem(pairs, scaled=scaled), state


def of_a_tool(oriented):
    # Where the touches close: elsewhere the derivatives leave out what noise would add.
    made = touches_of(Job(tips=3, points=2, axes=2, contact_m=0.0), 2)
    state = Placement(compose(TURN.as_matrix(), TIP), POINTS[:2])
    return tool_problem(made.touches, ROBOT, oriented=oriented), state


@pytest.mark.parametrize("of", [of_features, *product((of_points, of_a_tool), (False, True))])
def test_derivatives_are_those_of_the_residuals(of):
    problem, state = of() if of is of_features else of[0](of[1])
    slopes = problem.linearise(state).jacobian
    found = jacobian(
        lambda step: problem.linearise(problem.move(state, step)).residuals, slopes.shape[2]
    )
    # Central differences of lengths near a metre are exact to some 1e-9.
    assert np.abs(slopes - found).max() < 1e-8


@pytest.mark.parametrize("off_m", [0.0, 2e-4])
@pytest.mark.parametrize(
    ("local", "axis", "words"),
    [
        ([[0.0, 0, 0], [0, 0, 0], [0.1, 0.2, 0]], (1, 0), "mm from the origin"),
        ([[0.0, 0, 0], [0.3, 0, 0], [0.1, 0, 0]], (2, 1), r"about its x .*mm from the x axis"),
    ],
)
def test_touches_that_determine_no_direction_are_refused(local, axis, words, off_m):
    frame, points = some_frame(np.random.default_rng(9)), np.array(local)
    points[axis] = off_m
    touches = replace(featured(9, ONE_EACH)[1], measured=placed(frame, points))
    raised(DegenerateError, words, fit_features, touches)


@pytest.mark.parametrize("kind", ["x", "xy"])
def test_features_that_contradict_each_other_are_refused(kind):
    frame, touches = featured(11, (*ONE_EACH, kind), 0.0)
    local = placed(np.linalg.inv(frame), touches.measured)
    local[3] *= [-1.0, -1.0, 1.0]
    with pytest.raises(DataError, match=f"kind {kind} lie on both sides") as caught:
        fit_features(replace(touches, measured=placed(frame, local)))
    assert "3" in caught.value.culprits
    _, touches = featured(7, ("origin", "origin", "x", "xy"))
    points = touches.measured.copy()
    points[1] += 0.05 * np.array([0.6, 0.0, 0.8])
    # Half of 50 mm at each of the two, and nothing at the others: 25 mm / sqrt(2).
    with pytest.raises(DataError, match=r"contradict each other: they are 1[78]") as caught:
        fit_features(replace(touches, measured=points))
    assert caught.value.culprits[0] in {"0", "1"}


def test_wrong_touches_of_an_axis_are_left_out_where_others_agree():
    for axes, at, left_out in ((3, 11, [11]), (1, 10, [])):
        made = touches_of(Job(axes=axes), 5)
        aside = 5e-3 * made.truly[at].apply(TURN.apply([1, 0, 0]))
        fit = fit_pivot(slipped(made.touches, at, aside))
        assert rejected(fit) == left_out
        # A lone touch of an axis is not accused.
        assert left_out or not fit.agreement.beyond[10:].any()


def of_other_kinds(made):
    kinds = list(made.touches.kinds)
    kinds[10], kinds[-1] = kinds[-1], kinds[10]
    return replace(made.touches, kinds=tuple(kinds))


def tips_alone(made):
    return made.touches


def without(*rows):
    return lambda made: made.touches.subset(~np.isin(np.arange(len(made.touches)), rows))


def of_another_point(made):
    return replace(relabelled(made.touches, 10, 1), names=("A", "B"))


def moved_by(row, tip_m, reach):
    """The flange of a touch moved so that the tool's point stays on its axis."""

    def spoil(made):
        by = np.array(tip_m) + reach * made.reached[row]
        return slipped(made.touches, row, made.truly[row].apply(TURN.apply(by)))

    return spoil


def small_turns(made):
    rng = np.random.default_rng(4)
    leans = np.deg2rad(0.6) * rng.standard_normal((10, 3))
    rotations = Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec(leans)
    place = POINTS[0] - rotations.apply(TIP) + 5e-4 * rng.standard_normal((10, 3))
    return replace(made.touches, base_from_flange=compose(rotations.as_matrix(), place))


@pytest.mark.parametrize(
    ("job", "spoil", "words"),
    [
        (Job(tips=2), tips_alone, "2 touches of kind point"),
        (Job(axes=1), without(11), "none of kind xz"),
        (Job(axes=1), without(10), "none of kind z:"),
        (Job(axes=1), of_another_point, "touch 10 of kind z is of point 'B'"),
        (Job(axes=1), moved_by(10, [0.0, 0.0, -2e-3], 1.0), "kind z or xz have their points too"),
        (Job(axes=3), moved_by(11, np.zeros(3), 2.0), "lie on both sides: 11 on .* than 10, 12"),
        (Job(axes=2), of_other_kinds, r"touches 10 \(xz\) and 13 \(z\) have each other's kinds"),
        (Job(), small_turns, r"sigma of .* mm \(limit 5\).*turn by at most"),
        (Job(tips=4, contact_m=0.02, cone_deg=20.0), tips_alone, r"at a scatter of 1\d mm"),
    ],
)
def test_touches_that_determine_no_tool_are_refused(job, spoil, words):
    with pytest.raises((DataError, DegenerateError), match=words):
        fit_pivot(spoil(touches_of(job, 1)))


def shifted(problem, at, by):
    values = problem.values.copy()
    values[at] += by
    return Lines(problem.jacobian, values, problem.observed, problem.known)


def test_the_covariance_is_the_scatter():
    squared, levels = [], []
    for seed in range(200):
        problem = lines(seed, partial=True)
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
    lopsided = Lines(jacobian, jacobian @ TRUTH, problem.observed, problem.known)
    noise = SIGMA * np.random.default_rng(6).standard_normal((10, 3))
    lopsided = shifted(lopsided, slice(None), noise)
    # An error along the direction that only the first group sees is a change of the unknown.
    found = find_inlier_groups(shifted(lopsided, 0, jacobian[0] @ np.array([0, 0, 0, 0, 0, 0.05])))
    assert found.mask.all()
    assert found.fit.state[5] == pytest.approx(TRUTH[5] + 0.05, abs=20 * SIGMA)


def test_where_nothing_shows_the_wrong_one_both_stay_and_are_doubtful():
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


@pytest.mark.parametrize("draws", seeds(20, 60))
def test_sound_sets_keep_all_their_groups(draws):
    lost = [seed for seed in draws if not find_inlier_groups(lines(seed, 8)).mask.all()]
    # One in a thousand loses one by design: more than two of 60 have a probability of 3e-5, more
    # than one of 20 of 2e-4.
    assert len(lost) <= 1 + len(draws) // 60


def noisy(touches, rng, noise_m=NOISE_M):
    return replace(
        touches, measured=touches.measured + noise_m * rng.normal(size=(len(touches), 3))
    )


def measured_part(seed, count, noise_m=NOISE_M):
    """A frame and the points of a part that lies there."""
    rng = np.random.default_rng(seed)
    frame, nominal = some_frame(rng), some_drawing(rng, count)
    return frame, pairs_of(nominal, placed(frame, nominal) + noise_m * rng.normal(size=(count, 3)))


@pytest.mark.parametrize("draws", seeds(50, 200))
def test_known_and_unknown_noise_add_up(draws):
    squares, levels = [], []
    for seed in draws:
        rng = np.random.default_rng(seed)
        frame, nominal, known = some_frame(rng), some_drawing(rng, 10), uneven(rng, 10)
        noise = noise_of(known + even(10, 2 * NOISE_M), rng)
        pairs = pairs_of(nominal, placed(frame, nominal) + noise, known)
        fit = fit_groups(fixture_problem(pairs))
        edge = Edge(fit.state.frame, fit.covariance)
        squares.append(misfit(edge, frame))
        levels.append(fit.sigma)
    # Of a chi-square with six degrees, a little widened by some twenty residuals' noise level: the
    # mean of F is 6 * 20 / 18 = 6.7, and so many draws scatter by 4.2 over their root.
    assert np.mean(squares) == pytest.approx(6.6, abs=14.1 / np.sqrt(len(draws)))
    assert np.median(levels) == pytest.approx(2 * NOISE_M, rel=0.1)


def test_the_frames_derivatives_by_points_are_right():
    frame, pairs = measured_part(5, 5, 0.0)
    pairs = replace(pairs, covariances=uneven(np.random.default_rng(5), 5))
    found = fit_points(pairs).agreement.fit.by_points

    def moved_frame(step):
        measured = pairs.measured + step.reshape(5, 3)
        found = fit_points(replace(pairs, measured=measured)).agreement.fit.state.frame
        return log(invert(frame) @ found)

    # Of exact points; the steps of a micrometre leave 1e-8 of a gain near one, and some of its
    # slope: a frame turns by radians a metre over points of 0.1 m.
    expected = np.moveaxis(jacobian(moved_frame, 15).reshape(6, 5, 3), 0, 1)
    assert np.abs(found - expected).max() < 1e-4


def rejected(fit):
    return np.flatnonzero(~fit.agreement.mask).tolist()


def test_the_robots_noise_is_carried_to_the_touched_point():
    made = touches_of(Job(tips=1, axes=1), 3)
    problem = tool_problem(made.touches, Noise.of_robot(1e-3, 2e-3), oriented=True)
    tool, point = compose(TURN.as_matrix(), TIP), np.array([*POINTS[0], 1.0])
    known = problem.linearise(Placement(tool, POINTS[:1])).known
    for at, flange in enumerate(made.touches.base_from_flange):

        def touched(by, flange=flange):
            return (invert(flange @ exp(by) @ tool) @ point)[:3]

        slope = jacobian(touched, 6, 1e-5) * np.repeat([1e-3, 2e-3], 3)
        # The floor of a micrometre is 2.5e-7 of the level.
        assert known[at] == pytest.approx(slope @ slope.T, rel=1e-5, abs=1e-11)


@pytest.mark.parametrize("draws", seeds(8, 20))
def test_error_and_covariance_agree(draws):
    squared = 0.0
    for seed in draws:
        fit = fit_pivot(touches_of(Job(tips=6, axes=2), seed).touches)
        error = error_of(fit.flange_from_tool)
        squared += error @ np.linalg.solve(fit.covariance, error)
    # An F distribution over 24 degrees of freedom or more: 9 % over its size on average, and its
    # standard deviation is at most 1.2 sqrt(2 6); four standard errors of the mean.
    count = len(draws)
    assert abs(squared / count - 1.09 * 6) < 4 * 1.2 * np.sqrt(2 * 6 / count)


def test_the_covariance_is_the_bound_where_the_noise_is_known():
    # The points are exact, so that no noise is estimated; differences are exact to 1e-8.
    frame, touches = featured(3, ONE_EACH * 2, 0.0)
    found = fit_features(replace(touches, covariances=even(6, NOISE_M)))
    assert np.allclose(found.fit.covariance, feature_bound(frame, touches, NOISE_M), rtol=1e-5)
    rng = np.random.default_rng(4)
    frame, nominal, known = some_frame(rng), some_drawing(rng, 8), uneven(rng, 8)
    pairs = pairs_of(nominal, placed(frame, nominal), known)
    pairs = replace(pairs, nominal_sigma_m=np.full(8, NOISE_M))
    bound = point_bound(frame, nominal, known + even(8, NOISE_M))
    assert np.allclose(fit_points(pairs).agreement.fit.covariance, bound, rtol=1e-5, atol=1e-14)


@pytest.mark.parametrize("job", [Job(tips=3), Job(tips=2, points=2), Job(axes=1), Job(points=3)])
def test_exact_touches_give_the_exact_tool(job):
    made = touches_of(replace(job, contact_m=0.0), 1)
    fit = fit_pivot(made.touches)
    # Exact in double precision, at levers of a metre and the weakest of these geometries.
    assert fit.flange_from_tool[:3, 3] == pytest.approx(TIP, abs=1e-11)
    assert fit.agreement.fit.state.points == pytest.approx(POINTS[: job.points], abs=1e-11)
    turn = TURN.as_matrix() if job.axes else np.eye(3)
    assert fit.flange_from_tool[:3, :3] == pytest.approx(turn, abs=1e-10)
    assert fit.oriented == fit.covariance[:3].any() == (job.axes > 0)
    assert fit.agreement.mask.all()
    assert not fit.looks_inverse
