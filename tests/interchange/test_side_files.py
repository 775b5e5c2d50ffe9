"""Folders of a recording with other files beside it: each is read as the recording that it is."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from support.commands import visioncal
from support.following import follow

from visioncal.interchange.formats.intrinsics import FAULT, lenses_in, read_intrinsics
from visioncal.interchange.formats.joints import joint_names
from visioncal.interchange.formats.reading import read_fields
from visioncal.session import Session

BOARD = ("--target", "checkerboard_9x7_20mm", "--mount", "eye-to-hand")


def write(path: Path, document: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(document if isinstance(document, str) else json.dumps(document))


def shoot(folder: Path, name: str, count: int, size=(128, 72)) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for at in range(1, count + 1):
        cv2.imwrite(str(folder / name.format(at)), np.full(size[::-1], 40 + at, np.uint8))


def matrices(count: int, seed=0) -> np.ndarray:
    """(n, 4, 4) poses."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(0.2, 0.9, (count, 3))
    return poses


def frames_of_cameras(folder: Path) -> None:
    """Four cameras' poses in the base, whose names have numbers."""
    named = {f"cam{at + 1}": {"T_4x4": pose.tolist()} for at, pose in enumerate(matrices(4))}
    write(folder / "side/base_to_camera.json", {"T_base_to_camera": named})


def frames_in_a_list(folder: Path) -> None:
    """Five fixtures' poses, which are counted."""
    rows = [{"nr": at + 1, "T": pose.tolist()} for at, pose in enumerate(matrices(5))]
    write(folder / "side/fixtures.json", {"fixtures": rows})


def lengths_of_links(folder: Path) -> None:
    rows = [{"joint_id": f"J{at}", "a": 0.1 * at, "d": 0.2, "alpha": 1.5} for at in range(1, 7)]
    write(folder / "side/links.json", {"joints": rows})


LENS = {
    "camera_id": "cam1",
    "image_size_wh": {"width": 192, "height": 108},
    "number": 3.0,
    "intrinsics_K": {"fx": 150.0, "fy": 151.0, "cx": 95.5, "cy": 53.5},
    "distortion": {"model": "opencv", "coefficients": [-0.25, 0.125, 0.0, 0.0, 0.5]},
}


@pytest.mark.parametrize("write_frames", [frames_of_cameras, frames_in_a_list])
def test_joint_angles_of_all_pictures_come_before_frames_of_a_few(tmp_path, write_frames):
    shoot(tmp_path / "in/images", "img{}_cam1.png", 12)
    joints = np.random.default_rng(1).uniform(-90, 90, (12, 6))
    rows = [
        {
            "pose_id": at + 1,
            "joint_angles_deg": {f"joint_{n + 1}": q for n, q in enumerate(row)},
            "images": {f"cam{n}": f"cam{n}/img{at + 1}_cam{n}" for n in (1, 2)},
        }
        for at, row in enumerate(joints.tolist())
    ]
    write(tmp_path / "in/side/dataset.json", {"robot": "UR3", "poses": rows})
    write_frames(tmp_path / "in")
    lengths_of_links(tmp_path / "in")
    write(tmp_path / "in/lens/cam1.json", LENS)
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *BOARD).good()
    session = Session.load(tmp_path / "out")
    np.testing.assert_allclose([v.joints_rad for v in session.views], np.deg2rad(joints))
    assert len({view.image for view in session.views}) == 12
    assert "Left aside, as 12 images have other rows: " in done.err
    assert "calibrate needs the arm, as by --robot-model" in done.err
    # Read whole, for pictures of two thirds of its size.
    assert session.camera.matrix == pytest.approx([100.0, 151 / 1.5, 63.5, 35.5])
    assert list(session.camera.distortion) == [-0.25, 0.125, 0.0, 0.0, 0.5]
    assert "the matrix is scaled by 0.6667" in done.err


