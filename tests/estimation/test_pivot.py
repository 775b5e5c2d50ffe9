"""The pivot: a tool's tip and rotation from touches, wrong touches, and poor motion."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.marks import slow
from support.touched import (
    EXACT,
    POINTS,
    TIP,
    TURN,
    Job,
    error_of,
    relabelled,
    slipped,
    touched,
    turned,
)

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import compose, exp, invert
from visioncal.estimation.pivot import fit_pivot, tool_problem
from visioncal.estimation.points import Placement
from visioncal.estimation.problem_parts import Noise

ROBOT = Noise.of_robot(5e-5, 3e-5)
WAY = np.array([0.48, -0.6, 0.64])


def rejected(fit):
    return np.flatnonzero(~fit.agreement.mask).tolist()


@pytest.mark.parametrize("job", [Job(tips=3), Job(tips=2, points=2), Job(axes=1), Job(points=3)])
def test_exact_touches_give_the_exact_tool(job):
    made = touched(replace(job, contact_m=0.0), 1)
    fit = fit_pivot(made.touches)
    # Exact in double precision, at levers of a metre and the weakest of these geometries.
    assert fit.flange_from_tool[:3, 3] == pytest.approx(TIP, abs=1e-11)
    assert fit.agreement.fit.state.points == pytest.approx(POINTS[: job.points], abs=1e-11)
    turn = TURN.as_matrix() if job.axes else np.eye(3)
    assert fit.flange_from_tool[:3, :3] == pytest.approx(turn, abs=1e-10)
    assert fit.oriented == (job.axes > 0)
    assert fit.agreement.mask.all()
    if not fit.oriented:
        assert not fit.covariance[:3].any()


def test_three_touches_that_agree_by_chance_are_not_believed():
    squares = []
    for seed in range(40):
        fit = fit_pivot(touched(Job(tips=3), seed).touches)
        error = fit.flange_from_tool[:3, 3] - TIP
        squares.append(error @ np.linalg.solve(fit.covariance[3:, 3:], error))
    # Chi-square of three stays under 31, five sigmas, in all but one case of a million.
    assert max(squares) < 31.0
    assert (
        fit_pivot(touched(Job(tips=3), 0).touches, expected_sigma_m=3e-4).agreement.fit.sigma
        >= 3e-4
    )


@pytest.mark.parametrize("oriented", [False, True])
def test_derivatives_are_those_of_the_residuals(oriented):
    # Where the touches close: elsewhere the derivatives leave out what noise would add.
    made = touched(Job(tips=3, points=2, axes=2, contact_m=0.0), 2)
    problem = tool_problem(made.touches, ROBOT, oriented=oriented)
    state = Placement(compose(TURN.as_matrix(), TIP), POINTS[:2])
    jacobian = problem.linearise(state).jacobian
    for at, step in enumerate(1e-6 * np.eye(jacobian.shape[2])):
        ahead, behind = (
            problem.linearise(problem.move(state, value)).residuals for value in (step, -step)
        )
        # Central differences at 1e-6 err by their square and by rounding over the step.
        assert jacobian[:, :, at] == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)


def test_the_gradient_is_exact_far_from_closing_too():
    made = touched(Job(tips=3, points=2, axes=2), 2)
    problem = tool_problem(made.touches, EXACT, oriented=True)
    twist = np.array([0.1, -0.2, 0.3, 0.01, 0.02, -0.01])
    state = Placement(compose(TURN.as_matrix(), TIP) @ exp(twist), POINTS[:2] + 0.01)

    def cost(step):
        return np.sum(problem.linearise(problem.move(state, step)).residuals ** 2) / 2

    groups = problem.linearise(state)
    gradient = np.einsum("mij,mi->j", groups.jacobian, groups.residuals)
    expected = [(cost(value) - cost(-value)) / 2e-6 for value in 1e-6 * np.eye(12)]
    # Central differences of a cost of 0.01 are exact to rounding over the step.
    assert gradient == pytest.approx(np.array(expected), abs=1e-10)


def test_the_robots_noise_is_carried_to_the_touched_point():
    made = touched(Job(tips=1, axes=1), 3)
    problem = tool_problem(made.touches, Noise.of_robot(1e-3, 2e-3), oriented=True)
    tool, point = compose(TURN.as_matrix(), TIP), np.array([*POINTS[0], 1.0])
    known = problem.linearise(Placement(tool, POINTS[:1])).known
    for at, flange in enumerate(made.touches.base_from_flange):
        jacobian = [
            (invert(flange @ exp(step) @ tool) - invert(flange @ exp(-step) @ tool)) @ point / 2e-5
            for step in 1e-5 * np.eye(6)
        ]
        slope = np.array(jacobian)[:, :3].T * np.repeat([1e-3, 2e-3], 3)
        # The floor of a micrometre is 2.5e-7 of the level.
        assert known[at] == pytest.approx(slope @ slope.T, rel=1e-5, abs=1e-11)


@pytest.mark.parametrize(
    "job",
    [
        Job(tips=6, axes=2),
        *(slow(job) for job in (Job(noise=ROBOT), Job(tips=4, points=3))),
    ],
)
def test_error_and_covariance_agree(job):
    squared = []
    for seed in range(30):
        made = touched(job, seed)
        fit = fit_pivot(made.touches, job.noise)
        free = np.arange(0 if job.axes else 3, 6)
        error = error_of(fit.flange_from_tool) if job.axes else np.zeros(6)
        if not job.axes:
            error[3:] = fit.flange_from_tool[:3, 3] - TIP
        covariance = fit.covariance[np.ix_(free, free)]
        squared.append(error[free] @ np.linalg.solve(covariance, error[free]))
    size = len(free)
    # An F distribution over 24 degrees of freedom or more: 9 % over its size on average, and its
    # standard deviation is at most 1.2 sqrt(2 size); four standard errors of the mean.
    assert abs(np.mean(squared) - 1.09 * size) < 4 * 1.2 * np.sqrt(2 * size / 30)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "spoil",
    [
        lambda value: slipped(value, 4, 1e-3 * WAY),
        lambda value: slipped(value, 4, 5e-3 * WAY),
        lambda value: turned(value, 4, np.deg2rad(2.0) * WAY),
    ],
    ids=["slip of 1 mm", "slip of 5 mm", "turn of 2 deg"],
)
def test_one_wrong_touch_in_ten_is_left_out(spoil, seed):
    fit = fit_pivot(spoil(touched(Job(noise=ROBOT), seed).touches), ROBOT)
    assert rejected(fit) == [4]
    assert fit.agreement.beyond[4] > 1.0
    # What is left errs as ten touches of 0.1 mm do: half of that, and six times it for certain.
    assert np.linalg.norm(fit.flange_from_tool[:3, 3] - TIP) < 6e-4


def test_a_wrong_touch_of_an_axis_is_left_out_where_others_tell():
    made = touched(Job(axes=3), 5)
    fit = fit_pivot(slipped(made.touches, 11, 5e-3 * made.truly[11].apply(TURN.apply([1, 0, 0]))))
    assert rejected(fit) == [11]


def test_a_lone_touch_of_an_axis_is_not_accused():
    made = touched(Job(axes=1), 5)
    aside = 5e-3 * made.truly[10].apply(TURN.apply([1, 0, 0]))
    fit = fit_pivot(slipped(made.touches, 10, aside))
    assert fit.agreement.mask.all()
    assert not fit.agreement.beyond[10:].any()


def test_of_two_touches_of_a_point_neither_is_accused():
    touches = touched(Job(tips=5, points=2), 3).touches
    # Of point B there are one touch of its own and one that was slipped.
    few = touches.subset(np.array([True] * 5 + [True, True] + [False] * 3))
    fit = fit_pivot(slipped(few, 5, 2e-3 * WAY))
    assert fit.agreement.mask.all()
    assert np.flatnonzero(fit.agreement.doubtful).tolist() == [5, 6]
    assert not fit.agreement.explained


def test_sound_touches_are_kept():
    lost = [
        seed
        for seed in range(20)
        if not fit_pivot(touched(Job(), seed).touches).agreement.mask.all()
    ]
    # One in a thousand loses one by design: more than one of 20 has a probability of 2e-4.
    assert len(lost) <= 1


def test_small_turns_are_refused_with_their_size():
    rng = np.random.default_rng(4)
    leans = np.deg2rad(0.6) * rng.standard_normal((10, 3))
    rotations = Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec(leans)
    place = POINTS[0] - rotations.apply(TIP) + 5e-4 * rng.standard_normal((10, 3))
    touches = replace(
        touched(Job(), 1).touches, base_from_flange=compose(rotations.as_matrix(), place)
    )
    with pytest.raises(DegenerateError, match=r"sigma of .* mm \(limit 5\).*turn by at most"):
        fit_pivot(touches)


def test_touches_that_scatter_are_told_from_touches_that_do_not_turn():
    touches = touched(Job(tips=4, contact_m=0.02, cone_deg=20.0), 1).touches
    with pytest.raises(DegenerateError, match=r"at a scatter of 1\d mm"):
        fit_pivot(touches)


@pytest.mark.parametrize(
    ("job", "keep", "match"),
    [
        (Job(tips=2), None, "2 touches of kind point"),
        (Job(axes=1), slice(0, 11), "none of kind xz"),
        (Job(axes=1), [*range(10), 11], "none of kind z:"),
    ],
)
def test_missing_touches_are_named(job, keep, match):
    touches = touched(job, 1).touches
    chosen = np.zeros(len(touches), dtype=bool)
    chosen[slice(None) if keep is None else keep] = True
    with pytest.raises(DataError, match=match):
        fit_pivot(touches.subset(chosen))


def test_an_axis_touch_of_a_point_that_the_tip_never_met_is_refused():
    touches = touched(Job(axes=1), 1).touches
    other = replace(relabelled(touches, 10, 1), names=("A", "B"))
    with pytest.raises(DataError, match="touch 10 of kind z is of point 'B'"):
        fit_pivot(other)


def test_axis_touches_too_near_to_the_tip_are_refused():
    made = touched(Job(axes=1), 1)
    poses = made.touches.base_from_flange.copy()
    # The point stays on the axis, but 2 mm from the tip.
    near = made.reached[10] - [0.0, 0.0, 2e-3]
    poses[10, :3, 3] += made.truly[10].apply(TURN.apply(near))
    with pytest.raises(DegenerateError, match="of kind z or xz have their points too near"):
        fit_pivot(replace(made.touches, base_from_flange=poses))


def test_touches_on_opposite_sides_of_the_tip_are_refused_by_name():
    made = touched(Job(axes=3), 1)
    poses = made.touches.base_from_flange.copy()
    poses[11, :3, 3] += 2 * made.truly[11].apply(TURN.apply(made.reached[11]))
    with pytest.raises(DataError, match=r"kind z lie on both sides: 11 on .* than 10, 12"):
        fit_pivot(replace(made.touches, base_from_flange=poses))


def test_inverse_poses_are_recognised_by_a_far_tip():
    one = touched(Job(), 2).touches
    assert fit_pivot(replace(one, base_from_flange=invert(one.base_from_flange))).looks_inverse
    assert not fit_pivot(one).looks_inverse
