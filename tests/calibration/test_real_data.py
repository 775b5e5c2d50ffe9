"""Real measurements, against what plain OpenCV and scipy scripts get from them."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.marks import slow
from support.tracked import known_of

import visioncal
from visioncal.estimation import solve
from visioncal.interchange.formats import DoubtfulSession
from visioncal.results.views import rms_of
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE


def rokae(data: Path) -> Session:
    """Poses at 30 stops of a six-axis arm, by a laser."""
    folder = data / "rokae_laser_6d"
    lines = (folder / "joint_angle.csv").read_text().splitlines()
    inside = [re.search(r"j:\{([^}]*)\}", line)[1] for line in lines if "j:{" in line]
    q = np.deg2rad([[float(part) for part in text.split(",")[:6]] for text in inside])
    rows = [line.split() for line in (folder / "laser_pos.csv").read_text().splitlines() if line]
    measured = np.array([[float(name) for name in row[7:13]] for row in rows])
    turns = Rotation.from_euler("xyz", measured[:, 3:], degrees=True).as_quat()
    numbers = np.hstack([1e-3 * measured[:, :3], turns, q]).tolist()
    table = np.loadtxt(folder / "dh.csv", delimiter=",", skiprows=1) * [1.0, 1e-3, 1e-3, 1.0]
    names = ("alpha_rad", "a_m", "d_m", "theta_offset_rad")
    table[:, [0, 3]] = np.deg2rad(table[:, [0, 3]])
    robot = {"schema": 1, "name": "rokae", "tip": "flange", "convention": "modified"}
    robot["joint"] = [dict(zip(names, row, strict=True)) for row in table.tolist()]
    # What is not stated of the instrument is taken as usual for its kind.
    document = {"schema": 1, "name": "rokae", "instrument": {"sigma_m": 2e-5, "sigma_rad": 1e-4}}
    document["robot"] = {"model": "rokae", "tip": "flange"}
    columns = ["view", *(f"meas_{name}" for name in POSE), *(f"q{at}_rad" for at in range(1, 7))]
    cells = [[str(view), *map(repr, row)] for view, row in enumerate(numbers)]
    return Session.assemble(document, columns, cells, MemoryImages({}), robot_document=robot)


@pytest.mark.slow
def test_a_charuco_board_before_a_fixed_camera_is_calibrated(real_data):
    result = visioncal.calibrate(real_data / "sessions/ric_charuco_eye_to_hand")
    unused = [view for view in result.views if not view.used]
    assert [view.view for view in unused] == [2]
    assert "too few corners" in unused[0].reason
    # OpenCV's calibrateCamera reaches 0.525 px as the root mean square length of a residual.
    assert result.camera.estimated
    assert np.sqrt(2) * result.noise["pixel_px"] == pytest.approx(0.525, rel=0.15)
    # Park's solution of the same views: 1.86 mm and 0.21 deg; left out one by one 2.11 and 0.24,
    # and the joint fit with intrinsics and bend free is to come under 1.8 and 0.20.
    assert result.rms.mm <= 1.6
    assert result.rms.deg <= 0.15
    assert result.validation.held_out.mm <= 1.8
    assert result.validation.held_out.deg <= 0.20
    # What is wrong with the cell: a board that is bent and half a per cent larger than stated.
    assert result.verdict.status == "check"
    assert any("The board is not flat" in reason for reason in result.verdict.reasons)
    assert any("larger than stated" in reason for reason in result.verdict.reasons)
    # Of the 0.5 % a size that is shrunk by its own uncertainty leaves some.
    away = result.board.shape["scale"] - 0.0047
    assert abs(away) < 2.0 * result.board.sigma["scale"]
    # Park's camera, within what 15 views leave open; he takes the board as stated, and half a per
    # cent of the 0.9 m to it is 4 mm.
    away = result.transforms["base_from_cam"].translation - [-0.0184, 1.2637, 0.2900]
    assert 1e3 * np.linalg.norm(away) < 4 + 3 * result.edges["base_from_cam"].sigma_mm


@pytest.mark.slow
def test_a_six_axis_arm_is_calibrated_by_a_laser_tracker(real_data):
    known = known_of(rokae(real_data))
    assert known.robot_arm.kinematics.nominal.rms_mm > 2.0
    # Plain least squares leave 0.099 mm and 0.038 deg in the fit; left out they are at 0.12 mm.
    rms = rms_of(known.findings.views)
    assert rms.mm < 0.1
    assert rms.deg < 0.03
    assert known.findings.held_out.mm < 0.13


@pytest.mark.parametrize(
    ("name", "views", "said"),
    [
        ("ric_charuco_eye_to_hand", None, "fit as first read"),
        # Of each image one of two poses is taken, so that no reading explains half of them.
        slow("ur3e_checkerboard_to_hand_cam1", 20, ""),
    ],
)
def test_a_real_session_of_images_is_not_accused(real_data, name, views, said):
    session = Session.load(real_data / "sessions" / name)
    guess = DoubtfulSession(session.only([view.number for view in session.views][:views])).guess()
    assert not guess.stands_out, guess.sentence
    assert said in guess.sentence


@pytest.mark.slow
def test_a_real_lens_that_departs_from_its_model_is_no_pane_of_negative_thickness(real_data):
    """A pane of -7.6 mm explained its field, and doubled what its arm errs by."""
    found = visioncal.calibrate(real_data / "sessions/kuka_checkerboard_in_hand").verdict
    assert found.causes[0].kind == "arm_errors"
    assert "window" not in {finding.kind for finding in found.findings}


@pytest.mark.slow
@pytest.mark.parametrize("stops", [30, 40])
def test_two_cameras_of_one_arm_agree_within_a_bounded_search(real_data, monkeypatch, stops):
    # Cameras 1 and 3 of four, whose lenses are not as stated; rows 25 and 26 are exchanged.
    steps, minimise = [], solve.levenberg_marquardt

    def counted(start, linearise, *more):
        return minimise(start, lambda at: steps.append(at) or linearise(at), *more)

    monkeypatch.setattr(solve, "levenberg_marquardt", counted)
    session = Session.load(real_data / "field/sets/four_all")
    cameras = session.only([100 * name + stop for name in (1, 3) for stop in range(1, stops + 1)])
    found = visioncal.calibrate(cameras).verdict.findings
    assert found[0].kind == "exchanged_views"
    assert {125, 126, 325, 326} == {int(view) for view in re.findall(r"\d{3}", found[0].words)}
    assert "convert SESSION FIXED --exchange 125,126,325,326 &&" in found[0].do.command
    # By another reference the board is 0.15 to 0.24 % smaller than stated, within its 0.5 %.
    assert not any(item.kind == "board_size" for item in found)
    # By the board alone, without the robot, camera 3 turns against camera 1 evenly all the time.
    (crept,) = (item.words for item in found if item.kind == "frame_creeps")
    assert "cam_cam3 by" in crept
    # A camera alone takes some 500 steps, and two whose arm is calibrated beside some 2,000. Where
    # cameras were reconciled by noise of the robot, two took more than 20,000.
    assert len(steps) < 5000


@pytest.mark.slow
def test_a_wide_lens_of_exact_corners_is_named_and_mended(real_data, tmp_path):
    shutil.copytree(real_data / "field/cases/fisheye-wrist/session", folder := tmp_path / "session")
    cause = visioncal.calibrate(folder).verdict.causes[0]
    assert cause.kind == "lens_model"
    assert 'write model = "fisheye" in [camera]' in cause.do.words
    toml = folder / "session.toml"
    toml.write_text(toml.read_text().replace("[camera]", '[camera]\nmodel = "fisheye"'))
    mended = visioncal.calibrate(folder).edges["flange_from_cam"].matrix[:3, :3]
    true = Rotation.from_rotvec([3.878, -0.882, 87.021], degrees=True)
    # The corners of nine views leave 0.01 deg; taken for Brown's model, the lens leaves 0.7.
    assert np.rad2deg((true.inv() * Rotation.from_matrix(mended)).magnitude()) < 0.05
