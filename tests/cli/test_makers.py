"""The maker of a robot is kept: what goes in as its pendant shows it comes out so, everywhere."""

import json
import re
import shlex
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from support import readers
from support.aligned_cells import made_up_cell
from support.commands import visioncal, write_table
from support.makers import MAKERS, NUMBER, pose_of, written
from support.refusals import raised

from visioncal.core.choices import POSE_FORMS
from visioncal.core.conventions import controller_form
from visioncal.core.errors import DataError
from visioncal.present.recording.notes import verdict_markdown
from visioncal.results import Calibration, RobotResult, to_document
from visioncal.robot import load_robot
from visioncal.session import Session
from visioncal.session.columns import MEASURED_CAM_POSE


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A simulated session of pose pairs."""
    folder = tmp_path_factory.mktemp("cell") / "cell"
    visioncal("simulate", folder, "--views", 14, "--no-images").good()
    return Session.load(folder)


def poses_of(session):
    return [view.base_from_flange().as_matrix() for view in session.views]


def table_of(session, maker, path):
    """The session as a table of its maker, with the measured poses of the target."""
    names = MAKERS[maker][0].split(",")
    rows = [[*map(repr, written(maker, pose))] for pose in poses_of(session)]
    seen = {
        name: [view.cell(name) for view in session.views] for name in ("view", *MEASURED_CAM_POSE)
    }
    return write_table(path, names, rows, seen)


def converted(cell, maker, folder, *more):
    """Such a table as a session."""
    source = table_of(cell, maker, folder / f"{maker}.csv")
    words = ("--robot-form", maker, "--mount", "eye-in-hand", *more)
    visioncal("convert", source, folder / "session", *words).good()
    return folder / "session"


def calibrated(session, out):
    return visioncal("calibrate", session, "-o", out, "--no-report", "--no-recording").good()


def in_words(maker, name, text):
    """A transform that the console prints: its place [mm], and its rotation in a maker's form."""
    place = re.search(rf"{name}: \(([^)]*)\) mm", text)[1]
    turn = re.search(rf"{name}: .*\n.*{maker.upper()} [^(]*\(([^)]*)\)", text)[1]
    return pose_of(maker, [*place.split(","), *turn.split(",")], 1e-3)


@pytest.mark.parametrize("maker", MAKERS)
def test_the_maker_is_kept_from_the_table_to_the_export(cell, maker, tmp_path):
    session, out = converted(cell, maker, tmp_path), tmp_path / "out"
    assert tomllib.loads((session / "session.toml").read_text())["robot"] == {"form": maker}
    read = poses_of(Session.load(session))
    # To the rounding of SciPy.
    assert np.abs(np.array(read) - poses_of(cell)).max() < 1e-9
    said = calibrated(session, out).out
    assert json.loads((out / "calibration.json").read_text())["robot"] == {"form": maker}
    found = Calibration.load(out)
    assert found.robot is None
    assert found.controller().name == maker
    for name, edge in found.edges.items():
        # Half of the last digits that are printed: 5 um, and 5e-5 deg or 5e-7.
        assert np.abs(in_words(maker, name, said)[:3, 3] - edge.matrix[:3, 3]).max() < 5.1e-6
        assert np.abs(in_words(maker, name, said)[:3, :3] - edge.matrix[:3, :3]).max() < 3e-6
    command = next(line for line in said.splitlines() if "visioncal export" in line)
    exported = visioncal(*shlex.split(command)[1:]).good().out
    camera = found.edges["flange_from_cam"].matrix
    assert np.abs(readers.READERS[maker](exported) - camera).max() < 1e-9


def test_a_recording_keeps_it_and_digests_do_not_depend_on_it(cell, tmp_path):
    session, recording = converted(cell, "fanuc", tmp_path), tmp_path / "session.rrd"
    visioncal("convert", session, recording).good()
    visioncal("convert", recording, tmp_path / "back").good()
    for path in (recording, tmp_path / "back"):
        assert Session.load(path).robots[""].form == "fanuc"
        assert Session.load(path).digest() == Session.load(session).digest()
    calibrated(recording, tmp_path / "out")
    assert Calibration.load(tmp_path / "out").controller().name == "fanuc"
    # What was recorded is the same, whoever made the robot.
    plain = Session.load(session)
    of_nobody = {name: value for name, value in plain.document.items() if name != "robot"}
    assert plain.with_content(document=of_nobody).digest() == plain.digest()
    named = {"robot": {"model": "ur10e"}}
    digests = {
        plain.with_content(document={**of_nobody, **named}).digest(),
        plain.with_content(
            document={**of_nobody, "robot": {"model": "ur10e", "form": "ur"}}
        ).digest(),
    }
    assert len(digests) == 1
    assert plain.digest() not in digests


