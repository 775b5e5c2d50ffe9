"""The result of a whole cell: its file, and what is taken out of it for one camera and robot."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.arm_documents import arm_of
from support.commands import visioncal
from support.misfits import misfit
from support.refusals import raised
from support.whole_cells import saved, simulated, truth

import visioncal as package
from visioncal.core.errors import DataError
from visioncal.core.number_format import significant
from visioncal.core.transforms import invert, log
from visioncal.results import Calibration, RobotResult, to_document
from visioncal.results.views import left_out_rms
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.simulation import cell_session

# Chi-square of twelve, and of six, exceed these in one case of a thousand.
MOST_OF_TWELVE, MOST_OF_SIX = 32.9, 22.5
PAIRS = [("left", "b", "plate_b"), ("left", "a", "plate_a"), ("hand", "a", "floor")]


@pytest.fixture(scope="module")
def cell():
    return simulated()


@pytest.fixture(scope="module")
def folder(cell, tmp_path_factory):
    place = tmp_path_factory.mktemp("whole")
    session, _ = saved(place, cell)
    done = visioncal("calibrate", session, "-o", place / "out", "--json").good()
    written = json.loads((place / "out" / "calibration.json").read_text())
    assert json.loads(done.out) == written
    return place


@pytest.fixture(scope="module")
def found(folder):
    return Calibration.load(folder / "out")


def test_the_file_has_the_sections_of_one_camera_by_name(folder):
    written = json.loads((folder / "out" / "calibration.json").read_text())
    assert written["schema"] == 2
    assert set(written["cameras"]) == {"left", "hand"}
    assert set(written["robots"]) == {"a", "b"}
    assert set(written["targets"]) == {"floor", "plate_a", "plate_b"}
    assert written["robots"]["a"]["name"] == "ur5e"
    assert written["joint_covariance"]["order"] == list(written["transforms"])
    size = 6 * len(written["transforms"])
    assert np.shape(written["joint_covariance"]["matrix"]) == (size, size)
    assert written["tree"]["cam_hand"] == "flange_a"
    assert all(value["pixel_px"] > 0 for name, value in written["noise"].items() if "cam" in name)
    view = next(value for value in written["views"] if value["target"] == "plate_b")
    assert (view["camera"], view["robots"], view["used"]) == ("left", ["b"], True)
    assert view["corners"] == 54
    # A corner is seen to 0.05 px, and the robot's noise moves it by a little more.
    assert 0.02 < view["rms_px"] < 1.0
    assert written["rms"]["px"] > 0.0
    assert "null" not in (folder / "out" / "calibration.json").read_text()


def test_the_file_says_what_each_frame_is_uncertain_by(folder, found):
    budgets = json.loads((folder / "out" / "calibration.json").read_text())["uncertainty"]
    assert budgets["budget_mm"].keys() == found.edges.keys()
    for name, parts in budgets["budget_mm"].items():
        assert parts["total"] == pytest.approx(found.edges[name].sigma_mm, rel=1e-6)
        squares = [mm**2 for source, mm in parts.items() if source != "total"]
        # Of lens and board, one may count for less than nothing, which is written as nothing.
        assert sum(squares) == pytest.approx(parts["total"] ** 2, rel=0.05)
        assert {"pixels of cam_left", "pixels of cam_hand", "robot a", "robot b"} <= parts.keys()
    of_hand = budgets["budget_mm"]["flange_a_from_cam_hand"]
    assert of_hand["pixels of cam_hand"] > of_hand["pixels of cam_left"]
    html = (folder / "out" / "report.html").read_text()
    assert "Where the uncertainty comes from" in html
    assert f"{significant(of_hand['total'])}</td>" in html


def test_the_file_says_how_well_the_noise_of_each_robot_is_known(folder, found):
    written = json.loads((folder / "out" / "calibration.json").read_text())
    for robot in ("a", "b"):
        for name, (low, high) in written["uncertainty"]["noise_95"][robot].items():
            assert 0.0 < low < written["noise"][robot][name] < high
    # Two levels of 20 stops, some directions of which the frames have taken: not known exactly.
    part = found.of("left", "b", "plate_b")
    assert part.uncertainty.noise_95.keys() < part.noise.keys()
    assert 20.0 < part.noise_dof < 120.0
    low = written["uncertainty"]["noise_95"]["b"]["translation_mm"][0]
    assert f"95 %: {significant(low)} to" in (folder / "out" / "report.html").read_text()


def test_what_was_left_out_is_told_by_camera_and_target(folder, found):
    written = json.loads((folder / "out" / "calibration.json").read_text())["validation"]
    assert written["method"] == "leave-one-out over stops"
    # Unseen views are off by more than those that were fitted, but not by much with 20 stops.
    assert 1.0 < written["held_out"]["px"] / found.rms.px < 1.3
    one = found.of("hand", target="floor").validation
    seen = [view for view in found.views if (view.seer, view.seen) == ("cam_hand", "target_floor")]
    assert (one.method, one.held_out) == (written["method"], left_out_rms(seen))


@pytest.mark.parametrize(("camera", "robot", "target"), PAIRS)
def test_one_camera_robot_and_target_are_as_near_as_their_covariance_says(
    cell, found, camera, robot, target
):
    one = found.of(camera, robot, target)
    assert one.mount == ("eye-in-hand" if camera == "hand" else "eye-to-hand")
    error = []
    for name, edge in one.edges.items():
        parent, child = name.split("_from_")
        ends = f"{parent}_{robot}", f"{child}_{camera if child == 'cam' else target}"
        error.append(log(invert(truth(cell, *ends)) @ edge.matrix))
        np.testing.assert_allclose(
            edge.covariance, found.between(*ends).covariance, rtol=1e-9, atol=1e-18
        )
    error = np.concatenate(error)
    assert error @ np.linalg.solve(one.joint_covariance, error) < MOST_OF_TWELVE
    assert one.camera.camera is found.cell.cameras[camera].camera
    assert one.robot.name == "ur5e"
    ends = (f"cam_{camera}", f"target_{target}")
    mine = [view.view for view in found.views if (view.seer, view.seen) == ends]
    assert [view.view for view in one.views] == mine


@pytest.mark.slow
def test_a_stated_camera_of_measured_poses_is_kept(cell):
    whole = package.calibrate(cell_session(cell, "poses", seen="poses"), need_mm=0.1)
    found = whole.of("left", "b")
    assert found.camera.camera.resolution == (2448, 2048)
    assert not found.camera.estimated
    assert "pixel_px" not in found.noise
    # Of both together: more than the robot's alone.
    assert found.noise["combined_translation_mm"] > found.noise["robot_translation_mm"]
    # Each camera picks with each robot that parts it from what it sees; the worst pair decides.
    pairs = {(pair.camera, pair.robot): pair.probability for pair in whole.need.pairs}
    assert pairs.keys() == {(camera, robot) for camera in ("left", "hand") for robot in "ab"}
    assert whole.need.probability == min(pairs.values()) < max(pairs.values())
    assert found.need.probability == pairs["left", "b"]


def test_what_is_taken_out_can_be_kept_by_itself(found, tmp_path):
    one = found.of("hand", target="floor")
    one.save(tmp_path / "calibration.json")
    again = Calibration.load(tmp_path)
    assert to_document(again) == to_document(one)
    assert again.cell is None
    assert again.of() is again
    raised(DataError, "which have no names", again.of, camera="hand")


@pytest.mark.parametrize("of", [Calibration, Session])
@pytest.mark.parametrize(
    ("names", "words", "step"),
    [
        ({}, r"several cameras \(left, hand\), and which is meant is not said", "--camera left"),
        ({"camera": "left"}, r"several robots \(a, b\)", "--robot a"),
        ({"camera": "lefft"}, "no camera 'lefft': its cameras are left, hand", "Did you mean left"),
        ({"robot": "c"}, "no robot 'c': its robots are a, b", ""),
        ({"camera": "left", "target": "floor"}, "no one robot parts", "These go together: "),
        ({"camera": "hand", "target": "plate_b"}, "no one robot parts", "These go together: "),
        ({"camera": "left", "robot": "a", "target": "plate_b"}, "no one robot parts", "These go"),
        ({"camera": "hand", "robot": "b"}, "no one robot parts", "These go together: "),
    ],
)
def test_what_cannot_be_meant_is_said_with_the_names(found, folder, of, names, words, step):
    whole = found if of is Calibration else Session.load(folder / "session")
    assert step in raised(DataError, words, whole.of, **names).next_step


def test_a_session_of_one_pair_has_its_rows_with_the_poses_of_their_stops(cell, folder):
    session = Session.load(folder / "session")
    one = session.of("cam_hand", target="floor")
    assert one.mount == "eye-in-hand"
    assert one.columns[:2] == ("view", "stop")
    assert not {"camera", "robot", "target"} & {*one.columns}
    seen = [
        observation
        for observation in session.observations
        if (observation.seer, observation.seen) == ("cam_hand", "target_floor")
    ]
    assert [view.number for view in one.views] == [observation.view.number for observation in seen]
    for view in one.views:
        pose = view.base_from_flange().as_matrix()
        np.testing.assert_allclose(pose, cell.robots["a"].base_from_flange[view.stop], atol=1e-12)
    assert one.robot_document == session.robot_documents["a"]
    assert one.corners.keys() == {view.number for view in one.views}
    assert one.of() is one


def test_a_pair_calibrated_by_itself_agrees_with_the_whole_cell(found, folder):
    alone = package.calibrate(Session.load(folder / "session").of("left", "b"), level="hand-eye")
    for name, edge in found.of("left", "b").edges.items():
        other = alone.edges[name]
        # Of the same corners: the whole cell is nearer to the truth than the pair.
        assert misfit(other, edge.matrix) < MOST_OF_SIX
        assert edge.sigma_mm < other.sigma_mm


def test_further_stages_of_a_robot_stand_in_its_section(found, tmp_path):
    arm = found.cell.robots["b"]
    bent = arm.model.corrected(1e-3 * np.ones((7, 6)))
    robots = {**found.cell.robots, "b": RobotResult(arm.model, arm=arm_of(bent))}
    bending = replace(found, cell=replace(found.cell, robots=robots))
    bending.save(tmp_path / "calibration.json")
    again = Calibration.load(tmp_path)
    assert not again.of("left", "a").arm_is_calibrated
    one, q = again.of("left", "b"), np.full((1, 6), 0.3)
    assert one.arm_is_calibrated
    np.testing.assert_allclose(one.standing(q), bent.base_from_flange(q), atol=1e-12)
    np.testing.assert_allclose(
        one.robot.base_from_flange(q), Robot.from_document(arm.model.document).base_from_flange(q)
    )
