"""What recordings of others leave open or get wrong: found, told, or refused with a next step.

Some of these were once read wrongly without a word.
"""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.foreign_samples import (
    BASE_FROM_FLANGE,
    CAM_FROM_TARGET,
    CHARUCO,
    COUNT,
    picture,
    quaternions,
    streams,
    vectors,
)
from support.refusals import raised

from visioncal.core.conventions import POSE_FORMS, PoseNumbers, Reading, write_pose
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.interchange.formats import (
    ImportOptions,
    PoseImportOptions,
    assemble,
    convert,
    read_foreign,
)
from visioncal.interchange.formats.file_search import files_in, images_named
from visioncal.interchange.formats.intrinsics import read_intrinsics

HAND = ImportOptions(mount="eye-in-hand")
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


@pytest.mark.parametrize(("step", "timed"), [(1, False), (0.5, True)])
def test_numbers_of_rows_are_no_times(table, step, timed):
    pairs = zip(quaternions(BASE_FROM_FLANGE), quaternions(CAM_FROM_TARGET), strict=True)
    source = table("", [[1 + step * at, *a, *b] for at, (a, b) in enumerate(pairs)])
    foreign = read_foreign(source, ImportOptions(mount="eye-in-hand"))
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
    found = read_foreign(source, ImportOptions(mount="eye-in-hand", robot=requested))
    np.testing.assert_allclose(found.robot.poses(), BASE_FROM_FLANGE, atol=1e-6)


def vector(pose):
    """Its rvec and tvec, as OpenCV's functions return them."""
    numbers = vectors(pose[None])[0].tolist()
    return {"rvec": numbers[3:], "tvec": numbers[:3]}


def test_what_is_said_of_a_stream_holds_once(tmp_path):
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
        asked = replace(HAND, robot=PoseImportOptions(names))
        assert read_foreign(rows(fields), asked).stamps_s is None
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
    alone = rows(lambda at: vector(BASE_FROM_FLANGE[at]))
    requested = replace(HAND, robot=PoseImportOptions(("tvec", "rvec")))
    assert read_foreign(alone, requested).camera is None
    both = rows(
        lambda at: {"robot": vector(BASE_FROM_FLANGE[at]), "board": vector(CAM_FROM_TARGET[at])}
    )
    named = replace(HAND, robot=PoseImportOptions(("robot.tvec", "robot.rvec")))
    found = read_foreign(both, named)
    # One conversion to a vector and back, in double precision.
    np.testing.assert_allclose(found.camera.poses(), CAM_FROM_TARGET, atol=1e-14)
    with pytest.raises(DataError, match=r"'tvec' may be robot\.tvec, board\.tvec"):
        read_foreign(both, replace(HAND, robot=PoseImportOptions(("tvec", "rvec"))))


def test_half_a_pose_is_refused_by_its_row(logged):
    robot = quaternions(BASE_FROM_FLANGE).astype(str)
    robot[4, 6] = ""
    source = logged("x,y,z,qx,qy,qz,qw", robot.tolist())
    with pytest.raises(DataError, match=r"log\.csv, line 6: a part of the pose's numbers is"):
        assemble(read_foreign(source, HAND))


@pytest.mark.parametrize("form", ["seven numbers", "a matrix", "seven names"])
def test_an_order_that_nothing_tells_is_said(rows, form):
    numbers = quaternions(BASE_FROM_FLANGE)
    fields = {
        "seven numbers": lambda at: {"robot_pose": numbers[at].tolist()},
        "a matrix": lambda at: {"robot_pose": BASE_FROM_FLANGE[at].tolist()},
        "seven names": lambda at: dict(zip(NAMED, numbers[at].tolist(), strict=True)),
    }[form]
    notes = " ".join(read_foreign(rows(fields), HAND).notes)
    said = "robot's quaternions are taken for x, y" in notes
    assert said == ("quaternions are taken" in notes) == (form == "seven numbers")


NAMED = ("x", "y", "z", "qx", "qy", "qz", "qw")
BY_ROWS = [525.0, 0, 319.5, 0, 526, 239.5, 0, 0, 1]
BY_COLUMNS = [525.0, 0, 0, 0, 526, 0, 319.5, 239.5, 1]


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (BY_ROWS, ""),
        (BY_COLUMNS, ""),
        (np.reshape(BY_COLUMNS, (3, 3)).tolist(), ""),
        ([525, 0, 320, 0, 526, 240, 7, 8, 9], "are needed"),
        ([525, 0, 320, 0, 526, 240, 0, 0, 0.5], "are needed"),
        ([525, 0, 320, 0, -526, 240, 0, 0, 1], "above 0"),
    ],
)
def test_a_camera_matrix_by_rows_or_by_columns_or_none(tmp_path, matrix, words):
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
def test_names_of_images_that_are_refused(tmp_path, name):
    raised(DataError, "or leaves the folder", images_named, [name], tmp_path, None)


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


def test_what_is_no_image_is_not_copied(tmp_path, naming):
    (tmp_path / "a.png").write_text("root:x:0:0")
    picture(tmp_path / "b.png")
    raised(DataError, r"a\.png is no image", naming, "a.png", "b.png")
    session = naming("b.png")
    (tmp_path / "b.png").write_text("root:x:0:0")
    raised(DataError, r"b\.png is no image", session.save, tmp_path / "out")


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


@pytest.mark.parametrize("third", [None, "left out", [[1, 2], [3]]])
def test_entries_without_a_pose_are_named_and_ragged_ones_refused(rows, third):
    def fields(at):
        pair = {"robot": BASE_FROM_FLANGE[at].tolist(), "camera": CAM_FROM_TARGET[at].tolist()}
        if at == 3 and third == "left out":
            del pair["robot"]
        return pair | ({"robot": third} if at == 3 and third != "left out" else {})

    source = rows(fields)
    if isinstance(third, list):
        raised(DataError, "entry 3: robot is no regular list", read_foreign, source, HAND)
        return
    notes = " ".join(assemble(read_foreign(source, HAND)).warnings)
    assert "have no pose of the robot: log.json, entry 3" in notes
