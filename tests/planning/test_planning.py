"""Which stops tell most, and that planned stops keep their limits, by the simulation's geometry."""

import itertools
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from support.apart import clearances, corners
from support.cells import calibrated, exact, known_of
from support.live_cell import postures_in_view, true_cell
from support.marks import slow
from support.refusals import raised
from support.slopes import jacobian

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import Camera, FloatArray, Need
from visioncal.estimation.appearance import Appearance, compress
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.problem_parts import Noise, State
from visioncal.planning import pick_probability
from visioncal.planning.candidates import candidates
from visioncal.planning.cell import Box, Limits, PlanCell
from visioncal.planning.design import Design, choose_stops
from visioncal.planning.information import (
    WORLDS,
    located_jacobian,
    predict_worlds,
    predicted_corners,
    shown_fit,
    stated,
    stop_factors,
)
from visioncal.planning.path import Route, left_candidates, order_stops
from visioncal.planning.pick_probability import Picking
from visioncal.planning.purposes import PURPOSES, Purpose
from visioncal.planning.recorded import SessionStart, start_from_session
from visioncal.planning.visibility import FieldOfView
from visioncal.robot import load_robot
from visioncal.simulation import CellOptions, SimulatedCell, simulate
from visioncal.simulation.arms import arm_named, forward
from visioncal.simulation.boards import Sheet, centre_m, outline_m
from visioncal.simulation.optics import sees
from visioncal.vision.camera import intrinsics, project, with_intrinsics
from visioncal.vision.targets import corner_positions


def plan_cell(options: CellOptions, sigma_rad: float = 0.0, sigma_m: float = 0.0) -> PlanCell:
    """The cell as it would be planned for: guesses that are off by a draw of their sigmas."""
    true = true_cell(options)
    rng = np.random.default_rng([options.seed, 99])
    off = exp(rng.standard_normal((2, 6)) * np.repeat([sigma_rad, sigma_m], 3))
    return replace(true, x=true.x @ off[0], z=true.z @ off[1], sigma_rad=sigma_rad, sigma_m=sigma_m)


def next_best(begun: SessionStart, purpose: Purpose, q: FloatArray, worlds: int = WORLDS) -> Design:
    """Three stops that a plan adds to a session, wherever the arm can drive."""
    cells = (begun.cell, *begun.cell.guesses(worlds - 1, 0))
    return choose_stops(predict_worlds(cells, purpose, q, recorded=begun.recorded), 3)


def so_far_of(cell: SimulatedCell, **changes) -> tuple[RunState, str]:
    """What is known of a cell's views, as far as they tell it, and why no more."""
    known = known_of(cell, level="hand-eye", **changes)
    for stage in STAGES:
        if stage.name in ("robot", "detect"):
            continue
        try:
            known = stage.run(known)
        except DegenerateError as error:
            return known, error.message
    return known, ""


MOUNTS = ("eye-in-hand", "eye-to-hand")
HAND_EYE, KINEMATICS = (PURPOSES[name] for name in ("hand-eye", "kinematics"))
CELL = CellOptions(robot="ur5e")


def mm(world, rows):
    """Sigma of the place that the purpose is about, from some candidates [mm]."""
    return 1e3 * float(np.sqrt(np.trace(world.position @ world.covariance(rows))))


@pytest.fixture(scope="module")
def in_view():
    """Postures in view of the eye-in-hand cell."""
    return postures_in_view(CELL, 120)


