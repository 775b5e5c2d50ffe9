"""Sessions from sessions and from recordings of others: each form gives the same poses."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from support.commands import visioncal as typed
from support.following import follow
from support.foreign_samples import (
    BASE_FROM_FLANGE,
    CAM_FROM_TARGET,
    CHARUCO,
    COUNT,
    RECORDINGS,
    easy_handeye,
    images_and_table,
    industrial,
    kuka_csv,
    picture,
    quaternions,
    streams,
    vectors,
)
from support.problems import swung
from support.refusals import raised
from support.samples import made_up

import visioncal
from visioncal.calibration.run import calibrate
from visioncal.core.conventions import POSE_FORMS, PoseNumbers, Reading, write_pose
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import exp, invert, pose_difference
from visioncal.interchange.formats import (
    ImportOptions,
    PoseImportOptions,
    assemble,
    convert,
    read_foreign,
)
from visioncal.interchange.formats.file_search import files_in, head
from visioncal.interchange.formats.intrinsics import read_intrinsics
from visioncal.interchange.formats.pairing import images_named
from visioncal.session import Session
from visioncal.session.columns import POSE

HAND = ImportOptions(mount="eye-in-hand")


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


def test_positions_that_are_too_far_are_millimetres_whatever_the_form(tmp_path):
    """A UR's form is in metres; its poses were written in millimetres."""
    rows = vectors(BASE_FROM_FLANGE) * [1e3, 1e3, 1e3, 1, 1, 1]
    text = "\n".join(",".join(map(repr, row)) for row in rows.tolist())
    (tmp_path / "poses.csv").write_text(f"x,y,z,rx,ry,rz\n{text}\n", encoding="utf-8")
    for unit, read in ((None, "mm"), ("m", "m")):
        requested = ImportOptions(robot=PoseImportOptions(form="ur", unit=unit))
        assert read_foreign(tmp_path / "poses.csv", requested).robot.reading.unit == read


def test_content_beside_the_poses_is_kept(tmp_path):
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
    sessions = [convert(recording.source, tmp_path / "out", requested=requested)]
    as_is = replace(requested, robot=PoseImportOptions(inverse=False))
    session = convert(recording.source, tmp_path / "as is", requested=as_is)
    np.testing.assert_allclose(poses_of(session, "base_from_flange"), BASE_FROM_FLANGE, atol=1e-14)
    # Samples that say where the camera is need no mount.
    text = recording.source.read_text()
    recording.source.write_text("parameters: {calibration_type: eye_on_base}\n" + text)
    sessions.append(convert(recording.source, tmp_path / "said"))
    for session in sessions:
        found = poses_of(session, "base_from_flange")
        assert session.mount == "eye-to-hand"
        # One inversion in double precision.
        np.testing.assert_allclose(found, invert(BASE_FROM_FLANGE), atol=1e-14)


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
    again = convert(tmp_path / "samples.yaml", tmp_path / "again", requested=HAND)
    for name in ("base_from_flange", "cam_from_target"):
        np.testing.assert_array_equal(poses_of(again, name), poses_of(session, name))


def test_columns_that_only_sound_like_ours_get_another_name(tmp_path):
    robot, camera = quaternions(BASE_FROM_FLANGE).tolist(), quaternions(CAM_FROM_TARGET).tolist()
    robot_names = ["a", "b", "c", "d", "e", "f", "g"]
    extra = {"role": "tester", "stop": "emergency", "temp1_c": "warm", "camera": "", "q1_rad": "1"}
    text = ",".join([*robot_names, *(f"cft_{name}" for name in POSE), *extra, "group"]) + "\n"
    for at, row in enumerate(np.hstack([robot, camera]).tolist()):
        cells = [*map(repr, row), *(extra | {"camera": f"cam {at % 2}"}).values(), "warm-up"]
        text += ",".join(cells) + "\n"
    (tmp_path / "log.csv").write_text(text)
    requested = ImportOptions(
        mount="eye-in-hand", robot=PoseImportOptions(tuple(robot_names), unit="m"), joints=("a",)
    )
    session = convert(tmp_path / "log.csv", tmp_path / "out", requested=requested)
    assert {f"source_{name}" for name in extra} < set(session.columns)
    assert session.views[0].text["group"] == "warm-up"
    assert session.views[0].text["source_role"] == "tester"


