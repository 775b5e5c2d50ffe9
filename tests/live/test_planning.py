"""Which stops tell most: predicted information, the choice by exchange, and stops to add."""

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from support.cells import exact, known_of, reporting
from support.live_cell import postures_in_view, true_cell
from support.marks import slow

from visioncal.calibration.run import STAGES
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import exp
from visioncal.core.types import FloatArray
from visioncal.estimation.linalg import covariance_root
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.problem_parts import Noise, State
from visioncal.live.planning.cell import PlanCell
from visioncal.live.planning.design import Design, choose_stops
from visioncal.live.planning.information import WORLDS, predict_worlds, stop_factors
from visioncal.live.planning.plan import PlanRequest, make_plan
from visioncal.live.planning.purposes import PURPOSES, Purpose
from visioncal.live.planning.recorded import PartialCalibration, SessionStart, start_from_session
from visioncal.live.planning.visibility import BoardViews
from visioncal.robot import load_robot
from visioncal.simulation import CellOptions, Second, SimulatedCell, fine_camera, simulate
from visioncal.vision.targets import extent_m


def plan_cell(options: CellOptions, sigma_rad: float = 0.0, sigma_m: float = 0.0) -> PlanCell:
    """The cell as it would be planned for: guesses that are off by a draw of their sigmas."""
    true = true_cell(options)
    rng = np.random.default_rng([options.seed, 99])
    off = exp(rng.standard_normal((2, 6)) * np.repeat([sigma_rad, sigma_m], 3))
    return replace(true, x=true.x @ off[0], z=true.z @ off[1], sigma_rad=sigma_rad, sigma_m=sigma_m)


def next_best(
    begun: SessionStart,
    purpose: Purpose,
    q: FloatArray,
    count: int,
    **draw,
) -> Design:
    """The stops that a plan adds to a session, wherever the arm can drive."""
    cells = (begun.cell, *begun.cell.guesses(draw.get("worlds", WORLDS) - 1, draw.get("seed", 0)))
    worlds = predict_worlds(cells, purpose, q, recorded=begun.recorded)
    return choose_stops(worlds, count)


def so_far_of(cell: SimulatedCell, **changes) -> PartialCalibration:
    """What is known of a cell's views, as far as they tell it."""
    known = known_of(cell, level="hand-eye", **changes)
    for stage in STAGES:
        if stage.name in ("robot", "detect"):
            continue
        try:
            known = stage.run(known)
        except DegenerateError as error:
            return PartialCalibration(known, error.message)
    return PartialCalibration(known)


MOUNTS = ("eye-in-hand", "eye-to-hand")
HAND_EYE, OFFSETS, KINEMATICS = (PURPOSES[name] for name in ("hand-eye", "offsets", "kinematics"))
CELL = CellOptions(robot="ur5e")


def mm(world, rows):
    """Sigma of the place that the purpose is about, from some candidates [mm]."""
    return 1e3 * float(np.sqrt(np.trace(world.position @ world.covariance(rows))))


@pytest.fixture(scope="module")
def views():
    """Postures in view of the eye-in-hand cell."""
    return postures_in_view(CELL, 120)


@pytest.mark.parametrize("mount", MOUNTS)
def test_predicted_information_is_that_of_the_recorded_views(mount):
    """A plan is made of the estimator's own numbers, at the same poses."""
    options = exact(replace(CELL, mount=mount, views=6, cut_views=0.0))
    seen = so_far_of(simulate(options)).known
    cell = replace(true_cell(options), noise=Noise.of_robot(5e-5, 3e-5), pixel_px=0.05)
    q = simulate(options).robot.joints
    factors = stop_factors(cell, HAND_EYE, q)
    problem = seen.cell_fit.inlier_problem
    # The same corners at the plan's noise; exact ones count as seen to a millionth of a pixel.
    scale = (0.05 / max(seen.pixel_px, 1e-6)) ** 2
    views = replace(problem.observations, covariance=scale * problem.observations.covariance)
    state = State(np.stack([cell.x, cell.z]), problem.start_values)
    there = fisher_information(replace(problem, observations=views), state, cell.noise)
    summed = np.einsum("kij,kil->jl", factors, factors)
    size = 1.0 / np.sqrt(np.diag(there)[:12])
    # Poses and corners agree to rounding of the fit of each pose (1e-6 rad and m).
    assert summed[:12, :12] * np.outer(size, size) == pytest.approx(
        there[:12, :12] * np.outer(size, size), abs=1e-4
    )


