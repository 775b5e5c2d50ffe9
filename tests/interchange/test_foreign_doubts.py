"""What recordings of others leave open or get wrong: found, told, or refused with a next step."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.foreign_samples import (
    BASE_FROM_FLANGE,
    CAM_FROM_TARGET,
    CHARUCO,
    COUNT,
    industrial,
    picture,
    quaternions,
)
from typer.testing import CliRunner

from visioncal.cli.app import app
from visioncal.core.conventions import POSE_FORMS, write_pose
from visioncal.core.errors import DataError
from visioncal.interchange.formats import (
    DoubtfulSession,
    ImportOptions,
    PoseImportOptions,
    assemble,
    convert,
    read_foreign,
)

SEEN = ImportOptions(mount="eye-in-hand", target=CHARUCO)
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


def test_pairs_by_order_are_told_and_two_columns_of_images_are_one_too_many(tmp_path, table):
    poses = quaternions(BASE_FROM_FLANGE).tolist()
    for at in range(COUNT):
        picture(tmp_path / f"images/{at:03d}.png")
    requested = replace(SEEN, images=tmp_path / "images")
    foreign = read_foreign(table("x,y,z,qx,qy,qz,qw", poses), requested)
    assert any(
        "line 2 with 000.png, log.csv, line 10 with 008.png" in note for note in foreign.notes
    )
    # Why they show nothing is said before any reading is tried.
    with pytest.raises(DataError, match=r"no view shows the target.*almost uniform"):
        DoubtfulSession.of(foreign).guess()
    with pytest.raises(DataError, match="elsewhere does not exist"):
        read_foreign(tmp_path / "log.csv", replace(SEEN, images=tmp_path / "elsewhere"))
    both = [[f"{at:03d}.png", f"{at:03d}.png", *pose] for at, pose in enumerate(poses)]
    with pytest.raises(DataError, match=r"left, right name images.*--image-column"):
        read_foreign(table("left,right,x,y,z,qx,qy,qz,qw", both), requested)


def test_images_are_looked_for_beside_and_some_must_be_there(tmp_path, table):
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


@pytest.mark.parametrize(
    ("names", "form"), [("X,Y,Z,A,B,C", "kuka"), ("X,Y,Z,W,P,R", "fanuc"), ("x,y,z,rx,ry,rz", "ur")]
)
def test_angles_beyond_a_turn_are_not_taken_for_radians(tmp_path, logged, names, form):
    degrees = np.rad2deg(1) if form == "ur" else 1.0
    poses = written(POSE_FORMS[form]) * [1, 1, 1, degrees, degrees, degrees]
    source, hand = logged(names, poses.tolist()), ImportOptions(mount="eye-in-hand")
    with pytest.raises(DataError, match=r"too large for radians.*kuka.*fanuc.*--guess"):
        convert(source, tmp_path / "out", requested=hand)
    assert not (tmp_path / "out").exists()
    said = PoseImportOptions(form="rotation-vector-deg" if form == "ur" else form)
    convert(source, tmp_path / "out", requested=replace(hand, robot=said))


# Names in a maker's own letters, and in others.
NAMES = [
    ("fanuc", "X,Y,Z,W,P,R"),
    ("abb", "x,y,z,q1,q2,q3,q4"),
    ("abb", "x,y,z,qw,qx,qy,qz"),
    ("yaskawa", "x,y,z,Rx,Ry,Rz"),
    ("doosan", "x,y,z,a,b,c"),
    ("kuka", "X,Y,Z,A,B,C"),
]


@pytest.mark.parametrize(("form", "names"), NAMES)
def test_the_names_of_makers_are_known(logged, form, names):
    source = logged(names, written(POSE_FORMS[form]).tolist())
    requested = ImportOptions(mount="eye-in-hand", robot=PoseImportOptions(form=form))
    found = read_foreign(source, requested).robot.poses()
    # One conversion to the maker's form and back, near a singularity of none.
    np.testing.assert_allclose(found, BASE_FROM_FLANGE, atol=1e-12)


def test_quoted_decimal_commas_are_pointed_to_another_separator(tmp_path):
    source = tmp_path / "log.csv"
    source.write_text('x,y,z,a,b,c\n"958,2","51,0","400,5","90,0","0,0","180,0"\n')
    with pytest.raises(DataError, match="x holds '958,2'; a number is needed") as caught:
        read_foreign(source, ImportOptions(robot=PoseImportOptions(form="kuka")))
    assert "semicolons" in caught.value.next_step


@pytest.mark.parametrize("key", ["robot", "nested"])
def test_keys_plainly_named_are_known(tmp_path, key):
    def entry(pose):
        if key == "robot":
            return pose.tolist()
        numbers = write_pose(pose, POSE_FORMS["ur"]).tolist()
        return {"tvec": numbers[:3], "rvec": numbers[3:]}

    pairs = zip(BASE_FROM_FLANGE, CAM_FROM_TARGET, strict=True)
    rows = [{"robot": entry(a), "camera": entry(b)} for a, b in pairs]
    (tmp_path / "log.json").write_text(json.dumps(rows))
    foreign = read_foreign(tmp_path / "log.json", ImportOptions(mount="eye-in-hand"))
    for found, pose in ((foreign.robot, BASE_FROM_FLANGE), (foreign.camera, CAM_FROM_TARGET)):
        # A rotation vector and back.
        np.testing.assert_allclose(found.poses(), pose, atol=1e-12)


@pytest.mark.parametrize("cell", ["nan", ""])
def test_rows_without_a_pose_are_named(logged, cell):
    poses = quaternions(BASE_FROM_FLANGE).tolist()
    poses[3] = [cell] * 7
    session = assemble(
        read_foreign(logged("x,y,z,qx,qy,qz,qw", poses), ImportOptions(mount="eye-in-hand"))
    )
    assert any(
        "1 of 9 rows have no pose of the robot: log.csv, line 5" in warning
        for warning in session.warnings
    )


@pytest.mark.parametrize(
    ("third", "noted"), [(None, True), ("left out", True), ([[1, 2], [3]], False)]
)
def test_entries_without_a_pose_are_named_and_ragged_ones_refused(tmp_path, third, noted):
    pairs = zip(BASE_FROM_FLANGE.tolist(), CAM_FROM_TARGET.tolist(), strict=True)
    rows = [{"robot": a, "camera": b} for a, b in pairs]
    if third == "left out":
        del rows[3]["robot"]
    else:
        rows[3]["robot"] = third
    (tmp_path / "log.json").write_text(json.dumps(rows))
    if noted:
        session = assemble(read_foreign(tmp_path / "log.json", ImportOptions(mount="eye-in-hand")))
        assert any(
            "have no pose of the robot: log.json, entry 3" in warning
            for warning in session.warnings
        )
    else:
        with pytest.raises(DataError, match="entry 3: robot is no regular list"):
            read_foreign(tmp_path / "log.json", ImportOptions(mount="eye-in-hand"))


def test_empty_columns_and_numbers_of_cameras_are_no_poses(table):
    rows = [
        ["a.png", 0, 1, *quaternion, *[""] * 7]
        for quaternion in quaternions(BASE_FROM_FLANGE).tolist()
    ]
    source = table(f"image,camera,robot,x,y,z,qx,qy,qz,qw,{CAMERA}", rows)
    foreign = read_foreign(source, SEEN)
    assert foreign.camera is None
    assert foreign.robot.present.all()


@pytest.mark.parametrize(("step", "timed"), [(1, False), (0.5, True)])
def test_numbers_of_rows_are_no_times(table, step, timed):
    pairs = zip(quaternions(BASE_FROM_FLANGE), quaternions(CAM_FROM_TARGET), strict=True)
    source = table("", [[1 + step * at, *a, *b] for at, (a, b) in enumerate(pairs)])
    foreign = read_foreign(source, ImportOptions(mount="eye-in-hand"))
    assert (foreign.stamps_s is not None) == timed
    assert any("Column 1 is taken for times" in note for note in foreign.notes) == timed


def test_joints_too_large_for_radians_are_taken_for_degrees(tmp_path):
    degrees = np.array([[168.0, 3.0 * at] for at in range(len(BASE_FROM_FLANGE))])
    rows = [
        {"joints": them, "robot": value.tolist()}
        for them, value in zip(degrees.tolist(), BASE_FROM_FLANGE, strict=True)
    ]
    (tmp_path / "log.json").write_text(json.dumps(rows))
    found = read_foreign(tmp_path / "log.json", ImportOptions(mount="eye-in-hand"))
    assert "Joint angles up to 168 are no radians, and are taken for degrees." in found.notes
    np.testing.assert_allclose(found.joints_rad, np.deg2rad(degrees))


@pytest.mark.parametrize(
    ("name", "count", "degrees"),
    [
        ("J{}", 6, False),
        ("joint_{}_deg", 5, True),
        ("a{} [deg]", 6, True),
        ("J{} [°]", 6, True),
        ("joint_positions_degrees", 0, True),
        # They may as well be a quaternion.
        ("q{}", 4, None),
    ],
)
def test_joints_are_known_by_their_names(tmp_path, name, count, degrees):
    joints = np.linspace(-0.5, 0.7, len(BASE_FROM_FLANGE) * 6).reshape(-1, 6)[:, : count or 6]
    written = (np.rad2deg(joints) if degrees else joints).tolist()
    names = [name.format(at) for at in range(1, count + 1)]
    rows = [
        {**(dict(zip(names, them, strict=True)) if count else {name: them}), "robot": pose}
        for them, pose in zip(written, BASE_FROM_FLANGE.tolist(), strict=True)
    ]
    (tmp_path / "log.json").write_text(json.dumps(rows))
    found = read_foreign(tmp_path / "log.json", ImportOptions(mount="eye-in-hand")).joints_rad
    if degrees is None:
        assert found is None
    else:
        np.testing.assert_allclose(found, joints)


@pytest.mark.parametrize("unit", ["[deg]", "[°]", "(º)"])
def test_angles_of_poses_are_in_the_degrees_of_their_header(table, unit):
    header = ",".join(["X [mm]", "Y [mm]", "Z [mm]", *(f"{name} {unit}" for name in "ABC")])
    source = table(header, written(POSE_FORMS["kuka"]).tolist())
    requested = PoseImportOptions(form="kuka")
    found = read_foreign(source, ImportOptions(mount="eye-in-hand", robot=requested))
    np.testing.assert_allclose(found.robot.poses(), BASE_FROM_FLANGE, atol=1e-6)


def test_a_robots_model_is_checked_before_anything_is_written(tmp_path, logged):
    source = logged("x,y,z,qx,qy,qz,qw", quaternions(BASE_FROM_FLANGE).tolist())
    (tmp_path / "positioner.toml").write_text('schema = 1\nname = "nonsense"\n')
    requested = ImportOptions(mount="eye-in-hand", robot_model=str(tmp_path / "positioner.toml"))
    with pytest.raises(DataError, match="nonsense: convention is missing"):
        convert(source, tmp_path / "out", requested=requested)
    missing = replace(requested, robot_model="nowhere.toml")
    with pytest.raises(DataError, match=r"does not exist\. Check the path"):
        convert(source, tmp_path / "out", requested=missing)
    assert not (tmp_path / "out").exists()


def test_notes_keep_still_where_the_user_has_spoken(tmp_path):
    recording = industrial(tmp_path / "in")
    words = "distortion; it is taken for zero"
    assert any(words in note for note in read_foreign(recording.source, recording.requested).notes)
    said = replace(recording.requested, intrinsics="estimate")
    foreign = read_foreign(recording.source, said)
    assert not any(words in note for note in foreign.notes)
    assert not foreign.lens


@pytest.mark.parametrize("names", ["X,X,X,A,B,C", ",,,", "", "X,Y,,A"])
def test_names_that_are_none_or_doubled_are_refused(tmp_path, names):
    command = ["convert", str(tmp_path), str(tmp_path / "out"), "--robot-columns", names]
    with pytest.raises(DataError, match=r"--robot-columns is .*each once"):
        CliRunner().invoke(app, command, catch_exceptions=False)


def test_an_encoding_without_its_mark_is_refused_with_what_to_do(tmp_path):
    (tmp_path / "log.csv").write_bytes("Größe,x\n1,2\n".encode("utf-16-le"))
    with pytest.raises(DataError, match=r"CSV UTF-8.*iconv -f"):
        read_foreign(tmp_path / "log.csv", SEEN)
