"""The whole way: a folder goes in, and a result comes out, or what is wrong and what to type."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.boards import charuco, circles
from support.cells import exact
from support.commands import visioncal as command
from support.edited import rewritten
from support.following import follow
from support.fuzz.broken_sessions import BROKEN, SMALL, Mistake, broken_session, edit, sound_session
from support.marks import slow
from support.refusals import raised
from support.rendered import Shot, photograph

import visioncal
from visioncal.calibration.pipeline.checkup import to_document as checkup_document
from visioncal.calibration.run import run
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.verdict import NOTE
from visioncal.interchange.formats import load_for_rereading
from visioncal.results import Calibration, to_document
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE, pose_row
from visioncal.simulation import (
    BOARDS,
    CellOptions,
    cell_session,
    read_truth,
    simulate,
    write_session,
)
from visioncal.vision.targets import corner_positions


@pytest.fixture(scope="module")
def result(done) -> Calibration:
    return done[0].calibration


def away_mm(one: Calibration, other: Calibration) -> float:
    """How far the camera's edge is from another calibration's."""
    pair = (it.transforms["flange_from_cam"] for it in (one, other))
    return 1e3 * float(np.linalg.norm((next(pair).inv() * next(pair)).translation))


def same(one: Calibration, other: Calibration) -> bool:
    """Whether the camera's edge is another calibration's, to the last bit."""
    return np.array_equal(*(it.edges["flange_from_cam"].matrix for it in (one, other)))


CONTRACT_KEYS = {
    "joint_fit", "kinematics", "schema", "visioncal", "created", "session", "mount", "transforms",
    "joint_covariance", "solvers", "camera", "robot", "noise", "ray_frame", "views", "rms",
    "validation", "verdict", "board", "uncertainty",
}  # fmt: skip
EDGE_KEYS = {"matrix", "quaternion_xyzw", "translation_m", "covariance", "sigma_mm", "sigma_deg"}
SOLVER_KEYS = {"joint", "tsai", "park", "horaud", "daniilidis", "andreff", "shah", "li"}


def test_the_document_keeps_the_contract(result):
    document = to_document(result)
    assert set(document) == CONTRACT_KEYS
    assert "null" not in json.dumps(document)
    assert set(document["solvers"]) == SOLVER_KEYS
    edge = document["transforms"]["flange_from_cam"]
    assert set(edge) == EDGE_KEYS
    covariance = np.array(edge["covariance"])
    assert edge["sigma_mm"] == pytest.approx(1e3 * np.sqrt(np.trace(covariance[3:, 3:])))
    joint = np.array(document["joint_covariance"]["matrix"])
    assert document["joint_covariance"]["order"] == ["flange_from_cam", "base_from_target"]
    np.testing.assert_array_equal(joint[:6, :6], covariance)
    assert np.all(np.linalg.eigvalsh(joint) > 0)
    assert len(document["views"]) == 12
    assert all(view["used"] and view["rms_px"] > 0 for view in document["views"])
    assert len(document["camera"]["covariance"]) == 9
    raised(DataError, "flange_from_cam, base_from_target", result.covariance, "base_from_cam")


@pytest.mark.parametrize(
    ("form", "changed"),
    [
        ("translation_m", lambda old: [old[0], old[1], old[2] + 1e-3]),
        ("quaternion_xyzw", lambda old: [-old[1], old[0], old[3], -old[2]]),
        ("matrix", lambda old: [[*old[0][:3], old[0][3] + 2e-5], *old[1:]]),
    ],
)
def test_a_pose_whose_forms_contradict_each_other_is_refused_and_a_rounded_one_is_not(
    result, form, changed
):
    for place in ("transforms", "solvers"):
        document = to_document(result)
        found = document[place]["park"] if place == "solvers" else document[place]
        pose = found["flange_from_cam"]
        pose[form] = changed(pose[form])
        words = r"^cal\.json: flange_from_cam: \w+ is .* another pose"
        no = raised(DataError, words, Calibration.from_json, json.dumps(document), "cal.json")
        assert form == "matrix" or any(form in culprit for culprit in no.culprits)
    document = to_document(result)
    pose = document["transforms"]["flange_from_cam"]
    for name, sign in (("translation_m", 1.0), ("quaternion_xyzw", -1.0)):
        pose[name] = [round(sign * value, 6) for value in pose[name]]
    again = Calibration.from_json(json.dumps(document), "cal.json")
    assert same(again, result)


def test_joints_stand_in_for_poses(session_copy, result):
    rewritten(session_copy, lambda _, row: {k: v for k, v in row.items() if k not in POSE})
    # A board's file that sessions share is beside them, and no reason for doubt.
    name = BOARDS["charuco"].name
    shutil.copy(Path(__file__).parents[2] / "targets" / f"{name}.toml", session_copy.parent)
    edit(session_copy, lambda text: text.replace(f'"{name}"', f'"../{name}.toml"'))
    found = visioncal.calibrate(session_copy)
    # The model's poses and the reported ones agree to rounding.
    assert away_mm(found, result) < 1e-6
    (shared,) = (one for one in found.verdict.findings if "outside of the session" in one.words)
    assert (shared.kind, shared.do) == (NOTE, None)
    assert found.verdict.status == result.verdict.status


def test_a_view_held_out_by_the_session_is_in_no_fit(session_copy):
    rewritten(session_copy, lambda at, row: row | {"role": "holdout" if at == 3 else ""})
    whole = visioncal.calibrate(session_copy)
    assert not whole.views[3].used
    assert "holdout" in whole.views[3].reason
    assert whole.validation.holdout.mm < 1.0

    def spoil(at, row):
        return row | {"x_m": repr(float(row["x_m"]) + 0.05 * (at == 3))}

    rewritten(session_copy, spoil)
    spoilt = visioncal.calibrate(session_copy)
    assert same(spoilt, whole)
    # The spoilt pose is off by 50 mm, and shows as such.
    assert spoilt.validation.holdout.mm == pytest.approx(50.0, abs=2.0)


def test_images_and_measured_poses_are_calibrated_in_one_session(session_copy, done, result):
    """Some rows bring the target's pose themselves, the lens being estimated from the others."""
    evidence = {view.view: view for view in done[0].evidence}

    def measured(at, row):
        cam_pose = pose_row(evidence[at].cam_from_target)
        cells = {f"cft_{name}": repr(value) if at < 3 else "" for name, value in cam_pose.items()}
        return row | cells | {"image": "" if at < 3 else row["image"]}

    rewritten(session_copy, measured)
    mixed = visioncal.calibrate(session_copy)
    assert all(view.used for view in mixed.views)
    assert away_mm(mixed, result) < 4 * result.edges["flange_from_cam"].sigma_mm
    # The noise of the measured poses is not known: both kinds are estimated as one.
    assert "combined_translation_mm" in mixed.noise