@pytest.mark.parametrize("mount", MOUNTS)
def test_predicted_information_is_that_of_the_recorded_views(mount):
    """A plan is made of the estimator's own numbers, at the same poses."""
    options = exact(replace(CELL, mount=mount, views=6, cut_views=0.0))
    seen = so_far_of(simulate(options))[0]
    cell = replace(true_cell(options), noise=Noise.of_robot(5e-5, 3e-5), pixel_px=0.05)
    q = simulate(options).robot.joints
    factors = stop_factors(cell, HAND_EYE, q)
    problem = seen.cell_fit.fit.problem
    # The same corners at the plan's noise; exact ones count as seen to a millionth of a pixel.
    scale = (0.05 / max(seen.pixel_px, 1e-6)) ** 2
    in_view = replace(problem.observations, covariance=scale * problem.observations.covariance)
    state = State(np.stack([cell.x, cell.z]), problem.start_values)
    fisher = fisher_information(replace(problem, observations=in_view), state, cell.noise)
    summed = np.einsum("kij,kil->jl", factors, factors)
    size = 1.0 / np.sqrt(np.diag(fisher)[:12])
    # Poses and corners agree to rounding of the fit of each pose (1e-6 rad and m).
    assert summed[:12, :12] * np.outer(size, size) == pytest.approx(
        fisher[:12, :12] * np.outer(size, size), abs=1e-4
    )


def test_a_lens_is_predicted_as_well_as_the_corners_of_such_stops_show_it():
    """Their information on the lens, with free poses, beside that on the stops."""
    options = exact(replace(CELL, views=6, cut_views=0.0))
    seen = so_far_of(simulate(options))[0]
    cell = replace(true_cell(options), noise=Noise.of_robot(5e-5, 3e-5), pixel_px=0.05)
    q = simulate(options).robot.joints
    factors = stop_factors(cell, HAND_EYE, q, estimates_lens=True)
    lens = slice(12, 12 + 4 + len(cell.camera.distortion))
    assert factors[:, :6, :12] == pytest.approx(stop_factors(cell, HAND_EYE, q)[:, :, :12])
    rows = factors[:, 6:, lens]
    predicted = np.einsum("kij,kil->jl", rows, rows)
    corners = seen.cell_fit.linearised_corners
    (sigma_px,) = corners.sigmas_px
    scale = max(sigma_px, 1e-6) ** 2 / 0.05**2
    size = lens.stop - lens.start
    shown = scale * corners.corners.information[:size, :size]
    units = 1.0 / np.sqrt(np.diag(shown))
    # To the rounding of exact poses.
    assert predicted * np.outer(units, units) == pytest.approx(
        shown * np.outer(units, units), abs=1e-4
    )


@pytest.mark.parametrize("mount", MOUNTS)
def test_things_are_off_by_the_camera_and_by_the_lens_as_their_images_say(mount, in_view):
    cell, q = true_cell(replace(CELL, mount=mount)), in_view[:3]
    if mount == "eye-to-hand":
        q = simulate(replace(CELL, mount=mount, views=3)).robot.joints
    free, middle = stated(cell, estimates_lens=True), corner_positions(cell.target).mean(axis=0)
    poses, lens = cell.cam_from_target(q), intrinsics(cell.camera)
    # A small board hardly shows k2 and k3.
    units = np.append(np.full(4, lens[0]), [1.0, 1e2, 1.0, 1.0, 1e3])
    stack, seen = predicted_corners(cell, poses, 0)
    found = located_jacobian(shown_fit(cell, q, None, free), middle)[:, 3:]

    def places(by: FloatArray) -> FloatArray:
        """Where boards are by the same images, with an edge and a lens that are off."""
        camera = with_intrinsics(cell.camera, lens + units * by[6:])
        look = Appearance(camera, free.appearance.board)
        shown = compress(stack, free.basis, look, poses[seen]).cam_from_target
        return ((cell.x @ exp(by[:6])) @ shown @ [*middle, 1.0])[:, :3].ravel()

    by_steps = jacobian(places, 6 + len(lens), 1e-4).reshape(len(q), 3, -1)
    sizes = np.abs(by_steps).max(axis=(0, 1))
    slopes = np.concatenate([found[:, :, :6], units * found[:, :, 12 : 12 + len(lens)]], axis=2)
    # Poses fit their corners, and shift in proportion to the steps, to a thousandth.
    np.testing.assert_allclose(slopes / sizes, by_steps / sizes, atol=1e-3)


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