@pytest.mark.parametrize(
    ("requested", "words"),
    [
        ({"robot": PoseImportOptions(("X", "Y", "Q"))}, "it has X, Y, Z, A, B, C"),
        ({"robot": PoseImportOptions(("X", "Y", "Z", "A", "B", "operator"))}, "is 'Ann'"),
        ({"robot": PoseImportOptions(("X", "Y", "Z", "A", "B", "C"), form="kuko")}, "kuka"),
        ({"robot": PoseImportOptions(("X", "Y", "Z", "A", "B", "C"), unit="feet")}, "m, mm, cm"),
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


@pytest.mark.slow
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
    requested = replace(HAND, camera_file=tmp_path / "camera.csv")
    session = convert(tmp_path / "robot.csv", tmp_path / "out", requested=requested)
    # All of both streams is kept as it was, and nothing is stated of the clocks.
    assert len(session.views) == len(camera_s)
    np.testing.assert_array_equal(session.streams["robot"].stamps_s, robot_s)
    assert session.declaration.clock.camera_minus_robot_s is None
    result = visioncal.calibrate(session)
    # What cubics between samples of 100 Hz leave.
    assert result.clock.camera_minus_robot_s == pytest.approx(ahead_s, abs=1e-6)
    away = pose_difference(result.edges["flange_from_cam"].matrix, invert(FLANGE_FROM_CAM_BACK))
    assert max(away) < 1e-4


def test_two_files_of_stops_with_the_same_times_are_rows(tmp_path):
    stamps = 6.0 * np.arange(len(BASE_FROM_FLANGE))
    for name, poses in (("robot", BASE_FROM_FLANGE), ("camera", CAM_FROM_TARGET)):
        np.savetxt(tmp_path / f"{name}.txt", np.hstack([stamps[:, None], quaternions(poses)]))
    requested = replace(HAND, camera_file=tmp_path / "camera.txt")
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
    requested = replace(HAND, camera_file=tmp_path / "camera.txt")
    session = convert(tmp_path / "robot.txt", tmp_path / "out", requested=requested)
    raised(DegenerateError, "of the same motion", visioncal.calibrate, session)


FLANGE_FROM_CAM_BACK = exp(np.array([0.1, -0.2, 1.5, 0.05, 0.01, 0.08]))
TARGET = exp(np.array([0.3, 0.1, 0.2, 0.5, 0.1, 0.9]))


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
    "realsense.json": '{"width": 640, "height": 480, "ppx": 320.0, "ppy": 240.0, "fx": 500.5, '
    '"fy": 501.0, "model": "distortion.brown_conrady", "coeffs": [-0.25, 0.125, 0, 0, 0.5]}',
    "zivid.yml": "CameraIntrinsics:\n  CameraMatrix: {CX: 320, CY: 240, FX: 500.5, FY: 501}\n"
    "  Distortion: {K1: -0.25, K2: 0.125, K3: 0.5, P1: 0, P2: 0}\n  Resolution: [640, 480]\n",
    "within.json": '{"intrinsics": {"width": 640, "height": 480, "fx": 500.5, "fy": 501, '
    '"cx": 320, "cy": 240, "distortion": [-0.25, 0.125, 0, 0, 0.5]}}',
    "beside.json": '{"intrinsics": {"width": 640, "height": 480, "fx": 500.5, "fy": 501, '
    '"cx": 320, "cy": 240}, "distortion": [-0.25, 0.125, 0, 0, 0.5]}',
    "named.json": '{"Width": 640, "Height": 480, "cameraMatrix": {"fx": 500.5, "fy": 501, '
    '"cx": 320, "cy": 240}, "distCoeffs": {"k1": -0.25, "k2": 0.125, "p1": 0, "p2": 0, "k3": 0.5}}',
}


@pytest.mark.parametrize("name", LENSES)
def test_intrinsics_of_other_programs_are_read(tmp_path, name):
    (tmp_path / name).write_text(LENSES[name])
    lens, notes = read_intrinsics(tmp_path / name)
    assert not notes
    assert lens["model"] == "brown"
    assert lens["matrix"] == [500.5, 501, 320, 240]
    assert lens["distortion"][:4] == [-0.25, 0.125, 0, 0]
    assert lens["distortion"][4] == (0 if name == "kalibr.yaml" else 0.5)
    assert lens["resolution"] == [640, 480]


def test_intrinsics_of_numpy_and_of_a_fisheye_are_read(tmp_path):
    matrix = [[500.5, 0, 320], [0, 501, 240], [0, 0, 1]]
    np.savez(tmp_path / "lens.npz", cameraMatrix=matrix, distCoeffs=[[-0.25, 0.125, 0, 0, 0.5]])
    assert read_intrinsics(tmp_path / "lens.npz")[0]["distortion"] == [-0.25, 0.125, 0, 0, 0.5]
    # A matrix alone, and numbers alone.
    np.save(tmp_path / "k.npy", matrix)
    assert read_intrinsics(tmp_path / "k.npy")[0]["matrix"] == [500.5, 501, 320, 240]
    np.savetxt(tmp_path / "k.txt", np.ravel([*np.ravel(matrix), -0.25, 0.125, 0, 0, 0.5]))
    assert read_intrinsics(tmp_path / "k.txt")[0]["distortion"] == [-0.25, 0.125, 0, 0, 0.5]
    text = LENSES["kalibr.yaml"].replace("radtan", "equidistant")
    (tmp_path / "fisheye.yaml").write_text(text)
    assert read_intrinsics(tmp_path / "fisheye.yaml")[0]["model"] == "fisheye"
    (tmp_path / "omni.yaml").write_text(text.replace("pinhole", "omni"))
    raised(
        DataError,
        "must have the camera matrix of a pinhole",
        read_intrinsics,
        tmp_path / "omni.yaml",
    )


def test_numbers_or_images_say_which_pose_has_no_image(tmp_path):
    recording = images_and_table(tmp_path / "in")
    (recording.source / "shot5.png").unlink()
    session = convert(recording.source, tmp_path / "one", requested=recording.requested)
    assert [view.image for view in session.views][4:6] == ["images/shot4.png", "images/shot6.png"]
    (recording.source / "shot8.png").unlink()
    with pytest.raises(DataError, match=r"7 images \(shot0.png ... shot7.png\).* 9 poses"):
        convert(recording.source, tmp_path / "out", requested=recording.requested)
    assert not (tmp_path / "out").exists()


def test_without_names_the_fields_are_listed(tmp_path):
    (tmp_path / "log.csv").write_text("alpha,beta\n1,2\n3,4\n")
    with pytest.raises(DataError, match="numbers alpha, beta"):
        convert(tmp_path / "log.csv", tmp_path / "out", requested=HAND)


SEEN = replace(HAND, target=CHARUCO)
CAMERA = "cft_x_m,cft_y_m,cft_z_m,cft_qx,cft_qy,cft_qz,cft_qw"
ORDER = [4, 0, 7, 2, 8, 1, 6, 3, 5]


def written(form):
    """The robot's poses as a maker writes them."""
    return np.array([write_pose(value, form) for value in BASE_FROM_FLANGE])


@pytest.fixture
def table(tmp_path):
    """Writes a table with a header, or without where that is empty."""

    def write(header, rows, name="log.csv"):
        lines = [",".join(map(str, row)) for row in rows]
        (tmp_path / name).write_text("\n".join([header] * bool(header) + lines))
        return tmp_path / name

    return write


@pytest.fixture
def logged(table):
    """Writes poses of the robot under these names beside the camera's."""

    def write(names, poses):
        camera = quaternions(CAM_FROM_TARGET).tolist()
        return table(f"{names},{CAMERA}", [[*a, *b] for a, b in zip(poses, camera, strict=True)])

    return write


@pytest.fixture
def rows(tmp_path):
    """Writes rows as a list of JSON: what `fields(at)` gives for each of the world's poses."""

    def write(fields):
        (tmp_path / "log.json").write_text(json.dumps([fields(at) for at in range(COUNT)]))
        return tmp_path / "log.json"

    return write


@pytest.mark.parametrize("header", ["nr,Bild,x,y,z,qx,qy,qz,qw", ""], ids=["named", "headerless"])
@pytest.mark.parametrize("ending", [".png", ""], ids=["whole name", "stem"])
def test_a_column_that_names_images_pairs_them(tmp_path, table, header, ending):
    for at in range(COUNT):
        picture(tmp_path / f"images/a{at}b.png")
    poses = quaternions(BASE_FROM_FLANGE).tolist()
    source = table(header, [[at + 1, f"a{at}b{ending}", *poses[at]] for at in ORDER])
    names = () if header else tuple("3456789")
    requested = replace(SEEN, images=tmp_path / "images", robot=PoseImportOptions(names))
    foreign = read_foreign(source, requested)
    assert [image.name for image in foreign.images] == [f"a{at}b.png" for at in ORDER]
    assert foreign.stamps_s is None
    assert not any("in order" in note for note in foreign.notes)


@pytest.mark.parametrize(
    ("names", "form"), [("X,Y,Z,A,B,C", "kuka"), ("X,Y,Z,W,P,R", "fanuc"), ("x,y,z,rx,ry,rz", "ur")]
)
def test_angles_beyond_a_turn_are_read_as_the_target_s_poses_have_them(
    tmp_path, logged, names, form
):
    degrees = np.rad2deg(1) if form == "ur" else 1.0
    poses = written(POSE_FORMS[form]) * [1, 1, 1, degrees, degrees, degrees]
    source = logged(names, poses.tolist())
    session = convert(source, tmp_path / "out", requested=HAND)
    assert any("Found by the poses: With the robot's rot" in note for note in session.warnings)
    np.testing.assert_allclose(poses_of(session, "base_from_flange"), BASE_FROM_FLANGE, atol=1e-9)
    # Too few rows to tell.
    source.write_text("\n".join(source.read_text().splitlines()[:4]))
    with pytest.raises(DataError, match=r"form of the robot's rotations is not.*--robot-form"):
        convert(source, tmp_path / "few", requested=HAND)
    assert not (tmp_path / "few").exists()
    said = PoseImportOptions(form="rotation-vector-deg" if form == "ur" else form)
    convert(source, tmp_path / "few", requested=replace(HAND, robot=said))


@pytest.mark.parametrize(
    ("form", "unit"),
    # Millimetres are found by their size.
    [("ur", 1.0), ("ur", 1e3), ("rpy", 1.0), ("rotation-vector", 1.0)],
)
def test_degrees_in_a_form_of_radians_are_named_first(tmp_path, logged, monkeypatch, form, unit):
    monkeypatch.chdir(tmp_path)
    names = "x,y,z,roll,pitch,yaw" if form == "rpy" else "x,y,z,rx,ry,rz"
    poses = written(POSE_FORMS.get(form, POSE_FORMS["ur"])) * np.repeat([unit, np.rad2deg(1)], 3)
    logged(names, poses.tolist())
    followed = follow("convert", "log.csv", "out", "--mount", "eye-in-hand", "--robot-form", form)
    degrees = "rpy-deg" if form == "rpy" else "rotation-vector-deg"
    assert f"\nGive --robot-form {degrees}, where" in followed.runs[0].refused().err
    followed.last.good()
    found = poses_of(Session.load("out"), "base_from_flange")
    np.testing.assert_allclose(found, BASE_FROM_FLANGE, atol=1e-9)


@pytest.mark.parametrize(("name", "word"), [("log.csv", "columns"), ("log.json", "key")])
def test_poses_of_unknown_names_are_asked_for_by_the_option_of_the_source(tmp_path, name, word):
    rows = [{"foo": at, "bar": 2 * at} for at in range(4)]
    text = json.dumps(rows) if word == "key" else "foo,bar\n1,2\n3,4\n"
    (tmp_path / name).write_text(text)
    step = f"Name them with --robot-{word}, or the joint angles with --joint-{word}."
    assert raised(DataError, "foo", convert, tmp_path / name, tmp_path / "out").next_step == step


# Names in a maker's own letters, and in others.
NAMES = [
    ("fanuc", "X,Y,Z,W,P,R"),
    ("abb", "x,y,z,q1,q2,q3,q4"),
    ("abb", "x,y,z,qw,qx,qy,qz"),
    ("yaskawa", "x,y,z,Rx,Ry,Rz"),
    ("doosan", "x,y,z,a,b,c"),
    ("kuka", "X,Y,Z,A,B,C"),
    ("xarm", "x,y,z,roll,pitch,yaw"),
    ("mecademic", "x,y,z,alpha,beta,gamma"),
    ("kawasaki", "X,Y,Z,O,A,T"),
    ("comau", "X,Y,Z,A,E,R"),
    ("epson", "X,Y,Z,U,V,W"),
    ("realman", "x,y,z,rx,ry,rz"),
    ("rpy-deg", "x,y,z,roll,pitch,yaw"),
]


@pytest.mark.parametrize(("form", "names"), NAMES)
def test_the_names_of_makers_are_known(logged, form, names):
    source = logged(names, written(POSE_FORMS[form]).tolist())
    requested = replace(HAND, robot=PoseImportOptions(form=form))
    found = read_foreign(source, requested).robot.poses()
    # One conversion to the maker's form and back, near a singularity of none.
    np.testing.assert_allclose(found, BASE_FROM_FLANGE, atol=1e-12)


@pytest.mark.parametrize("form", ["franka", "matrix-transposed", "matrix", None])
def test_sixteen_numbers_are_read_by_columns_where_stated(logged, form):
    names = tuple(f"m{at}" for at in range(16))
    by_columns = BASE_FROM_FLANGE.transpose(0, 2, 1).reshape(-1, 16)
    source = logged(",".join(names), by_columns.tolist())
    foreign = read_foreign(source, replace(HAND, robot=PoseImportOptions(names, form)))
    # To rounding.
    np.testing.assert_allclose(foreign.robot.poses(), BASE_FROM_FLANGE, atol=1e-12)
    # Franka's are in metres.
    assert any("robot's positions are taken for metres" in note for note in foreign.notes) == (
        form != "franka"
    )


@pytest.mark.parametrize(("step", "timed"), [(1, False), (0.5, True)])
def test_numbers_of_rows_are_no_times(table, step, timed):
    pairs = zip(quaternions(BASE_FROM_FLANGE), quaternions(CAM_FROM_TARGET), strict=True)
    source = table("", [[1 + step * at, *a, *b] for at, (a, b) in enumerate(pairs)])
    foreign = read_foreign(source, HAND)
    assert (foreign.stamps_s is not None) == timed
    assert any("Column 1 is taken for times" in note for note in foreign.notes) == timed


@pytest.mark.parametrize(
    ("name", "count", "degrees", "noted"),
    [
        ("J{}", 6, False, False),
        ("joint_{}_deg", 5, True, False),
        ("a{} [deg]", 6, True, False),
        ("J{} [°]", 6, True, False),
        ("joint_positions_degrees", 0, True, False),
        # Too large for radians.
        ("joints", 0, True, True),
        # They may as well be a quaternion.
        ("q{}", 4, None, False),
    ],
)
def test_joints_are_known_by_their_names_and_sizes(rows, name, count, degrees, noted):
    joints = np.linspace(-0.5, 2.9, COUNT * 6).reshape(-1, 6)[:, : count or 6]
    names, written = [name.format(at) for at in range(1, count + 1)], joints.tolist()
    if degrees:
        written = np.rad2deg(joints).tolist()

    def fields(at):
        angles = dict(zip(names, written[at], strict=True)) if count else {name: written[at]}
        return angles | {"robot": BASE_FROM_FLANGE[at].tolist()}

    found = read_foreign(rows(fields), HAND)
    assert any("are no radians, and are taken" in note for note in found.notes) == noted
    if degrees is None:
        assert found.joints_rad is None
    else:
        np.testing.assert_allclose(found.joints_rad, joints)


@pytest.mark.parametrize("unit", ["[deg]", "[°]", "(º)"])
def test_angles_of_poses_are_in_the_degrees_of_their_header(table, unit):
    header = ",".join(["X [mm]", "Y [mm]", "Z [mm]", *(f"{name} {unit}" for name in "ABC")])
    source = table(header, written(POSE_FORMS["kuka"]).tolist())
    requested = PoseImportOptions(form="kuka")
    found = read_foreign(source, replace(HAND, robot=requested))
    np.testing.assert_allclose(found.robot.poses(), BASE_FROM_FLANGE, atol=1e-6)


def vector(pose):
    """Its rvec and tvec, as OpenCV's functions return them."""
    numbers = vectors(pose[None])[0].tolist()
    return {"rvec": numbers[3:], "tvec": numbers[:3]}


def test_the_stated_form_of_a_stream_applies_once(tmp_path):
    recording = streams(tmp_path)
    wanted = read_foreign(recording.source, recording.requested).stream.poses
    table = np.loadtxt(recording.source, delimiter=",")
    poses = PoseNumbers(table[:, 1:4], table[:, 4:], Reading(), tuple(map(str, table[:, 0])))
    written = quaternions(invert(poses.poses())) * ([1e3] * 3 + [1] * 4)
    np.savetxt(recording.source, np.hstack([table[:, :1], written]), "%.12f", delimiter=",")
    said = PoseImportOptions(unit="mm", inverse=True, form="ros")
    found = read_foreign(recording.source, replace(recording.requested, robot=said)).stream.poses
    # Nine digits are written of the original, twelve here.
    np.testing.assert_allclose(found.poses(), wanted.poses(), atol=1e-8)


def test_a_translation_called_t_is_no_time(rows):
    def apart(at):
        pose = BASE_FROM_FLANGE[at]
        return {"R": pose[:3, :3].tolist(), "t": pose[:3, 3].tolist()}

    def single(at):
        # One number a row, but of the robot's pose.
        place = dict(zip("txy", BASE_FROM_FLANGE[at, :3, 3].tolist(), strict=True))
        return place | {"rvec": vector(BASE_FROM_FLANGE[at])["rvec"]}

    for fields, names in ((apart, ("t", "R")), (single, ("t", "x", "y", "rvec"))):
        options = replace(HAND, robot=PoseImportOptions(names))
        assert read_foreign(rows(fields), options).stamps_s is None
    timed = rows(lambda at: {"t": 0.5 * at, "robot_pose": BASE_FROM_FLANGE[at].tolist()})
    assert read_foreign(timed, HAND).stamps_s[2] == 1.0


def test_twelve_numbers_are_read_in_the_order_that_makes_rotations(table):
    """The position first; rows of a matrix are a form of test_foreign's."""
    place, turn = BASE_FROM_FLANGE[:, :3, 3], BASE_FROM_FLANGE[:, :3, :3].reshape(-1, 9)
    columns = [f"a{index}" for index in range(12)]
    source = table(",".join(columns), np.hstack([place, turn]).tolist())
    found = read_foreign(source, replace(HAND, robot=PoseImportOptions(tuple(columns))))
    np.testing.assert_allclose(found.robot.poses(), BASE_FROM_FLANGE, atol=1e-13)


def test_the_robots_fields_are_not_the_cameras_as_well(rows):
    robot_only = rows(lambda at: vector(BASE_FROM_FLANGE[at]))
    requested = replace(HAND, robot=PoseImportOptions(("tvec", "rvec")))
    assert read_foreign(robot_only, requested).camera is None
    two_sides = rows(
        lambda at: {"robot": vector(BASE_FROM_FLANGE[at]), "board": vector(CAM_FROM_TARGET[at])}
    )
    named = replace(HAND, robot=PoseImportOptions(("robot.tvec", "robot.rvec")))
    found = read_foreign(two_sides, named)
    # One conversion to a vector and back, in double precision.
    np.testing.assert_allclose(found.camera.poses(), CAM_FROM_TARGET, atol=1e-14)
    # Of equal names, those under a side's own word are its.
    same = PoseImportOptions(("tvec", "rvec"))
    for whose, poses in (("robot", BASE_FROM_FLANGE), ("camera", CAM_FROM_TARGET)):
        found = getattr(read_foreign(two_sides, replace(HAND, robot=same, camera=same)), whose)
        np.testing.assert_allclose(found.poses(), poses, atol=1e-14)
    other = rows(
        lambda at: {"first": vector(BASE_FROM_FLANGE[at]), "other": vector(CAM_FROM_TARGET[at])}
    )
    with pytest.raises(DataError, match=r"'tvec' may be first\.tvec, other\.tvec"):
        read_foreign(other, replace(HAND, robot=same))


def test_half_a_pose_is_refused_by_its_row(logged):
    robot = quaternions(BASE_FROM_FLANGE).astype(str)
    robot[4, 6] = ""
    source = logged("x,y,z,qx,qy,qz,qw", robot.tolist())
    with pytest.raises(DataError, match=r"log\.csv, line 6: a part of the pose's numbers is"):
        assemble(read_foreign(source, HAND))


@pytest.mark.parametrize("form", ["seven numbers", "a matrix", "seven names"])
def test_an_order_that_nothing_determines_is_reported(rows, form):
    numbers = quaternions(BASE_FROM_FLANGE)
    fields = {
        "seven numbers": lambda at: {"robot_pose": numbers[at].tolist()},
        "a matrix": lambda at: {"robot_pose": BASE_FROM_FLANGE[at].tolist()},
        "seven names": lambda at: {
            name.removesuffix("_m"): value
            for name, value in zip(POSE, numbers[at].tolist(), strict=True)
        },
    }[form]
    notes = " ".join(read_foreign(rows(fields), HAND).notes)
    said = "robot's quaternions are taken for x, y" in notes
    assert said == ("quaternions are taken" in notes) == (form == "seven numbers")


BY_ROWS = [525.0, 0, 319.5, 0, 526, 239.5, 0, 0, 1]
BY_COLUMNS = [525.0, 0, 0, 0, 526, 0, 319.5, 239.5, 1]


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (BY_ROWS, ""),
        (BY_COLUMNS, ""),
        (np.reshape(BY_COLUMNS, (3, 3)).tolist(), ""),
        ([525, 0, 320, 0, 526, 240, 7, 8, 9], "must be the nine numbers"),
        ([525, 0, 320, 0, 526, 240, 0, 0, 0.5], "must be the nine numbers"),
        ([525, 0, 320, 0, -526, 240, 0, 0, 1], "above 0"),
    ],
)
def test_a_camera_matrix_is_read_by_rows_or_by_columns_or_refused(tmp_path, matrix, words):
    (tmp_path / "lens.json").write_text(json.dumps({"intrinsic_matrix": matrix}))
    if words:
        raised(DataError, words, read_intrinsics, tmp_path / "lens.json")
    else:
        assert read_intrinsics(tmp_path / "lens.json")[0]["matrix"] == [525, 526, 319.5, 239.5]