@pytest.mark.parametrize("purpose", [HAND_EYE, OFFSETS, KINEMATICS], ids=lambda value: value.name)
@pytest.mark.parametrize("mount", MOUNTS)
def test_more_stops_tell_more_of_everything(mount, purpose):
    options = replace(CELL, mount=mount, views=12, cut_views=0.0)
    cell, q = true_cell(options), simulate(options).robot.joints
    world = predict_worlds([cell], purpose, q)[0]
    size = world.factors.shape[2]
    assert size == {"hand-eye": 13, "offsets": 19, "kinematics": 49}[purpose.name]
    stops = world.covariance(range(len(q)))
    one_less = world.covariance(range(len(q) - 1))
    assert np.linalg.eigvalsh(one_less - stops).min() > -1e-9 * np.trace(one_less)
    assert mm(world, range(len(q))) < 5.0


def test_a_board_that_is_not_seen_tells_nothing(views):
    cell = true_cell(CELL)
    away = replace(cell, z=cell.z @ exp(np.array([0, 0, 0, 5.0, 0, 0])))
    assert not stop_factors(away, HAND_EYE, views[:5]).any()
    assert stop_factors(cell, HAND_EYE, views[:5]).any(axis=(1, 2)).all()


def test_the_choice_is_nearly_the_best_of_all():
    """All 495 choices of 4 among 12, by inverting each one's information."""
    few = postures_in_view(CELL, 12)
    world = predict_worlds([true_cell(CELL)], HAND_EYE, few)[0]

    def value(rows):
        return float(np.trace(world.objective @ world.covariance(list(rows))))

    values = sorted(value(combination) for combination in combinations(range(12), 4))
    design = choose_stops([world], 4)
    found = value(design.rows)
    assert design.sigma_mm == pytest.approx(1e3 * np.sqrt(found), rel=1e-6)
    # Exchange ends in a local optimum: among the best one per cent.
    assert found <= values[4] + 1e-9 * abs(values[4])


def test_the_values_are_those_of_a_plain_inversion(views):
    """Rank-six updates, left-out directions and worlds change no figure."""
    cell = plan_cell(CELL, 0.03, 0.01)
    for purpose in (HAND_EYE, KINEMATICS):
        worlds = predict_worlds((cell, *cell.guesses(2, 0)), purpose, views)
        design = choose_stops(worlds, 9)
        plain = [np.trace(world.position @ world.covariance(design.rows)) for world in worlds]
        assert design.predicted.mm == pytest.approx(1e3 * np.sqrt(np.mean(plain)), rel=1e-6)
        everything = [
            np.trace(world.position @ world.covariance(range(len(views)))) for world in worlds
        ]
        assert design.best.mm == pytest.approx(1e3 * np.sqrt(np.mean(everything)), rel=1e-6)
        history = [accuracy.mm for accuracy in design.history]
        assert len(history) == 10
        assert all(after <= before for before, after in pairwise(history))