def test_the_values_are_those_of_a_plain_inversion(in_view):
    """Rank-six updates, left-out directions and worlds change no figure."""
    cell = plan_cell(CELL, 0.03, 0.01)
    for purpose in (HAND_EYE, KINEMATICS):
        worlds = predict_worlds((cell, *cell.guesses(2, 0)), purpose, in_view)
        design = choose_stops(worlds, 9)
        plain = [np.trace(world.position @ world.covariance(design.rows)) for world in worlds]
        assert design.predicted.mm == pytest.approx(1e3 * np.sqrt(np.mean(plain)), rel=1e-6)
        everything = [
            np.trace(world.position @ world.covariance(range(len(in_view)))) for world in worlds
        ]
        assert design.best.mm == pytest.approx(1e3 * np.sqrt(np.mean(everything)), rel=1e-6)
        history = [accuracy.mm for accuracy in design.history]
        assert len(history) == 10
        assert all(after <= before for before, after in pairwise(history))


@pytest.mark.slow
def test_thirty_planned_stops_are_expected_better_than_random_ones():
    # A board whose size is open by 0.1 % would leave 0.5 mm, whatever the stops.
    sure = replace(CELL.target, square_sigma_m=1e-5 * CELL.target.square_m)
    options = replace(CELL, target=sure)
    q = postures_in_view(options, 250)
    cell = plan_cell(options, 0.03, 0.01)
    rows = choose_stops(predict_worlds((cell, *cell.guesses(2, 0)), KINEMATICS, q), 30).rows
    truth = predict_worlds([true_cell(options)], KINEMATICS, q)[0]
    rng = np.random.default_rng(0)
    random = [mm(truth, rng.choice(len(q), 30, replace=False)) for _ in range(20)]
    # Of 1500 candidates they are 1.5 times better; of 250 less.
    assert mm(truth, rows) < 0.85 * np.median(random)
    assert mm(truth, rows) < min(random)


@pytest.mark.parametrize(
    "options",
    [
        replace(CELL, views=12, seed=4),
        replace(CELL, views=16, seed=3, state_intrinsics=False, mount="eye-to-hand"),
    ],
    ids=["stated lens", "estimated lens"],
)
def test_before_any_stop_the_prediction_is_the_sigma_of_the_session(options):
    cell = simulate(options)
    found = so_far_of(cell)
    begun = start_from_session(*found)
    q = cell.robot.joints[:3]
    world = predict_worlds([begun.cell], HAND_EYE, q, recorded=begun.recorded)[0]
    solved = found[0].assessment
    # How well levels of noise are known, and errors of the arm that no stop shows, are told of data
    # alone.
    assert not found[0].robot_arm.errors.gain
    sources = solved.fit.by_source
    covariance = solved.fit.whole - sources["noise_level"] - sources["arm"]
    sigmas = np.sqrt(np.diag(covariance)[:6])
    # The plan's weak prior of 0.2 m and rad is all that differs.
    assert np.sqrt(np.diag(world.covariance([]))[:6]) == pytest.approx(sigmas, rel=1e-4)
    three = world.covariance(range(3))
    assert np.trace(three[3:6, 3:6]) < np.trace(world.covariance([])[3:6, 3:6])


ERRING = replace(CELL, views=30, seed=5, dh_sigma_m=5e-4, dh_sigma_rad=1e-3)


@pytest.mark.slow
def test_errors_of_the_arm_count_in_the_prediction_as_in_the_result():
    found = so_far_of(simulate(ERRING))
    known = found[0]
    assert known.robot_arm.errors.is_significant
    assert known.robot_arm.errors.is_estimated
    begun, q = start_from_session(*found), postures_in_view(CELL, 40)
    design = next_best(begun, HAND_EYE, q)
    # How well the sizes of the arm's errors and of the noise are known cannot be told beforehand.
    sources = ("size of arm errors", "noise_level")
    not_known = sum((known.assessment.fit.by_source.get(name, 0.0) for name in sources), 0.0)
    covariance = known.assessment.fit.whole - not_known
    obtained = 1e3 * np.sqrt(np.trace(covariance[3:6, 3:6]))
    world = predict_worlds([begun.cell], HAND_EYE, q, recorded=begun.recorded)[0]
    # A result holds the board's size; in the plan it is open, and takes up errors of the arm. What
    # a lens does beyond its model is in the result alone.
    assert mm(world, []) == pytest.approx(obtained, rel=0.02)
    assert design.before.mm == pytest.approx(obtained, rel=0.15)
    assert design.predicted.mm == pytest.approx(mm(world, design.rows), rel=0.1)