@pytest.mark.parametrize(("model", "noted"), [({}, True), ({"distortion_model": "fisheye"}, False)])
def test_four_coefficients_may_be_a_fisheyes(tmp_path, model, noted):
    document = {"K": BY_ROWS, "D": [-0.01, 0.02, -0.003, 0.001], **model}
    (tmp_path / "lens.json").write_text(json.dumps(document))
    lens, notes = read_intrinsics(tmp_path / "lens.json")
    assert lens["model"] == ("brown" if noted else "fisheye")
    assert bool(notes) == noted


@pytest.fixture
def naming(table):
    """Writes a table whose rows name these images, and reads it."""

    def assembled(*names):
        poses = zip(names, quaternions(BASE_FROM_FLANGE).tolist(), strict=False)
        source = table("image,x,y,z,qx,qy,qz,qw", [[name, *pose] for name, pose in poses])
        return assemble(read_foreign(source, SEEN))

    return assembled


def test_every_row_keeps_its_own_image(tmp_path, naming):
    names = ("a/x.png", "b/x.png", "c/1_x.png", "d/X.png", "a/x.png")
    for level, name in enumerate(names[:4], start=1):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / name), np.full((20, 30), 10 * level, np.uint8))
    session = naming(*names)
    data = [session.images.read(view.image) for view in session.views]
    levels = [int(cv2.imdecode(np.frombuffer(value, np.uint8), 0)[0, 0]) for value in data]
    assert levels == [10, 20, 30, 40, 10]
    assert len({view.image.lower() for view in session.views}) == 4