def test_a_lens_of_matlab_has_the_rows_of_its_pictures_first(tmp_path):
    shoot(tmp_path / "in", "{:02}.png", 6)
    for at, pose in enumerate(matrices(6), 1):
        write(tmp_path / f"in/{at:02}.json", {"base_from_flange": pose.tolist()})
    lens = {"K": [[100.0, 0, 62.0], [0, 101.0, 36.0], [0, 0, 1]], "image_size": [72, 128]}
    savemat(tmp_path / "in/camera_params.mat", lens | {"radial_distortion": [-0.25, 0.125]})
    visioncal("convert", tmp_path / "in", tmp_path / "out", *BOARD).good()
    camera = Session.load(tmp_path / "out").camera
    assert (tuple(camera.resolution), camera.matrix[0]) == ((128, 72), 100.0)


def test_a_reading_of_a_small_part_of_the_pictures_says_so(tmp_path):
    shoot(tmp_path / "in", "{:02}.png", 12)
    poses = matrices(5)
    for at, pose in enumerate(poses, 3):
        write(tmp_path / f"in/{at:02}.json", {"base_from_flange": pose.tolist()})
    write(tmp_path / "in/notes.csv", "\n".join(["temperature", *map(str, np.arange(12) / 7)]))
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *BOARD).good()
    assert "ATTENTION: only 5 of 12 images are views" in done.err
    assert "notes.csv (12 rows)" in done.err


def test_a_lens_is_read_whole_or_not_at_all(tmp_path):
    write(tmp_path / "lens.json", LENS)
    lens, _ = read_intrinsics(tmp_path / "lens.json")
    assert lens["matrix"] == [150.0, 151.0, 95.5, 53.5]
    assert lens["distortion"] == [-0.25, 0.125, 0.0, 0.0, 0.5]
    assert lens["resolution"] == [192, 108]
    assert [*lenses_in(LENS, "lens")] == [("lens: intrinsics_K", lens)]
    other = LENS | {"distortion": {"model": "of our own", "coefficients": [0.1]}}
    (_, unread), = lenses_in(other, "lens")  # fmt: skip
    assert "'of our own' is not known" in unread[FAULT]
    # Sides that are not around the centre, and single numbers, are of something else.
    board = {"width": 5, "height": 7, "d": 0.3, "lens": LENS["intrinsics_K"]}
    (_, read), = lenses_in(board, "board")  # fmt: skip
    assert "resolution" not in read
    assert read["distortion"] == [0.0] * 5


def test_a_lens_that_is_not_read_is_named(tmp_path):
    shoot(tmp_path / "in", "{:02}.png", 6)
    rows = [{"image": f"{at:02}.png", "T": p.tolist()} for at, p in enumerate(matrices(6), 1)]
    write(tmp_path / "in/poses.json", rows)
    other = LENS | {"distortion": {"model": "of our own", "coefficients": [0.1]}}
    write(tmp_path / "in/lens.json", other)
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *BOARD).good()
    assert "The intrinsics are left aside: lens.json: intrinsics_K: the lens model" in done.err
    assert Session.load(tmp_path / "out").camera is None


def test_files_of_the_same_columns_are_named_and_the_one_of_the_pictures_is_read(
    tmp_path, monkeypatch
):
    """A command that adds columns which all of them have would be a circle."""
    monkeypatch.chdir(tmp_path)
    shoot(tmp_path / "in/lens", "RGB{}.png", 14)
    shoot(tmp_path / "in/saved", "{}.png", 9)
    for count, name in ((9, "set"), (11, "set (copy)"), (12, "set for later")):
        poses = matrices(count, count)
        turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
        np.savetxt(tmp_path / f"in/{name}.txt", np.hstack([1e3 * poses[:, :3, 3], turns]))
    said = ("--target", "checkerboard_9x7_20mm", "--mount", "eye-to-hand")
    said = (*said, "--robot-form", "rotation-vector", "--robot-unit", "mm")
    followed = follow("convert", "in", "out", *said)
    first = followed.runs[0].refused().err
    assert "3 files have the columns 1,2,3,4,5,6: set (copy).txt (11 rows), set" in first
    assert "as set.txt, of as many rows as there are images in saved/#.png" in first
    followed.last.good()
    assert len(followed.done) == 1
    assert len(Session.load("out").views) == 9