@pytest.mark.parametrize(
    ("mount", "changes", "joints"),
    [
        ("eye-in-hand", {"dh_sigma_m": 5e-4, "dh_sigma_rad": 1e-3}, True),
        slow("eye-to-hand", {"dh_sigma_m": 5e-4, "dh_sigma_rad": 1e-3}, True),
        *(slow(mount, {"dh_sigma_m": 5e-4, "dh_sigma_rad": 1e-3}, False) for mount in MOUNTS),
        *(slow(mount, {"state_intrinsics": False}, True) for mount in MOUNTS),
    ],
)
def test_picks_by_what_was_recorded_are_those_of_the_verdict(mount, changes, joints, monkeypatch):
    # A plan adds a margin to the noise, for sessions that show more by chance: here as much as half
    # of them.
    monkeypatch.setattr(pick_probability, "_LARGER_NOISE", 0.5)
    cell = simulate(replace(CELL, mount=mount, views=15, seed=1, **changes))
    known = {"joints": joints, "robot": load_robot(CELL.robot)}
    begun, run = start_from_session(*so_far_of(cell, **known)), calibrated(cell, **known)
    (picks,) = run.findings.picks
    q = cell.robot.joints
    worlds = predict_worlds([begun.cell], HAND_EYE, q, recorded=begun.recorded, estimates_lens=True)
    by_controller = picks if picks.uncorrected is None else picks.uncorrected
    for verdict, is_corrected in ((picks, True), (by_controller, False)):
        # Both know the noise by what 15 stops show, and the arm by two levels of its errors.
        need = Need(mm=0.5 * verdict.good_for_mm)
        plan = Picking([begun.cell], worlds, q, need, begun.recorded)
        chance = plan.chance(np.arange(0), is_corrected=is_corrected)
        assert chance == pytest.approx(verdict.probability(need), abs=0.12)


@pytest.mark.slow
def test_stops_for_the_arm_need_joint_angles():
    begun = start_from_session(*so_far_of(simulate(replace(ERRING, views=12))))
    q = postures_in_view(CELL, 60)
    added = next_best(begun, KINEMATICS, q, worlds=2)
    assert added.predicted.mm < added.before.mm
    poses_only = replace(begun, recorded=replace(begun.recorded, q=None))
    raised(DataError, "no joint angles", next_best, poses_only, KINEMATICS, q)


def test_two_stops_are_too_few_to_add_to():
    found = so_far_of(simulate(replace(CELL, views=2)))
    raised(DataError, "not even roughly", start_from_session, *found)


def cell_of(options: CellOptions, **changes) -> PlanCell:
    """The cell as it is; a floor so low that the board lies on it."""
    cell = true_cell(options)
    floor_m = min(0.0, cell.z[2, 3] - 0.02) if options.mount == "eye-in-hand" else 0.0
    guess = {"sigma_rad": 0.005, "sigma_m": 0.002, "limits": Limits(floor_m=floor_m)}
    return replace(cell, **guess | changes)


def views(cell: PlanCell, q: FloatArray) -> FloatArray:
    """`cam_from_target` by the simulation's kinematics."""
    flange = forward(arm_named(cell.robot.name), q)
    if cell.mount == "eye-in-hand":
        return invert(flange @ cell.x) @ cell.z
    return invert(cell.x) @ flange @ cell.z


def whole(cell: PlanCell, q: FloatArray, edge_px: float) -> FloatArray:
    """Whether the simulation's camera sees the whole print."""
    outline = outline_m(Sheet(target=cell.target), 0.0)
    seen = views(cell, q)
    points = outline @ np.swapaxes(seen[:, :3, :3], 1, 2) + seen[:, None, :3, 3]
    return sees(cell.camera, points, edge_px).all(axis=1)