def test_what_is_known_beforehand_may_be_singular_to_rounding(views):
    (world,) = predict_worlds([true_cell(CELL)], HAND_EYE, views[:20])
    size, sharp = len(world.prior), np.zeros(len(world.prior))
    sharp[[11, 12]] = 1e-3, 1.0
    # Two unknowns of which next to nothing but their difference is known, as of a rational lens.
    stiff = replace(world, prior=world.prior + 1e24 * np.outer(sharp, sharp))
    assert np.linalg.eigvalsh(stiff.prior)[0] < 1e-16 * np.linalg.eigvalsh(stiff.prior)[-1]
    assert len(choose_stops([stiff], 3).rows) == 3
    # What is known beforehand is the identity in the new coordinates: as much of it as rounding
    # leaves, which is some 1e-8 of the largest here.
    root = covariance_root(world.prior)
    np.testing.assert_allclose(root.T @ world.prior @ root, np.eye(size), atol=1e-9)


def test_a_board_of_unknown_size_is_in_the_way():
    options = CELL
    worlds = predict_worlds([true_cell(options)], KINEMATICS, postures_in_view(options, 60))
    # A size that is open by 0.1 % leaves half a millimetre of an arm's place at a metre.
    design = choose_stops(worlds, 30)
    assert design.best.mm > 0.4


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_thirty_planned_stops_are_expected_better_than_random_ones(mount):
    # A board whose size is open by 0.1 % would leave 0.5 mm, whatever the stops.
    sure = replace(CELL.target, square_sigma_m=1e-5 * CELL.target.square_m)
    options = replace(CELL, mount=mount, target=sure)
    q = postures_in_view(options, 250)
    cell = plan_cell(options, 0.03, 0.01)
    rows = choose_stops(predict_worlds((cell, *cell.guesses(2, 0)), KINEMATICS, q), 30).rows
    truth = predict_worlds([true_cell(options)], KINEMATICS, q)[0]
    rng = np.random.default_rng(0)
    random = [mm(truth, rng.choice(len(q), 30, replace=False)) for _ in range(20)]
    # Of 1500 candidates they are 1.5 times better; of 250 less.
    assert mm(truth, rows) < 0.85 * np.median(random)
    assert mm(truth, rows) < min(random)


def test_stops_are_added_as_far_from_the_board_as_it_has_been_seen():
    options = CellOptions(robot="ur5e", mount="eye-to-hand", views=10, seed=1)
    cell = simulate(options)
    found = start_from_session(so_far_of(cell)).cell
    low, high = extent_m(found.target)
    seen, centre = cell.cam_from_target, np.append(0.5 * (low + high), 0.0)
    away = np.linalg.norm(seen[:, :3, :3] @ centre + seen[:, :3, 3], axis=1)
    # The fit places camera and board to a tenth of a millimetre.
    assert found.observed_distances_m == pytest.approx((away.min(), away.max()), abs=1e-3)
    # Farther off than where the board fills the image, as a camera at the cell's edge looks.
    near, far = BoardViews(replace(found, observed_distances_m=None), 0).distance_m
    wider = BoardViews(replace(found, observed_distances_m=(3.0 * near, 3.0 * far)), 0).distance_m
    assert wider[0] == near
    assert wider[1] > 3.0 * far


@pytest.mark.slow
def test_the_few_stops_that_a_recorded_cell_allows_are_added():
    """As before a fixed camera: of a guessed cell so few say that it is guessed wrong."""
    begun = start_from_session(so_far_of(simulate(CellOptions(mount="eye-to-hand", seed=4))))
    cell = replace(begun.cell, limits=replace(begun.cell.limits, edge_px=334.0))
    request = PlanRequest(HAND_EYE, count=5)
    plan = make_plan(cell, request, begun=replace(begun, cell=cell))
    assert len(plan.stops) == 5
    # A tenth of the number is what a guessed cell has to have.
    assert 5 < plan.candidate_count < 0.1 * request.candidates
    assert plan.design.predicted.mm < plan.design.before.mm
    with pytest.raises(
        DataError, match=f"{plan.candidate_count} of {request.candidates} possible stops"
    ):
        make_plan(cell, request)


