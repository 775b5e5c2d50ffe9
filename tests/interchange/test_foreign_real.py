"""Data sets of others: one command converts each, and it calibrates to what others got from it.

The figures are those of a plain OpenCV and scipy script (Park's solution of the same poses), or the
published ones.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import commands
from support.following import follow
from support.marks import slow

import visioncal
from visioncal.core.transforms import compose, invert, mean_transform, pose_difference
from visioncal.session import Session

POSITIONER = """
schema = 1
name = "positioner"
convention = "standard"
[[joint]]
name = "tilt"
a_m = 0.0
d_m = 0.0
alpha_rad = -1.5707963267948966
[[joint]]
name = "turn"
theta_offset_rad = -1.5707963267948966
a_m = 0.0
d_m = -0.475
alpha_rad = 0.0
"""


def convert(*arguments):
    return commands.visioncal("convert", *arguments)


@pytest.fixture
def calibrated(tmp_path):
    """Runs the command and calibrates what it wrote: (calibration, what it said)."""

    def run(*arguments):
        done = convert(arguments[0], tmp_path / "session", *arguments[1:]).good()
        return visioncal.calibrate(Session.load(tmp_path / "session")), done.err

    return run


def by_opencv(session):
    """Park's flange_from_cam by OpenCV [mm], and the target's scatter: (mm, deg), rms."""
    robot = np.array([view.base_from_flange().as_matrix() for view in session.views])
    camera = np.array([view.cam_from_target().as_matrix() for view in session.views])
    if session.mount == "eye-to-hand":
        robot = invert(robot)
    rotation, translation = cv2.calibrateHandEye(
        robot[:, :3, :3],
        robot[:, :3, 3],
        camera[:, :3, :3],
        camera[:, :3, 3],
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    targets = robot @ compose(rotation, translation[:, 0]) @ camera
    apart = [pose_difference(mean_transform(targets), target) for target in targets]
    return 1e3 * translation[:, 0], *np.sqrt(np.mean(np.square(apart), axis=0))


def away_mm(calibration, edge, millimetres):
    return np.linalg.norm(1e3 * calibration.transforms[edge].translation - millimetres)


@pytest.mark.slow
def test_data_of_industrial_calibration_are_calibrated(real_data, calibrated):
    result, _ = calibrated(
        real_data / "ric_charuco_eye_to_hand",
        "--images",
        real_data / "sessions/ric_charuco_eye_to_hand/images",
        "--intrinsics",
        "estimate",
    )
    assert result.mount == "eye-to-hand"
    assert result.camera.estimated
    assert [view.view for view in result.views if not view.used] == [2]
    assert result.rms.mm <= 1.86
    assert result.rms.deg <= 0.215
    # Park's camera, within what 15 views leave open; he takes the board as stated, and the half per
    # cent by which the robot finds it larger is 4 mm over the 0.9 m to it.
    sigma_mm = result.edges["base_from_cam"].sigma_mm
    assert away_mm(result, "base_from_cam", [-18.4, 1263.7, 290.0]) < 4 + 3 * sigma_mm
    # The session that was made of the same data by hand states its squares to 0.06 %, and not to
    # the 0.1 % that are taken where nothing is said: the camera moves by less than half its sigma.
    by_hand = visioncal.calibrate(real_data / "sessions/ric_charuco_eye_to_hand")
    x_mm = 1e3 * by_hand.transforms["base_from_cam"].translation
    assert away_mm(result, "base_from_cam", x_mm) < 0.5 * sigma_mm


@pytest.mark.slow
def test_visps_data_of_a_carried_board_are_calibrated(real_data, calibrated):
    result, said = calibrated(
        real_data / "visp_franka_hand_eye/data-eye-to-hand",
        "--target",
        "marker_DICT_APRILTAG_36h11_10_48mm",
    )
    assert "eye-to-hand" in said
    # The published mean of 2.0 mm is that of lengths; their root mean square is a little more.
    assert result.rms.mm <= 2.4
    sigma_mm = result.edges["base_from_cam"].sigma_mm
    assert away_mm(result, "base_from_cam", [954, -51, 477]) < 3 * sigma_mm


@pytest.mark.parametrize(
    ("source", "unit", "count", "park_mm", "scatter"),
    [
        ("doosan_a0509_charuco", "mm", 31, [-17.7, 32.1, -12.0], (1.62, 0.42)),
        slow(
            "pose_pairs_small/franka_charuco_joint_angles",
            "m",
            12,
            [47.6, 9.2, -35.8],
            (3.43, 0.72),
        ),
    ],
    ids=["two units", "a file a view"],
)
def test_pose_pairs_give_what_opencv_gets_of_them(
    real_data, calibrated, tmp_path, source, unit, count, park_mm, scatter
):
    result, said = calibrated(real_data / source, "--robot-unit", unit, "--mount", "eye-in-hand")
    assert "Found by the poses: The poses fit as first read" in said
    assert len(result.views) == count
    # Half a unit of the last digit that is written of each.
    x_mm, rms_mm, rms_deg = by_opencv(Session.load(tmp_path / "session"))
    np.testing.assert_allclose(x_mm, park_mm, atol=0.05)
    assert (rms_mm, rms_deg) == pytest.approx(scatter, abs=0.005)
    if count > 12:  # Which pairs of so few are solved for, and by what weights, matters.
        assert result.solvers["park"].rms_mm == pytest.approx(rms_mm, abs=0.1)
    assert result.rms.mm <= rms_mm


def test_samples_of_moveit_give_the_published_answer(real_data, calibrated, tmp_path):
    result, _ = calibrated(
        real_data / "pose_pairs_small/moveit_eye_to_hand_50.json", "--mount", "eye-to-hand"
    )
    # The published figures have three digits; 2 mm is what the data's own scatter allows.
    assert away_mm(result, "base_from_cam", [659, -249, 830]) < 2
    # Half a unit of the last digit that is written of each.
    x_mm, rms_mm, _ = by_opencv(Session.load(tmp_path / "session"))
    np.testing.assert_allclose(x_mm, [659.5, -250.1, 830.3], atol=0.05)
    assert rms_mm == pytest.approx(4.60, abs=0.005)


@pytest.mark.slow
def test_two_streams_by_two_clocks_are_joined(real_data, calibrated):
    folder = real_data / "pose_pairs_small/ethz_unsynchronised_streams"
    robot, camera = (
        folder / f"robot_arm_complete_bag_color_and_ir_{name}.csv"
        for name in ("base_link_sr300_hinge", "target_ir")
    )
    arguments = ["--camera-file", camera, "--camera-inverse", "--mount", "eye-in-hand"]
    result, said = calibrated(robot, *arguments)
    assert "calibrate finds how far their clocks differ" in said
    # A frame lasts 33 ms and the robot's samples 20.
    clock = result.clock
    assert clock.camera_minus_robot_s == pytest.approx(0.0170, abs=1e-3)
    assert 2e-4 < clock.sigma_s < 2e-3
    used = [view for view in result.views if view.used]
    # 3.2 mm and 0.36 deg in the median over 174 samples that stand close to each other; these lie
    # all over the motion.
    assert np.median([value.residual_mm for value in used]) < 3.2
    assert np.median([value.residual_deg for value in used]) < 0.5


@pytest.mark.slow
def test_a_positioner_is_calibrated_from_its_joints(real_data, calibrated, tmp_path):
    (tmp_path / "positioner.toml").write_text(POSITIONER)
    result, _ = calibrated(
        real_data / "ric_positioner_camera_kinematics/measurements.yaml",
        "--robot-model",
        tmp_path / "positioner.toml",
    )
    assert len(result.views) == 205
    # A fit of both axes with 18 parameters leaves a mean of 0.38 mm and 0.046 deg; the nominal
    # geometry with its right angles 20 % more.
    assert np.mean([view.residual_mm for view in result.views]) < 1.2 * 0.38
    assert np.mean([view.residual_deg for view in result.views]) < 1.2 * 0.046


@pytest.mark.slow
def test_a_calibrated_positioner_predicts_views_that_no_fit_has_seen(real_data, tmp_path):
    (tmp_path / "positioner.toml").write_text(POSITIONER)
    source = real_data / "ric_positioner_camera_kinematics/measurements.yaml"
    convert(source, tmp_path / "s", "--robot-model", tmp_path / "positioner.toml").good()
    session = Session.load(tmp_path / "s")
    views = tuple(replace(view, holdout=view.number % 10 == 0) for view in session.views)
    result = visioncal.calibrate(replace(session, views=views))
    assert result.arm_is_calibrated
    # Ten folds leave 0.36 mm in the mean over all, and a fit of both axes alone 0.38 mm in sample.
    away = [view for view in result.views if view.view % 10 == 0]
    assert len(away) == 21
    assert np.mean([view.residual_mm for view in away]) < 1.2 * 0.38
    assert np.mean([view.residual_deg for view in away]) < 1.2 * 0.046


@pytest.mark.slow
def test_a_ur10_is_calibrated_from_its_joints(real_data, calibrated):
    joints = "shoulder_pan_joint,shoulder_lift_joint,elbow_joint,wrist_1_joint,wrist_2_joint"
    result, _ = calibrated(
        real_data / "figaroh_small/ur10_pose_calibration.csv",
        "--mount",
        "eye-to-hand",
        "--camera-columns",
        "x1,y1,z1,phix1,phiy1,phiz1",
        "--camera-form",
        "rpy",
        "--joint-columns",
        f"{joints},wrist_3_joint",
        "--robot-model",
        "ur10",
    )
    # The nominal geometry leaves a mean of 10.7 mm and 21 at most.
    assert np.mean([view.residual_mm for view in result.views]) < 11.5
    assert np.max([view.residual_mm for view in result.views]) < 21


@pytest.mark.slow
def test_a_guess_finds_the_unstated_reading(real_data, tmp_path):
    source = real_data / "doosan_a0509_charuco"
    done = convert(source, tmp_path / "s", "--robot-unit", "m", "--guess", "--yes").good()
    assert "positions in mm" in done.err
    assert "eye-in-hand" in done.err
    assert visioncal.calibrate(tmp_path / "s").rms.mm < 5


def test_a_mount_that_poses_do_not_determine_is_asked_for(real_data, tmp_path):
    # Its target faces the camera, so that the inverse of the camera's poses is a cell as well.
    source = real_data / "pose_pairs_small/moveit_eye_to_hand_50.json"
    convert(source, tmp_path / "s", "--guess", "--yes").refused(
        "eye-to-hand (as first read)", "--mount"
    )
    assert not (tmp_path / "s").exists()


def test_touches_alone_are_no_session_of_a_camera(real_data, tmp_path):
    convert(
        real_data / "tcp_pivot_rvbust/poses.csv", tmp_path / "s", "--mount=eye-in-hand"
    ).refused("neither images nor poses of the target")
    assert not (tmp_path / "s").exists()


@pytest.mark.slow
def test_a_pan_tilt_head_of_a_urdf_of_any_name(real_data, tmp_path):
    case, out = real_data / "field/cases/pan-tilt", tmp_path / "s"
    seen = "board_x,board_y,board_z,board_qx,board_qy,board_qz,board_qw"
    arm = ("--robot-model", case / "ptu.urdf", "--tip", "tilt", "--mount=eye-in-hand")
    joints = ("--joint-columns", "pan_joint,tilt_joint", "--camera-columns", seen)
    convert(case / "pantilt.csv", out, *arm, *joints).good()
    # The names of its joints find the URDF that stands beside the table, its end the tip.
    converted = convert(case, tmp_path / "found", "--mount=eye-in-hand").good()
    assert "pan_joint, tilt_joint are the joints of ptu.urdf, to its tilt" in converted.err
    found, stated = ((tmp_path / name / "views.csv").read_text() for name in ("found", "s"))
    assert found == stated
    assert 'tip = "tilt"' in (tmp_path / "found/session.toml").read_text()
    assert (out / "ptu.urdf").is_file()
    result = visioncal.calibrate(out)
    # The case states whole millimetres; one sigma of the result is 1.1 mm.
    assert away_mm(result, "flange_from_cam", [53.0, 18.0, 88.0]) < 1.1
    assert not any(finding.kind == "board_size" for finding in result.verdict.findings)


def test_whole_degrees_are_read_at_the_second_attempt(real_data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = real_data / "field/cases/rounded-poses/rounded.csv"
    matrix = ",".join(f"m{at}" for at in range(16))
    words = ("--camera-columns", matrix, "--mount", "eye-in-hand", "--robot-form", "rpy")
    followed = follow("convert", source, "s", *words)
    # Positions beyond any arm's reach are millimetres: the form alone is asked for.
    assert "Give --robot-form rpy-deg, " in followed.runs[0].refused("in radians").err
    assert followed.last.status == 0
    assert len(followed.runs) == 2
    first = Session.load(tmp_path / "s").views[0].base_from_flange()
    assert np.allclose(first.translation, [0.760, 0.464, 0.533])
    turn = Rotation.from_euler("xyz", [-151, 11, 155], degrees=True)
    # To rounding.
    assert (first.rotation.inv() * turn).magnitude() < 1e-12
