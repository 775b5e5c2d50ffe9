"""Recordings of others: each form gives the same poses, and what is missing is named."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from support.foreign_samples import (
    BASE_FROM_FLANGE,
    CAM_FROM_TARGET,
    RECORDINGS,
    easy_handeye,
    images_and_table,
    industrial,
    kuka_csv,
    quaternions,
)
from support.refusals import raised

import visioncal
from visioncal.core.conventions import Reading
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import exp, invert, pose_difference
from visioncal.interchange.formats import ImportOptions, PoseImportOptions, convert, read_foreign
from visioncal.interchange.formats.intrinsics import read_intrinsics
from visioncal.session import Session
from visioncal.session.columns import POSE


def poses_of(session, name):
    poses = [getattr(view, name)() for view in session.views]
    return None if poses[0] is None else np.array([pose.as_matrix() for pose in poses])


@pytest.mark.parametrize("make", RECORDINGS.values(), ids=RECORDINGS.keys())
def test_every_form_gives_the_same_poses(make, tmp_path):
    recording = make(tmp_path / "in")
    convert(recording.source, tmp_path / "out", requested=recording.requested)
    session = Session.load(tmp_path / "out")
    robot, camera = poses_of(session, "base_from_flange"), poses_of(session, "cam_from_target")
    assert robot is not None or camera is not None
    assert camera is not None or all(view.image for view in session.views)
    # Two roundings of a double: once through the writer's form, once through a quaternion.
    if robot is not None:
        np.testing.assert_allclose(robot, BASE_FROM_FLANGE, atol=1e-14)
    if camera is not None:
        np.testing.assert_allclose(camera, CAM_FROM_TARGET, atol=1e-14)
    # What the user says of poses is applied in every form.
    plain = read_foreign(recording.source, recording.requested)
    said = {
        whose: replace(getattr(recording.requested, whose), unit="cm", inverse=whose == "robot")
        for whose in ("robot", "camera")
    }
    read = read_foreign(recording.source, replace(recording.requested, **said))
    for whose, requested in said.items():
        before, after = getattr(plain, whose), getattr(read, whose)
        if before is not None and before.present.any():
            assert after.reading == Reading(before.reading.rotation, "cm", requested.inverse)
            np.testing.assert_array_equal(after.positions, before.positions)


def test_what_a_form_says_besides_poses_is_kept(tmp_path):
    recording = industrial(tmp_path / "in")
    session = convert(recording.source, tmp_path / "out", requested=recording.requested)
    assert session.mount == "eye-in-hand"
    assert (session.target.columns, session.target.rows) == (5, 7)
    assert session.target.dictionary == "DICT_6X6_250"
    assert session.resolution == (64, 48)  # from the images, which the source does not describe
    assert any("no distortion" in warning for warning in session.warnings)
    estimated = replace(recording.requested, intrinsics="estimate")
    assert convert(recording.source, tmp_path / "free", requested=estimated).camera is None


def test_the_samples_of_a_camera_on_the_base_are_inverted(tmp_path):
    recording = easy_handeye(tmp_path / "in")
    requested = replace(recording.requested, mount="eye-to-hand")
    session = convert(recording.source, tmp_path / "out", requested=requested)
    # One inversion in double precision.
    np.testing.assert_allclose(
        poses_of(session, "base_from_flange"), invert(BASE_FROM_FLANGE), atol=1e-14
    )
    as_is = replace(requested, robot=PoseImportOptions(inverse=False))
    session = convert(recording.source, tmp_path / "as is", requested=as_is)
    np.testing.assert_allclose(poses_of(session, "base_from_flange"), BASE_FROM_FLANGE, atol=1e-14)


def test_samples_that_say_where_the_camera_is_need_no_mount(tmp_path):
    recording = easy_handeye(tmp_path / "in")
    text = recording.source.read_text()
    recording.source.write_text("parameters: {calibration_type: eye_on_base}\n" + text)
    session = convert(recording.source, tmp_path / "out")
    assert session.mount == "eye-to-hand"
    np.testing.assert_allclose(
        poses_of(session, "base_from_flange"), invert(BASE_FROM_FLANGE), atol=1e-14
    )


def test_samples_are_found_in_their_folder_with_the_mount_beside_them(tmp_path):
    recording = easy_handeye(tmp_path / "in")
    result = recording.source.with_suffix(".calib")
    result.write_text("parameters: {calibration_type: eye_in_hand}\n")
    session = convert(tmp_path / "in", tmp_path / "out")
    assert session.mount == "eye-in-hand"
    # As the services of ROS 1 have them: a list each, here below a header.
    samples = yaml.safe_load(recording.source.read_text())["samples"]
    lists = {
        name: {"header": {"seq": 0}, "transforms": [sample[part] for sample in samples]}
        for name, part in (("hand_world_samples", "robot"), ("camera_marker_samples", "tracking"))
    }
    (tmp_path / "samples.yaml").write_text(yaml.safe_dump({"samples": lists}))
    again = convert(
        tmp_path / "samples.yaml", tmp_path / "again", requested=ImportOptions(mount="eye-in-hand")
    )
    for name in ("base_from_flange", "cam_from_target"):
        np.testing.assert_array_equal(poses_of(again, name), poses_of(session, name))


def test_columns_that_only_sound_like_ours_get_another_name(tmp_path):
    robot, camera = quaternions(BASE_FROM_FLANGE).tolist(), quaternions(CAM_FROM_TARGET).tolist()
    own = ["a", "b", "c", "d", "e", "f", "g"]
    extra = {"role": "tester", "stop": "emergency", "temp1_c": "warm", "camera": "", "q1_rad": "1"}
    text = ",".join([*own, *(f"cft_{name}" for name in POSE), *extra, "group"]) + "\n"
    for at, row in enumerate(np.hstack([robot, camera]).tolist()):
        cells = [*map(repr, row), *(extra | {"camera": f"cam {at % 2}"}).values(), "warm-up"]
        text += ",".join(cells) + "\n"
    (tmp_path / "log.csv").write_text(text)
    requested = ImportOptions(
        mount="eye-in-hand", robot=PoseImportOptions(tuple(own), unit="m"), joints=("a",)
    )
    session = convert(tmp_path / "log.csv", tmp_path / "out", requested=requested)
    assert {f"source_{name}" for name in extra} < set(session.columns)
    assert session.views[0].text["group"] == "warm-up"
    assert session.views[0].text["source_role"] == "tester"


@pytest.mark.parametrize(
    ("requested", "words"),
    [
        ({"robot": PoseImportOptions(("X", "Y", "Q"))}, "it has X, Y, Z, A, B, C"),
        ({"robot": PoseImportOptions(("X", "Y", "Z", "A", "B", "operator"))}, "holds 'Ann'"),
        ({"robot": PoseImportOptions(("X", "Y", "Z", "A", "B", "C"), form="kuko")}, "kuka"),
        ({"robot": PoseImportOptions(("X", "Y", "Z", "A", "B", "C"), unit="feet")}, "m, cm, mm"),
        ({"mount": None}, "--mount"),
        ({"target": "chekerboard_9x6_25mm"}, "checkerboard_9x6_23.6mm"),
        ({"intrinsics": "no such file.yaml"}, "does not exist"),
    ],
)
def test_mistakes_are_answered_with_what_there_is(tmp_path, requested, words):
    recording = kuka_csv(tmp_path / "in")
    with pytest.raises(DataError) as caught:
        convert(
            recording.source, tmp_path / "out", requested=replace(recording.requested, **requested)
        )
    assert words in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_the_offset_of_two_clocks_is_found(tmp_path):
    ahead_s = 0.337
    robot_s, camera_s = np.arange(0, 12, 0.01), np.arange(0.5, 11.5, 1 / 30)
    columns = "t,x,y,z,qx,qy,qz,qw"
    world = {
        "robot": (robot_s, swung(robot_s) @ FLANGE_FROM_CAM_BACK),
        "camera": (camera_s + ahead_s, invert(swung(camera_s)) @ TARGET),
    }
    for name, (stamps, poses) in world.items():
        rows = np.hstack([stamps[:, None], quaternions(poses)])
        np.savetxt(
            tmp_path / f"{name}.csv", rows, "%.17g", delimiter=",", header=columns, comments=""
        )
    requested = ImportOptions(mount="eye-in-hand", camera_file=tmp_path / "camera.csv")
    session = convert(tmp_path / "robot.csv", tmp_path / "out", requested=requested)
    # All of both streams is kept as it was, and nothing is stated of the clocks.
    assert len(session.views) == len(camera_s)
    np.testing.assert_array_equal(session.streams["robot"].stamps_s, robot_s)
    assert not session.declaration.clock.model_fields_set
    result = visioncal.calibrate(session)
    # What cubics between samples of 100 Hz leave.
    assert result.clock.camera_minus_robot_s == pytest.approx(ahead_s, abs=1e-6)
    away = pose_difference(result.edges["flange_from_cam"].matrix, invert(FLANGE_FROM_CAM_BACK))
    assert max(away) < 1e-4


def test_two_files_of_stops_with_the_same_times_are_rows(tmp_path):
    stamps = 6.0 * np.arange(len(BASE_FROM_FLANGE))
    for name, poses in (("robot", BASE_FROM_FLANGE), ("camera", CAM_FROM_TARGET)):
        np.savetxt(tmp_path / f"{name}.txt", np.hstack([stamps[:, None], quaternions(poses)]))
    requested = ImportOptions(mount="eye-in-hand", camera_file=tmp_path / "camera.txt")
    session = convert(tmp_path / "robot.txt", tmp_path / "out", requested=requested)
    assert not session.streams
    for name, poses in (
        ("base_from_flange", BASE_FROM_FLANGE),
        ("cam_from_target", CAM_FROM_TARGET),
    ):
        np.testing.assert_allclose(poses_of(session, name), poses, atol=1e-14)


def test_streams_of_different_motions_are_refused(tmp_path):
    stamps = np.arange(0, 30, 0.02)
    for name, poses in (("robot", swung(stamps)), ("camera", swung(1.7 * stamps + 3))):
        rows = np.hstack([stamps[:, None], quaternions(poses)])
        np.savetxt(tmp_path / f"{name}.txt", rows, "%.17g")
    requested = ImportOptions(mount="eye-in-hand", camera_file=tmp_path / "camera.txt")
    session = convert(tmp_path / "robot.txt", tmp_path / "out", requested=requested)
    raised(DegenerateError, "of the same motion", visioncal.calibrate, session)


FLANGE_FROM_CAM_BACK = exp(np.array([0.1, -0.2, 1.5, 0.05, 0.01, 0.08]))
TARGET = exp(np.array([0.3, 0.1, 0.2, 0.5, 0.1, 0.9]))


def swung(times_s):
    """A camera that swings about all axes, never twice alike within a minute: (n, 4, 4)."""
    rates = np.array([0.31, 0.47, 0.73, 0.21, 0.37, 0.53])
    sizes = np.array([0.4, 0.5, 0.7, 0.1, 0.1, 0.1])
    return exp(np.sin(2 * np.pi * rates * times_s[:, None] + np.arange(6)) * sizes)


LENSES = {
    "ros.yaml": "image_width: 640\nimage_height: 480\ncamera_name: x\ndistortion_model: plumb_bob\n"
    "camera_matrix: {rows: 3, cols: 3, data: [500.5, 0, 320, 0, 501, 240, 0, 0, 1]}\n"
    "distortion_coefficients: {rows: 1, cols: 5, data: [-0.25, 0.125, 0, 0, 0.5]}\n",
    "opencv.yml": "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
    "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [ 500.5, 0., 320., 0., 501., 240., 0., 0., 1. ]\n"
    "distortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n"
    "   data: [ -0.25, 0.125, 0., 0., 5.0e-1 ]\n",
    "opencv.xml": '<?xml version="1.0"?><opencv_storage><width>640</width><height>480</height>'
    '<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt><data>500.5 0. '
    '320. 0. 501. 240. 0. 0. 1.</data></camera_matrix><dist type_id="opencv-matrix"><rows>1</rows>'
    "<cols>5</cols><dt>f</dt><data>-0.25 0.125 0. 0. 0.5</data></dist></opencv_storage>",
    "opencv.json": '{"width": 640, "height": 480, "K": {"type_id": "opencv-matrix", "rows": 3, '
    '"cols": 3, "dt": "d", "data": [500.5, 0, 320, 0, 501, 240, 0, 0, 1]}, '
    '"D": [[-0.25, 0.125, 0, 0, 0.5]]}',
    "kalibr.yaml": "cam0:\n  camera_model: pinhole\n  intrinsics: [500.5, 501.0, 320.0, 240.0]\n"
    "  distortion_model: radtan\n  distortion_coeffs: [-0.25, 0.125, 0.0, 0.0]\n"
    "  resolution: [640, 480]\n",
}


@pytest.mark.parametrize("name", LENSES)
def test_intrinsics_of_others(tmp_path, name):
    (tmp_path / name).write_text(LENSES[name])
    lens, notes = read_intrinsics(tmp_path / name)
    assert not notes
    assert lens["model"] == "brown"
    assert lens["matrix"] == [500.5, 501, 320, 240]
    assert lens["distortion"][:4] == [-0.25, 0.125, 0, 0]
    assert lens["distortion"][4] == (0 if name == "kalibr.yaml" else 0.5)
    assert lens["resolution"] == [640, 480]


def test_intrinsics_of_numpy_and_of_a_fisheye(tmp_path):
    matrix = [[500.5, 0, 320], [0, 501, 240], [0, 0, 1]]
    np.savez(tmp_path / "lens.npz", cameraMatrix=matrix, distCoeffs=[[-0.25, 0.125, 0, 0, 0.5]])
    assert read_intrinsics(tmp_path / "lens.npz")[0]["distortion"] == [-0.25, 0.125, 0, 0, 0.5]
    text = LENSES["kalibr.yaml"].replace("radtan", "equidistant")
    (tmp_path / "fisheye.yaml").write_text(text)
    assert read_intrinsics(tmp_path / "fisheye.yaml")[0]["model"] == "fisheye"
    (tmp_path / "omni.yaml").write_text(text.replace("pinhole", "omni"))
    raised(DataError, "pinhole is needed", read_intrinsics, tmp_path / "omni.yaml")


def test_as_many_images_as_poses_are_needed(tmp_path):
    recording = images_and_table(tmp_path / "in")
    (recording.source / "shot5.png").unlink()
    with pytest.raises(DataError, match=r"8 images \(shot0.png ... shot8.png\).* 9 poses"):
        convert(recording.source, tmp_path / "out", requested=recording.requested)
    assert not (tmp_path / "out").exists()


def test_without_names_the_fields_are_listed(tmp_path):
    (tmp_path / "log.csv").write_text("alpha,beta\n1,2\n3,4\n")
    with pytest.raises(DataError, match="it has alpha, beta"):
        convert(
            tmp_path / "log.csv", tmp_path / "out", requested=ImportOptions(mount="eye-in-hand")
        )