@pytest.mark.parametrize(
    "options",
    [
        replace(CELL, views=12, seed=4),
        replace(CELL, views=16, seed=3, state_intrinsics=False, mount="eye-to-hand"),
        slow(replace(CELL, views=16, seed=6, second=Second(), camera=fine_camera())),
    ],
    ids=["stated lens", "estimated lens", "two boards"],
)
def test_before_any_stop_the_prediction_is_the_sigma_of_the_session(options):
    cell = simulate(options)
    found = so_far_of(cell)
    begun = start_from_session(found)
    world = predict_worlds([begun.cell], HAND_EYE, cell.robot.joints[:3], recorded=begun.recorded)[
        0
    ]
    solved = found.known.assessment
    # How well levels of noise are known is told of data alone.
    covariance = solved.covariance - solved.covariance_by_source["noise_level"]
    sigmas = np.sqrt(np.diag(covariance)[:6])
    # The plan's weak prior of 0.2 m and rad is all that differs.
    assert np.sqrt(np.diag(world.covariance([]))[:6]) == pytest.approx(sigmas, rel=1e-4)
    three = world.covariance(range(3))
    assert np.trace(three[3:6, 3:6]) < np.trace(world.covariance([])[3:6, 3:6])


ERRING = replace(CELL, views=30, seed=5, dh_sigma_m=5e-4, dh_sigma_rad=1e-3)


@pytest.mark.parametrize("case", ["estimated", slow("taken for noise"), slow("neighbours alike")])
def test_errors_of_the_arm_count_in_the_prediction_as_in_the_result(case):
    cell = simulate(ERRING)
    if case == "neighbours alike":
        cell = simulate(replace(CELL, views=30, seed=1))
        off = np.random.default_rng(0).standard_normal((10, 6)) * np.repeat([4e-4, 2e-4], 3)
        alike = cell.robot.base_from_flange @ exp(np.repeat(off, 3, axis=0))
        cell = reporting(cell, base_from_flange=alike)
    poses = {} if case == "estimated" else {"joints": False, "robot": load_robot("ur5e")}
    found = so_far_of(cell, **poses)
    known = found.known
    errors = known.robot_arm.errors
    assert errors.is_significant
    assert errors.is_estimated == (case == "estimated")
    begun, q = start_from_session(found), postures_in_view(CELL, 40)
    design = next_best(begun, HAND_EYE, q, 3)
    # How well the sizes of the arm's errors and of the noise are known cannot be told beforehand.
    beside = ("size of arm errors", "noise_level")
    untold = sum((known.assessment.covariance_by_source.get(name, 0.0) for name in beside), 0.0)
    covariance = known.assessment.covariance - untold
    obtained = 1e3 * np.sqrt(np.trace(covariance[3:6, 3:6]))
    world = predict_worlds([begun.cell], HAND_EYE, q, recorded=begun.recorded)[0]
    # A result holds the board's size; in the plan it is open, and takes up errors of the arm. What
    # a lens does beyond its model is in the result alone.
    # Where errors make up for noise in some direction, the plan does not take them off.
    assert mm(world, []) == pytest.approx(obtained, rel=0.02 if case == "estimated" else 0.15)
    assert design.before.mm == pytest.approx(obtained, rel=0.15)
    assert design.predicted.mm == pytest.approx(mm(world, design.rows), rel=0.1)


def test_stops_for_the_arm_need_joint_angles():
    options = replace(CELL, views=12, seed=5, dh_sigma_m=5e-4, dh_sigma_rad=1e-3)
    begun = start_from_session(so_far_of(simulate(options)))
    q = postures_in_view(options, 60)
    added = next_best(begun, KINEMATICS, q, 3, worlds=2)
    assert added.predicted.mm < added.before.mm
    poses_only = replace(begun, recorded=replace(begun.recorded, q=None))
    with pytest.raises(DataError, match="no joint angles"):
        next_best(poses_only, KINEMATICS, q, 3)


def test_two_stops_are_too_few_to_add_to():
    with pytest.raises(DataError, match="not even roughly"):
        start_from_session(so_far_of(simulate(replace(CELL, views=2))))
