"""Whole cells on disk, by any one camera, robot and target of them, and commands on them."""

import json
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.arm_documents import arm_of
from support.commands import turned_poses, visioncal, write_poses
from support.misfits import misfit
from support.refusals import raised
from support.whole_cells import LATER, OPTIONS, part, recorded, saved, simulated, truth

import visioncal as package
from visioncal.core.errors import DataError
from visioncal.core.number_format import significant
from visioncal.core.transforms import invert, log
from visioncal.frames.camera_chain import Plane
from visioncal.frames.frame_from_images import seen_frame
from visioncal.frames.locate import locate
from visioncal.results import Calibration, Edge, RobotResult, to_document
from visioncal.results.compare import compare
from visioncal.results.compensation import correct
from visioncal.results.views import left_out_rms
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.simulation import Moved, cell_session, simulate

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


def test_views_left_out_are_named_by_camera_and_target(folder, found):
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
    views = [view.view for view in found.views if (view.seer, view.seen) == ends]
    assert [view.view for view in one.views] == views


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


def test_a_part_of_a_cell_can_be_saved_by_itself(found, tmp_path):
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
        ({}, r"several cameras \(left, hand\), and none is chosen", "--camera left"),
        ({"camera": "left"}, r"several robots \(a, b\)", "--robot a"),
        ({"camera": "lefft"}, "no camera 'lefft': its cameras are left, hand", "Did you mean left"),
        ({"robot": "c"}, "no robot 'c': its robots are a, b", ""),
        ({"camera": "left", "target": "floor"}, "no one robot parts", "These go together: "),
        ({"camera": "hand", "target": "plate_b"}, "no one robot parts", "These go together: "),
        ({"camera": "left", "robot": "a", "target": "plate_b"}, "no one robot parts", "These go"),
        ({"camera": "hand", "robot": "b"}, "no one robot parts", "These go together: "),
    ],
)
def test_an_ambiguous_choice_is_refused_with_the_names(found, folder, of, names, words, step):
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
    of_pair = package.calibrate(Session.load(folder / "session").of("left", "b"), level="hand-eye")
    for name, edge in found.of("left", "b").edges.items():
        other = of_pair.edges[name]
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


# Chi-square of six and of three exceed these in one case of a thousand.
MOST, MOST_OF_THREE = 22.5, 16.3


def done(*arguments):
    return visioncal(*arguments).good().out


def test_a_tool_is_found_by_touches_of_either_robot_and_joins_the_cell(folder, tmp_path):
    rng = np.random.default_rng(3)
    tip, point = np.array([0.01, -0.02, 0.15]), np.array([0.4, 0.1, 0.05])
    poses = turned_poses(rng, np.tile(point, (12, 1)), tip, np.eye(3))
    poses[:, :3, 3] += rng.normal(0.0, 5e-5, (12, 3))
    touches = write_poses(tmp_path / "touches.csv", poses)
    out = shutil.copytree(folder / "out", tmp_path / "out")
    unnamed = visioncal("tcp", touches, "-c", out, "--name", "pin")
    assert "several robots (a, b)" in unnamed.err
    done("tcp", touches, "-c", out, "--robot", "b", "--name", "pin")
    whole = Calibration.load(out)
    edge = whole.frames["flange_b_from_pin"].edge
    error = edge.matrix[:3, 3] - tip
    assert error @ np.linalg.solve(edge.covariance[3:, 3:], error) < MOST_OF_THREE
    assert "flange_from_pin" in whole.of("left", "b").frames
    assert "flange_from_pin" not in whole.of("left", "a").frames
    # By the name that it has in the cell.
    done("export", out, "--to", "ur-tcp", "--robot", "b", "--edge", "flange_b_from_pin")


def test_touches_or_a_tool_of_a_cell_say_which_robot_is_meant(folder, tmp_path):
    tip, point = np.array([0.01, -0.02, 0.15]), np.array([0.4, 0.1, 0.05])
    places = point + 0.1 * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    rng = np.random.default_rng(4)

    def table(name, at, robots, kinds):
        path = write_poses(tmp_path / name, turned_poses(rng, at, tip, np.eye(3)))
        head, *rows = path.read_text().splitlines()
        cells = zip(rows, robots, kinds, strict=True)
        path.write_text("\n".join([f"{head},robot,kind", *map(",".join, cells)]) + "\n")
        return path

    of_b = table("b.csv", np.tile(point, (8, 1)), "b" * 8, ["point"] * 8)
    out = copied(folder, tmp_path)
    # The table names one robot of the cell: nobody is asked.
    done("tcp", of_b, "-c", out, "--name", "pen")
    assert "flange_b_from_pen" in Calibration.load(out).frames
    # Without a calibration, --robot says which rows, and which of the cell's tools, are meant.
    of_both = table("both.csv", np.tile(point, (16, 1)), "a" * 8 + "b" * 8, ["point"] * 16)
    done("tcp", of_both, "--robot", "b", "-o", tmp_path / "pen.json")
    jig = table("jig.csv", places, "bbb", ["origin", "x", "xy"])
    named = ("--tool", f"{out}:pen", "--name", "jig", "-o", tmp_path / "jig.json")
    done("fixture", jig, *named, "--robot", "b")
    bare = write_poses(tmp_path / "bare.csv", turned_poses(rng, places, tip, np.eye(3)))
    visioncal("tcp", bare, "--robot", "b").refused("--robot")


