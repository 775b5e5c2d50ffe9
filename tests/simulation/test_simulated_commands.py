"""What `simulate` writes is what each command reads; its truth is what they find."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.commands import visioncal
from support.depth_cells import SMALL
from support.marks import slow
from support.misfits import misfit
from support.refusals import raised

from visioncal import simulation
from visioncal.calibration.run import calibrate
from visioncal.core.choices import SIMULATED_CELLS
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import invert, log
from visioncal.results import Calibration
from visioncal.robot import load_robot
from visioncal.session import Session
from visioncal.session.depth import read_depth
from visioncal.simulation import CAMERAS, cell_session, read_cell, simulate

# Chi-square of six exceeds this in one case of a thousand.
MOST = 22.5


def done(*arguments):
    """What a command printed to stdout, once it ended well."""
    result = visioncal(*arguments).good()
    return result.out


def truth_of(folder):
    content = json.loads(folder.with_name(f"{folder.name}.truth.json").read_text())
    edges = {name: np.array(value) for name, value in content.get("transforms", {}).items()}
    return content, edges


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("simulated")


@pytest.fixture(scope="module")
def seen(place):
    """A cell with images and touches, calibrated, and four stops of another recording of it."""
    folder, out, fresh = place / "cell", place / "out", place / "fresh"
    with pytest.MonkeyPatch.context() as patch:
        # To draw and search all pixels takes half of the fixture's time.
        patch.setitem(CAMERAS, "wide", SMALL)
        done("simulate", folder, "--views", 8, "--touches")
        done("simulate", fresh, "--views", 4, "--recording", 1)
    done("calibrate", folder, "-o", out)
    return folder, out, fresh


def test_tools_and_fixtures_are_found_by_simulated_touches(seen):
    folder, out, _ = seen
    done("tcp", folder / "touches.csv", "-c", out, "--name", "gripper")
    done("fixture", folder / "points.csv", "--cad", folder / "cad.csv", "-c", out, "--name", "jig")
    done("fixture", folder / "features.csv", "-c", out, "--name", "plate")
    found, (_, edges) = Calibration.load(out).frames, truth_of(folder)
    assert misfit(found["flange_from_gripper"].edge, edges["flange_from_tool"]) < MOST
    assert misfit(found["base_from_jig"].edge, edges["base_from_fixture"]) < MOST
    assert misfit(found["base_from_plate"].edge, edges["base_from_fixture"]) < MOST


def test_another_recording_of_the_cell_is_verified_and_its_board_located(seen):
    folder, out, fresh = seen
    assert json.loads(done("verify", fresh, "--against", out, "--json"))["passed"]
    (_, edges), (_, again) = truth_of(folder), truth_of(fresh)
    assert all(np.array_equal(edges[name], again[name]) for name in again)
    places = json.loads(done("locate", fresh, "-c", out, "--json"))
    assert len(places) == 4
    for value in places:
        error = np.array(value["p_base_m"]) - edges["base_from_target"][:3, 3]
        # Chi-square of three exceeds this in one case of ten thousand.
        assert error @ np.linalg.solve(np.array(value["covariance"]), error) < 21.1


@pytest.mark.slow
def test_a_second_board_is_placed_along(place):
    done("simulate", place / "two", "--second-board", "--no-images", "--views", 12)
    done("calibrate", place / "two", "-o", place / "two-out")
    found, (_, edges) = Calibration.load(place / "two-out"), truth_of(place / "two")
    assert set(found.edges) == set(edges)
    assert len(edges) == 3
    for name, truth in edges.items():
        assert misfit(found.edges[name], truth) < MOST, name
    again = ("--second-board", "--no-images", "--views", 6, "--recording", 1)
    done("simulate", place / "two-later", *again)
    # Both boards are looked at, with no word on which is meant.
    done("verify", place / "two-later", "--against", place / "two-out")
    assert "without images" in visioncal("plan", place / "two", "--add", 2).err


# Cells of two arms are the subject of tests/calibration/test_cells.py.
@pytest.mark.parametrize(
    "name", [name if name == "two-cameras" else slow(name) for name in SIMULATED_CELLS]
)
def test_cells_that_come_with_visioncal_are_calibrated(name, place):
    folder, out = place / name, place / f"{name}-out"
    done("simulate", folder, "--cell", name, "--no-images", "--views", 20)
    assert len({view.stop for view in Session.load(folder).views}) == 20
    done("calibrate", folder, "-o", out)
    found, (content, edges) = Calibration.load(out), truth_of(folder)
    bodies = [
        edge for edge in edges if edge.startswith(("cam_", "target_", "instrument_", "point_"))
    ]
    assert set(bodies) <= {edge.partition("_from_")[2] for edge in found.edges}
    for edge, item in found.edges.items():
        parent, _, child = edge.partition("_from_")
        truth = edges[child]
        if parent == "cell":
            assert content["parents"][child] == "cell"
            truth = invert(edges[found.cell.reference]) @ truth
        among = slice(None) if item.oriented else slice(3, 6)
        assert misfit(item, truth, among) < MOST, edge


def test_another_recording_of_a_whole_cell_is_that_of_a_cell_whose_camera_was_knocked(place):
    first, again = place / "whole-1", place / "whole-2"
    shipped = Path(simulation.__file__).parent / "cells" / "two-arms.toml"
    bent = re.sub(r"(?m)^(\[robots\..*)$", r"\1\ndh_sigma_m = 3e-4", shipped.read_text("utf-8"))
    (place / "bent.toml").write_text(bent)
    some = ("--cell", place / "bent.toml", "--no-images", "--views", 5)
    done("simulate", first, *some)
    done("simulate", again, *some, "--recording", 1, "--camera-moved-mm", 2)
    (before, edges), (after, other) = truth_of(first), truth_of(again)
    assert all(np.array_equal(edges[name], other[name]) for name in edges)
    assert before["arms"] == after["arms"]
    assert before["arms"]["a"]["a"] != before["arms"]["b"]["a"]
    assert before["base_from_flange"] != after["base_from_flange"]
    assert after["moved"] == [{"frame": "cam_left", "from_stop": 0}]


@pytest.mark.slow
@pytest.mark.parametrize("read", ["points", "probe"])
def test_a_tracker_beside_a_cell_ties_its_robots(read, place):
    folder, out = place / f"cell-{read}", place / f"cell-{read}-out"
    done(
        "simulate", folder, "--cell", "two-arms", "--no-images", "--views", 8, "--instrument", read
    )
    done("calibrate", folder, "-o", out)
    found, (_, edges) = Calibration.load(out), truth_of(folder)
    truth = invert(edges["base_a"]) @ edges["instrument_tracker"]
    assert misfit(found.between("base_a", "instrument_tracker"), truth) < MOST
    for robot in ("a", "b"):
        edge = found.edges[f"flange_{robot}_from_point_{robot}1"]
        among = slice(None) if read == "probe" else slice(3, 6)
        assert misfit(edge, edges[f"point_{robot}1"], among) < MOST


def test_a_users_file_describes_a_cell(place):
    (place / "own.toml").write_text(OWN + PUSHED)
    cell = simulate(read_cell(str(place / "own.toml")))
    assert [robot.robot for robot in cell.options.robots] == ["ur10e"]
    assert cell.options.cameras[0].camera.resolution == (2448, 2048)
    assert cell.options.boards[0].scale == 1.002
    assert {reading.point for reading in cell.readings} == {"ball"}
    assert cell.options.moved[0].from_stop == 4
    assert cell_session(cell, "own", seen="poses").cameras.keys() == {"top"}
    done("simulate", place / "own", "--cell", place / "own.toml", "--no-images", "--seed", 3)
    content, _ = truth_of(place / "own")
    assert (content["options"]["seed"], content["options"]["stops"]) == (3, 6)
    assert content["moved"] == [{"frame": "target_plate", "from_stop": 4}]


OWN = """
stops = 6
[robots.a]
robot = "ur10e"
place_m = [-0.7, 0.0, 0.0]
[cameras.top]
camera = "fine"
[targets.plate]
on = "a"
scale = 1.002
[instruments.tracker]
place_m = [2.0, 0.0, 0.3]
[points.ball]
on = "a"
place_m = [0.0, 0.1, 0.1]
"""
SWEPT = """
[[sweeps]]
camera = "top"
robot = "a"
target = "plate"
camera_minus_robot_s = 0.04
stops = 5
"""
PUSHED = """
[[moved]]
frame = "target_plate"
from_stop = 4
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[robots.a]", "[robot.a]", "own.toml: robot is not known.*Did you mean robots"),
        ("stops = 6", "stop = 6", "own.toml: stop is not known.*Did you mean stops?"),
        ('on = "a"\nscale', 'on = "b"\nscale', "plate is on 'b'; there are a, cell"),
        ("[robots.a]", '[robots."a b"]', "robots.a b.name is 'a b', but must be a name of letters"),
        ("[robots.a]", "[robots]\na = 5\n[robots.b]", r"must be tables \[robots.NAME\]"),
        ("[instruments.tracker]", "[cameras.b]", "own.toml: there are points and no instrument"),
        ("place_m = [2.0, 0.0, 0.3]", "", "own.toml: instruments.tracker.place_m is missing"),
        ("[2.0, 0.0, 0.3]", "[nan, 0.0, 0.3]", r"place_m\[0\] is nan, but must be a finite"),
        ("[cameras.top]", '[cameras.top]\nname = "x"', "cameras.top.name is not known"),
        (
            "place_m = [-0.7, 0.0, 0.0]",
            "place_m = [-0.7, 0.0, 0.0]\nbacklash_rad = [nan]",
            r"backlash_rad\[0\] is nan, but must be a finite",
        ),
        ("from_stop = 4", "from_stop = 6", "target_plate is pushed before stop 6; of 6 stops"),
        ('robot = "a"', 'robot = "b"', "a sweep is of robot 'b'; there are a"),
        ('camera = "top"', 'camera = "left"', "a sweep is of camera 'left'; there are top"),
    ],
)
def test_a_description_with_a_mistake_is_refused_by_its_field(old, new, words, tmp_path):
    assert old in OWN + PUSHED + SWEPT
    (tmp_path / "own.toml").write_text((OWN + PUSHED + SWEPT).replace(old, new))
    raised(DataError, words, lambda: simulate(read_cell(str(tmp_path / "own.toml"))))


