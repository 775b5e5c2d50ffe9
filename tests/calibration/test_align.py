"""Whole cells from sessions: frames, faults, symmetric boards, lenses, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from support.marks import slow
from support.whole_cells import OPTIONS

from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import Target
from visioncal.robot import load_robot
from visioncal.session import Session
from visioncal.session.columns import POSE, pose_row
from visioncal.simulation import CellOptions, simulate
from visioncal.simulation.arms import Payload
from visioncal.simulation.layout import (
    BoardAt,
    CameraAt,
    InstrumentAt,
    Moved,
    NetworkOptions,
    PointAt,
    RobotAt,
)
from visioncal.simulation.optics import fine_camera
from visioncal.simulation.records import cell_session

STOPS = 20
# Looks the same after half a turn: both counts are even.
ALIKE = Target("checkerboard_8x6_25mm", "checkerboard", 8, 6, 0.025, 2.5e-5)
FLOOR = BoardAt("floor", place_m=(0.0, 0.0, 0.05))
LEFT = CameraAt("left", place_m=(0.0, -1.0, 1.1))
RIGHT = CameraAt("right", place_m=(0.15, 0.95, 1.25), camera=fine_camera())


def aligned(cell):
    session = cell_session(cell, "cell", seen="names")
    return calibrate(session, corners={corner.view: corner for corner in cell.corners})


@pytest.fixture(scope="module")
def clean():
    cell = simulate(NetworkOptions(stops=STOPS))
    return cell, aligned(cell)


def off(cell, found, first, second):
    """(6,) by which a frame is off from another's, and its squared length in sigmas."""
    edge = found.between(first, second)
    away = log(invert(cell.between(first, second)) @ edge.matrix)
    return away, float(away @ np.linalg.solve(edge.covariance, away))


def test_bases_are_as_near_as_their_covariance_says(clean):
    cell, found = clean
    away, squared = off(cell, found, "base_a", "base_b")
    # 2e-4 m: four sigma of what twenty stops tell at a metre; chi-square of 6 beyond 22 is 0.1 %.
    assert np.linalg.norm(away[3:]) < 2e-4
    assert squared < 22.0
    assert found.tree.edge_of("base_b").sigma_mm < 0.1
    assert found.verdict.status == "good"
    assert all(view.used for view in found.views)
    assert not found.cell.moved
    assert found.cell.reference == "base_a"


def test_noise_is_told_apart_by_robot_and_camera(clean):
    cell, found = clean
    assert found.cell.noise["cam_left"]["pixel_px"] == pytest.approx(
        cell.options.pixel_sigma_px, rel=0.1
    )
    # Twenty stops tell a robot's to some 15 %.
    assert found.cell.noise["a"]["translation_mm"] == pytest.approx(0.03, rel=0.5)
    assert found.cell.noise["b"]["translation_mm"] == pytest.approx(0.03, rel=0.5)


def test_any_frame_is_placed_in_any_other(clean):
    cell, found = clean
    _, squared = off(cell, found, "cam_left", "cam_right")
    assert squared < 22.0
    there, back = found.between("cam_left", "base_b"), found.between("base_b", "cam_left")
    np.testing.assert_allclose(there.matrix @ back.matrix, np.eye(4), atol=1e-12)
    direct = found.between("base_a", "base_b")
    np.testing.assert_allclose(direct.covariance, found.tree.edge_of("base_b").covariance)
    assert not found.between("base_a", "base_a").covariance.any()


