"""Simulated cells of several robots: the rows say what was really there."""

from dataclasses import replace

import numpy as np
import pytest

from visioncal.core.transforms import invert, pose_difference
from visioncal.simulation import (
    BOARDS,
    BoardAt,
    CameraAt,
    CellOptions,
    InstrumentAt,
    Moved,
    NetworkOptions,
    Payload,
    PointAt,
    RobotAt,
    Second,
    cell_session,
    simulate,
)

EVEN = replace(BOARDS["checkerboard"], name="even", columns=8, rows=6)
OPTIONS = NetworkOptions(
    cameras=(*NetworkOptions().cameras, CameraAt("hand", "a")),
    boards=(*NetworkOptions().boards[1:], BoardAt("even", target=EVEN)),
    instruments=(InstrumentAt("tracker", (1.0, -1.5, 0.5), 0.3),),
    points=(PointAt("nest", "cell", (0.2, 0.1, 0.0)), PointAt("ball", "b", (0.0, 0.05, 0.1))),
    stops=8,
    lens_views=3,
)


STOPS = 8
ONE_ARM = NetworkOptions(
    robots=(RobotAt("a", (-0.6, 0.0, 0.0)),), boards=(BoardAt("plate", "a"),), stops=STOPS
)


@pytest.fixture(scope="module")
def cell():
    return simulate(OPTIONS)


def chained(cell, frame, robots):
    """`cell_from_frame` by the poses that rows tell, written out anew."""
    parent, placed = cell.parents[frame], cell.mountings[frame]
    if parent == "cell":
        return placed
    name = parent.removeprefix("flange_")
    told = robots[name].base_from_flange().as_matrix()
    return cell.mountings[f"base_{name}"] @ told @ placed


def test_rows_tell_all_that_their_observations_need(cell):
    session = cell_session(cell, "cell", seen="poses")
    assert session.frames["target_even"] == "cell"
    assert session.frames["cam_hand"] == "flange_a"
    assert session.frames["point_ball"] == "flange_b"
    pairs = {(observation.seer, observation.seen) for observation in session.observations}
    # The camera on one robot looks at the board on the other.
    assert ("cam_hand", "target_plate_b") in pairs
    for observation in session.observations:
        assert not observation.missing_robots
        seer = chained(cell, observation.seer, observation.robots)
        seen = chained(cell, observation.seen, observation.robots)
        if observation.view.reading_m is not None:
            off_mm = 1e3 * np.linalg.norm((invert(seer) @ seen)[:3, 3] - observation.view.reading_m)
            # Four sigma of the tracker (15 um) and of the arm, whose turn acts at 0.1 m.
            assert off_mm < 0.2
            continue
        mm, deg = pose_difference(
            invert(seer) @ seen, observation.view.cam_from_target().as_matrix()
        )
        # Arms repeat to 0.03 mm and 0.003 deg, but the depth of small boards is seen to 1 mm.
        assert mm < 6.0
        assert deg < 0.5


def test_faults_are_where_the_truth_says(cell):
    faulty = simulate(
        replace(
            OPTIONS,
            swapped_rows=1,
            stray_images=2,
            moved=(Moved("target_plate_b"), Moved("cam_left", 6, 0.02)),
        )
    )
    assert len(faulty.wrong_views) == 4
    other = {
        new.view
        for old, new in zip(cell.sights, faulty.sights, strict=False)
        if old.view == new.view and not np.allclose(old.cam_from_target, new.cam_from_target)
    }
    moved = {
        sight.view
        for sight in cell.sights
        if (sight.board == "plate_b" and sight.stop >= 4)
        or (sight.camera == "left" and sight.stop >= 6)
    }
    # A push may take a board out of an image: then rows are numbered otherwise from there on.
    early = {sight.view for sight in cell.sights if 0 <= sight.stop < 4}
    assert other & early == set(faulty.wrong_views) & early
    assert other & moved & {sight.view for sight in cell.sights if sight.stop == 4}


def test_robots_of_a_whole_cell_give_way_and_carry_what_rows_say():
    loads = (Payload(), Payload(5.0, (0.0, 0.0, 0.1)))
    soft = RobotAt(
        "a",
        (-0.6, 0.0, 0.0),
        robot_sigma_m=0.0,
        robot_sigma_rad=0.0,
        compliance_rad_per_nm=(1e-5,) * 6,
        backlash_rad=(0.0, 1e-3, 0.0, 0.0, 0.0, 0.0),
        payloads=loads,
    )
    cell = simulate(replace(ONE_ARM, robots=(soft,)))
    for robot in (soft, replace(soft, payloads=())):
        expected = robot.flange_at(
            cell.robots["a"].true_arm,
            cell.robots["a"].joints,
            robot.loads(STOPS),
            np.resize([-1.0, 1.0], STOPS),
        )
        away = np.abs(expected - cell.robots["a"].true_base_from_flange).max(axis=(1, 2))
        # The second load of 5 kg bends the arm by some tenths of a millimetre.
        assert (away[::2] < 1e-12).all()
        assert (away[1::2] > 1e-5).all() == (not robot.payloads)
    for view in cell_session(cell, "cell", seen="corners").views:
        if view.text.get("robot"):
            assert view.numbers["payload_kg"] == loads[view.stop % 2].kg
            assert view.text["approach"] == "-+"[view.stop % 2]


def test_one_robot_with_one_camera_is_a_cell_whose_things_have_no_names():
    single = simulate(CellOptions(views=4, second=Second()))
    assert single.robot_of("cam") == ""
    assert single.robot_of("target_first") is None
    for sight in single.sights:
        board = single.mountings[f"target_{sight.board}"]
        flange = single.robot.true_base_from_flange[sight.stop]
        seen = invert(flange @ single.mountings["cam"]) @ board
        # A product of matrices of order one.
        np.testing.assert_allclose(seen, sight.cam_from_target, atol=1e-12)