def written(folder: Path, robot: np.ndarray, camera: np.ndarray) -> Path:
    folder.mkdir(parents=True)
    for name, poses in (("one.txt", robot), ("other.txt", camera)):
        np.savetxt(folder / name, poses.reshape(len(poses) * 4, 4))
    return folder


def test_two_sides_are_no_two_runs_of_one(tmp_path):
    """Lengths in millimetres make all rotations near each other beside these."""
    robot, tool, base = matrices(12, 1), *matrices(2, 2)
    robot[:, :3, 3] *= 1e3
    tool[:3, 3] *= 30
    base[:3, 3] *= 400
    pair = written(tmp_path / "pair", robot, np.linalg.inv(base) @ robot @ tool)
    said = visioncal("convert", pair, tmp_path / "out", "--mount", "eye-to-hand").refused().err
    assert "has 12 poses in one.txt and as many in other.txt: which are the robot's" in said
    assert "nearly the same" not in said
    again = robot.copy()
    again[:, :3, 3] += np.random.default_rng(3).normal(0, 2, (12, 3))
    runs = written(tmp_path / "runs", robot, again)
    said = visioncal("convert", runs, tmp_path / "out", "--mount", "eye-to-hand").refused().err
    assert "nearly the same 12 rows" in said
    assert "--camera-file" in said
    # The very same rows are no second side.
    copies = written(tmp_path / "copies", robot, robot)
    said = visioncal("convert", copies, tmp_path / "out", "--mount", "eye-to-hand").refused().err
    assert "nearly the same 12 rows" in said
    assert "--camera-file" not in said


def tracked(folder: Path, points: int, seed=4) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles [deg] (n, 6) and places [mm] (n, k, 3) of points that are fast on a flange."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    joints, on_flange = rng.uniform(-90, 90, (10, 6)), rng.uniform(-90, 90, (points, 3))
    poses = matrices(10, seed)
    places = 1e3 * poses[:, None, :3, 3] + np.einsum("nij,kj->nki", poses[:, :3, :3], on_flange)
    return joints, 900.0 + places


def test_an_instrument_needs_no_name(tmp_path):
    joints, places = tracked(tmp_path / "in", 1)
    np.savetxt(tmp_path / "in/joints.txt", joints)
    np.savetxt(tmp_path / "in/places.txt", places[:, 0])
    said = ("--mount", "instrument", "--robot-model", "irb120")
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    assert "The sigma of the readings is not stated" in done.err
    assert len(Session.load(tmp_path / "out").views) == 10


TRACKED = ("--instrument", "0.02", "--robot-model", "irb120")


def test_points_of_several_files_are_read_together_and_others_are_named(tmp_path):
    joints, places = tracked(tmp_path / "in", 3)
    np.savetxt(tmp_path / "in/joints_tool.txt", joints)
    for at in range(3):
        np.savetxt(tmp_path / f"in/position_SMR_{at + 1}.txt", places[:, at])
    np.savetxt(tmp_path / "in/position_SMR_base.txt", places[:3, 0] + 300)
    # A copy of all is no further points, either.
    shutil.copytree(tmp_path / "in", tmp_path / "in/copy")
    (tmp_path / "in/copy/joints_tool.txt").unlink()
    # A drawing of one of them is no further point.
    rng = np.random.default_rng(2)
    np.savetxt(tmp_path / "in/position_nominal.txt", places[:, 0] + rng.normal(0, 1, (10, 3)))
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *TRACKED).good()
    session = Session.load(tmp_path / "out")
    assert len(session.views) == 30
    named = [f"position_SMR_{at}" for at in (1, 2, 3)]
    assert [view.point for view in session.views[::10]] == named
    assert [view.stop for view in session.views] == [*range(10)] * 3
    found = [[view.numbers[f"meas_{axis}_m"] for axis in "xyz"] for view in session.views]
    np.testing.assert_allclose(found, 1e-3 * np.swapaxes(places, 0, 1).reshape(-1, 3))
    assert "Left aside: position_SMR_base.txt (3 rows), position_nominal.txt (10" in done.err or (
        "position_SMR_base.txt (3 rows)" in done.err and "position_nominal.txt (10" in done.err
    )