POSES = [compose(np.eye(3), np.array([0.1, 0.45, 0.2])), exp(np.array([0, 0, 0.5, 0.5, -0.4, 0.1]))]
BOXES = (
    Box("feeder", POSES[0], np.array([0.2, 0.15, 0.4])),
    Box("column", POSES[1], np.array([0.1, 0.1, 0.7])),
)


def board_plate(cell):
    """The print as a box (pose in the target's frame, size) of a hair's thickness."""
    print_m = outline_m(Sheet(target=cell.target), 0.0)
    low, high = print_m.min(axis=0), print_m.max(axis=0)
    return compose(np.eye(3), 0.5 * (low + high)), high - low + [0, 0, 1e-6]


def least_clearance(cell, q):
    """By plain geometry, of arm, camera or board, floor and boxes [m]."""
    pose, size = board_plate(cell)
    boxes = [(box.base_from_box, box.size_m) for box in cell.boxes]
    flange = forward(arm_named("ur5e"), q)
    if cell.mount == "eye-in-hand":
        boxes.append((cell.z @ pose, size))
        carried = corners(flange @ cell.x @ compose(np.eye(3), np.zeros(3)), np.full(3, 0.02))
    else:
        boxes.append((cell.x, np.full(3, 0.02)))
        carried = corners(flange @ cell.z @ pose, size)
    found = [clearances(arm_named("ur5e"), q, cell.limits.floor_m, boxes)]
    if cell.limits.floor_m is not None:
        found.append(carried[..., 2].min(axis=1) - cell.limits.floor_m)
    for base_from_box, box in boxes[:-1]:
        inside = (carried - base_from_box[:3, 3]) @ base_from_box[:3, :3]
        beyond = np.maximum(np.abs(inside) - 0.5 * box, 0.0)
        found.append(np.linalg.norm(beyond, axis=-1).min(axis=1))
    return float(np.min(found))


@pytest.mark.parametrize("mount", [slow("eye-in-hand"), "eye-to-hand"])
def test_all_stops_and_ways_keep_limits_and_clearances(mount):
    cell = cell_of(CellOptions(robot="ur5e", mount=mount), boxes=BOXES)
    limits = replace(cell.limits, joint_margin_rad=0.1, focus_m=(0.3, 0.75))
    cell = replace(cell, limits=limits)
    stops = candidates(cell, 60, seed=1)
    assert len(stops) == 60
    seen = views(cell, stops.q)
    np.testing.assert_allclose(stops.cam_from_target, seen, atol=1e-9)
    assert whole(cell, stops.q, limits.edge_px).all()
    centre = centre_m(Sheet(target=cell.target))
    sight = seen[:, :3, :3] @ centre + seen[:, :3, 3]
    cosine = np.einsum("ki,ki->k", sight, seen[:, :3, 2]) / np.linalg.norm(sight, axis=1)
    # Rounding of the arc's cosine at its end.
    assert np.arccos(cosine).max() < limits.tilt_rad + 1e-6
    outline = outline_m(Sheet(target=cell.target), 0.0)
    depth = outline @ seen[:, 2, :3].T + seen[:, 2, 3]
    assert depth.min() > 0.3
    assert depth.max() < 0.75
    route = order_stops(cell, None, stops.q)
    assert set(route.order) | set(route.unreachable) == set(range(60))
    assert len(route.order) >= 55
    legs = zip(route.order, route.order[1:], route.segments, strict=False)
    knots = [np.vstack([stops.q[a], via, stops.q[b]]) for a, b, via in legs]
    passed = np.vstack(knots)
    assert np.all(passed >= cell.robot.lower_rad + 0.1)
    assert np.all(passed <= cell.robot.upper_rad - 0.1)
    shares = np.linspace(0.0, 1.0, 25)[:, None]
    lines = [(p, q) for way in knots for p, q in itertools.pairwise(way)]
    moved = np.vstack([p + shares * (q - p) for p, q in lines])
    assert least_clearance(cell, moved) >= limits.clearance_m
    travelled = sum(float(np.linalg.norm(q - p)) for p, q in lines)
    assert route.length_rad == pytest.approx(travelled)
    # In the drawn order the joints would travel more than twice as far.
    assert travelled < 0.5 * np.linalg.norm(np.diff(stops.q, axis=0), axis=1).sum()


