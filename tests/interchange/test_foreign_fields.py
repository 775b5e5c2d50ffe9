"""What the fields of others mean: which is what, and what is refused or said where it may be both.

Each of these was once read wrongly without a word.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.foreign_samples import BASE_FROM_FLANGE, CAM_FROM_TARGET, quaternions, streams, vectors
from typer.testing import CliRunner

from visioncal.cli.app import app
from visioncal.core.conventions import ROTATION_FORMS, PoseNumbers, Reading
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.interchange.formats import ImportOptions, PoseImportOptions, assemble, read_foreign
from visioncal.interchange.formats.intrinsics import read_intrinsics
from visioncal.session import Session

HAND = ImportOptions(mount="eye-in-hand")


@pytest.fixture
def rows(tmp_path):
    """Writes rows as a list of JSON: what `fields(at)` gives for each of the world's poses."""

    def write(fields, name="log.json"):
        count = len(BASE_FROM_FLANGE)
        (tmp_path / name).write_text(json.dumps([fields(at) for at in range(count)]))
        return tmp_path / name

    return write


def vector(pose):
    """Its rvec and tvec, as OpenCV's functions return them."""
    numbers = vectors(pose[None])[0].tolist()
    return {"rvec": numbers[3:], "tvec": numbers[:3]}


# How the robot's stream is written, and what the user then says.
WRITTEN = {
    "millimetres": (lambda value: value, 1e3, PoseImportOptions(unit="mm")),
    "inverse": (invert, 1.0, PoseImportOptions(inverse=True)),
    "by name": (lambda value: value, 1.0, PoseImportOptions(form="ros")),
}


@pytest.mark.parametrize(("turned", "scale", "said"), WRITTEN.values(), ids=WRITTEN.keys())
def test_what_is_said_of_a_stream_holds_once(tmp_path, turned, scale, said):
    recording = streams(tmp_path)
    wanted = read_foreign(recording.source, recording.requested).stream.poses
    table = np.loadtxt(recording.source, delimiter=",")
    poses = PoseNumbers(table[:, 1:4], table[:, 4:], Reading(), tuple(map(str, table[:, 0])))
    written = quaternions(turned(poses.poses())) * ([scale] * 3 + [1] * 4)
    np.savetxt(recording.source, np.hstack([table[:, :1], written]), "%.12f", delimiter=",")
    found = read_foreign(recording.source, replace(recording.requested, robot=said)).stream.poses
    # Nine digits are written of the original, twelve here.
    np.testing.assert_allclose(found.poses(), wanted.poses(), atol=1e-8)


def test_a_translation_called_t_is_no_time(rows):
    source = rows(
        lambda at: {
            "R": BASE_FROM_FLANGE[at, :3, :3].tolist(),
            "t": BASE_FROM_FLANGE[at, :3, 3].tolist(),
            "camera_pose": CAM_FROM_TARGET[at].tolist(),
        }
    )
    requested = replace(HAND, robot=PoseImportOptions(("t", "R")))
    assert read_foreign(source, requested).stamps_s is None
    # One number a row, but of the robot's pose.
    single = rows(
        lambda at: (
            dict(zip("txy", BASE_FROM_FLANGE[at, :3, 3].tolist(), strict=True))
            | {"rvec": vector(BASE_FROM_FLANGE[at])["rvec"]}
        )
    )
    requested = replace(HAND, robot=PoseImportOptions(("t", "x", "y", "rvec")))
    assert read_foreign(single, requested).stamps_s is None
    timed = rows(lambda at: {"t": 0.5 * at, "robot_pose": BASE_FROM_FLANGE[at].tolist()})
    assert read_foreign(timed, HAND).stamps_s[2] == 1.0


