"""What is wrong with a session before it is calibrated: named, with what to type."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.boards import charuco, circles
from support.commands import visioncal as command
from support.fuzz.broken_sessions import BROKEN, Mistake, broken_session, edit, sound_session
from support.refusals import raised
from support.rendered import Shot, photograph

import visioncal
from visioncal.calibration.pipeline.checkup import to_document
from visioncal.core.errors import DataError
from visioncal.interchange.formats import load_for_rereading
from visioncal.session import Session
from visioncal.simulation import BOARDS

# Where the finding comes from: poses, files, images, motion. All others are kept answers.
NAMED = {
    "quaternion with w first": "misread_poses",
    "one pose typed wrong": "wrong_views",
    "images in another folder": "missing_images",
    "no turns": "motion",
}
# Files that cannot be read as they stand are refused, with what to type.
REFUSED = {
    "[cam] for [camera]": "Add [camera]",
    "images turned clockwise": "In session.toml, write resolution = ",
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    return sound_session(tmp_path_factory.mktemp("doctor") / "sound")


def test_nothing_is_wrong_with_a_sound_session(sound):
    found = visioncal.doctor(sound)
    assert found.is_sound
    assert "15 of 15 images" in str(found)
    done = command("doctor", sound)
    assert (done.status, done.err) == (0, "")
    assert f"visioncal calibrate {sound} -o out" in done.out


def first_of_blurred(shown, sigma_px):
    """What is said of a declared ChArUco board of 9 x 6 where images show another or are blurred.

    A module of its markers is 2.9 px wide.
    """
    image, _ = photograph(shown, Shot(square_px=28))
    image = np.pad(image, 20, mode="edge")
    image = cv2.GaussianBlur(image, (0, 0), sigma_px) if sigma_px else image
    session = Session.from_arrays([image] * 3, np.tile(np.eye(4), (3, 1, 1)), charuco(9, 6))
    return visioncal.doctor(session).findings[0]


def test_a_board_too_blurred_for_its_markers_is_no_other_board():
    found = first_of_blurred(charuco(12, 6), 2.9)
    assert "no view shows the target" in found.words
    assert "sharp, near enough and not mirrored" in found.do.words


def test_a_board_without_markers_has_to_be_stated():
    found = first_of_blurred(circles(4, 7, asymmetric=True), 0.0)
    assert "no view shows the target" in found.words
    assert 'kind = "circles", columns' in str(found.do)
    assert 'target = "board.toml" in session.toml' in str(found.do)


@pytest.mark.parametrize("name", NAMED)
def test_what_is_wrong_is_named_first(tmp_path, monkeypatch, name):
    folder = broken_session(tmp_path / "session", BROKEN[name])
    found = visioncal.doctor(folder)
    assert found.findings[0].kind == NAMED[name]
    assert found.findings[0].do is not None
    assert "SESSION" not in str(found)
    # The command finds the same again: once shows that.
    if name != "quaternion with w first":
        monkeypatch.setattr("visioncal.cli.doctor.doctor", lambda *_, **__: found)
    done = command("doctor", folder, "--json")
    assert done.status == 3
    assert json.loads(done.out) == to_document(found)


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_is_refused_with_what_to_type(tmp_path, name):
    folder = broken_session(tmp_path / "session", BROKEN[name])
    refused = command("doctor", folder)
    assert refused.status in (2, 3)
    assert REFUSED[name] in refused.said


def test_a_board_that_is_not_declared_is_named_by_calibrate(tmp_path):
    folder = broken_session(tmp_path / "session", BROKEN["another size of board"])
    caught = raised(DataError, "ChArUco board of 9 x 6 squares", visioncal.calibrate, folder)
    assert "target check SESSION/images" in caught.next_step


@pytest.mark.slow
def test_squares_in_the_place_of_inner_corners_are_named(tmp_path):
    options = replace(Mistake().options, target=BOARDS["checkerboard"], views=4)
    folder = sound_session(tmp_path / "squares", Mistake(options=options))
    described = 'kind = "checkerboard"\ncolumns = 10\nrows = 7\nsquare_m = 0.025\n'
    (folder / "board.toml").write_text(described)
    edit(folder, lambda text: text.replace("checkerboard_9x6_25mm", "board.toml"))
    (found,) = visioncal.doctor(folder).findings
    assert found.kind == "other_board"
    assert "checkerboard of 9 x 6" in found.words
    caught = raised(DataError, "checkerboard of 9 x 6", visioncal.calibrate, folder)
    assert "In the target's .toml, write columns = 9 and rows = 6" in caught.next_step


def test_rotations_of_another_form_are_loaded_in_doubt(tmp_path):
    name = "Euler angles in degrees in quaternion columns"
    doubtful = load_for_rereading(broken_session(tmp_path / "session", BROKEN[name]))
    assert doubtful.robot is not None
    assert doubtful.robot.reading.rotation == "euler-xyz-deg"
    assert np.abs(doubtful.robot.rotations).max() > 90.0
    assert doubtful.session.views[0].numbers["qw"] == 1.0