OUTSIDE = {
    "long": "a" * 300 + ".png",
    "parent": "..",
    "NUL": "a\0.png",
    "above": "../secret.png",
    "absolute": "/etc/hostname",
    "deep": "a/" * 3000 + "b.png",
}


@pytest.mark.parametrize("name", OUTSIDE.values(), ids=OUTSIDE.keys())
def test_forbidden_names_of_images_are_refused(tmp_path, name):
    raised(DataError, "or leaves the folder", images_named, [name], tmp_path)


def test_links_that_lead_out_are_not_followed(tmp_path, naming):
    inside, outside = tmp_path / "in", tmp_path / "outside"
    picture(outside / "a.png")
    inside.mkdir()
    (inside / "a.png").symlink_to(outside / "a.png")
    (inside / "folder").symlink_to(outside)
    picture(inside / "own.png")
    (inside / "b.png").symlink_to(inside / "own.png")
    (tmp_path / "circle.png").symlink_to(tmp_path / "circle.png")
    assert [path.name for path in files_in(inside)] == ["b.png", "own.png"]
    (tmp_path / "out.png").symlink_to("/etc/hostname")
    for name in ("out.png", "circle.png"):
        raised(DataError, "or leaves the folder", naming, name)
    # The folder that the user names may be a link itself.
    (tmp_path / "alias").symlink_to(inside)
    assert [path.name for path in files_in(tmp_path / "alias")] == ["b.png", "own.png"]