def test_a_sweep_of_a_cell_with_a_rolling_shutter_has_corners(place):
    rolling = OWN.replace("stops = 6", "stops = 12") + SWEPT + "readout_s = 0.012\n"
    (place / "rolling.toml").write_text(rolling)
    some = ("simulate", place / "rolling", "--cell", place / "rolling.toml")
    visioncal(*some).refused("--no-images")
    done(*some, "--no-images")
    session = Session.load(place / "rolling")
    assert all(view.has_corners or view.reading_m is not None for view in session.views)
    assert sum(view.stamp_s is not None for view in session.views) > 10


def test_depth_is_off_by_what_was_asked_for(place):
    folder = place / "depth"
    options = ("--depth-scale", 1.02, "--depth-offset-mm", 3, "--depth-bowl-mm", 0)
    done("simulate", folder, "--views", 1, "--mount", "eye-to-hand", *options)
    content, _ = truth_of(folder)
    session = Session.load(folder)
    camera = session.declaration.camera
    size, unit_m = session.resolution, camera.depth_unit_m
    path = session.views[0].depth
    depth = read_depth(session.images.read(path), path, size, unit_m)
    # Where the board's middle is imaged; beside it the wall is at 2.6 m.
    pose = np.array(content["cam_from_target"][0])
    middle = pose @ [0.135, 0.09, 0.0, 1.0]
    px = simulation.project(simulation.CAMERAS["wide"], middle[None, :3])[0]
    u, v = np.rint(px).astype(int)
    seen = np.nanmedian(depth[v - 2 : v + 3, u - 2 : u + 3])
    # Noise under 2 mm, ink 2 mm, and the slope between pixels.
    assert abs(seen - (1.02 * middle[2] + 0.003)) < 0.004
    assert abs(np.nanmedian(depth) - (1.02 * 2.6 + 0.003)) < 0.004
    assert 0.01 < np.isnan(depth).mean() < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand", "instrument"])