@pytest.mark.slow
def test_stops_are_added_to_one_pair(folder, tmp_path):
    chosen = ("--camera", "left", "--target", "plate_b", "--candidates", 60)
    out = tmp_path / "plan"
    done("plan", folder / "later", "--add", 2, *chosen, "-o", out)
    assert len(json.loads((out / "plan.json").read_text())["stops"]) == 2
    # The calibration itself says which board it was made with.
    file = folder / "out" / "calibration.json"
    (tmp_path / "calibration.json").write_text(file.read_text())
    chosen = ("--camera", "hand", "--target", "floor", "--candidates", 60)
    done("plan", tmp_path, "--stops", 3, *chosen, "-o", out)
    assert json.loads((out / "plan.json").read_text())["cell"]["mount"] == "eye-in-hand"


def test_transforms_of_one_robot_are_exported(folder):
    whole = Calibration.load(folder / "out")
    text = done("export", folder / "out", "--to", "text", "--camera", "left", "--robot", "b")
    rows = [line for line in text.splitlines() if line and not line.startswith("#")]
    written = np.array([row.split() for row in rows], dtype=float)
    np.testing.assert_allclose(written, whole.between("base_b", "cam_left").matrix)
    named = ("--edge", "flange_from_target", "--robot", "b", "--camera", "left")
    done("export", folder / "out", "--to", "text", *named, "--target", "plate_b")
    refused = visioncal("export", folder / "out", "--to", "robot-dh")
    assert "several robots (a, b)" in refused.err
    refused = visioncal("export", folder / "out", "--to", "robot-dh", "--robot", "b")
    assert "needs a calibrated arm" in refused.err


def test_targets_are_corrected_for_the_robot_that_is_named(folder, tmp_path):
    whole = Calibration.load(folder / "out")
    arm = whole.cell.robots["b"]
    bent = arm.model.corrected(1e-3 * np.ones((7, 6)))
    robots = {**whole.cell.robots, "b": RobotResult(arm.model, arm=arm_of(bent))}
    replace(whole, cell=replace(whole.cell, robots=robots)).save(tmp_path / "calibration.json")
    q = np.array([[0.2, -1.2, 1.4, -1.6, -1.5, 0.3], [0.5, -1.0, 1.2, -1.4, -1.3, 0.1]])
    wanted = bent.base_from_flange(q)
    found = correct(Calibration.load(tmp_path), wanted, q[0], robot="b")
    np.testing.assert_allclose(found.q, q, atol=1e-6)
    table = write_poses(tmp_path / "targets.csv", wanted)
    assert len(document_of("correct", table, "--against", tmp_path, "--robot", "b")["targets"]) == 2
    visioncal("correct", table, "--against", tmp_path, "--robot", "a").refused("no calibrated arm")


def of(camera, robot="", target=""):
    """The options that name a pair."""
    chosen = (("--camera", camera), ("--robot", robot), ("--target", target))
    return [word for option in chosen if option[1] for word in option]


def document_of(*arguments):
    return json.loads(done(*arguments, "--json"))


def later_with(folder, name, shift_m):
    """The later stops of the same cell, a frame of which was pushed before."""
    cell = simulate(replace(OPTIONS, moved=(Moved(name, LATER, shift_m=shift_m),)))
    part(recorded(cell), LATER, OPTIONS.stops).save(folder / name)
    return folder / name


def test_every_pair_holds_and_what_was_pushed_is_named_by_its_own_pair_alone(folder):
    against = ("--against", folder / "out")
    # The hand sees no other target by way of a robot.
    for pair in (of("left", "b"), of("hand")):
        assert document_of("verify", folder / "later", *against, *pair)["passed"]
    bumped = later_with(folder, "cam_left", 0.002)
    seen = visioncal("verify", bumped, *against, *of("left", "a"))
    assert seen.status == 3
    assert "The camera moved by" in seen.out
    # A guard needs a pair's name, too.
    assert "--camera" in visioncal("guard", *against).refused().err
    done("verify", bumped, *against, *of("hand", target="floor"))
    # A check of one pair names it in the command that it advises.
    pushed = later_with(folder, "target_floor", 0.01)
    seen = visioncal("verify", pushed, *against, *of("hand", target="floor"))
    assert seen.status == 3
    (advised,) = (line for line in seen.out.splitlines() if "--board-moved" in line)
    assert visioncal(*shlex.split(advised)[1:]).status == 0


