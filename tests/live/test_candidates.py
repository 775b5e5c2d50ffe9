"""Planned stops keep their limits, by the simulation's own geometry and optics."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from support.apart import UR5E_RADIUS_M, clearances, corners, lines, lines_apart, tubes
from support.marks import slow

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert, log
from visioncal.core.types import Camera, FloatArray
from visioncal.estimation.problem_parts import Noise
from visioncal.live.planning.candidates import candidates
from visioncal.live.planning.cell import Box, Limits, PlanCell
from visioncal.live.planning.design import choose_stops
from visioncal.live.planning.information import predict_worlds
from visioncal.live.planning.path import order_stops
from visioncal.live.planning.purposes import PURPOSES
from visioncal.live.planning.visibility import FieldOfView
from visioncal.robot import Robot, load_robot
from visioncal.simulation import CellOptions, simulate
from visioncal.simulation.arms import forward, ur_arm
from visioncal.simulation.boards import Sheet, centre_m, outline_m
from visioncal.simulation.optics import sees
from visioncal.vision.camera import project


def cell_of(options: CellOptions, **changes) -> PlanCell:
    """The cell as it is; a floor so low that the board lies on it."""
    x, z = simulate(replace(options, views=2)).transforms.values()
    floor_m = min(0.0, z[2, 3] - 0.02) if options.mount == "eye-in-hand" else 0.0
    cell = PlanCell(
        mount=options.mount,
        robot=load_robot(options.robot),
        camera=options.camera,
        target=options.target,
        x=x,
        z=z,
        sigma_rad=0.005,
        sigma_m=0.002,
        noise=Noise.of_robot(5e-5, 3e-5),
        pixel_px=0.05,
        limits=Limits(floor_m=floor_m),
    )
    return replace(cell, **changes)


def views(cell: PlanCell, q: FloatArray) -> FloatArray:
    """`cam_from_target` by the simulation's kinematics."""
    flange = forward(ur_arm(cell.robot.name), q)
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
    flange = forward(ur_arm("ur5e"), q)
    if cell.mount == "eye-in-hand":
        boxes.append((cell.z @ pose, size))
        carried = corners(flange @ cell.x @ compose(np.eye(3), np.zeros(3)), np.full(3, 0.02))
    else:
        boxes.append((cell.x, np.full(3, 0.02)))
        carried = corners(flange @ cell.z @ pose, size)
    found = [clearances(ur_arm("ur5e"), q, cell.limits.floor_m, boxes)]
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


@pytest.mark.slow
def test_a_stop_without_a_safe_way_is_named():
    cell = cell_of(CellOptions(robot="ur5e"))
    stops = candidates(cell, 12, seed=3).q
    # Jailed between two walls that leave its own posture free, and no way out.
    flange = forward(ur_arm("ur5e"), stops[:1])[0, :3, 3]
    ring = [
        Box(f"wall {at}", compose(np.eye(3), flange + 0.24 * np.array(side)), np.array(size))
        for at, (side, size) in enumerate(
            [
                ((1, 0, 0), (0.01, 0.5, 0.5)),
                ((-1, 0, 0), (0.01, 0.5, 0.5)),
                ((0, 1, 0), (0.5, 0.01, 0.5)),
                ((0, -1, 0), (0.5, 0.01, 0.5)),
            ]
        )
    ]
    route = order_stops(replace(cell, boxes=tuple(ring)), None, stops)
    assert set(route.order) | set(route.unreachable) == set(range(12))
    assert all("wall" in words for words in route.unreachable.values())
    assert route.unreachable


def test_a_start_in_contact_is_refused_by_name():
    cell = cell_of(CellOptions(robot="ur5e"))
    down = np.array([0.0, 0.6, 0.2, 0.0, 0.0, 0.0])
    with pytest.raises(DataError, match=r"where the arm starts, .*floor"):
        order_stops(cell, down, candidates(cell, 5).q)


def test_the_way_begins_at_the_start():
    cell = cell_of(CellOptions(robot="ur5e"))
    stops = candidates(cell, 10).q
    start = stops[4] + 1e-3
    route = order_stops(cell, start, stops)
    assert route.order[0] == 4
    assert len(route.segments) == len(route.order)


def test_boxes_do_not_hide_the_board():
    cell = cell_of(CellOptions(robot="ur5e"))
    centre = (cell.z @ np.append(centre_m(Sheet(target=cell.target)), 1.0))[:3]
    # A shelf over a half of the board, out of the arm's way.
    shelf = Box(
        "shelf", compose(np.eye(3), centre + np.array([0.2, 0, 0.25])), np.array([0.3, 0.5, 0.01])
    )
    table = Box(
        "table", compose(np.eye(3), centre - np.array([0, 0, 0.05])), np.array([0.6, 0.6, 0.0999])
    )
    shelved = replace(cell, boxes=(shelf, table), limits=replace(cell.limits, floor_m=None))
    stops = candidates(shelved, 30, seed=2)
    assert stops.lost["a free line of sight (shelf)"] > 0
    assert "a free line of sight (table)" not in stops.lost
    outline = outline_m(Sheet(target=cell.target), 0.0) @ cell.z[:3, :3].T + cell.z[:3, 3]
    shares = np.linspace(0.0, 1.0, 300)[:, None, None]
    for eye in (forward(ur_arm("ur5e"), stops.q) @ cell.x)[:, :3, 3]:
        on_the_way = eye + shares * (outline - eye)
        inside = np.abs(on_the_way - shelf.base_from_box[:3, 3]) < 0.5 * shelf.size_m
        assert not inside.all(axis=-1).any()