@pytest.mark.parametrize("by_point", [False, True])
@pytest.mark.parametrize("ending", ["mat", "txt"])
def test_several_points_a_stop_without_names_are_told_by_their_distances(
    tmp_path, by_point, ending
):
    joints, places = tracked(tmp_path / "in", 3)
    rows = (np.swapaxes(places, 0, 1) if by_point else places).reshape(-1, 3)
    if ending == "mat":
        savemat(tmp_path / "in/CaliJointAngles.mat", {"CaliJointAngles": joints})
        savemat(tmp_path / "in/CaliPosition.mat", {"CaliPosition": rows})
    else:
        np.savetxt(tmp_path / "in/CaliJointAngles.txt", joints)
        np.savetxt(tmp_path / "in/CaliPosition.txt", rows)
    said = TRACKED if ending == "mat" else (*TRACKED, "--joint-columns", "1,2,3,4,5,6")
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    order = "one after the other" if by_point else "in turn at each stop"
    assert f"3 points are taken {order}" in done.err
    session = Session.load(tmp_path / "out")
    assert len(session.views) == 30
    for view, row in zip(session.views, rows, strict=True):
        assert view.numbers["meas_y_m"] == pytest.approx(1e-3 * row[1])
        np.testing.assert_allclose(view.joints_rad, np.deg2rad(joints[view.stop]))


def test_points_whose_order_their_distances_do_not_show_are_refused(tmp_path):
    joints, places = tracked(tmp_path / "in", 2)
    np.savetxt(tmp_path / "in/joints.txt", joints)
    rows = np.random.default_rng(1).permutation(places.reshape(-1, 3))
    np.savetxt(tmp_path / "in/places.txt", rows)
    said = visioncal("convert", tmp_path / "in", tmp_path / "out", *TRACKED).refused().err
    assert "Add a column `stop`" in said


def test_points_of_another_arm_beside_an_arm_s_are_left_aside(tmp_path):
    """Points of as many rows as the joint angles are theirs, whatever file stands first."""
    joints, places = tracked(tmp_path / "in", 1)
    np.savetxt(tmp_path / "in/Q_six.txt", joints)
    np.savetxt(tmp_path / "in/P_six.txt", places[:, 0])
    np.savetxt(tmp_path / "in/P_3R.txt", places[:7, 0] + 100.0)
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *TRACKED).good()
    assert "Left aside: P_3R.txt (7 rows)" in done.err
    found = [view.numbers["meas_x_m"] for view in Session.load(tmp_path / "out").views]
    np.testing.assert_allclose(found, 1e-3 * places[:, 0, 0])


def test_poses_of_the_target_alone_are_not_proposed_as_the_robot_s(tmp_path):
    poses = matrices(11)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec().tolist()
    seen = {"board_to_camera_tvecs": poses[:, :3, 3].tolist(), "board_to_camera_rvecs": turns}
    write(tmp_path / "in/out_camera_data.json", {"extrinsic_parameters": seen})
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand")
    assert "Put the robot's poses beside them" in done.refused("are the target's").err
    assert "--robot-key extrinsic" not in done.err


def test_numbered_thetas_are_joint_angles_beside_the_measured_pose(tmp_path):
    rng, poses = np.random.default_rng(2), matrices(14)
    names = [f"theta_{at}" for at in range(1, 7)] + [
        f"m_{r}{c}" for r in range(4) for c in range(4)
    ]
    rows = np.hstack([rng.uniform(-1.5, 1.5, (14, 6)), poses.reshape(-1, 16)])
    cells = [",".join(map(repr, row)) for row in rows.tolist()]
    write(tmp_path / "in/run.csv", "\n".join([",".join(names), *cells]))
    done = visioncal("convert", tmp_path / "in/run.csv", tmp_path / "out", "--mount", "eye-to-hand")
    done.refused("there are joint angles and no poses of the robot", "--robot-model")