def test_an_arm_of_four_axes_is_simulated_with_a_measured_height(mount, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    how = ("--instrument", "points") if mount == "instrument" else ("--no-images", "--mount", mount)
    done("simulate", "cell", "--robot", "generic-scara-600", *how, "--seed", 2)
    session, (_, edges) = Session.load("cell"), truth_of(Path("cell"))
    # The independent chain is that of the built-in model.
    robot = load_robot("generic-scara-600")
    for view in session.views:
        stated = view.base_from_flange()
        if stated is not None:
            found = robot.base_from_flange(view.joints_rad[None])[0]
            np.testing.assert_allclose(found, stated.as_matrix(), atol=1e-12)
    result = calibrate(session)
    assert result.verdict.status == "good"
    assert any("the views alone leave it open" in f.words for f in result.verdict.findings)
    for name, edge in result.edges.items():
        # Of the points on the flange no rotation is read.
        free = slice(3 * (mount == "instrument" and name == "flange_from_probe"), 6)
        off = log(invert(edges[name]) @ edge.matrix)[free]
        assert off @ np.linalg.solve(edge.covariance[free, free], off) < MOST
    bare = replace(session, document={k: v for k, v in session.document.items() if k != "prior"})
    refusal = raised(DegenerateError, "is not determined at all", calibrate, bare)
    step = "This arm cannot tilt: measure that offset for [prior."
    assert refusal.next_step.startswith(step)


def test_an_arm_of_four_axes_takes_no_option_of_those_with_six(tmp_path):
    said = ("--robot", "generic-scara-600", "--touches", "--no-images")
    refused = visioncal("simulate", tmp_path / "cell", *said)
    refused.refused("--touches: simulated for arms of six joints", "take another --robot")
