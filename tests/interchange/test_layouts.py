"""Recordings in layouts that no program of a known name writes: each gives the same session."""

import json
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.commands import visioncal
from support.following import follow
from support.samples import made_up

from visioncal.interchange.formats.sources import look
from visioncal.session import Session
from visioncal.vision.boards.charuco import charuco_board

FIELD = Path(__file__).parents[3] / "shared/data/field/cases"


@lru_cache
def world():
    """The robot's poses (n, 4, 4) and the pictures of a board, as arrays."""
    session = made_up(9, images=False).session
    poses = np.array([view.base_from_flange().as_matrix() for view in session.views])
    seen = (view.cam_from_target().as_matrix() for view in session.views)
    target = session.target
    size_px = [round(4000 * n * target.square_m) for n in (target.columns, target.rows)]
    printed = charuco_board(target).generateImage(size_px)
    matrix = np.array([[520.0, 0, 322.5], [0, 521.0, 198.0], [0, 0, 1]])
    pictures = [
        cv2.warpPerspective(
            printed,
            matrix @ pose[:3, [0, 1, 3]] @ np.diag([1 / 4000, 1 / 4000, 1.0]),
            (640, 400),
            flags=cv2.INTER_AREA,
            borderValue=150,
        )
        for pose in seen
    ]
    return poses, [cv2.GaussianBlur(picture, (3, 3), 0) for picture in pictures], session


def seven(pose):
    return [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]