def test_a_file_that_is_no_image_is_not_copied(tmp_path, naming):
    (tmp_path / "a.png").write_text("root:x:0:0")
    picture(tmp_path / "b.png")
    raised(DataError, r"a\.png must be an image", naming, "a.png", "b.png")
    session = naming("b.png")
    (tmp_path / "b.png").write_text("root:x:0:0")
    raised(DataError, r"b\.png must be an image", session.save, tmp_path / "out")


def test_images_are_searched_beside_the_table_and_some_must_exist(tmp_path, table):
    poses = quaternions(BASE_FROM_FLANGE).tolist()
    rows = [[f"{at}.png", *pose] for at, pose in enumerate(poses)]
    source = table("file,x,y,z,qx,qy,qz,qw", rows)
    with pytest.raises(DataError, match=r"9 of 9 images are missing.*--images"):
        convert(source, tmp_path / "out", requested=SEEN)
    for at in range(1, COUNT):
        picture(tmp_path / f"images/{at}.png")
    session = convert(source, tmp_path / "out", requested=SEEN)
    assert (tmp_path / "out/images/8.png").is_file()
    assert any(
        "1 of 9 images are missing" in warning and "--images" in warning
        for warning in session.warnings
    )


@pytest.mark.parametrize("third", [None, "left out", [[1, 2], [3]]])
def test_entries_without_a_pose_are_named_and_ragged_ones_refused(rows, third):
    def fields(at):
        pair = {"robot": BASE_FROM_FLANGE[at].tolist(), "camera": CAM_FROM_TARGET[at].tolist()}
        if at == 3 and third == "left out":
            del pair["robot"]
        return pair | ({"robot": third} if at == 3 and third != "left out" else {})

    source = rows(fields)
    if isinstance(third, list):
        raised(DataError, "entry 3: robot must be a list or matrix", read_foreign, source, HAND)
        return
    notes = " ".join(assemble(read_foreign(source, HAND)).warnings)
    assert "have no pose of the robot: log.json, entry 3" in notes


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "cell, größer"
    made_up(5).session.save(path)
    return path