def test_positions_and_rotations_in_a_file_each_are_poses(tmp_path):
    poses, other = matrices(12, 1), matrices(12, 2)
    (tmp_path / "in").mkdir()
    for name, of in (("tcp", poses), ("ur", other)):
        np.savetxt(tmp_path / f"in/pos_{name}", of[:, :3, 3])
        turns = Rotation.from_matrix(of[:, :3, :3]).as_rotvec()
        np.savetxt(tmp_path / f"in/rotvec_{name}", turns)
    places = poses[:, :3, 3] + 0.1 * poses[:, :3, 2] + 1.0
    np.savetxt(tmp_path / "in/pos_pen", places)
    said = ("--instrument", "0.5", "--robot-form", "ur")
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    views = Session.load(tmp_path / "out").views
    found = [view.base_from_flange().as_matrix() for view in views]
    np.testing.assert_allclose(found, poses, atol=1e-12)
    assert views[3].numbers["meas_z_m"] == pytest.approx(places[3, 2])
    assert "left aside: pos_ur, rotvec_ur" in done.err
    said = (*said, "--robot-key", "pos_ur,rotvec_ur", "--camera-key", "pos_pen")
    visioncal("convert", tmp_path / "in", tmp_path / "ur", *said).good()
    views = Session.load(tmp_path / "ur").views
    found = [view.base_from_flange().as_matrix() for view in views]
    np.testing.assert_allclose(found, other, atol=1e-12)


@pytest.mark.parametrize("names", [("法蘭座標", "關節角度"), ("法兰坐标", "关节角")])
def test_joint_angles_in_chinese_are_no_camera_s(tmp_path, names):
    poses = matrices(6)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz", degrees=True)
    flanges = np.hstack([1e3 * poses[:, :3, 3], turns]).tolist()
    joints = np.random.default_rng(1).uniform(-150, 150, (6, 6)).tolist()
    rows = [dict(zip(names, row, strict=True)) for row in zip(flanges, joints, strict=True)]
    write(tmp_path / "in/record.json", rows)
    said = ("--mount", "eye-in-hand", "--robot-form", "euler-xyz-deg")
    said = visioncal("convert", tmp_path / "in", tmp_path / "out", *said).refused().err
    assert "has 6 poses of the robot, but neither images nor poses of the target" in said
    assert f"--camera-key {names[1]}" not in said


def test_seven_angle_positions_are_joints(tmp_path):
    fields = read_fields(
        _saved(tmp_path / "arm.mat", {"calibrationAnglePositions": np.ones((9, 7)) * 0.3})
    )
    assert joint_names(fields, ()) == ("calibrationAnglePositions",)


def _saved(path: Path, arrays) -> Path:
    savemat(path, arrays)
    return path


def test_the_length_of_a_grid_of_circles_is_that_of_its_rows(tmp_path):
    """Makers state the distance of circles within a row, which is twice as long."""
    (tmp_path / "in").mkdir()
    for at, pose in enumerate(matrices(4)):
        picture = np.full((480, 640), 235, np.uint8)
        for row in range(11):
            for column in range(4):
                place = (170 + 60 * column + 30 * (row % 2) + 5 * at, 80 + 30 * row)
                cv2.circle(picture, place, 11, 30, -1, cv2.LINE_AA)
        cv2.imwrite(str(tmp_path / f"in/{at}.png"), picture)
        write(tmp_path / f"in/{at}.json", {"base_from_flange": pose.tolist()})
    said = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand")
    said = said.refused().err
    assert "is not stated: an asymmetric grid of 4 x 11 circles" in said
    assert "Measure the distance from one row of circles to the next" in said
    assert "half of that between circles of a row" in said
    assert "side of a square" not in said


def a_calibrated_pair(count: int, seed=1):
    """The robot's poses (n, 4, 4) and a camera's of a target on the flange [mm]."""
    robot, (base, tool) = matrices(count, seed), matrices(2, seed + 1)
    for pose in (robot, base, tool):
        pose[..., :3, 3] *= 1e3
    return robot, np.linalg.inv(base) @ robot @ tool