def test_the_covariance_of_a_chain_is_that_of_its_edges(clean):
    _, found = clean
    edges = list(found.edges)
    flange = exp(np.array([0.3, -0.2, 0.5, 0.4, 0.1, 0.6]))
    poses = {"b": flange}
    chain = found.between("cam_left", "target_plate_b", poses)
    step, jacobian = 1e-6, np.zeros((6, 6 * len(edges)))
    for at in range(6 * len(edges)):
        twist = np.zeros(6)
        twist[at % 6] = step
        name = edges[at // 6]
        moved = replace(found.edges[name], matrix=found.edges[name].matrix @ exp(twist))
        other = replace(found, edges={**found.edges, name: moved})
        there = other.between("cam_left", "target_plate_b", poses).matrix
        jacobian[:, at] = log(invert(chain.matrix) @ there) / step
    expected = jacobian @ found.joint_covariance @ jacobian.T
    # Forward differences of 1e-6 are exact to 1e-6 of themselves.
    np.testing.assert_allclose(chain.covariance, expected, rtol=1e-4, atol=1e-13)


def test_a_frame_that_moves_with_a_robot_asks_for_its_pose(clean):
    _, found = clean
    with pytest.raises(DataError, match="moves with robot 'b': its pose is needed"):
        found.between("cam_left", "target_plate_b")
    with pytest.raises(DataError, match="no frame 'cam_lft'"):
        found.between("cam_lft", "base_a")


@pytest.mark.slow
def test_all_that_is_wrong_is_named_and_the_answer_is_that_of_a_sound_cell():
    pushes = (Moved("target_floor", 9), Moved("cam_right", 12))
    options = NetworkOptions(stops=STOPS, moved=pushes, swapped_rows=1, stray_images=3, seed=3)
    cell = simulate(options)
    found = aligned(cell)
    assert [(value.frame, value.first_stop) for value in found.cell.moved] == [
        ("target_floor", 9),
        ("cam_right", 12),
    ]
    for value in found.cell.moved:
        # A pushed frame's own place is known to 0.1 mm.
        assert value.shift_mm == pytest.approx(5.0, abs=0.4)
    reasons = {view.view: view.reason for view in found.views if not view.used}
    assert sorted(reasons) == list(cell.wrong_views)
    assert sum("exchanged" in reason for reason in reasons.values()) == 2
    assert sum("its image is of stop" in reason for reason in reasons.values()) == 3
    assert found.verdict.status == "check"
    assert any(
        "cam_right was bumped between stops 11 and 12" in reason for reason in found.verdict.reasons
    )
    away, squared = off(cell, found, "base_a", "base_b")
    assert squared < 22.0
    assert np.linalg.norm(away[3:]) < 2.5e-4


@pytest.mark.slow
def test_a_frame_that_moved_twice_has_three_places_however_its_moves_were_found():
    """The later push is found first."""
    pushes = (Moved("target_floor", 4), Moved("target_floor", 10))
    found = aligned(simulate(NetworkOptions(stops=STOPS, moved=pushes, seed=3)))
    frame = "target_floor"
    befores = [f"{frame}_until_stop_3", f"{frame}_until_stop_9"]
    assert [value.before for value in found.cell.moved] == befores
    assert [(value.last_stop, value.first_stop) for value in found.cell.moved] == [(3, 4), (9, 10)]
    places = {edge for edge in found.edges if frame in edge}
    assert places == {f"cell_from_{before}" for before in (*befores, frame)}


def test_a_robot_that_was_pushed_is_named_and_counts_as_it_stood_before():
    cell = simulate(NetworkOptions(stops=STOPS, moved=(Moved("base_b", 10),)))
    found = aligned(cell)
    (words,) = [reason for reason in found.verdict.reasons if "pushed" in reason]
    assert "did not stand at stop 10 and after where its pose says" in words
    assert "as if base_b had been pushed by 5" in words
    assert not found.cell.moved
    assert off(cell, found, "base_a", "base_b")[1] < 22.0


def test_boards_that_look_alike_from_both_ends_are_told_apart_across_cameras():
    boards = (
        replace(FLOOR, target=ALIKE),
        BoardAt("plate_a", "a", target=ALIKE),
        BoardAt("plate_b", "b", target=ALIKE),
    )
    cell = simulate(NetworkOptions(boards=boards, stops=STOPS))
    found = aligned(cell)
    assert all(view.used for view in found.views)
    for frames in (("base_a", "base_b"), ("cam_left", "cam_right")):
        assert off(cell, found, *frames)[1] < 22.0


@pytest.mark.slow
def test_a_board_of_a_wholly_other_size_is_found_and_the_cell_is_where_it_is():
    """Five per cent: the chain is not linear in a size so far off, and lenses seem to breathe."""
    floor, _, plate = OPTIONS.boards
    target = replace(floor.target, square_sigma_m=1e-5)
    boards = (replace(floor, target=target, scale=1.05), plate)
    found = aligned(cell := simulate(replace(OPTIONS, boards=boards)))
    (cause, *_) = found.verdict.causes
    assert cause.kind == "board_size"
    assert "the board floor is 5 % larger than stated" in cause.words
    assert off(cell, found, "base_a", "base_b")[1] < 22.0


@pytest.mark.slow
def test_lenses_come_from_images_of_their_own():
    cameras = (replace(LEFT, state_intrinsics=False), replace(RIGHT, state_intrinsics=False))
    cell = simulate(NetworkOptions(cameras=cameras, lens_views=12, stops=STOPS))
    assert LEFT.camera.resolution != RIGHT.camera.resolution
    found = aligned(cell)
    assert off(cell, found, "base_a", "base_b")[1] < 22.0
    for camera in cameras:
        got = found.cell.lenses[f"cam_{camera.name}"]
        assert got.estimated
        assert got.camera.resolution == camera.camera.resolution
        sigma = np.sqrt(np.diag(got.covariance))[:4]
        # Five sigma of each: the distortion's own errors go with them.
        assert np.all(np.abs(got.camera.matrix - camera.camera.matrix) < 5 * sigma)
    # Images of the lens alone are no observations of the cell.
    assert len(found.views) == len(cell.sights) - 24


@pytest.mark.parametrize("mode", ["auto", slow("hold")])
def test_a_lens_that_is_stated_wrong_is_refined_or_kept_as_asked(clean, mode):
    cell, right = clean
    session = cell_session(cell, "cell", seen="names")
    stated = session.document["cameras"]["left"]
    wrong = np.add(stated["matrix"], [8.0, 8.0, -3.0, 4.0])
    left = {**stated, "matrix": wrong.tolist(), "intrinsics": mode}
    document = {**session.document, "cameras": {**session.document["cameras"], "left": left}}
    found = calibrate(
        replace(session, document=document),
        corners={corner.view: corner for corner in cell.corners},
    )
    got = found.cell.lenses["cam_left"]
    (said,) = [
        reason for reason in found.verdict.reasons if "the given intrinsics do not fit" in reason
    ]
    assert said.startswith("cam_left: ")
    if mode == "auto":
        sigma = np.sqrt(np.diag(got.covariance))[:4]
        assert np.all(np.abs(got.camera.matrix - LEFT.camera.matrix) < 5 * sigma)
        assert off(cell, found, "base_a", "base_b")[1] < 22.0
        assert "were refined" in said
        return
    np.testing.assert_array_equal(got.camera.matrix, wrong)
    assert 'intrinsics = "hold" keeps them' in said
    # What is open about it counts where that camera is.
    edges = found.edges["cell_from_cam_left"], right.edges["cell_from_cam_left"]
    assert edges[0].sigma_mm > 2.0 * edges[1].sigma_mm
    # Corners pull at it: the camera is a centimetre away, which is within what that counts for.
    away, squared = off(cell, found, "base_a", "cam_left")
    assert np.linalg.norm(away[3:]) > 5e-3
    assert squared < 22.0
    budget = found.cell.uncertainty.budget_mm["cell_from_cam_left"]
    assert budget["held_values"] > 0.9 * budget["total"]


def test_cameras_in_the_hand_and_poses_that_are_given():
    cameras = (CameraAt("left", "a"), CameraAt("right", "b"))
    cell = simulate(NetworkOptions(cameras=cameras, boards=(FLOOR,), stops=STOPS))
    found = calibrate(cell_session(cell, "cell", seen="poses"))
    away, squared = off(cell, found, "base_a", "base_b")
    assert np.linalg.norm(away[3:]) < 1e-3
    # The noise of the given poses is estimated, too: fewer are told than they are.
    assert squared < 40.0


POINTS = (
    PointAt("n1", "cell", (0.2, 0.3, 0.1)),
    PointAt("n2", "cell", (-0.2, 0.35, 0.2)),
    PointAt("n3", "cell", (0.1, -0.4, 0.15)),
    PointAt("fa", "a", (0.05, 0.02, 0.08)),
    PointAt("fb", "b", (0.03, -0.04, 0.09)),
)
TRACKERS = (InstrumentAt("t1", (0.0, -3.0, 1.2)), InstrumentAt("t2", (0.5, 3.0, 1.2), 2.5))


def test_instruments_and_the_points_that_they_share_tie_robots_without_a_camera():
    cell = simulate(NetworkOptions(cameras=(), instruments=TRACKERS, points=POINTS, stops=12))
    # The second stands alone but for the points in the cell.
    kept = [
        reading
        for reading in cell.readings
        if reading.instrument == "t1" or reading.point.startswith("n")
    ]
    found = aligned(replace(cell, readings=tuple(kept)))
    for frames in (("base_a", "base_b"), ("instrument_t1", "instrument_t2")):
        assert off(cell, found, *frames)[1] < 22.0
    # Places alone were read: a point's axes are its parent's by choice.
    assert not found.tree.edge_of("point_n1").oriented
    assert all(view.residual_deg is None for view in found.views)
    # Some 250 coordinates tell what a tracker's noise is of what is said of it, to 5 %.
    assert found.cell.noise["instrument_t1"]["level"] == pytest.approx(1.0, rel=0.25)


def test_an_instrument_that_reads_nothing_in_common_is_reported_with_what_would_tie_it():
    cell = simulate(NetworkOptions(instruments=TRACKERS[:1], points=POINTS[:3], stops=8))
    found = aligned(cell)
    (remedy,) = {value.remedy for value in found.cell.untied if value.frame == "instrument_t1"}
    assert "read points on a robot's flange" in remedy


ERRING = (
    RobotAt("a", (-0.6, 0.0, 0.0), offset_sigma_rad=1e-3),
    RobotAt("b", (0.6, 0.05, 0.02), offset_sigma_rad=1e-3),
)


@pytest.mark.slow
def test_arms_that_err_are_named_and_their_offsets_found_where_that_is_asked_for():
    cell = simulate(NetworkOptions(robots=ERRING, stops=STOPS))
    session = cell_session(cell, "cell", seen="names")
    corners = {view_corners.view: view_corners for view_corners in cell.corners}
    reported = calibrate(session, corners=corners, level="hand-eye")
    assert sum("follow the arm's posture" in reason for reason in reported.verdict.reasons) == 2
    found = calibrate(session, corners=corners)
    assert found.verdict.status == "good"
    for robot in ("a", "b"):
        kinematics = found.cell.robots[robot].arm
        assert kinematics.level == "offsets"
        true = cell.robots[robot].true_arm.offset - cell.robots[robot].arm.offset
        arm = kinematics.robot
        told = arm.chain.functions[:, 0] - load_robot("ur5e").chain.functions[:, 0]
        # What the first joint and the last take may be the base's and the flange's: they stay about
        # as stated. Others are known to some 0.05 mrad by this many stops.
        assert told[[0, -1]] == pytest.approx(0.0, abs=1e-6)
        assert told[1:-1] == pytest.approx(true[1:-1], abs=2.5e-4)
        zeros = [parameter for parameter in kinematics.parameters if parameter.name == "theta_rad"]
        surprises = ([zero.change for zero in zeros] - true) / [zero.sigma for zero in zeros]
        assert np.abs(surprises).max() < 4.5  # one of twelve in ten thousand sessions
        one = found.of("cam_left", robot, f"target_plate_{robot}")
        np.testing.assert_allclose(
            one.standing(cell.robots[robot].joints),
            arm.base_from_flange(cell.robots[robot].joints),
            atol=1e-12,
        )
    assert off(cell, found, "cam_left", "cam_right")[1] < 22.0
    after, before = (
        calibration.between("cam_left", "cam_right").sigma_mm for calibration in (found, reported)
    )
    # Well under a half: what the arms err by puts the given lenses in doubt, too.
    assert after < 0.45 * before


def test_a_robot_without_joints_stays_as_it_reports_itself():
    cell = simulate(NetworkOptions(stops=8))
    session = cell_session(cell, "cell", seen="names")
    columns = [column for column in session.columns if not column.startswith("q")]
    columns += ["qx", "qy", "qz", "qw"]
    bare = Session.assemble(
        session.document,
        columns,
        [[view.cell(column) for column in columns] for view in session.views],
        session.images,
        target_document=session.target_document,
        robot_document=session.robot_document,
    )
    found = calibrate(
        bare, corners={corner.view: corner for corner in cell.corners}, level="offsets"
    )
    assert sum("stays as it reports itself" in reason for reason in found.verdict.reasons) == 2
    with pytest.raises(DataError, match="level 'all'"):
        calibrate(bare, level="all")


def test_a_robot_that_nothing_ties_is_refused_with_what_would_tie_it():
    boards = (FLOOR, BoardAt("plate_a", "a"))
    cell = simulate(NetworkOptions(boards=boards, stops=8))
    with pytest.raises(DegenerateError, match="nothing ties base_b to base_a") as caught:
        aligned(cell)
    assert "let cam_left, cam_right see a board on flange_b" in caught.value.next_step


def four_axes_beside_six(b_turns_rad, prior):
    """A session in which one camera sees boards on two arms, and where base b is in base a.

    Args:
        b_turns_rad: (s, 3) rotation vectors of flange b.
        prior: What session.toml has of `flange_b_from_target_plate_b`.
    """
    rng = np.random.default_rng(4)
    bases = {"a": np.eye(4), "b": exp(np.array([[0.01, -0.02, 1.2, 1.0, 0.4, 0.03]]))[0]}
    cell_from_top = exp(np.array([[3.0, 0.1, 0.0, 0.5, 0.2, 1.6]]))[0]
    plates = {name: exp(np.array([[0.05, 0.0, 0.4, 0.05, 0.02, 0.03]]))[0] for name in bases}
    columns = ("camera", "stop", "target", "robot", *POSE, *(f"cft_{name}" for name in POSE))
    rows = []
    for stop, turn in enumerate(b_turns_rad):
        turns = {"a": rng.uniform(-0.6, 0.6, 3), "b": turn}
        for name, base in bases.items():
            flange = exp(np.array([[*turns[name], *rng.uniform(-0.2, 0.2, 3)]]))[0]
            seen = invert(cell_from_top) @ base @ flange @ plates[name]
            seen = seen @ exp(rng.normal(0.0, 1e-4, (1, 6)))[0]
            row = pose_row(flange) | {f"cft_{key}": at for key, at in pose_row(seen).items()}
            row |= {"camera": "top", "stop": stop, "target": f"plate_{name}", "robot": name}
            rows.append([str(len(rows)), *(str(row[column]) for column in columns)])
    frames = {"cam_top": "cell"} | {f"target_plate_{name}": f"flange_{name}" for name in bases}
    document = {
        "schema": 1,
        "name": "two arms",
        "robots": {name: {} for name in bases},
        "cameras": {"top": {"resolution": [640, 480]}},
        "targets": {f"plate_{name}": "charuco_9x6_30mm" for name in bases},
        "frames": frames,
        "prior": {"flange_b_from_target_plate_b": prior} if prior else {},
    }
    return Session.assemble(document, ("view", *columns), rows, {}), bases["b"]


# Eight stops about one axis are fewer than what a start needs to find the turn about it by noise.
ABOUT_Z = np.array([[0.0, 0.0, angle] for angle in np.linspace(-2.0, 2.0, 8)])


def test_a_measured_offset_ties_an_arm_of_four_axes_to_a_cell():
    session, base_b = four_axes_beside_six(ABOUT_Z, {"z_m": 0.03, "sigma_m": 1e-4})
    edge = calibrate(session).between("base_a", "base_b")
    away = log(invert(base_b) @ edge.matrix)
    # Chi-square of 6 beyond 22 is 0.1 %.
    assert away @ np.linalg.solve(edge.covariance, away) < 22.0
    assert edge.sigma_mm < 1.0


def test_what_an_arm_that_hardly_turns_is_advised_to_do():
    with pytest.raises(DegenerateError, match="nothing ties base_b to base_a") as caught:
        calibrate(four_axes_beside_six(ABOUT_Z, None)[0])
    assert "for [prior.flange_b_from_target_plate_b]" in caught.value.next_step
    with pytest.raises(DegenerateError, match="differ in position only") as caught:
        calibrate(four_axes_beside_six(np.zeros((8, 3)), None)[0])
    assert caught.value.next_step == (
        "To tie base_b: add 3 or more stops in which flange_b is tilted by 20 to 40 degrees about "
        "different axes, not only about one."
    )


def one_camera(cell):
    return cell_session(cell, "cell", seen="poses")


def two_cameras(cell):
    """What two fixed cameras say of the board on a robot's flange, one of them a metre beside."""
    session = cell_session(cell, "cell", seen="poses")
    columns, rows = ("camera", "stop", *session.columns), []
    beside = exp(np.array([[0.0, 0.3, 0.0, 1.0, 0.0, 0.0]]))[0]
    for view in session.views:
        seen = view.cam_from_target().as_matrix()
        for camera, pose in (("left", seen), ("right", beside @ seen)):
            row = view.numbers | {f"cft_{name}": value for name, value in pose_row(pose).items()}
            row |= {"view": len(rows), "camera": camera, "stop": view.number}
            rows.append([str(row[column]) for column in columns])
    cameras = {name: {"resolution": [640, 480]} for name in ("left", "right")}
    document = {"schema": 1, "name": "cell", "mount": "eye-to-hand", "cameras": cameras}
    document |= {"robot": session.document["robot"]} if "robot" in session.document else {}
    return Session.assemble(document, columns, rows, session.images)


@pytest.mark.parametrize(
    ("mount", "seen", "motion"),
    [
        ("eye-in-hand", one_camera, "one_axis"),
        slow("eye-to-hand", one_camera, "translation"),
        slow("eye-to-hand", two_cameras, "one_axis"),
        slow("eye-to-hand", two_cameras, "translation"),
    ],
)
def test_motion_that_leaves_an_offset_from_an_only_robot_open_is_named(mount, seen, motion):
    words, left_open = {
        "one_axis": (r"all \d+ (stops|used views) .*turn about .*'s", "offset along"),
        "translation": (r"the \d+ (stops|used views) .*differ in position", "offset from"),
    }[motion]
    with pytest.raises(DegenerateError, match=words) as caught:
        calibrate(seen(simulate(CellOptions(mount=mount, motion=motion))))
    culprit, frame = caught.value.culprits[0], "the cell"
    if seen is one_camera:
        frame = "the tool" if mount == "eye-in-hand" else "the base"
    assert "cam" in culprit
    assert f"'s {left_open} {frame}" in culprit


@pytest.mark.slow
def test_a_camera_that_sees_nothing_but_its_own_board_is_reported():
    wall = BoardAt("wall", place_m=(3.0, 0.0, 0.05))
    apart = CameraAt("apart", place_m=(3.0, -1.0, 1.1), looks_at_m=(3.0, 0.0, 0.05))
    boards = (FLOOR, BoardAt("plate_a", "a"), BoardAt("plate_b", "b"), wall)
    cell = simulate(NetworkOptions(cameras=(LEFT, RIGHT, apart), boards=boards, stops=12))
    found = aligned(cell)
    assert {value.frame for value in found.cell.untied} == {"cam_apart", "target_wall"}
    assert found.verdict.status == "check"
    assert all(not view.used for view in found.views if view.seer == "cam_apart")
    (reason,) = {view.reason for view in found.views if view.seer == "cam_apart"}
    assert reason == "nothing ties cam_apart to the rest of the cell"


def test_a_camera_that_one_standing_view_ties_is_refused():
    far = replace(LEFT, place_m=(0.0, -1.5, 1.6))
    boards, cameras = (FLOOR, BoardAt("plate_b", "b")), (far, CameraAt("hand", on="a"))
    cell = simulate(NetworkOptions(cameras=cameras, boards=boards, stops=12, pixel_sigma_px=0.3))
    kept = [sight for sight in cell.sights if (sight.camera, sight.board) != ("hand", "plate_b")]
    with pytest.raises(DegenerateError, match="cam_left") as caught:
        aligned(replace(cell, sights=tuple(kept)))
    assert "cam_left" in caught.value.next_step


def test_a_camera_that_a_board_ties_either_way_round_is_refused():
    beside = CameraAt("right", place_m=(0.15, 0.95, 1.25), looks_at_m=(0.0, 0.0, 0.05))
    boards = (replace(FLOOR, target=ALIKE), BoardAt("plate_a", "a"))
    cell = simulate(
        NetworkOptions(
            robots=(RobotAt("a", (-0.6, 0.0, 0.0)),),
            cameras=(LEFT, beside),
            boards=boards,
            stops=12,
        )
    )
    kept = [
        sight for sight in cell.sights if not (sight.camera == "right" and sight.board == "plate_a")
    ]
    cell = replace(cell, sights=tuple(kept))
    with pytest.raises(DegenerateError, match="cam_right may be in two places: target_floor looks"):
        aligned(cell)


def with_elbow_of_b(session, change):
    """The session with no more than joints of one robot, the third of them changed."""
    views = [
        replace(
            view, numbers=change({k: number for k, number in view.numbers.items() if k not in POSE})
        )
        if view.text.get("robot") == "b"
        else view
        for view in session.views
    ]
    return replace(session, views=tuple(views))


@pytest.mark.slow
def test_joints_of_one_robot_are_held_against_what_the_cameras_see(clean):
    cell, _ = clean
    session, corners = cell_session(cell, "cell", seen="names"), dict(enumerate(cell.corners))
    moved = with_elbow_of_b(session, lambda value: value | {"q3_rad": value["q3_rad"] + 0.2})
    found = calibrate(moved, corners=corners)
    (words,) = [reason for reason in found.verdict.reasons if "elbow_joint" in reason]
    assert words.startswith("Robot b: the joint angles do not belong to ur5e as they are declared.")
    assert "moved by -11.4" in words
    _, squared = off(cell, found, "base_a", "base_b")
    # Chi-square of 6 beyond 22 is 0.1 %.
    assert squared < 22.0
    turned = with_elbow_of_b(session, lambda value: value | {"q3_rad": -value["q3_rad"]})
    with pytest.raises(DataError, match=r"^robot b: .* not those of ur5e .* of the opposite sign"):
        calibrate(turned, corners=corners)


@pytest.mark.slow
def test_an_arm_that_bends_is_as_elastic_in_a_cell_as_by_itself(tmp_path):
    springs = (1e-4, 1e-4, 8e-5, 2e-5, 2e-5, 1e-5)
    loads = (Payload(0.0, (0.0, 0.0, 0.0)), Payload(8.0, (0.0, 0.0, 0.08)))
    bending = simulate(
        CellOptions(
            mount="eye-to-hand",
            compliance_rad_per_nm=springs,
            payloads=loads,
            branches=True,
            views=30,
        )
    )
    cell_session(bending, "pairs", seen="poses").save(tmp_path / "pairs")
    alone = calibrate(Session.load(tmp_path / "pairs"))
    cell = calibrate(two_cameras(bending)).of(camera="left")
    assert cell.arm.level == "elastic"
    assert alone.arm.level == "elastic"
    rows = zip(*(calibration.elastic.joints for calibration in (alone, cell)), springs, strict=True)
    for one, other, true in rows:
        sigma = other.sigma_rad_per_nm
        # Of the same views, but for what a frame beside the arm takes up: within a sigma or so.
        assert other.compliance_rad_per_nm == pytest.approx(
            one.compliance_rad_per_nm, abs=1.5 * sigma
        )
        if other.determined:
            assert other.compliance_rad_per_nm == pytest.approx(true, abs=4.5 * sigma)
    assert sum(other.determined for other in cell.elastic.joints) >= 2
    np.testing.assert_allclose(
        cell.compliance, [joint.compliance_rad_per_nm for joint in cell.elastic.joints]
    )


def reported(cell, robot, poses):
    """A session in which one robot reports other poses, and what was seen in its images."""
    told = replace(cell.robots[robot], base_from_flange=poses)
    cell = replace(cell, robots={**cell.robots, robot: told})
    session = cell_session(cell, "cell", seen="names")
    return session, {corner.view: corner for corner in cell.corners}


@pytest.mark.slow
def test_boards_of_three_sizes_are_found_beside_arms_that_err():
    """What all three have in common the arms' links may have, too: free together none is clear."""
    robots = (replace(robot, offset_sigma_rad=1e-3) for robot in NetworkOptions().robots)
    scales = {"floor": 1.002, "plate_a": 0.999, "plate_b": 1.001}
    boards = (replace(board, scale=scales[board.name]) for board in NetworkOptions().boards)
    found = aligned(
        simulate(NetworkOptions(tuple(robots), boards=tuple(boards), stops=STOPS, seed=5))
    )
    shapes = {name: found.boards[name].shape["scale"] for name in scales}
    # Against each other they are known to some hundred-thousandths.
    assert shapes["floor"] - shapes["plate_a"] == pytest.approx(0.003, abs=1e-4)
    assert shapes["floor"] - shapes["plate_b"] == pytest.approx(0.001, abs=1e-4)
    # 0.03 mm is planted: sizes that stay wrong count as ten times that.
    assert max(found.cell.noise[name]["translation_mm"] for name in "ab") < 0.06