def shoot(folder: Path, name: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for at, picture in enumerate(world()[1]):
        cv2.imwrite(str(folder / name.format(at)), picture)


def write(path: Path, document: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(document if isinstance(document, str) else json.dumps(document))


def stems_with_depth(folder):
    shoot(folder, "{}.jpg")
    for at, pose in enumerate(world()[0]):
        cv2.imwrite(str(folder / f"{at}.png"), np.full((4, 6), 900 + at, np.uint16))
        write(folder / f"{at}.json", {"ee_pose": pose.tolist(), "joints": [[1.0] * (6 + at % 2)]})


def two_folders(folder):
    shoot(folder / "rgb", "frame_{:03d}.png")
    for at, pose in enumerate(world()[0]):
        write(
            folder / f"poses/T_{at:03d}.txt",
            "\n".join(" ".join(map(repr, r)) for r in pose.tolist()),
        )
    shoot(folder / "rgb", "frame_{:03d}_corners.png")


def array(folder):
    shoot(folder, "img{:02d}.png")
    np.save(folder / "robot_poses.npy", world()[0])
    np.save(folder / "camera_matrix.npy", [[520.0, 0, 322.5], [0, 521, 198], [0, 0, 1]])


def sixes(folder):
    """Euler angles of no stated order in degrees, positions in millimetres."""
    shoot(folder, "img{:02d}.png")
    turns = Rotation.from_matrix(world()[0][:, :3, :3]).as_euler("xyz", degrees=True)
    np.save(folder / "poses.npy", np.hstack([1e3 * world()[0][:, :3, 3], turns]))


def opencv_each(folder):
    shoot(folder, "img{:02d}.png")
    for at, pose in enumerate(world()[0]):
        data = ", ".join(map(repr, map(float, seven(pose))))
        text = "%YAML:1.0\n---\npose: !!opencv-matrix\n   rows: 7\n   cols: 1\n   dt: d\n"
        text += f"   data: [ {data} ]\n"
        write(folder / f"pose{at:02d}.yml", text)


def nested(folder):
    shoot(folder / "images", "{}.png")
    rows = [
        {"id": at, "T_base_ee": pose.tolist(), "image": f"{at}.png", "joints": [0.1] * (6 + at % 2)}
        for at, pose in enumerate(world()[0])
    ]
    lens = {"K": [520.0, 0, 322.5, 0, 521, 198, 0, 0, 1], "D": [0.0] * 5}
    document = {"collected_samples": {"camera": {"head_info": lens}, "samples": rows}}
    write(folder / "everything.json", document)


def mappings(folder):
    shoot(folder / "shots", "view_{}.png")
    rows = []
    for pose in world()[0]:
        numbers = seven(pose)
        rows.append(
            {
                "tcp": {
                    "orientation": dict(zip("wxyz", [numbers[6], *numbers[3:6]], strict=True)),
                    "position": dict(zip("xyz", numbers, strict=False)),
                },
                "joints": None,
            }
        )
    write(folder / "log.json", {"run": {"views": rows}})


def blanks(folder):
    """Text separated by blanks: Euler angles of another order."""
    shoot(folder, "img{:02d}.png")
    turns = Rotation.from_matrix(world()[0][:, :3, :3]).as_euler("ZYX", degrees=True)
    rows = np.hstack([world()[0][:, :3, 3], turns])
    write(folder / "poses.txt", "\n".join(" ".join(map(repr, row)) for row in rows.tolist()))


def inverted(folder):
    shoot(folder, "img{:02d}.png")
    np.savez(folder / "data.npz", poses=np.linalg.inv(world()[0]))


def krl(folder):
    shoot(folder, "img{:02d}.png")
    lines = ["&ACCESS RVP", "DEFDAT CALIB", ";FOLD", "DECL FDAT FP1={TOOL_NO 1,BASE_NO 0}"]
    for at, pose in enumerate(world()[0]):
        turns = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX", degrees=True)
        cells = [
            f"{n} {v:.9f}" for n, v in zip("XYZABC", [*(1e3 * pose[:3, 3]), *turns], strict=True)
        ]
        lines.append(f"DECL E6POS XP{at}={{{','.join(cells)},S 2,T 35,E1 0.0,E2 0.0}}")
    write(folder / "calib.dat", "\n".join([*lines, "ENDDAT"]))


def fanuc(folder):
    shoot(folder, "img{:02d}.png")
    text = "/PROG CALIB\n/MN\n   1:J P[1] 10% FINE    ;\n/POS\n"
    for at, pose in enumerate(world()[0], 1):
        turns = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", degrees=True)
        place = ",\t".join(
            f"{n} = {v:.9f} mm" for n, v in zip("XYZ", 1e3 * pose[:3, 3], strict=True)
        )
        turn = ",\t".join(f"{n} = {v:.9f} deg" for n, v in zip("WPR", turns, strict=True))
        head = "GP1:\n\tUF : 0, UT : 1,\tCONFIG : 'N U T, 0, 0, 0',"
        text += f"P[{at}]{{\n   {head}\n\t{place},\n\t{turn}\n}};\n"
    write(folder / "calib.ls", text + "/END\n")


def rapid(folder):
    shoot(folder, "img{:02d}.png")
    lines = ["MODULE Calib"]
    for at, pose in enumerate(world()[0]):
        x, y, z, qx, qy, qz, qw = seven(pose)
        place, turn = [1e3 * x, 1e3 * y, 1e3 * z], [qw, qx, qy, qz]
        both = ",".join(str([round(float(v), 9) for v in part]) for part in (place, turn))
        lines.append(f"  CONST robtarget p{at}:=[{both},[0,0,-1,0],[9E9,9E9,9E9,9E9,9E9,9E9]];")
    write(folder / "calib.mod", "\n".join([*lines, "  PROC main()", "  ENDPROC", "ENDMODULE"]))


def other_language(folder):
    """Names in another language, and a second place without a rotation."""
    shoot(folder, "bild_{}.png")
    for at, pose in enumerate(world()[0]):
        x, y, z, qx, qy, qz, qw = seven(pose)
        flange = {"Ort_mm": [1e3 * x, 1e3 * y, 1e3 * z], "Quaternion_wxyz": [qw, qx, qy, qz]}
        document = {"Roboter": {"Flansch": flange, "Greifer": {"Ort_mm": [0, 0, 120.0 + at]}}}
        write(folder / f"bild_{at}.json", document)


def parallel(folder):
    """Two lists in one mapping, poses as a position and a quaternion."""
    shoot(folder / "pics", "{}.png")
    rows = [[seven(pose)[:3], seven(pose)[3:]] for pose in world()[0]]
    files = [f"pics/{at}.png" for at in range(len(rows))]
    write(folder / "run.json", {"run": {"files": files, "hand_poses": rows}})


def printed(folder):
    """A dict of Python a line."""
    shoot(folder, "{}.png")
    rows = [
        {"t_mm": tuple((1e3 * pose[:3, 3]).tolist()), "R": pose[:3, :3].tolist(), "force": None}
        for pose in world()[0]
    ]
    write(folder / "log.txt", "\n".join(map(repr, rows)))


def messages(folder):
    """Several documents of YAML in a file, and a lens beside."""
    shoot(folder, "frame{:04d}.png")
    text = ""
    for pose in world()[0]:
        numbers = seven(pose)
        place = dict(zip("xyz", map(float, numbers), strict=False))
        turn = dict(zip("xyzw", map(float, numbers[3:]), strict=True))
        text += f"transform: {json.dumps({'translation': place, 'rotation': turn})}\n---\n"
    write(folder / "tf.yaml", text)
    write(folder / "camera_info.yaml", LENS)


LENS = """image_width: 640
image_height: 400
camera_matrix: {rows: 3, cols: 3, data: [520.0, 0, 322.5, 0, 521, 198, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.0, 0, 0, 0, 0]}
projection_matrix: {rows: 3, cols: 4, data: [520.0, 0, 322.5, 0, 0, 521, 198, 0, 0, 0, 1, 0]}
"""


def unnamed_angles(folder):
    """Euler angles ZYZ without a word, a lens beside, and pictures twice."""
    shoot(folder / "raw", "{}.png")
    shoot(folder / "undistorted", "{}.png")
    write(folder / "cam.yaml", LENS)
    turns = Rotation.from_matrix(world()[0][:, :3, :3]).as_euler("ZYZ")
    rows = np.hstack([world()[0][:, :3, 3], turns]).tolist()
    lines = [",".join([f"{at}.png", *map(repr, row)]) for at, row in enumerate(rows)]
    write(folder / "poses.csv", "\n".join(["image,e1,e2,e3,e4,e5,e6", *lines]))


def program_beside(folder):
    """A table and the robot's program with the same poses, rounded."""
    krl(folder)
    shoot(folder, "{:02d}.png")
    rows = ["Foto;X [mm];Y [mm];Z [mm];A;B;C"]
    for at, pose in enumerate(world()[0]):
        angles = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX", degrees=True)
        rows.append(
            f"{at:02d};" + ";".join(f"{float(n)!r}" for n in [*(1e3 * pose[:3, 3]), *angles])
        )
    write(folder / "Positionen.csv", "\n".join(rows))


def times_and_names(folder):
    """Two columns that name the same images, and a rotation before its position."""
    shoot(folder / "rgb", "17{}.250000.png")
    rows = ["stem,file,winkel_x,winkel_y,winkel_z,ort_x,ort_y,ort_z"]
    for at, pose in enumerate(world()[0]):
        angles = Rotation.from_matrix(pose[:3, :3]).as_euler("XYZ")
        numbers = ",".join(f"{float(number)!r}" for number in [*angles, *pose[:3, 3]])
        rows.append(f"17{at}.250000,C:\\shots\\17{at}.250000.png,{numbers}")
    write(folder / "poses.csv", "\n".join(rows))


def failed_rows(folder):
    """Vectors of six, some of which failed, beside joints of different counts."""
    shoot(folder / "shots", "{}.png")
    log = [
        {
            "img": f"shots/{at}.png",
            "tcp": [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_rotvec()],
            "joints": [0.5] * (6 + at % 2),
            "force": [0.1, 0.2, 9.8],
        }
        for at, pose in enumerate(world()[0])
    ]
    failed = {"img": None, "tcp": "n/a", "joints": None, "force": None}
    write(folder / "log.json", [*log[:3], failed, *log[3:]])


def two_of_a_language(folder):
    """The robot's and the board's poses, named in German, and images of another machine."""
    poses, _, session = world()
    shoot(folder / "bilder", "{}.png")
    rows = [
        {
            "datei": f"D:\\messung\\{at}.png",
            "tafel_in_kamera": session.views[at].cam_from_target().as_matrix().tolist(),
            "flansch_in_basis": pose.tolist(),
        }
        for at, pose in enumerate(poses)
    ]
    write(folder / "projekt.json", {"messungen": rows})


def old_results(folder):
    """A result and a first guess beside the poses, and a row that failed."""
    shoot(folder, "{}.png")
    rows = [{"img": f"{at}.png", "tcp": seven(pose)} for at, pose in enumerate(world()[0])]
    write(folder / "log.json", rows)
    write(folder / "result.json", {"X": np.eye(4).tolist(), "guess": np.eye(4).tolist()})
    np.save(folder / "old.npy", world()[0][0])


LAYOUTS: Mapping[str, Callable[[Path], None]] = {
    make.__name__: make
    for make in (
        stems_with_depth, two_folders, array, sixes, opencv_each, nested, mappings, blanks,
        inverted, krl, fanuc, rapid, other_language, parallel, printed, messages, unnamed_angles,
        program_beside, times_and_names, failed_rows, two_of_a_language, old_results,
    )
}  # fmt: skip


@pytest.mark.parametrize("make", LAYOUTS.values(), ids=LAYOUTS.keys())
def test_a_layout_comes_in_at_the_first_attempt(make, tmp_path):
    make(tmp_path / "in")
    poses, pictures, sample = world()
    target = sample.document["target"]
    done = visioncal(
        "convert", tmp_path / "in", tmp_path / "out", "--target", target, "--mount", "eye-in-hand"
    ).good()
    session = Session.load(tmp_path / "out")
    found = np.array([view.base_from_flange().as_matrix() for view in session.views])
    # Nine decimals of millimetres and degrees are written where a text has them.
    np.testing.assert_allclose(found, poses, atol=1e-9)
    for view, picture in zip(session.views, pictures, strict=True):
        data = np.frombuffer(session.images.read(view.image), np.uint8)
        stored = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        # JPEG changes grey levels by a few, and another view by tens.
        assert np.mean(cv2.absdiff(stored, picture)) < 3
    if make is stems_with_depth:
        assert [Path(view.text["source_depth"]).name for view in session.views][1] == "1.png"
        assert "depth pictures #.png (9 files)" in done.err
        assert "Left aside, as rows differ in their shape: joints" in done.err
    if make is two_folders:
        assert "Left out of the images: rgb/frame_#_corners.png (9 files)" in done.err
    if make in (sixes, blanks, inverted):
        assert "Found by the images: With the robot's" in done.err
    if make in (nested, array, messages, unnamed_angles):
        assert session.camera is not None


def test_an_unknown_folder_is_described_with_the_command_that_takes_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    poses, _, sample = world()
    for at, pose in enumerate(poses):
        write(tmp_path / f"in/{at}.json", {"alpha": pose.tolist(), "beta": np.eye(4).tolist()})
    shoot(tmp_path / "in", "{}.png")
    said = ("--target", sample.document["target"], "--mount", "eye-in-hand")
    words = look(tmp_path / "in").words()
    assert "#.png (9 files): images, 640 x 400, 8-bit grey" in words
    assert "alpha: 4 x 4, " in words
    assert words.count("looks like a pose") == 2
    followed = follow("convert", "in", "out", *said)
    assert "beta: 4 x 4, 0 to 1: looks like a pose" in followed.runs[0].refused().err
    followed.last.good()
    assert len(followed.done) == 1
    found = [view.base_from_flange().as_matrix() for view in Session.load("out").views]
    np.testing.assert_allclose(found, poses, atol=1e-12)


def test_a_tracker_s_joints_and_points_in_two_files_are_a_session_of_its(tmp_path):
    rng = np.random.default_rng(1)
    joints, points = rng.uniform(-90, 90, (12, 6)), rng.uniform(500, 900, (12, 3))
    (tmp_path / "in").mkdir()
    np.savetxt(tmp_path / "in/joints.txt", joints)
    lines = [f"A,Group1,p{at},{x},{y},{z}" for at, (x, y, z) in enumerate(points.tolist())]
    write(tmp_path / "in/points.csv", "\n".join(["collection,group,point,X,Y,Z", *lines]))
    visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-to-hand").good()
    view = Session.load(tmp_path / "out").views[3]
    np.testing.assert_allclose(view.joints_rad, np.deg2rad(joints[3]))
    assert view.numbers["meas_y_m"] == pytest.approx(1e-3 * points[3, 1])


def test_poses_beside_joints_are_the_target_s_where_nothing_else_was_seen(tmp_path):
    poses = world()[0]
    joints = [
        ";".join(f"{30.0 * at + n:.1f}".replace(".", ",") for n in range(6)) for at in range(9)
    ]
    rows = []
    for pose in poses:
        x, y, z, qx, qy, qz, qw = map(float, seven(pose))
        numbers = (1e3 * x, 1e3 * y, 1e3 * z, qw, qx, qy, qz)
        rows.append(";".join(f"{number:.12f}".replace(".", ",") for number in numbers))
    write(tmp_path / "in/joints.csv", "\n".join(["J1;J2;J3;J4;J5;J6", *joints]))
    write(tmp_path / "in/tracker.csv", "\n".join(["X;Y;Z;q0;q1;q2;q3", *rows]))
    said = ("--mount", "eye-to-hand", "--robot-model", "ur10")
    visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    views = Session.load(tmp_path / "out").views
    found = np.array([view.cam_from_target().as_matrix() for view in views])
    # Twelve decimals of millimetres.
    np.testing.assert_allclose(found, poses, atol=1e-11)
    np.testing.assert_allclose(views[2].joints_rad, np.deg2rad(60.0 + np.arange(6)))


@pytest.mark.parametrize(
    ("name", "target", "words"),
    [
        ("npz-base2ee", "checkerboard_4x7_33mm", "The poses fit as declared"),
        ("rpy-unstated", "checkerboard_11x8_20mm", "as Euler angles xyz about fixed axes in rad"),
    ],
)
def test_cases_of_the_field_come_in(tmp_path, name, target, words):
    if not FIELD.is_dir():
        pytest.skip("the cases of the field are not here (../shared/data)")
    out = tmp_path / "out"
    done = visioncal("convert", FIELD / name, out, "--target", target, "--mount", "eye-in-hand")
    assert words in done.good().err


def test_a_board_of_other_counts_is_named_before_the_form_is_asked_for(tmp_path):
    if not FIELD.is_dir():
        pytest.skip("the cases of the field are not here (../shared/data)")
    said = ("--target", "checkerboard_9x6_35mm", "--mount", "eye-in-hand")
    done = visioncal("convert", FIELD / "checkerboard-miscounted", tmp_path / "out", *said)
    done.refused("11 x 8 inner corners", "9 x 6", "--target")
    assert not (tmp_path / "out").exists()
    said = ("--target", "checkerboard_11x8_35mm", "--mount", "eye-in-hand")
    done = visioncal("convert", FIELD / "checkerboard-miscounted", tmp_path / "out", *said)
    assert "Euler angles" in done.good().err