def test_progress_is_reported_and_the_same_session_gives_the_same_numbers(rendered, done):
    found, reports = done
    assert ("detect", 12, 12) in reports
    assert {"pnp", "solve", "examine", "judge"} <= {stage for stage, *_ in reports}
    again = to_document(visioncal.calibrate(Session.load(rendered)))
    assert again | {"created": ""} == to_document(found.calibration) | {"created": ""}
    raised(DataError, r"solver is text .'best'", visioncal.calibrate, rendered, solver="best")
    raised(DataError, "level 'seven'", visioncal.calibrate, rendered, level="seven")


def test_evidence_shows_what_was_seen_and_where_it_should_be(done):
    found, _ = done
    assert len(found.evidence) == 12
    for seen, view in zip(found.evidence, found.calibration.views, strict=True):
        away = seen.predicted_px - seen.corners.px
        assert np.sqrt(np.mean(np.sum(away**2, axis=1))) == pytest.approx(view.rms_px)
    assert 0 < rotation_angle(found.evidence[0].cam_from_target) < np.pi


def errors(calibration, truth):
    """Distance [mm] and angle [deg] of the first edge from the truth."""
    name = next(iter(calibration.edges))
    away = invert(truth.transforms[name]) @ calibration.transforms[name].as_matrix()
    return 1e3 * np.linalg.norm(away[:3, 3]), np.rad2deg(rotation_angle(away))


