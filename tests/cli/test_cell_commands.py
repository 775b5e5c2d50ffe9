"""Commands on a whole cell: any of its cameras, robots and targets, against the truth."""

import json
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.arm_documents import arm_of
from support.commands import turned_poses, visioncal, write_poses
from support.misfits import misfit
from support.whole_cells import LATER, OPTIONS, part, recorded, saved, simulated, truth

from visioncal.frames.camera_chain import Plane
from visioncal.frames.frame_from_images import seen_frame
from visioncal.frames.locate import locate
from visioncal.results import Calibration, Edge, RobotResult
from visioncal.results.compare import compare
from visioncal.results.compensation import correct
from visioncal.session import Session
from visioncal.simulation import Moved, simulate

# Chi-square of six and of three exceed these in one case of a thousand.
MOST, MOST_OF_THREE = 22.5, 16.3


def done(*arguments):
    result = visioncal(*arguments).good()
    return result.out


@pytest.fixture(scope="module")
def cell():
    return simulated()


@pytest.fixture(scope="module")
def place(cell, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cell")
    session, _ = saved(folder, cell)
    done("calibrate", session, "-o", folder / "out")
    return folder


def test_a_tool_is_found_by_touches_of_either_robot_and_joins_the_cell(place, tmp_path):
    rng = np.random.default_rng(3)
    tip, point = np.array([0.01, -0.02, 0.15]), np.array([0.4, 0.1, 0.05])
    poses = turned_poses(rng, np.tile(point, (12, 1)), tip, np.eye(3))
    poses[:, :3, 3] += rng.normal(0.0, 5e-5, (12, 3))
    touches = write_poses(tmp_path / "touches.csv", poses)
    unnamed = visioncal("tcp", touches, "-c", place / "out", "--name", "pin")
    assert "several robots (a, b)" in unnamed.err
    done("tcp", touches, "-c", place / "out", "--robot", "b", "--name", "pin")
    whole = Calibration.load(place / "out")
    edge = whole.frames["flange_b_from_pin"].edge
    error = edge.matrix[:3, 3] - tip
    assert error @ np.linalg.solve(edge.covariance[3:, 3:], error) < MOST_OF_THREE
    assert "flange_from_pin" in whole.of("left", "b").frames
    assert "flange_from_pin" not in whole.of("left", "a").frames


def test_touches_or_a_tool_of_a_cell_say_which_robot_is_meant(place, tmp_path):
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
    out = copied(place, tmp_path)
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


def test_stops_are_added_to_one_pair(place, tmp_path):
    chosen = ("--camera", "left", "--target", "plate_b", "--candidates", 60)
    out = tmp_path / "plan"
    done("plan", place / "later", "--add", 2, *chosen, "-o", out)
    assert len(json.loads((out / "plan.json").read_text())["stops"]) == 2
    # The calibration itself says which board it was made with.
    alone = place / "out" / "calibration.json"
    (tmp_path / "calibration.json").write_text(alone.read_text())
    chosen = ("--camera", "hand", "--target", "floor", "--candidates", 60)
    done("plan", tmp_path, "--stops", 3, *chosen, "-o", out)
    assert json.loads((out / "plan.json").read_text())["cell"]["mount"] == "eye-in-hand"


def test_transforms_of_one_robot_are_exported(place):
    whole = Calibration.load(place / "out")
    text = done("export", place / "out", "--to", "text", "--camera", "left", "--robot", "b")
    rows = [line for line in text.splitlines() if line and not line.startswith("#")]
    written = np.array([row.split() for row in rows], dtype=float)
    np.testing.assert_allclose(written, whole.between("base_b", "cam_left").matrix)
    named = ("--edge", "flange_from_target", "--robot", "b", "--camera", "left")
    done("export", place / "out", "--to", "text", *named, "--target", "plate_b")
    refused = visioncal("export", place / "out", "--to", "robot-dh")
    assert "several robots (a, b)" in refused.err
    refused = visioncal("export", place / "out", "--to", "robot-dh", "--robot", "b")
    assert "writes the calibrated arm, and there is none" in refused.err


def test_targets_are_corrected_for_the_robot_that_is_named(place, tmp_path):
    whole = Calibration.load(place / "out")
    arm = whole.cell.robots["b"]
    bent = arm.model.corrected(1e-3 * np.ones((7, 6)))
    robots = {**whole.cell.robots, "b": RobotResult(arm.model, arm=arm_of(bent))}
    replace(whole, cell=replace(whole.cell, robots=robots)).save(tmp_path / "calibration.json")
    q = np.array([[0.2, -1.2, 1.4, -1.6, -1.5, 0.3], [0.5, -1.0, 1.2, -1.4, -1.3, 0.1]])
    wanted = bent.base_from_flange(q)
    found = correct(Calibration.load(tmp_path), wanted, q[0], robot="b")
    np.testing.assert_allclose(found.q, q, atol=1e-6)
    table = write_poses(tmp_path / "targets.csv", wanted)
    assert len(told("correct", table, "--against", tmp_path, "--robot", "b")["targets"]) == 2
    visioncal("correct", table, "--against", tmp_path, "--robot", "a").refused("no calibrated arm")


def of(camera, robot="", target=""):
    """The options that name a pair."""
    chosen = (("--camera", camera), ("--robot", robot), ("--target", target))
    return [word for option in chosen if option[1] for word in option]


def told(*arguments):
    return json.loads(done(*arguments, "--json"))


def later_with(place, name, shift_m):
    """The later stops of the same cell, a frame of which was pushed before."""
    cell = simulate(replace(OPTIONS, moved=(Moved(name, LATER, shift_m=shift_m),)))
    part(recorded(cell), LATER, OPTIONS.stops).save(place / name)
    return place / name


def test_every_pair_holds_and_what_was_pushed_is_named_by_its_own_pair_alone(place):
    against = ("--against", place / "out")
    # The hand sees no other target by way of a robot.
    for pair in (of("left", "b"), of("hand")):
        assert told("verify", place / "later", *against, *pair)["passed"]
    bumped = later_with(place, "cam_left", 0.002)
    seen = visioncal("verify", bumped, *against, *of("left", "a"))
    assert seen.status == 3
    assert "The camera moved by" in seen.out
    # A guard needs a pair's name, too.
    assert "--camera" in visioncal("guard", *against).refused().err
    done("verify", bumped, *against, *of("hand", target="floor"))
    # A check of one pair names it in the command that it advises.
    pushed = later_with(place, "target_floor", 0.01)
    seen = visioncal("verify", pushed, *against, *of("hand", target="floor"))
    assert seen.status == 3
    (advised,) = (line for line in seen.out.splitlines() if "--board-moved" in line)
    assert visioncal(*shlex.split(advised)[1:]).status == 0


def test_boards_and_pixels_are_located_in_the_base_of_any_robot(cell, place):
    for camera, robot in (("left", "b"), ("hand", "a")):
        pair = of(camera, robot, "floor")
        found = told("locate", place / "later", "-c", place / "out", *pair)
        at = truth(cell, f"base_{robot}", "target_floor")[:3, 3]
        assert len(found) >= 3
        for value in found:
            error = np.array(value["p_base_m"]) - at
            assert error @ np.linalg.solve(value["covariance"], error) < MOST_OF_THREE
    whole, plane = Calibration.load(place / "out"), Plane.horizontal(0.02)
    px, words = np.array([[1200.0, 1000.0]]), ("-c", place / "out", "--pixel", "1200,1000")
    for robot in ("a", "b"):
        (seen,) = told("locate", *words, "--plane", "z=20", *of("left", robot))
        (found,) = locate(whole, px, plane, camera="left", robot=robot)
        np.testing.assert_allclose(seen["p_base_m"], found.p_base)
    # In the plane of a board that stands still, it is on that board.
    (seen,) = told("locate", *words, "--plane", "floor", *of("left", "b"))
    floor = whole.between("base_b", "target_floor").matrix
    assert abs((np.array(seen["p_base_m"]) - floor[:3, 3]) @ floor[:3, 2]) < 1e-9
    visioncal("locate", *words, "--plane", "z=20", *of("left")).refused("several robots (a, b)")


def test_a_target_is_placed_on_any_flange_and_in_any_base(cell, place, tmp_path):
    for command, pair, ends in (
        ("tcp", of("left", "b", "plate_b"), ("flange_b", "target_plate_b")),
        ("fixture", of("hand", "a", "floor"), ("base_a", "target_floor")),
    ):
        into = ("--name", "thing", "-o", tmp_path / f"{command}.json")
        done(command, place / "later", "-c", place / "out", *pair, *into)
        content = json.loads((tmp_path / f"{command}.json").read_text())["frames"]
        found = content[f"{ends[0]}_from_thing"]
        edge = Edge(np.array(found["matrix"]), np.array(found["covariance"]))
        assert misfit(edge, truth(cell, *ends)) < MOST
    # A fixture of one robot is known in the base of the other.
    out = copied(place, tmp_path)
    done("fixture", place / "later", "-c", out, *of("hand", "a", "floor"), "--name", "jig")
    edge, own = (
        Calibration.load(out).of("left", robot).frames["base_from_jig"].edge for robot in "ba"
    )
    assert misfit(edge, truth(cell, "base_b", "target_floor")) < MOST
    assert edge.sigma_mm > own.sigma_mm
    assert "base_a_from_jig" in (out / "report.html").read_text()
    # A row without the robot's pose is left out.
    session = Session.load(place / "later").of("left", "b", "plate_b")
    first, *others = session.views
    shown = replace(session, views=(replace(first, numbers={}), *others))
    frame = seen_frame(shown, Calibration.load(out), "tool", camera="left", robot="b")
    (left,) = [observation for observation in frame.observations if not observation.used]
    assert "no pose of the robot" in left.reason


def copied(place, folder):
    """The result of the cell by itself, in a folder."""
    (folder / "out").mkdir()
    shutil.copy(place / "out" / "calibration.json", folder / "out")
    return folder / "out"


def test_two_whole_cells_are_compared_by_all_frames_or_by_a_pair(place, tmp_path):
    whole, name = Calibration.load(place / "out"), "cell_from_cam_left"
    edge, twist = whole.edges[name], np.eye(4)
    twist[0, 3] = 2e-3
    moved = replace(whole, edges=whole.edges | {name: replace(edge, matrix=edge.matrix @ twist)})
    moved.save(tmp_path / "calibration.json")
    found = told("diff", place / "out", tmp_path)
    changed = [edge for edge, value in found["transforms"].items() if value["is_change"]]
    assert changed == [name]
    assert "cam_left moved" in found["findings"][1]
    assert found["mounts"] == ["whole cell"] * 2
    pair = told("diff", place / "out", tmp_path, *of("left", "b"))
    assert pair["transforms"]["base_from_cam"]["is_change"]
    assert not compare(whole, moved, camera="hand").is_change