@pytest.mark.parametrize("first", ["position", "rotation"])
def test_twelve_numbers_are_read_in_the_order_that_makes_rotations(tmp_path, first):
    upper = BASE_FROM_FLANGE[:, :3].reshape(-1, 12)
    apart = np.hstack([BASE_FROM_FLANGE[:, :3, 3], BASE_FROM_FLANGE[:, :3, :3].reshape(-1, 9)])
    robot = apart if first == "position" else upper
    header = ",".join([*(f"a{index}" for index in range(12)), *(f"c{index}" for index in range(7))])
    source = tmp_path / "log.csv"
    table = np.hstack([robot, quaternions(CAM_FROM_TARGET)])
    np.savetxt(source, table, "%.15g", delimiter=",", header=header, comments="")
    columns = header.split(",")
    requested = replace(
        HAND,
        robot=PoseImportOptions(tuple(columns[:12])),
        camera=PoseImportOptions(tuple(columns[12:]), form="ros"),
    )
    # Fifteen digits are written.
    np.testing.assert_allclose(
        read_foreign(source, requested).robot.poses(), BASE_FROM_FLANGE, atol=1e-13
    )


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


def test_half_a_pose_is_refused_by_its_row(tmp_path):
    robot, camera = (
        quaternions(value).astype(str) for value in (BASE_FROM_FLANGE, CAM_FROM_TARGET)
    )
    robot[4, 6] = ""
    header = "x,y,z,qx,qy,qz,qw,cft_x_m,cft_y_m,cft_z_m,cft_qx,cft_qy,cft_qz,cft_qw"
    source = tmp_path / "log.csv"
    source.write_text(
        "\n".join([header, *(",".join(value) for value in np.hstack([robot, camera]))])
    )
    with pytest.raises(DataError, match=r"log\.csv, line 6: a part of the pose's numbers is"):
        assemble(read_foreign(source, HAND))


def test_counts_of_a_document_stay_counts(rows):
    source = rows(
        lambda at: {
            "view": at + 5,
            "stop": at // 3,
            "gain": 0.5,
            "robot_pose": BASE_FROM_FLANGE[at].tolist(),
            "camera_pose": CAM_FROM_TARGET[at].tolist(),
        }
    )
    session = assemble(read_foreign(source, HAND))
    assert [view.number for view in session.views] == list(range(5, 14))
    assert [view.stop for view in session.views] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert session.views[0].text["gain"] == "0.5"


def test_joints_in_degrees(rows, tmp_path):
    source = rows(
        lambda at: {"joints": [10.0 * at, -90.0], "camera_pose": CAM_FROM_TARGET[at].tolist()}
    )
    command = ["convert", str(source), str(tmp_path / "out"), "--mount", "eye-in-hand"]
    assert CliRunner().invoke(app, [*command, "--joint-unit", "deg"]).exit_code == 0
    joints = [view.joints_rad for view in Session.load(tmp_path / "out").views]
    np.testing.assert_array_equal(joints, np.deg2rad([[10.0 * at, -90.0] for at in range(9)]))


def test_no_column_takes_anothers_place(tmp_path):
    lines = [
        f"{','.join(map(repr, quaternion))},p,a,b,c"
        for quaternion in quaternions(BASE_FROM_FLANGE).tolist()
    ]
    header = "x,y,z,qx,qy,qz,qw,point,source_source_stop,stop,source_stop"
    (tmp_path / "log.csv").write_text("\n".join([header, *lines]))
    session = assemble(read_foreign(tmp_path / "log.csv", HAND))
    cells = {name: session.views[0].cell(name) for name in session.columns}
    assert {"a", "b", "c"} < set(cells.values())


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"robot_pose": quaternions(BASE_FROM_FLANGE)}, "robot's quaternions are taken for x, y"),
        ({"robot_pose": BASE_FROM_FLANGE}, ""),
        (
            dict(
                zip(
                    ("x", "y", "z", "qx", "qy", "qz", "qw"),
                    quaternions(BASE_FROM_FLANGE).T,
                    strict=True,
                )
            ),
            "",
        ),
    ],
    ids=["seven numbers", "a matrix", "seven names"],
)
def test_an_order_that_nothing_tells_is_said(rows, fields, words):
    source = rows(lambda at: {name: np.array(field)[at].tolist() for name, field in fields.items()})
    notes = " ".join(read_foreign(source, HAND).notes)
    assert ("quaternions are taken" in notes) == bool(words)
    assert words in notes