@pytest.fixture
def session_copy(rendered, tmp_path):
    return shutil.copytree(rendered, tmp_path / "copy")


def test_a_rendered_session_gives_the_truth_within_its_sigma(result, rendered):
    away_mm, away_deg = errors(result, read_truth(rendered))
    edge = result.edges["flange_from_cam"]
    # The length of an error of three components exceeds three roots of its variance rarely.
    assert away_mm < 3 * edge.sigma_mm
    assert away_deg < 3 * edge.sigma_deg
    # 12 sharp views of 640 x 400 with an unknown lens reach some tenths of a millimetre.
    assert edge.sigma_mm < 0.5
    assert result.verdict.status == "good"
    assert result.camera.estimated
    truth = read_truth(rendered).camera
    sigma = np.sqrt(np.diag(result.camera.covariance))[:4]
    assert np.all(np.abs(result.camera.camera.matrix - truth.matrix) < 4 * sigma)


@pytest.mark.parametrize("mount", [slow("eye-in-hand"), "eye-to-hand"])
def test_exact_pose_pairs_give_the_exact_edges(mount, tmp_path):
    folder = write_session(
        simulate(exact(CellOptions(mount=mount, seed=4))), tmp_path / "pairs", images=False
    )
    calibration = visioncal.calibrate(folder)
    away_mm, away_deg = errors(calibration, read_truth(folder))
    # Numbers on disk keep all digits; the solvers are exact to 1e-9 m.
    assert away_mm < 1e-6
    assert away_deg < 1e-6
    assert calibration.camera is None
    assert "pixel_px" not in calibration.noise


def test_missing_cut_and_empty_images_are_named_and_left_out(session_copy, result):
    images = sorted((session_copy / "images").iterdir())
    images[1].unlink()
    images[4].write_bytes(images[4].read_bytes()[:4000])
    images[7].write_bytes(b"")
    cv2.imwrite(str(images[9]), cv2.resize(cv2.imread(str(images[9])), None, fx=0.5, fy=0.5))
    calibration = visioncal.calibrate(session_copy)
    unused = {view.view: view.reason for view in calibration.views if not view.used}
    assert set(unused) == {1, 4, 7, 9}
    assert "320 x 200 px, and the camera's images are 640 x 400" in unused[9]
    assert "missing" in unused[1]
    assert "cut short" in unused[4]
    assert "empty" in unused[7]
    # Nothing shifts: the others keep their poses, and the answer stays where it was.
    assert away_mm(calibration, result) < 3 * calibration.edges["flange_from_cam"].sigma_mm


def test_two_views_and_no_board_are_refused(rendered):
    few = Session.load(rendered).only(range(3))
    files = {view.image: few.images.read(view.image) for view in few.views}
    files[few.views[2].image] = cv2.imencode(".png", np.full((400, 640), 90, np.uint8))[1].tobytes()
    two = few.with_content(images=MemoryImages(files))
    raised(DataError, "intrinsics: 2 views show the target", visioncal.calibrate, two)
    blank = [np.full((200, 320), 90, np.uint8)] * 3
    none = Session.from_arrays(blank, np.tile(np.eye(4), (3, 1, 1)), charuco(9, 6))
    caught = raised(DataError, "no view shows the target", visioncal.calibrate, none)
    assert "almost uniform" in caught.culprits[0]


@pytest.fixture(scope="module")
def done(rendered):
    """The run of a rendered session, and what was told of its progress."""
    reports = []
    return run(rendered, progress=lambda *report: reports.append(report)), reports