def test_a_box_in_the_way_is_gone_around():
    cell = cell_of(CellOptions(robot="ur5e"))
    # The arm stands to the left and to the right of a wall, outstretched.
    left, right = (
        np.array([2.6, -1.3, 1.3, -1.6, -1.57, 0]),
        np.array([3.7, -1.3, 1.3, -1.6, -1.57, 0]),
    )
    stops = np.stack([left, right])
    free = order_stops(cell, None, stops)
    assert [len(segment) for segment in free.segments] == [0]
    height = compose(np.eye(3), np.array([0.55, 0.12, 0.25]))
    wall = Box("wall", height, np.array([0.3, 0.04, 0.5]))
    walled = order_stops(replace(cell, boxes=(wall,)), None, stops)
    assert len(walled.order) == 2
    assert len(walled.segments[0]) > 0
    assert walled.length_rad > free.length_rad
    way = np.vstack([stops[walled.order[0]], walled.segments[0], stops[walled.order[1]]])
    shares = np.linspace(0.0, 1.0, 60)[:, None]
    moved = np.vstack([p + shares * (q - p) for p, q in itertools.pairwise(way)])
    assert least_clearance(replace(cell, boxes=(wall,)), moved) >= cell.limits.clearance_m


def test_a_stop_out_of_reach_is_replaced_by_one_nearer_to_others():
    """Each would be replaced by another in the same part of the workspace."""
    q = np.array([[0.0], [0.4], [1.6], [1.8], [2.0]])
    route = Route((0,), (np.zeros((0, 1)),), 0.0, {1: "link j2 and link j5"})
    left, chosen = np.arange(5), np.array([0, 4])
    assert left_candidates(q, left, chosen, route, missed_only=True).tolist() == [0, 1, 2, 3]
    assert left_candidates(q, left, chosen, route, missed_only=False).tolist() == [0, 1]


def test_a_start_in_contact_is_refused_by_name():
    cell = cell_of(CellOptions(robot="ur5e"))
    down = np.array([0.0, 0.6, 0.2, 0.0, 0.0, 0.0])
    with pytest.raises(DataError, match=r"where the arm starts, .*floor"):
        order_stops(cell, down, candidates(cell, 5).q)


def test_the_stops_take_all_branches_of_the_arm():
    cell = cell_of(CellOptions(robot="ur10e"))
    q = candidates(cell, 200).q
    for joint in (2, 4):
        # Elbow and wrist bend either way; by chance alone each would in half of the stops.
        assert 0.1 < np.mean(np.sin(q[:, joint]) > 0.0) < 0.9


@pytest.mark.parametrize("robot", ["panda", "irb120"])
def test_stops_are_found_for_arms_of_other_makers_and_of_seven_joints(robot):
    cell = cell_of(CellOptions(robot="ur5e"), robot=load_robot(robot))
    stops = candidates(cell, 30)
    assert stops.q.shape == (30, load_robot(robot).joint_count)
    assert np.all(stops.q >= cell.robot.lower_rad + cell.limits.joint_margin_rad)


@pytest.mark.slow
@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_from_a_bad_guess_nine_of_ten_stops_see_the_whole_board(mount):
    """Both edges are off by 5 cm and 10 degrees; what is said of the guesses is that."""
    true = cell_of(CellOptions(robot="ur10e", mount=mount))
    shares = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        turn, shift = rng.standard_normal((2, 2, 3))
        turn *= np.deg2rad(10.0) / np.linalg.norm(turn, axis=1, keepdims=True)
        shift *= 0.05 / np.linalg.norm(shift, axis=1, keepdims=True)
        off_x, off_z = exp(np.concatenate([turn, shift], axis=1))
        said = {"sigma_rad": np.deg2rad(10.0) / np.sqrt(3.0), "sigma_m": 0.05 / np.sqrt(3.0)}
        limits = replace(true.limits, floor_m=true.limits.floor_m and true.limits.floor_m - 0.2)
        guess = replace(true, x=true.x @ off_x, z=true.z @ off_z, limits=limits, **said)
        stops = candidates(guess, 100, seed=seed)
        seen = whole(true, stops.q, 0.0)
        worlds = predict_worlds([guess], PURPOSES["hand-eye"], stops.q)
        planned = choose_stops(worlds, 20).rows
        shares.append((seen.mean(), seen[planned].mean()))
    # The most telling stops are near the edge of what is safe, and must be as sure as the others.
    assert np.mean(shares) > 0.98
    assert np.min(shares) >= 0.9