@pytest.mark.parametrize("by_point", [False, True])
def test_several_points_that_a_camera_saw_at_each_pose_are_the_target_s(tmp_path, by_point):
    robot, seen = a_calibrated_pair(10)
    shape = np.array([[0, 0, 0], [90, 0, 0], [10, 60, 0], [20, 20, 40.0]])
    places = np.einsum("nij,kj->nki", seen[:, :3, :3], shape) + seen[:, None, :3, 3]
    rows = (np.swapaxes(places, 0, 1) if by_point else places).reshape(-1, 3)
    turns = Rotation.from_matrix(robot[:, :3, :3]).as_rotvec()
    arrays = {"pose_arm_N": np.hstack([robot[:, :3, 3], turns]), "P_C_N": rows}
    savemat(tmp_path / "in.mat", arrays)
    said = ("--mount", "eye-to-hand", "--robot-form", "rotation-vector")
    done = visioncal("convert", tmp_path / "in.mat", tmp_path / "out", *said).good()
    assert "P_C_N has 4 points" in done.err
    views = Session.load(tmp_path / "out").views
    found = np.array([view.cam_from_target().as_matrix() for view in views])
    # Whatever frame the points are given, its motions are the target's.
    moved, true = (each @ np.linalg.inv(each[0]) for each in (found, seen))
    true[:, :3, 3] *= 1e-3
    np.testing.assert_allclose(moved, true, atol=1e-9)


def test_points_on_a_line_are_no_pose(tmp_path):
    robot, seen = a_calibrated_pair(10)
    shape = np.array([[0, 0, 0], [40, 0, 0], [90.0, 0, 0]])
    places = np.einsum("nij,kj->nki", seen[:, :3, :3], shape) + seen[:, None, :3, 3]
    turns = Rotation.from_matrix(robot[:, :3, :3]).as_rotvec()
    arrays = {"pose_arm": np.hstack([robot[:, :3, 3], turns]), "seen": places.reshape(-1, 3)}
    savemat(tmp_path / "in.mat", arrays)
    said = ("--mount", "eye-to-hand", "--robot-form", "rotation-vector")
    said = visioncal("convert", tmp_path / "in.mat", tmp_path / "out", *said).refused().err
    assert "nothing says what a camera saw" in said


def opencv_rows(path: Path, **series: np.ndarray) -> None:
    """Matrices by numbered names, as OpenCV writes them."""
    lines = ["%YAML:1.0", "---"]
    for name, arrays in series.items():
        for at, array in enumerate(arrays, 1):
            rows, columns = np.atleast_2d(array).shape
            numbers = ", ".join(map(repr, np.ravel(array).tolist()))
            lines += [f"{name}{at:02d}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}"]
            lines += ["   dt: d", f"   data: [ {numbers} ]"]
    write(path, "\n".join(lines) + "\n")


def test_no_pose_is_proposed_of_files_that_do_not_belong_together(tmp_path):
    robot, seen = a_calibrated_pair(19)
    more = matrices(30, 5)
    places, turns = seen[:16, :3, 3], Rotation.from_matrix(seen[:16, :3, :3]).as_rotvec()
    opencv_rows(tmp_path / "in/handEye.yml", Matrix=robot)
    opencv_rows(tmp_path / "in/TranslationVectors.yml", TranslationVectors=places)
    opencv_rows(tmp_path / "in/RotationVectors.yml", RotationVectors=turns)
    others = Rotation.from_matrix(more[:, :3, :3]).as_rotvec()
    opencv_rows(
        tmp_path / "in/Vectors.yml", TranslationVectors=more[:, :3, 3], RotationVectors=others
    )
    said = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand")
    said = said.refused().err
    assert "TranslationVectors.TranslationVectors,Vectors.RotationVectors" not in said
    assert "Both sides need a row each: handEye.Matrix has 19 poses" in said
    assert "(16)" in said
    assert "(30)" in said