# Where the finding comes from: poses, files, images, motion. All others are kept answers.
NAMED = {
    "quaternion with w first": "misread_poses",
    "one pose typed wrong": "wrong_views",
    "images in another folder": "missing_images",
    "no turns": "motion",
}
# Files that cannot be read as they stand are refused, with what to type.
REFUSED = {
    "[cam] for [camera]": "Write camera for cam",
    "images turned clockwise": "In session.toml, write resolution = ",
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    return sound_session(tmp_path_factory.mktemp("doctor") / "sound", SMALL)


def broken(folder, name):
    """A broken session, its pictures small where the mistake asks for no cell of its own."""
    mistake = BROKEN[name]
    if mistake.options == Mistake().options:
        mistake = replace(mistake, options=SMALL.options)
    return broken_session(folder, mistake)


def test_nothing_is_wrong_with_a_sound_session(sound):
    done = command("doctor", sound)
    assert (done.status, done.err) == (0, "")
    assert f"visioncal calibrate {sound} -o out" in done.out
    assert "15 of 15 images" in done.out
    assert re.search(r"in 15 images, over [5-9]\d % of their width and [5-9]\d % of", done.out)


@pytest.mark.slow
def test_views_that_leave_lens_and_mount_open_are_reported_for_both():
    board, rng = CellOptions().target, np.random.default_rng(3)
    at_m = corner_positions(board) - corner_positions(board).mean(axis=0)
    seen, poses = [], []
    for angle in np.linspace(-1.2, 1.2, 10):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        shift_m = rng.uniform(-0.03, 0.03, 2)
        # A camera square to the board at 0.4 m, of 900 px.
        px = 900 * (at_m[:, :2] @ turn.T + shift_m) / 0.4 + [639.5, 399.5]
        seen.append((np.arange(len(px)), px + rng.normal(0.0, 0.05, px.shape)))
        cam_from_target = np.eye(4)
        cam_from_target[:2, :2], cam_from_target[:3, 3] = turn, [*shift_m, 0.4]
        poses.append(invert(cam_from_target))
    session = Session.from_corners(seen, np.array(poses), board, (1280, 800))
    first, second = visioncal.doctor(session).findings[:2]
    assert "turn about the tool's z" in first.words
    assert "intrinsics: the views leave the focal length open" in second.words


def test_too_few_stops_to_check_a_result_are_reported_in_the_verdicts_words(sound):
    views = Session.load(sound).only(range(6))
    (found,) = visioncal.doctor(views).findings
    judged = visioncal.calibrate(views).verdict
    (said,) = (finding for finding in judged.findings if finding.kind == "few_stops")
    assert (found.kind, found.words, found.do) == (said.kind, said.words, said.do)
    assert "Only 6 views" in found.words
    assert "Add 5 views or more, tilted" in found.do.words


def first_of_blurred(shown, sigma_px):
    """What is said of a declared ChArUco board of 9 x 6 where an image shows another or is blurred.

    A module of its markers is 2.9 px wide.
    """
    image, _ = photograph(shown, Shot(square_px=28))
    image = np.pad(image, 20, mode="edge")
    image = cv2.GaussianBlur(image, (0, 0), sigma_px) if sigma_px else image
    session = Session.from_arrays([image], np.eye(4)[None], charuco(9, 6))
    return visioncal.doctor(session).findings[0]


def test_lengths_of_another_board_are_measured():
    other = first_of_blurred(charuco(7, 5, dictionary="DICT_4X4_50"), 0.0).do
    assert "Measure the side of a square" in other.words
    assert "of it. In session" in other.words
    assert "target check" in other.command
    assert "--square-mm" in other.command
    counts = first_of_blurred(charuco(11, 6), 0.0).do
    assert "columns = 11" in counts.words
    assert "times it as marker_m" in counts.words


@pytest.mark.slow
def test_a_board_too_blurred_for_its_markers_is_no_other_board():
    found = first_of_blurred(charuco(12, 6), 2.9)
    assert "no view shows the target" in found.words
    assert "sharp, near enough and not mirrored" in found.do.words


def test_a_board_of_another_kind_is_named():
    found = first_of_blurred(circles(4, 7, asymmetric=True), 0.0)
    assert "another board than declared: asymmetric grid of 4 x 7 circles" in found.words
    assert 'write target = "seen.toml"' in found.do.words


@pytest.mark.parametrize(
    "name", [slow(name) if name in ("no turns", "one pose typed wrong") else name for name in NAMED]
)
def test_the_fault_is_named_first(tmp_path, monkeypatch, name):
    folder = broken(tmp_path / "session", name)
    found = visioncal.doctor(folder)
    assert found.findings[0].kind == NAMED[name]
    assert found.findings[0].do is not None
    assert "SESSION" not in str(found)
    # The command finds the same again: once shows that.
    if name != "quaternion with w first":
        monkeypatch.setattr("visioncal.cli.doctor.doctor", lambda *_, **__: found)
    done = command("doctor", folder, "--json")
    assert done.status == 3
    assert json.loads(done.out) == checkup_document(found)


# Turns by up to two degrees.
SLIGHT = {"tilt_rad": (0.0, 0.015), "roll_rad": 0.015}


@pytest.mark.parametrize(
    ("mount", "motion"),
    [
        slow("eye-in-hand", {"motion": "one_axis"}),
        slow("eye-to-hand", {"motion": "one_axis"}),
        slow("eye-to-hand", {"motion": "translation"}),
        ("eye-in-hand", SLIGHT),
    ],
)
def test_a_motion_that_determines_too_little_is_named_as_calibrate_names_it(mount, motion):
    cell = simulate(CellOptions(mount=mount, views=12, **motion))
    session = cell_session(cell, "poor", seen="corners")
    refused = raised(DegenerateError, "hand-eye", visioncal.calibrate, session)
    (found,) = visioncal.doctor(session).findings
    assert found.kind == "motion"
    said = f"hand-eye: the camera's offset {'from' if 'translation' in str(motion) else 'along'}"
    assert found.words.startswith(said)
    assert refused.message.startswith(said)
    # How the views turn, which is of their poses alone.
    assert found.words.rpartition(": ")[2] == refused.message.rpartition(": ")[2]
    assert str(found.do) == refused.next_step


@pytest.mark.parametrize("name", ["[cam] for [camera]", slow("images turned clockwise")])
def test_an_unreadable_source_is_refused_with_the_command_to_type(tmp_path, name):
    folder = broken(tmp_path / "session", name)
    refused = command("doctor", folder)
    assert refused.status in (2, 3)
    assert REFUSED[name] in refused.said


@pytest.mark.slow
def test_a_board_that_is_not_declared_is_named_by_calibrate(tmp_path):
    folder = broken_session(tmp_path / "session", BROKEN["another size of board"])
    caught = raised(DataError, "ChArUco board of 9 x 6 squares", visioncal.calibrate, folder)
    assert "Write columns = 9 and rows = 6 in the board's .toml" in caught.next_step


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
    followed = follow("calibrate", folder, "-o", tmp_path / "out")
    assert "Write columns = 9 and rows = 6 in the board's .toml" in followed.runs[0].refused().said
    # What remains is that these are few views.
    assert "4 of 4 views used" in followed.last.said


def test_rotations_of_another_form_are_loaded_in_doubt(tmp_path):
    name = "Euler angles in degrees in quaternion columns"
    # Its pictures are not read.
    mistake = replace(BROKEN[name], options=SMALL.options)
    doubtful = load_for_rereading(broken_session(tmp_path / "session", mistake))
    assert doubtful.robot is not None
    assert doubtful.robot.reading.rotation == "euler-xyz-deg"
    assert np.abs(doubtful.robot.rotations).max() > 90.0
    assert doubtful.session.views[0].numbers["qw"] == 1.0