def test_the_arm_itself_does_not_hide_the_board():
    """A camera behind the arm, that looks over it."""
    down, along = np.sin(0.36), np.cos(0.36)
    rotation = np.array([[0.0, -down, along], [-1.0, 0.0, 0.0], [0.0, -along, -down]])
    behind = compose(rotation, np.array([-0.7, 0.0, 0.75]))
    cell = replace(cell_of(CellOptions(robot="ur5e", mount="eye-to-hand")), x=behind)
    stops = candidates(cell, 100, seed=2)
    assert any(name.startswith("a line of sight past the arm (link ") for name in stops.lost)
    outline = outline_m(Sheet(target=cell.target), 0.0)
    arm = ur_arm("ur5e")
    found = tubes(arm, stops.q)
    board = forward(arm, stops.q) @ cell.z
    eye = np.broadcast_to(behind[:3, 3], (len(stops), 3))
    for point in outline[::6]:
        corner = board[:, :3, :3] @ point + board[:, :3, 3]
        # The board's own mount lies behind the print.
        sight = eye + 0.98 * (corner - eye)
        for link in range(5):
            for p, q in lines(found[link]):
                assert lines_apart(eye, sight, p, q).min() > UR5E_RADIUS_M[link] - 1e-9


@pytest.mark.slow
def test_a_joint_that_stops_the_arm_keeps_it_from_its_reach():
    cell = cell_of(CellOptions(robot="ur5e"))
    document = dict(cell.robot.document)
    rows = [dict(row) for row in document["joint"]]
    rows[4] |= {"lower_deg": 100.0, "upper_deg": 105.0}
    stiff = Robot.from_document(document | {"joint": rows})
    with pytest.raises(DataError, match="the arm's reach"):
        candidates(replace(cell, robot=stiff), 40)


def test_the_stops_take_all_branches_of_the_arm():
    cell = cell_of(CellOptions(robot="ur10e"))
    q = candidates(cell, 200).q
    for joint in (2, 4):
        # Elbow and wrist bend either way; by chance alone each would in half of the stops.
        assert 0.1 < np.mean(np.sin(q[:, joint]) > 0.0) < 0.9


@pytest.mark.parametrize("robot", ["panda", "irb120"])
def test_arms_of_other_makers_and_of_seven_joints(robot):
    cell = cell_of(CellOptions(robot="ur5e"), robot=load_robot(robot))
    stops = candidates(cell, 30)
    assert stops.q.shape == (30, load_robot(robot).joint_count)
    assert np.all(stops.q >= cell.robot.lower_rad + cell.limits.joint_margin_rad)


def test_an_arm_of_four_joints_finds_its_views_by_drawing_postures():
    turns = {"alpha_rad": 0.0, "d_m": 0.0, "lower_deg": -150, "upper_deg": 150}
    slides = {"type": "prismatic", "alpha_rad": 0.0, "d_m": 0.0, "lower_m": 0.0, "upper_m": 0.2}
    rows = [
        turns | {"name": "j1", "a_m": 0.35, "d_m": 0.4},
        turns | {"name": "j2", "a_m": 0.3, "alpha_rad": np.pi},
        slides | {"name": "z", "a_m": 0.0},
        turns | {"name": "j4", "a_m": 0.0},
    ]
    document = {"schema": 1, "name": "scara", "convention": "standard", "joint": rows}
    scara = Robot.from_document(document)
    board = compose(np.diag([1.0, -1.0, -1.0]), np.array([0.4, 0.1, -0.25]))
    aside = compose(np.eye(3), np.array([0.06, 0.0, 0.0]))
    limits = Limits(floor_m=-0.26, joint_margin_rad=0.01)
    cell = cell_of(CellOptions(robot="ur5e"), robot=scara, x=aside, z=board, limits=limits)
    stops = candidates(cell, 40)
    assert len(stops) == 40
    seen = invert(scara.base_from_flange(stops.q) @ aside) @ board
    np.testing.assert_allclose(stops.cam_from_target, seen, atol=1e-12)


def test_guesses_spread_as_they_are_said_to():
    cell = cell_of(CellOptions(robot="ur5e"), sigma_rad=0.03, sigma_m=0.01)
    drawn = cell.guesses(2000, seed=0)
    for edge in ("x", "z"):
        guess = getattr(cell, edge)
        moves = log(invert(guess) @ np.array([getattr(plan_cell, edge) for plan_cell in drawn]))
        # The spread of 2000 draws is off by 1.6 %.
        np.testing.assert_allclose(moves.std(axis=0), [0.03] * 3 + [0.01] * 3, rtol=0.08)


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
def test_a_cell_that_cannot_be_is_refused(make):
    with pytest.raises(DataError):
        make()


@pytest.mark.parametrize("factor", [1e6, 1e150])
def test_a_lens_that_sees_nothing_is_refused(factor):
    cell = cell_of(CellOptions())
    camera = replace(cell.camera, matrix=cell.camera.matrix * [factor, factor, 1.0, 1.0])
    with pytest.raises(DataError, match="camera: no ray of this lens"):
        candidates(replace(cell, camera=camera), 5, 0)


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