def test_poses_in_round_brackets_with_dates_are_the_robot_s_and_checks_are_not(tmp_path):
    poses = matrices(18)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    lines = [
        f"p({', '.join(map(repr, row))})     2017-12-18 10:28:{at + 10}"
        for at, row in enumerate(np.hstack([poses[:, :3, 3], turns]).tolist())
    ]
    write(tmp_path / "in/robot_pose.txt", "\n".join(lines) + "\n")
    opencv_rows(
        tmp_path / "in/VerifyPose.yml", verify_pose_=np.hstack([poses[:5, :3, 3], turns[:5]])
    )
    said = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand")
    said = said.refused().err
    assert "18 poses of the robot" in said
    fields = read_fields(tmp_path / "in/robot_pose.txt")
    np.testing.assert_allclose(fields.column("x")[:, 0], poses[:, 0, 3])


def test_broken_rotations_are_called_so(tmp_path):
    """Nine elements of one name that begin with w of a quaternion."""
    rng = np.random.default_rng(1)
    for side in ("stylus", "camera"):
        text = ""
        for place in rng.uniform(100, 400, (12, 3)):
            axes = "".join(f"<{a}>{v!r}</{a}>" for a, v in zip("xyz", place.tolist(), strict=True))
            w, x, y = rng.uniform(-0.6, 0.6, 3).tolist()
            cells = "".join(f"<Element>{v!r}</Element>" for v in (w, x, y, w, y, 0.7, w, x, -0.3))
            text += f"<Capture><Position>{axes}</Position><Rotation>{cells}</Rotation></Capture>"
        write(tmp_path / f"in/{side}_captures.xml", f"<?xml version='1.0'?><All>{text}</All>")
    said = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand")
    said = said.refused().err
    assert "stylus_captures.Rotation.Element are called rotations, and are none" in said
    assert "Record the robot's rotations" not in said


def test_a_folder_of_pose_pairs_has_no_pictures(tmp_path):
    robot, seen = a_calibrated_pair(9)
    (tmp_path / "in").mkdir()
    np.savez(tmp_path / "in/pairs.npz", robot=robot, camera=seen)
    said = visioncal("calibrate", tmp_path / "in", "-o", tmp_path / "out").refused().err
    assert "A folder's poses of robot and target become a session" in said
    np.savez(tmp_path / "in/pictures.npz", images=np.zeros((9, 400, 600), np.uint8))
    said = visioncal("calibrate", tmp_path / "in", "-o", tmp_path / "out").refused().err
    assert "A folder's pictures and poses become a session" in said


def test_depth_in_floats_is_in_metres(tmp_path):
    shoot(tmp_path / "in", "rgb_{}.png", 5)
    rows = [{"image": f"rgb_{at}.png", "T": p.tolist()} for at, p in enumerate(matrices(5), 1)]
    write(tmp_path / "in/poses.json", rows)
    for at in range(1, 6):
        cv2.imwrite(str(tmp_path / f"in/depth_{at}.tiff"), np.full((72, 128), 0.9, np.float32))
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *BOARD).good()
    assert "it is the views' depth, in metres unless" in done.err


def test_joints_behind_their_count_are_read(tmp_path):
    """As RobWork prints them; without pictures, what is there is said."""
    joints = np.random.default_rng(2).uniform(-2, 2, (7, 6)).round(6)
    rows = (f"Q[6]{{{', '.join(map(repr, row))}}}   " for row in joints.tolist())
    write(tmp_path / "autopose.txt", "\n".join(rows))
    fields = read_fields(tmp_path / "autopose.txt")
    assert joint_names(fields, ()) == ("Q",)
    np.testing.assert_array_equal(fields.numbers["Q"], joints)
    refused = visioncal("convert", tmp_path / "autopose.txt", tmp_path / "out", *BOARD[2:])
    refused.refused("has 7 joint angles of the robot, but neither images nor poses")


def test_pixels_beside_touched_points_are_named(tmp_path):
    numbers = np.random.default_rng(3).uniform(100, 900, (9, 5)).round(2).tolist()
    write(tmp_path / "touched.csv", "u,v,x,y,z\n" + "\n".join(str(row)[1:-1] for row in numbers))
    refused = visioncal("convert", tmp_path / "touched.csv", tmp_path / "out", *BOARD[2:])
    refused.refused("u, v and x, y, z are pixels and places of 9 points", "record --page")