def test_boards_and_pixels_are_located_in_the_base_of_any_robot(cell, folder):
    for camera, robot in (("left", "b"), ("hand", "a")):
        pair = of(camera, robot, "floor")
        found = document_of("locate", folder / "later", "-c", folder / "out", *pair)
        at = truth(cell, f"base_{robot}", "target_floor")[:3, 3]
        assert len(found) >= 3
        for value in found:
            error = np.array(value["p_base_m"]) - at
            assert error @ np.linalg.solve(value["covariance"], error) < MOST_OF_THREE
    whole, plane = Calibration.load(folder / "out"), Plane.horizontal(0.02)
    px, words = np.array([[1200.0, 1000.0]]), ("-c", folder / "out", "--pixel", "1200,1000")
    for robot in ("a", "b"):
        (seen,) = document_of("locate", *words, "--plane", "z=20", *of("left", robot))
        (found,) = locate(whole, px, plane, camera="left", robot=robot)
        np.testing.assert_allclose(seen["p_base_m"], found.p_base)
    # In the plane of a board that stands still, it is on that board.
    (seen,) = document_of("locate", *words, "--plane", "floor", *of("left", "b"))
    floor = whole.between("base_b", "target_floor").matrix
    assert abs((np.array(seen["p_base_m"]) - floor[:3, 3]) @ floor[:3, 2]) < 1e-9
    visioncal("locate", *words, "--plane", "z=20", *of("left")).refused("several robots (a, b)")


def test_a_target_is_placed_on_any_flange_and_in_any_base(cell, folder, tmp_path):
    for command, pair, ends in (
        ("tcp", of("left", "b", "plate_b"), ("flange_b", "target_plate_b")),
        ("fixture", of("hand", "a", "floor"), ("base_a", "target_floor")),
    ):
        into = ("--name", "thing", "-o", tmp_path / f"{command}.json")
        done(command, folder / "later", "-c", folder / "out", *pair, *into)
        content = json.loads((tmp_path / f"{command}.json").read_text())["frames"]
        found = content[f"{ends[0]}_from_thing"]
        edge = Edge(np.array(found["matrix"]), np.array(found["covariance"]))
        assert misfit(edge, truth(cell, *ends)) < MOST
    # A fixture of one robot is known in the base of the other.
    out = copied(folder, tmp_path)
    done("fixture", folder / "later", "-c", out, *of("hand", "a", "floor"), "--name", "jig")
    edge, nearer = (
        Calibration.load(out).of("left", robot).frames["base_from_jig"].edge for robot in "ba"
    )
    assert misfit(edge, truth(cell, "base_b", "target_floor")) < MOST
    assert edge.sigma_mm > nearer.sigma_mm
    assert "base_a_from_jig" in (out / "report.html").read_text()
    # A row without the robot's pose is left out.
    session = Session.load(folder / "later").of("left", "b", "plate_b")
    first, *others = session.views
    shown = replace(session, views=(replace(first, numbers={}), *others))
    frame = seen_frame(shown, Calibration.load(out), "tool", camera="left", robot="b")
    (left,) = [observation for observation in frame.observations if not observation.used]
    assert "no pose of the robot" in left.reason


def copied(folder, into):
    """The result of the cell by itself, in a folder."""
    (into / "out").mkdir()
    shutil.copy(folder / "out" / "calibration.json", into / "out")
    return into / "out"


def test_two_whole_cells_are_compared_by_all_frames_or_by_a_pair(folder, tmp_path):
    whole, name = Calibration.load(folder / "out"), "cell_from_cam_left"
    edge, twist = whole.edges[name], np.eye(4)
    twist[0, 3] = 2e-3
    moved = replace(whole, edges=whole.edges | {name: replace(edge, matrix=edge.matrix @ twist)})
    moved.save(tmp_path / "calibration.json")
    found = document_of("diff", folder / "out", tmp_path)
    changed = [edge for edge, value in found["transforms"].items() if value["is_change"]]
    assert changed == [name]
    assert "cam_left moved" in found["findings"][1]
    assert found["mounts"] == ["whole cell"] * 2
    pair = document_of("diff", folder / "out", tmp_path, *of("left", "b"))
    assert pair["transforms"]["base_from_cam"]["is_change"]
    assert not compare(whole, moved, camera="hand").is_change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda document: document["transforms"].pop("cell_from_base_b"), "is missing"),
        (lambda document: document["tree"].update(base_b="nowhere"), "lead to the cell"),
        (lambda document: document["tree"].update(base_b="base_b"), "lead to the cell"),
        (lambda document: document["tree"].pop("base_b"), "lead to the cell"),
    ],
)
def test_a_tree_that_does_not_hold_together_is_refused(change, words, found):
    document = json.loads(json.dumps(to_document(found)))
    change(document)
    with pytest.raises(DataError, match=words):
        Calibration.from_json(json.dumps(document), "calibration.json")