SIZE = (1280, 800)
MATRIX = np.array([600.0, 610.0, 650.0, 390.0])
LENSES = [
    ("brown", [0.0, 0.0, 0.0, 0.0, 0.0]),
    ("brown", [-0.28, 0.09, 1e-3, -5e-4, -0.01]),
    ("brown", [0.12, -0.05, 0.0, 2e-3, 0.0]),
    ("fisheye", [0.05, -0.01, 2e-3, 0.0]),
]


@pytest.mark.parametrize(("model", "distortion"), LENSES)
@pytest.mark.parametrize("edge_px", [0.0, 60.0])
def test_points_are_inside_where_they_project_inside(model, distortion, edge_px):
    camera = Camera(model, SIZE, MATRIX, np.array(distortion))
    rng = np.random.default_rng(0)
    # Directions well over the image's corners, and behind the camera.
    points = np.column_stack([rng.uniform(-1.5, 1.5, (20000, 2)), np.ones(20000)])
    points *= rng.uniform(0.2, 2.0, (20000, 1)) * rng.choice([-1.0, 1.0], (20000, 1), p=[0.1, 0.9])
    px = project(camera, points)
    high = np.array(SIZE) - 1.0 - edge_px
    inside = ((px >= edge_px) & (px <= high)).all(axis=1)
    holds = FieldOfView(camera, edge_px).holds(points[:, None])
    # A ray beyond the fold of a lens model comes back into the image; the window leaves it out.
    np.testing.assert_array_equal(holds, inside & _before_the_fold(camera, points))
    assert 0.1 < holds.mean() < 0.9


def _before_the_fold(camera, points):
    """Whether the projection still moves outwards with the ray."""
    farther = points * [1.0 + 1e-6, 1.0 + 1e-6, 1.0]
    middle = camera.matrix[2:]
    with np.errstate(invalid="ignore"):
        return np.linalg.norm(project(camera, farther) - middle, axis=1) > np.linalg.norm(
            project(camera, points) - middle, axis=1
        )


def test_an_arm_of_four_joints_finds_its_views_by_drawing_postures():
    scara = load_robot("generic-scara-600")
    board = compose(np.diag([1.0, -1.0, -1.0]), np.array([0.4, 0.1, -0.25]))
    aside = compose(np.eye(3), np.array([0.06, 0.0, 0.0]))
    limits = Limits(floor_m=-0.26, joint_margin_rad=0.01)
    cell = cell_of(CellOptions(robot="ur5e"), robot=scara, x=aside, z=board, limits=limits)
    stops = candidates(cell, 40)
    assert len(stops) == 40
    seen = invert(scara.base_from_flange(stops.q) @ aside) @ board
    np.testing.assert_allclose(stops.cam_from_target, seen, atol=1e-12)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Box("b", np.zeros((4, 4)), np.ones(3)),
        lambda: Box("b", np.eye(4), np.array([1.0, 0.0, 1.0])),
        lambda: Limits(clearance_m=-0.1),
        lambda: Limits(tilt_rad=2.0),
        lambda: Limits(focus_m=(0.5, 0.4)),
        lambda: replace(cell_of(CellOptions()), x=2.0 * np.eye(4)),
        lambda: replace(cell_of(CellOptions()), sigma_m=np.nan),
    ],
)
def test_an_impossible_cell_is_refused(make):
    with pytest.raises(DataError):
        make()