BY_ROWS = [525.0, 0, 319.5, 0, 526, 239.5, 0, 0, 1]
BY_COLUMNS = [525.0, 0, 0, 0, 526, 0, 319.5, 239.5, 1]


@pytest.mark.parametrize("matrix", [BY_ROWS, BY_COLUMNS, np.reshape(BY_COLUMNS, (3, 3)).tolist()])
def test_a_camera_matrix_by_rows_or_by_columns(tmp_path, matrix):
    (tmp_path / "lens.json").write_text(json.dumps({"intrinsic_matrix": matrix}))
    assert read_intrinsics(tmp_path / "lens.json")[0]["matrix"] == [525, 526, 319.5, 239.5]


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        ([525, 0, 320, 0, 526, 240, 7, 8, 9], "are needed"),
        ([525, 0, 320, 0, 526, 240, 0, 0, 0.5], "are needed"),
        ([525, 2.5, 320, 0, 526, 240, 0, 0, 1], "are needed"),
        ([525, 0, 320, 0, 526, 240], "are needed"),
        ([0, 0, 320, 0, 526, 240, 0, 0, 1], "above 0"),
        ([525, 0, 320, 0, -526, 240, 0, 0, 1], "above 0"),
    ],
    ids=["last row", "scaled", "skew", "six numbers", "no focal length", "negative"],
)
def test_a_camera_matrix_that_is_none(tmp_path, matrix, words):
    (tmp_path / "lens.json").write_text(json.dumps({"K": matrix}))
    with pytest.raises(DataError, match=words):
        read_intrinsics(tmp_path / "lens.json")


@pytest.mark.parametrize(("model", "noted"), [({}, True), ({"distortion_model": "fisheye"}, False)])
def test_four_coefficients_may_be_a_fisheyes(tmp_path, model, noted):
    document = {"K": BY_ROWS, "D": [-0.01, 0.02, -0.003, 0.001], **model}
    (tmp_path / "lens.json").write_text(json.dumps(document))
    lens, notes = read_intrinsics(tmp_path / "lens.json")
    assert lens["model"] == ("brown" if noted else "fisheye")
    assert bool(notes) == noted


def test_rows_that_hold_poses_are_not_taken_for_names_of_files(tmp_path):
    data = "".join(
        f"- pose: {robot.tolist()}\n  image: a.png\n  camera_pose: {camera.tolist()}\n"
        for robot, camera in zip(BASE_FROM_FLANGE, CAM_FROM_TARGET, strict=True)
    )
    (tmp_path / "log.yaml").write_text(f"data:\n{data}")
    found = read_foreign(tmp_path / "log.yaml", HAND)
    np.testing.assert_array_equal(found.robot.poses()[:, :3, 3], BASE_FROM_FLANGE[:, :3, 3])


@pytest.mark.parametrize("digits", [3, 4])
def test_written_digits_are_enough_for_a_rotation(digits):
    for form, numbers in (
        ("matrix", BASE_FROM_FLANGE[:, :3, :3].reshape(-1, 9)),
        ("quaternion-xyzw", quaternions(BASE_FROM_FLANGE)[:, 3:]),
    ):
        places = tuple(map(str, range(len(numbers))))
        rounded = PoseNumbers(
            np.zeros((len(numbers), 3)), numbers.round(digits), Reading(form), places
        )
        # A digit's half, in nine places.
        np.testing.assert_allclose(
            rounded.poses()[:, :3, :3], BASE_FROM_FLANGE[:, :3, :3], atol=4.5 * 10.0**-digits
        )
        with pytest.raises(DataError, match="the numbers are not"):
            replace(rounded, rotations=1.005 * numbers).poses()


def test_numbers_whose_squares_overflow_are_no_quaternion():
    numbers = np.array([[0.0, 0.0, 0.0, 1.0], [1e300, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 1.0]])
    found = ROTATION_FORMS["quaternion-xyzw"].read(numbers)
    assert found[0] == pytest.approx(np.eye(3))
    assert np.isnan(found[1:]).all()