def content(folder):
    """The bytes of every file, by its path in the folder."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_a_session_survives_the_way_to_a_recording_and_back(folder, tmp_path):
    recording, again = tmp_path / "cell.rrd", tmp_path / "again"
    convert(folder, recording)
    convert(recording, again)
    assert Session.load(recording).digest() == Session.load(folder).digest()
    assert content(again) == content(folder)


def test_existing_files_stay_and_force_replaces_a_recording_alone(folder, tmp_path):
    for name in ("taken", "taken.rrd"):
        (tmp_path / name).write_bytes(b"kept")
        raised(DataError, "exists, and nothing is overwritten", convert, folder, tmp_path / name)
        assert (tmp_path / name).read_bytes() == b"kept"
    convert(folder, tmp_path / "taken.rrd", force=True)
    assert Session.load(tmp_path / "taken.rrd").digest() == Session.load(folder).digest()
    (tmp_path / "folder.rrd").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").write_bytes(b"kept")
    for name in ("taken", "folder.rrd", "full"):
        raised(DataError, name, convert, folder, tmp_path / name, force=True)
    assert (tmp_path / "taken").read_bytes() == (tmp_path / "full/file").read_bytes() == b"kept"


def test_the_recording_that_comes_along_calibrates(tmp_path):
    path = Path(__file__).parents[2] / "recordings" / "ur10e_charuco.rrd"
    assert path.stat().st_size < 3_000_000
    folder = tmp_path / "ur10e_charuco"
    convert(path, folder)
    calibration = calibrate(folder)
    assert calibration.session_sha256 == Session.load(path).digest()
    assert calibration.verdict.status == "good"
    assert calibration.camera is not None
    assert calibration.camera.estimated


def test_the_command_converts_and_refuses(folder, tmp_path):
    done = typed("convert", folder, tmp_path / "new.rrd").good()
    assert Session.load(folder).digest() in done.err
    typed("convert", folder, tmp_path / "new.rrd").refused("--force")


def test_options_of_foreign_poses_are_refused_for_a_session(folder, tmp_path):
    typed("convert", folder, tmp_path / "new", "--robot-unit", "mm").refused("is a session already")
    assert not (tmp_path / "new").exists()


def test_files_of_the_kernel_are_not_read():
    """Some, such as /proc/kmsg, wait for ever: a folder that links to the root has them, too."""
    file = Path("/proc/version")
    if not file.is_file():
        pytest.skip("there is no /proc")
    assert file.read_text()
    assert head(file) == ""


def test_a_list_of_corners_that_is_absent_in_one_record_is_left_aside(rows):
    """Its numbers are no pose, though its name is of the board."""

    def fields(at):
        corners = [[1.5 * at, 2.0]] * 20 if at != 3 else []
        pose = BASE_FROM_FLANGE[at].tolist()
        return {"gripper_pose": pose, "board_detection": {"imgpts2d": corners}}

    notes = " ".join(read_foreign(rows(fields), HAND).notes)
    assert "board_detection.imgpts2d" in notes