@pytest.mark.parametrize("maker", ["kuka", "doosan", "ur", "yaskawa", "staubli"])
def test_lines_of_a_pendant_are_read_by_the_names_or_as_stated(cell, maker, tmp_path):
    # Doosan's names are KUKA's, and three makers have Rx, Ry, Rz.
    names, lines = MAKERS[maker][0].split(","), []
    (tmp_path / "images").mkdir()
    for view, pose in zip(cell.views, poses_of(cell), strict=True):
        units = [*["m" if maker == "ur" else "mm"] * 3, *["rad" if maker == "ur" else "deg"] * 3]
        cells = zip(names, written(maker, pose), units, strict=True)
        line = " ".join(f"{name} {value:.9f} {unit}" for name, value, unit in cells)
        lines.append(f"{line} {view.number:03d}.png")
        (tmp_path / "images" / f"{view.number:03d}.png").write_bytes(b"")
    source = tmp_path / "poses.txt"
    source.write_text("\n".join(lines))
    words = ("--target", "charuco_9x6_30mm", "--mount", "eye-in-hand", "--resolution", "1280,800")
    stated = () if maker == "kuka" else ("--robot-form", maker)
    visioncal("convert", source, tmp_path / "session", *words, *stated).good()
    session = Session.load(tmp_path / "session")
    assert session.robots[""].form == maker
    # Nine decimals of a metre, or of a degree at a metre.
    assert np.abs(np.array(poses_of(session)) - poses_of(cell)).max() < 1e-8
    other = visioncal("convert", source, tmp_path / "no", *words, "--robot-form", "fanuc")
    other.refused("not of 'fanuc'")


def test_a_form_of_a_library_is_no_maker_s(cell, tmp_path):
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    rows = [[view.cell(name) for name in ("x_m", "y_m", "z_m", *names[3:])] for view in cell.views]
    seen = {name: [view.cell(name) for view in cell.views] for name in MEASURED_CAM_POSE}
    source = write_table(tmp_path / "t.csv", names, rows, seen)
    words = ("--robot-form", "ros", "--mount", "eye-in-hand")
    visioncal("convert", source, tmp_path / "session", *words).good()
    assert "robot" not in Session.load(tmp_path / "session").document


def test_another_reading_of_the_rotations_takes_the_maker_away(cell, tmp_path):
    # W, P, R that are said to be KUKA's.
    source = table_of(cell, "fanuc", tmp_path / "t.csv")
    words = ("--robot-form", "kuka", "--mount", "eye-in-hand", "--guess", "--yes")
    columns = ("--robot-columns", "X,Y,Z,W,P,R")
    done = visioncal("convert", source, tmp_path / "session", *words, *columns).good()
    session = Session.load(tmp_path / "session")
    assert np.abs(np.array(poses_of(session)) - poses_of(cell)).max() < 1e-9, done.said
    assert session.robots[""].form is None


@pytest.mark.parametrize(
    ("form", "words"),
    [
        ('"kuak"', ("robot.form is 'kuak'", ", ".join(POSE_FORMS), "Did you mean kuka?")),
        ('"zzzzz"', ("robot.form is 'zzzzz'", ", ".join(POSE_FORMS))),
        ("3", ("robot.form is 3",)),
    ],
)
def test_a_form_that_is_not_known_is_refused(cell, tmp_path, form, words):
    cell.save(tmp_path / "cell")
    toml = tmp_path / "cell" / "session.toml"
    toml.write_text(toml.read_text().replace("[robot]", f"[robot]\nform = {form}"))
    visioncal("calibrate", tmp_path / "cell", "-o", tmp_path / "out").refused(*words)


def test_what_is_stated_goes_before_the_name_of_the_model():
    assert controller_form("kuka_kr6").name == "kuka"
    assert controller_form("ur10e", "kuka").name == "kuka"
    assert controller_form("somebody") is None
    raised(DataError, "Did you mean fanuc", controller_form, "ur10e", "fanucc")
    ur = RobotResult(load_robot("ur10e"))
    assert (ur.controller.name, replace(ur, form="abb").controller.name) == ("ur", "abb")


def test_each_robot_of_a_cell_has_its_own_form(tmp_path):
    cell = made_up_cell(1)
    robots = {"a": RobotResult(form="kuka"), "b": RobotResult(load_robot("lrmate200id"))}
    result = replace(cell, cell=replace(cell.cell, robots=robots))
    result.save(tmp_path / "calibration.json")
    result = Calibration.load(tmp_path)
    assert to_document(result)["robots"]["a"] == {"form": "kuka"}
    whose = {"cell_from_base_b": "kuka", "cell_from_cam_top": "kuka"}
    whose |= {"flange_a_from_cam_hand": "kuka", "flange_b_from_target_plate": "fanuc"}
    notes = verdict_markdown(result).replace("\\", "")
    for name, edge in result.edges.items():
        maker = whose[name]
        words = result.rotation_words(name, edge)
        assert f"{maker.upper()} {MAKERS[maker][0][6:].replace(',', ', ')}" in words
        assert words in notes
        numbers = re.findall(NUMBER, words.partition(maker.upper())[2])[-3:]
        turn = pose_of(maker, [0, 0, 0, *numbers])
        # Half of a tenth of a millidegree about each axis.
        assert np.abs(turn[:3, :3] - edge.matrix[:3, :3]).max() < 3e-6
    assert result.controller("cam_top", "target_plate") is None
    assert result.of(camera="top", robot="b", target="plate").controller().name == "fanuc"
