"""Recordings in layouts that no program of a known name writes: each gives the same session."""

import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w
from scipy.io import savemat
from scipy.spatial.transform import RigidTransform, Rotation
from support.commands import visioncal
from support.following import follow
from support.marks import slow
from support.samples import made_up
from support.urdf_arm import URDF, of_urdf

from visioncal.calibration.stages import detect
from visioncal.core.documents import tables
from visioncal.core.errors import DataError
from visioncal.interchange.formats import file_search, reading, settling
from visioncal.interchange.formats.columns import foreign_from
from visioncal.interchange.formats.fields import Fields
from visioncal.interchange.formats.foreign import ImportOptions, PoseImportOptions
from visioncal.interchange.formats.pose_forms import poses_from
from visioncal.interchange.formats.poses import pose_names, possible_poses
from visioncal.interchange.formats.reading import read_fields
from visioncal.interchange.formats.registry import read_foreign
from visioncal.interchange.formats.sources import describe, proposed
from visioncal.results.frame import FrameFile
from visioncal.robot import Robot
from visioncal.robot.files import read_robot_document
from visioncal.session import Session
from visioncal.session.columns import MEASURED_CAM_POSE, POSE
from visioncal.session.depth import ply_of, read_depth
from visioncal.vision.boards.charuco import charuco_board
from visioncal.vision.targets import target_document

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


def sevens(poses=None):
    """Positions and quaternions as text, as their digits are."""
    return [
        [*map(repr, map(float, seven(pose)))] for pose in (world()[0] if poses is None else poses)
    ]


def angles_of(order, *, unit=1e3, degrees=True, poses=None):
    """(n, 6) positions and Euler angles."""
    poses = np.array(world()[0] if poses is None else poses)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_euler(order, degrees=degrees)
    return np.hstack([unit * poses[:, :3, 3], turns])


def vectors(unit=1e3):
    """(n, 6) positions and rotation vectors."""
    turns = Rotation.from_matrix(world()[0][:, :3, :3]).as_rotvec()
    return np.hstack([unit * world()[0][:, :3, 3], turns])


def named(names, numbers, form="{} {:.9f}"):
    """Numbers, each after its name."""
    return [form.format(*each) for each in zip(names, numbers, strict=True)]


def shoot(folder: Path, name: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for at, picture in enumerate(world()[1]):
        cv2.imwrite(str(folder / name.format(at)), picture)


def shoot_one(file: Path, at: int) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), world()[1][at])


def write_table(path: Path, names, rows) -> None:
    """Writes a table with a header."""
    lines = (",".join(map(repr, row)) for row in rows.tolist())
    write(path, "\n".join([",".join(names), *lines]))


def write(path: Path, document: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(document if isinstance(document, str) else json.dumps(document))


def stems_with_depth(folder):
    shoot(folder, "{}.jpg")
    for at, pose in enumerate(world()[0]):
        cv2.imwrite(str(folder / f"{at}.png"), np.full((4, 6), 900 + at, np.uint16))
        write(folder / f"{at}.json", {"ee_pose": pose.tolist(), "joints": [[1.0] * (6 + at % 2)]})


def two_folders(folder):
    folder = folder / "Debug"
    shoot(folder / "rgb", "frame_{:03d}.png")
    for at, pose in enumerate(world()[0]):
        write(
            folder / f"poses/T_{at:03d}.txt",
            "\n".join(" ".join(map(repr, r)) for r in pose.tolist()),
        )
    shoot(folder / "rgb", "frame_{:03d}_corners.png")
    shoot(folder / "DrawChessboard", "frame_{:03d}.png")


def calls_of_numpy(folder):
    """A matrix a view, as NumPy's call in Python that gives it."""
    shoot(folder, "{}_view.png")
    for at, pose in enumerate(world()[0]):
        write(folder / f"{at}_view.txt", f"{'T = ' * (at % 2)}np.array({pose.tolist()})\n")


def array(folder):
    shoot(folder, "img{:02d}.png")
    np.save(folder / "robot_poses.npy", world()[0])
    np.save(folder / "camera_matrix.npy", [[520.0, 0, 322.5], [0, 521, 198], [0, 0, 1]])


def sixes(folder):
    """Euler angles of no stated order in degrees, positions in millimetres."""
    shoot(folder, "img{:02d}.png")
    np.save(folder / "poses.npy", angles_of("xyz"))


def opencv_each(folder):
    shoot(folder, "img{:02d}.png")
    head = "%YAML:1.0\n---\npose: !!opencv-matrix\n   rows: 7\n   cols: 1\n   dt: d\n"
    for at, numbers in enumerate(sevens()):
        write(folder / f"pose{at:02d}.yml", f"{head}   data: [ {', '.join(numbers)} ]\n")


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
    rows = angles_of("ZYX", unit=1.0).tolist()
    write(folder / "poses.txt", "\n".join(" ".join(map(repr, row)) for row in rows))


def inverted(folder):
    shoot(folder, "img{:02d}.png")
    np.savez(folder / "data.npz", poses=np.linalg.inv(world()[0]))


def krl_lines(names, poses):
    for name, numbers in zip(names, angles_of("ZYX", poses=poses), strict=True):
        cells = ",".join(named("XYZABC", numbers))
        yield f"DECL E6POS {name}={{{cells},S 2,T 35,E1 0.0,E2 0.0}}"


def krl(folder):
    shoot(folder, "img{:02d}.png")
    lines = ["&ACCESS RVP", "DEFDAT CALIB", ";FOLD", "DECL FDAT FP1={TOOL_NO 1,BASE_NO 0}"]
    lines += krl_lines(map("XP{}".format, range(9)), world()[0])
    write(folder / "calib.dat", "\n".join([*lines, "ENDDAT"]))


def fanuc(folder):
    shoot(folder, "img{:02d}.png")
    text = "/PROG CALIB\n/MN\n   1:J P[1] 10% FINE    ;\n/POS\n"
    for at, numbers in enumerate(angles_of("xyz"), 1):
        place = ",\t".join(named("XYZ", numbers[:3], "{} = {:.9f} mm"))
        turn = ",\t".join(named("WPR", numbers[3:], "{} = {:.9f} deg"))
        head = "GP1:\n\tUF : 0, UT : 1,\tCONFIG : 'N U T, 0, 0, 0',"
        text += f"P[{at}]{{\n   {head}\n\t{place},\n\t{turn}\n}};\n"
    write(folder / "calib.ls", text + "/END\n")


def robtargets(names, poses):
    for name, pose in zip(names, poses, strict=True):
        qx, qy, qz, qw = (f"{number:.9f}" for number in seven(pose)[3:])
        place = ",".join(f"{1e3 * number:.9f}" for number in pose[:3, 3])
        turn, rest = f"{qw},{qx},{qy},{qz}", "[0,0,-1,0],[9E9,9E9,9E9,9E9,9E9,9E9]"
        yield f"  CONST robtarget {name}:=[[{place}],[{turn}],{rest}];"


def rapid(folder):
    shoot(folder, "img{:02d}.png")
    lines = ["MODULE Calib", *robtargets(map("p{}".format, range(9)), world()[0])]
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
    rows = angles_of("ZYZ", unit=1.0, degrees=False).tolist()
    lines = [",".join([f"{at}.png", *map(repr, row)]) for at, row in enumerate(rows)]
    write(folder / "poses.csv", "\n".join(["image,e1,e2,e3,e4,e5,e6", *lines]))


def program_beside(folder):
    """A table and the robot's program with the same poses, rounded."""
    krl(folder)
    shoot(folder, "{:02d}.png")
    rows = enumerate(angles_of("ZYX").tolist())
    lines = [";".join([f"{at:02d}", *map(repr, row)]) for at, row in rows]
    write(folder / "Positionen.csv", "\n".join(["Foto;X [mm];Y [mm];Z [mm];A;B;C", *lines]))


def times_and_names(folder):
    """Two columns that name the same images, and a rotation before its position."""
    shoot(folder / "rgb", "17{}.250000.png")
    rows = ["stem,file,winkel_x,winkel_y,winkel_z,ort_x,ort_y,ort_z"]
    for at, row in enumerate(np.roll(angles_of("XYZ", unit=1.0, degrees=False), 3, 1).tolist()):
        names = f"17{at}.250000,C:\\shots\\17{at}.250000.png"
        rows.append(",".join([names, *map(repr, row)]))
    write(folder / "poses.csv", "\n".join(rows))


def failed_rows(folder):
    """Vectors of six, some of which failed, beside joints of different counts."""
    shoot(folder / "shots", "{}.png")
    log = [
        {"img": f"shots/{at}.png", "tcp": row, "joints": [0.5] * (6 + at % 2), "force": [0.1, 9.8]}
        for at, row in enumerate(vectors(1.0).tolist())
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


def later_names(folder):
    """Records of their own times, two seconds after the pictures', in another order of folders."""
    for at, pose in enumerate(world()[0]):
        second = 3 + 6 * at
        shoot_one(folder / f"写真/20231102_1435{second:02d}.png", at)
        place, turn = (
            ", ".join(map(repr, part.ravel().tolist()))
            for part in (1e3 * pose[:3, 3], pose[:3, :3])
        )
        text = f"; 単位 mm\n[フランジ]\n位置 = {place}\n回転行列 = {turn}\n[その他]\n荷重 = 2.4\n"
        write(folder / f"姿勢/20231102_1435{second + 2:02d}.ini", text)


def quaternion_first(folder):
    """Arrays of one shape: rotations before positions, and joint angles."""
    shoot(folder / "obs", "rgb{}.png")
    numbers = np.array([seven(pose) for pose in world()[0]])
    np.save(folder / "O_T_F.npy", np.roll(numbers, 4, axis=1))
    np.save(folder / "q.npy", np.random.default_rng(0).uniform(-2, 2, numbers.shape))


def three_deep(folder):
    """Records shuffled in nested lists, with words between, below a single date."""
    shoot(folder / "immagini", "st{}.png")
    rows = [
        [
            f"stazione {at}",
            [[row[:3], row[3:]], ["mm", "rad"]],
            [f"st{at}.png", ["esposizione", 11]],
        ]
        for at, row in enumerate(vectors().tolist())
    ]
    stations = {"note": [[], ["x"]], "stazioni": [rows[4 * at % 9] for at in range(9)]}
    write(folder / "dati.json", {"prove": {"2021-10-05": stations}})


def two_lists(folder):
    """Names of pictures in one list, poses in another and shuffled, joined by an id."""
    shoot(folder, "{}.png")
    shots = [{"id": f"P{at}", "file": f"{at}.png"} for at in range(9)]
    poses = [
        {"id": f"P{at}", "flange": seven(world()[0][at])} for at in (4 * k % 9 for k in range(9))
    ]
    write(folder / "log.json", {"shots": shots, "states": poses})


def poses_as_texts(folder):
    """Events of several kinds, whose poses are texts, the one that was asked for among them."""
    shoot(folder / "grabs", "grab-{:02d}.png")
    lines = [{"ev": "boot", "fw": "5.9.4"}]
    for at, row in enumerate(vectors(1.0)):
        target, reached = (
            f"p[{', '.join(f'{n:.12f}' for n in [*(row[:3] + off), *row[3:]])}]"
            for off in (0.02 * at, 0)
        )
        seen = {"file": f"grab-{at:02d}.png", "actual_flange": reached, "q": [1.0] * 6}
        lines += [{"ev": "move", "target": target}, {"ev": "grab", **seen}]
    write(folder / "events.jsonl", "\n".join(map(json.dumps, lines)))


def keys_are_names(folder):
    """A mapping by the pictures' names, in centimetres, with words of another language."""
    shoot(folder / "zdjęcia", "ujecie{}.png")
    records = {}
    for at in sorted(range(9), key=lambda at: -at):
        x, y, z, *turn = map(float, seven(world()[0][at]))
        pose = {"nastawienie": turn, "miejsce": [1e2 * x, 1e2 * y, 1e2 * z]}
        records[f"ujecie{at}"] = {"nadgarstek": pose, "jakość": 0.8 + at / 100}
    write(folder / "pomiary.json", {"jednostki": {"miejsce": "cm"}, "pomiary": records})


def another_order(folder):
    """Angles about x, y, z in columns of that order, which are applied in another one."""
    shoot(folder / "frames/cam0", "{}.png")
    rows = angles_of("YXZ", unit=1.0, degrees=False)[:, [4, 3, 5, 0, 1, 2]].tolist()
    lines = [",".join([*map(repr, row), f"cam0/{at}.png"]) for at, row in enumerate(rows)]
    write(folder / "arm.csv", "\n".join(["rx,ry,rz,tx,ty,tz,img", *lines]))


def comment_above(folder):
    """A comment above the header of a table with the ending of programs; angles first."""
    shoot(folder / "aufn", "a_{}.png")
    rows = np.roll(angles_of("ZXZ"), 3, axis=1).tolist()
    lines = [";".join([str(at), *map(repr, row), f"a_{at}.png"]) for at, row in enumerate(rows)]
    head = ["# Roboterstand 14.02.2018, Weg in mm", "lfd;phi;theta;psi;x;y;z;aufn"]
    write(folder / "stand.dat", "\n".join([*head, *lines]))


def beside_a_decoy(folder):
    """Matrices by columns, beside those of another program in a frame and scale of its own."""
    shoot(folder / "images", "{:04d}.png")
    rng = np.random.default_rng(1)
    frames = []
    for at in rng.permutation(9):
        decoy = np.eye(4)
        decoy[:3, :3], decoy[:3, 3] = (
            Rotation.random(random_state=int(at)).as_matrix(),
            rng.normal(size=3),
        )
        names = {"file_path": f"./images/{at:04d}", "transform_matrix": decoy.tolist()}
        frames.append({**names, "ee_to_base": world()[0][at].T.tolist()})
    write(folder / "transforms.json", {"fl_x": 520.0, "frames": frames})


def matlab(folder):
    """An array with the views last."""
    shoot(folder, "img_{}.png")
    savemat(folder / "calib.mat", {"T_base_tool": np.moveaxis(world()[0], 0, -1), "units": "m"})


def dense_log(folder):
    """A log of the robot beside it at a higher rate, of which a few rows have a picture."""
    shoot(folder / "cam", "17000000{}0.50.png")
    lines = []
    for step in range(-20, 100):
        numbers = [1700000000.51 + step, *seven(world()[0][min(max(round(step / 10), 0), 8)])]
        lines.append(" ".join(f"{number:.12f}" for number in numbers))
    write(folder / "robot.tum", "\n".join(lines))


def two_sessions(folder):
    """Parallel lists in two groups, whose pictures have the same names in two folders."""
    groups = []
    for group, rows in (("matin", range(5)), ("soir", range(5, 9))):
        for at in rows:
            shoot_one(folder / f"{group}/p{at % 5}.png", at)
        numbers = [seven(world()[0][at]) for at in rows]
        poses = [[each[:3], [each[6], *each[3:6]]] for each in numbers]
        groups.append({"nom": group, "images": [f"p{at % 5}.png" for at in rows], "poses": poses})
    document = {"config": {"repos": [[0.3, 0.0, 0.5], [0.0, 1.0, 0.0, 0.0]]}, "seances": groups}
    write(folder / "releve.json", document)


def several_bodies(folder):
    """A row a body and frame of a tracker, and a table that says in which frame a picture is."""
    shoot(folder / "shots", "DSC_77{:02d}.png")
    rng, lines = np.random.default_rng(2), ["frame,body,x,y,z,qx,qy,qz,qw,residual"]
    for frame in range(27):
        rig = world()[0][frame // 3] if frame % 3 == 0 else world()[0][4]
        table = [0.05, 1.1, 1.2, *Rotation.from_euler("x", 70, degrees=True).as_quat()]
        wand = [*rng.normal(size=3), *Rotation.random(random_state=frame).as_quat()]
        for body, numbers in ((31, wand), (4, table), (12, seven(rig))):
            cells = [*(1e3 * np.array(numbers[:3])), *numbers[3:]]
            lines.append(
                ",".join([f"{19500 + frame},{body}", *(f"{n:.12f}" for n in cells), "0.1"])
            )
    write(folder / "tracking.csv", "\n".join(["# export 6dof, 120 Hz", "# units: mm", *lines]))
    order = [4 * k % 9 for k in range(9)]
    shots = [f"DSC_77{at:02d}.png,{19500 + 3 * at}" for at in order]
    write(folder / "shots.csv", "\n".join(["photo,trigger_frame", *shots]))


def sentence_above(folder):
    """A comment of as many words as there are columns, above a number and a 3 x 4 matrix."""
    shoot(folder / "img", "{}7.png")
    lines = [
        " ".join([f"{at}7", *map(repr, np.linalg.inv(pose)[:3].ravel().tolist())])
        for at, pose in enumerate(world()[0])
    ]
    sentence = "# frame   T (3x4, row by row), robot base seen from the flange, m"
    write(folder / "poses.txt", "\n".join([sentence, *lines]))


def sorted_as_text(folder):
    """An array in the order of the pictures' names as texts, 10 before 2."""
    for at in range(9):
        shoot_one(folder / f"{at + 6}.png", at)
    np.save(folder / "poses.npy", world()[0][sorted(range(9), key=lambda at: str(at + 6))])


def called_by_words(folder):
    """Names without a number, with endings of their own by kind."""
    for at, pose in enumerate(world()[0]):
        name = "abcdefghi"[(4 * at) % 9] * 3
        shoot_one(folder / f"shots/scene-{name}.png", at)
        write(folder / f"arm/scene-{name}_hand.json", {"pose": pose.tolist()})


def a_folder_a_view(folder):
    """Folders without a number, with files of the same names in each."""
    for at, pose in enumerate(world()[0]):
        view = folder / f"take_{'abcdefghi'[(4 * at) % 9]}"
        shoot_one(view / "color.png", at)
        write(view / "state.yaml", json.dumps({"flange": pose.tolist(), "speed": 0.1}))


def columns_as_lists(folder):
    """A list a column in one mapping, whole numbers among them."""
    shoot(folder, "{:03d}.png")
    numbers = np.array([seven(pose) for pose in world()[0]]).T.tolist()
    names = dict(zip(("X", "Y", "Z", "i", "j", "k", "w"), numbers, strict=True))
    document = {"n": [9], "gain": [3, 1, 2, 0, 4, 8, 7, 6, 5], **names, "iso": [*range(8, -1, -1)]}
    write(folder / "arm.json", {"log": document})


def blocks_of_text(folder):
    """A log of several lines a view, with the picture's name above; grey pictures beside."""
    shoot(folder, "view{}.png")
    for at, picture in enumerate(world()[1]):
        cv2.imwrite(str(folder / f"view{at}.png"), cv2.merge([picture] * 3))
        cv2.imwrite(str(folder / f"infra{at}.png"), np.roll(picture, 25, axis=1))
    text = "calibration run of 2024\n"
    for at in (4 * k % 9 for k in range(9)):
        place, turn = seven(world()[0][at])[:3], seven(world()[0][at])[3:]
        text += f"saved view{at}.png\n  position: {' '.join(map(repr, map(float, place)))}\n"
        text += f"  rotation (xyzw) = [{', '.join(map(repr, map(float, turn)))}]\n\n"
    write(folder / "run.log", text)


def mappings_of_any_names(folder):
    """Angles in a mapping under names of another kind."""
    shoot(folder, "{}.png")
    for at, row in enumerate(angles_of("ZXZ").tolist()):
        turn = dict(zip(("psi", "theta", "phi"), row[3:], strict=True))
        place = dict(zip("xyz", row[:3], strict=True))
        write(folder / f"{at}.json", {"arm": {"lage": turn, "stelle": place}})


def rounds(folder):
    """Lists of pictures and poses in several rounds, without a name."""
    shoot(folder / "foto", "img_{}.png")
    rows = [[f"img_{at}.png", [seven(p)[:3], seven(p)[3:]]] for at, p in enumerate(world()[0])]
    document = {"velocita": [0.1, 0.1], "giri": [rows[:3], rows[3:5], rows[5:]]}
    write(folder / "giri.json", document)


def pictures_to_numbers(folder):
    """Six numbers by the name of the picture, and nothing else."""
    shoot(folder, "zdj_{}.png")
    rows = enumerate(angles_of("xyz").tolist())
    write(folder / "pozycje.json", {f"zdj_{at}.png": row for at, row in rows})


def lines_with_brackets(folder):
    """A value a line, whose unit is in brackets."""
    shoot(folder / "camera", "gauche_{}.png")
    for at, row in enumerate(vectors().tolist()):
        place, vector = (" ".join(map(repr, part)) for part in (row[:3], row[3:]))
        lines = ["Date : 14/03/2021 15:11:07", f"Position (mm) : {place}"]
        text = "\n".join([*lines, f"Vecteur rotation (rad) : {vector}", "Vitesse (%) : 20"])
        write(folder / f"bras/pose_{at}.txt", text)


def with_others(first=0, last=0):
    """The robot's poses between others where it took no picture, by whether they are these."""
    away = [np.array(world()[0][4]) for _ in range(first + last)]
    for at, pose in enumerate(away):
        pose[:3, 3] += 0.1 + 0.02 * at
    return [*away[:first], *world()[0], *away[first:]]


def krl_with_a_retract(folder):
    """A program whose last point has no picture."""
    shoot(folder, "P{}.png")
    lines = krl_lines(map("XP{}".format, range(10)), with_others(0, 1))
    write(folder / "calib.dat", "\n".join(lines))


def krl_from_one(folder):
    """Points from 1 on, the first and the last without a picture, and pictures from 0 on."""
    shoot(folder / "pics", "{}.png")
    names = map("XP{}".format, range(1, 12))
    write(folder / "calib.dat", "\n".join(krl_lines(names, with_others(1, 1))))


def krl_with_a_home_of_another_name(folder):
    """Points in steps of ten between two of other names, and pictures counted by the camera."""
    shoot(folder, "IMG_{:04d}.png")
    names = ["XHOME", *(f"XP{at}" for at in range(10, 100, 10)), "XBACK"]
    write(folder / "calib.dat", "\n".join(krl_lines(names, with_others(1, 1))))


def rapid_with_a_home(folder):
    """A first target without a picture."""
    shoot(folder / "Pictures", "HE{}0.png")
    lines = robtargets(["pHome", *(f"pHE{at}0" for at in range(9))], with_others(1))
    write(folder / "calib.mod", "\n".join(["MODULE Calib", *lines, "ENDMODULE"]))


def lines_of_lost_pictures(folder):
    """A line a picture, of which three were deleted."""
    lost, names = iter(with_others(3)[:3]), iter(range(9))
    lines = list[str]()
    for number in range(1, 13):
        at = None if number in (3, 4, 9) else next(names)
        lines += map(",".join, sevens([next(lost) if at is None else world()[0][at]]))
        if at is not None:
            shoot_one(folder / f"{number}.jpg", at)
    write(folder / "poses.txt", "\n".join(lines))


def lines_of_few_pictures(folder):
    """A line a picture, of which two in three were deleted: their numbers have gaps."""
    kept, lost = (1, 2, 4, 7, 8, 9, 12, 13, 24), iter(with_others(17)[:17])
    lines = list[str]()
    for number in range(1, 27):
        at = kept.index(number) if number in kept else None
        lines += map(",".join, sevens([next(lost) if at is None else world()[0][at]]))
        if at is not None:
            shoot_one(folder / f"img{number:02d}.png", at)
    write(folder / "poses.txt", "\n".join(lines))


def letters_of_a_lost_picture(folder):
    """A line more than pictures, whose names count nothing: motion says which is over."""
    for at in range(9):
        shoot_one(folder / f"shot{'abcdefghi'[at]}.png", at)
    poses = [*world()[0][:5], with_others(1)[0], *world()[0][5:]]
    write(folder / "poses.txt", "\n".join(map(",".join, sevens(poses))))


def letters_of_a_picture_too_many(folder):
    """A picture more than lines, of nothing."""
    for at in range(9):
        shoot_one(folder / f"shot{'abcefghij'[at]}.png", at)
    cv2.imwrite(str(folder / "shotd.png"), np.full((400, 640), 150, np.uint8))
    write(folder / "poses.txt", "\n".join(map(",".join, sevens())))


def headings_in_turn(folder):
    """A number a line below the headings of a position and a quaternion, one after the other."""
    shoot(folder / "pics", "{}.png")
    names = ("translation: ", "x", "y", "z", "rotation: ", "x", "y", "z", "w")
    lines = list[str]()
    for row in sevens():
        numbers = iter(row)
        lines += [name if ":" in name else f"{name}: {next(numbers)}" for name in names]
    write(folder / "tfs.txt", "\n".join(lines))


def lines_before_the_first_picture(folder):
    """Two lines more than pictures, which are counted from one."""
    for at in range(9):
        shoot_one(folder / f"shot{at + 1}.png", at)
    np.savetxt(folder / "poses.txt", [seven(pose) for pose in with_others(2)])


def urscript_with_a_start(folder):
    """Named poses of a script, the first of another name."""
    shoot(folder, "wp{}.png")
    names = ["start_p", *(f"Waypoint_{at}_p" for at in range(9))]
    lines = ["def calib():"]
    for name, pose in zip(names, with_others(1), strict=True):
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_rotvec()]
        lines.append(f"  global {name}=p[{', '.join(f'{number:.12f}' for number in numbers)}]")
    write(folder / "calib.script", "\n".join([*lines, "end"]))


PREAMBLE = (
    *("Projekt;Zelle 4;;;;;;", "Roboter;Yaskawa GP7, YRC1000;;;;;;", "Stand;1,5;;;;;;"),
    *("Winkel wie am Pendant: Rx, Ry, Rz (°);;;;;;;", ";;;;;;;", ""),
)


def below_a_preamble(folder):
    """A table of Windows with decimal commas below rows of as many cells."""
    shoot(folder / "Bilder", "Bild_{}.png")
    lines = ["Nr.;Bild;X [mm];Y [mm];Z [mm];Rx [°];Ry [°];Rz [°]"]
    for at, row in enumerate(angles_of("xyz")):
        numbers = ";".join(f"{number:.10f}".replace(".", ",") for number in row)
        lines.append(f"{at + 1};Bild_{at}.png;{numbers}")
    (folder / "Messung.csv").write_bytes("\r\n".join([*PREAMBLE, *lines]).encode("cp1252"))


def below_tabs(folder):
    """Three rows of a preamble between tabs, and a header without a number or an image."""
    shoot(folder, "shot{}.png")
    lines = ["operator\tM. K.\t\t\t\t\t", "date\t2026-07-14\t\t\t\t\t", "version\t3\t\t\t\t\t"]
    lines += ["x\ty\tz\tqx\tqy\tqz\tqw", *map("\t".join, sevens())]
    write(folder / "log.txt", "\n".join(lines))


def below_units(folder):
    """A long preamble of other widths, units below the header, and a last row without a picture."""
    shoot(folder, "a{}.png")
    lines = [*["Robot: TX2-90"] * 14, "", "Bild;X;Y;Z;Rx;Ry;Rz", ";[mm];[mm];[mm];deg;deg;deg"]
    for at, row in enumerate(angles_of("xyz")):
        lines.append(";".join([f"a{at}.png", *(f"{n:.10f}".replace(".", ",") for n in row)]))
    lines.append(lines[-1].replace("a8.png", "n/a"))
    write(folder / "p.csv", "\n".join(lines))


def below_headings(folder):
    """Matrices below headings of as many words as they have columns, numbered as pictures."""
    shoot(folder, "capture_{}.png")
    text = ""
    for at in (4 * k % 9 for k in range(9)):
        text += f"=== capture {at} ===\n"
        text += "".join(f"  {'  '.join(map(repr, row))}\n" for row in world()[0][at].tolist())
    write(folder / "run.log", text)


def points_of_a_table(folder):
    """A column of points' names, of which two have no picture."""
    shoot(folder, "P{}.png")
    rows = zip(
        ["HOME", *(f"P{at}" for at in range(9)), "END"], sevens(with_others(1, 1)), strict=True
    )
    lines = [",".join([name, *cells]) for name, cells in rows]
    write(folder / "p.csv", "\n".join(["point,x,y,z,qx,qy,qz,qw", *lines]))


def as_many_of_other_names(folder):
    """As many points as pictures, of which one has no picture, and one picture no point."""
    shoot(folder, "P{}.png")
    cv2.imwrite(str(folder / "P9.png"), world()[1][4][::-1])
    rows = zip(["HOME", *(f"P{at}" for at in range(9))], sevens(with_others(1)), strict=True)
    lines = [",".join([name, *cells]) for name, cells in rows]
    write(folder / "p.csv", "\n".join(["stop_name,x_m,y_m,z_m,qx,qy,qz,qw", *lines]))


def halcon(folder):
    """A file a picture as HALCON's write_pose has it, in each of its representations."""
    shoot(folder, "calib_image_{:02d}.png")
    codes = (0, 2, 4, 1, 3, 5, 8, 10, 13)
    for at, (code, pose) in enumerate(zip(codes, world()[0], strict=True)):
        turned = Rotation.from_matrix(pose[:3, :3])
        place = -pose[:3, :3].T @ pose[:3, 3] if code > 7 else pose[:3, 3]
        if code & 4:
            vector = turned.as_rotvec() * (-1 if code % 2 else 1)
            turns = vector / np.linalg.norm(vector) * np.tan(np.linalg.norm(vector) / 2)
        elif code % 2:
            # The product of the negated turns is the inverse of that in the other order.
            turns = turned.inv().as_euler("zyx" if code & 2 else "ZYX", degrees=True)
            turns = turns[::-1]
        else:
            turns = turned.as_euler("xyz" if code & 2 else "XYZ", degrees=True)
        text = f"#\n# 3D POSE PARAMETERS: rotation and translation\n#\n\nf {code}\n\n"
        for name, numbers in (("r", turns), ("t", place)):
            text += f"# {name}:\n{name} {' '.join(map(repr, np.asarray(numbers).tolist()))}\n\n"
        write(folder / f"robot_pose_{at:02d}.dat", text)


def console(folder):
    """A log of matrices, with the picture's name below, numbers between, and a last position."""
    shoot(folder / "texture", "frame_{:02d}.png")
    text = "Version: 1.17.3\nListening on port 59153...\nExposure: 12.5\n"
    for at, pose in enumerate(with_others(0, 1)):
        matrix = np.vstack([np.column_stack([pose[:3, :3], 1e3 * pose[:3, 3]]), [0, 0, 0, 1]])
        text += ">>> Robot position:\n"
        text += "".join(f"  {'  '.join(map(repr, row))}\n" for row in matrix.tolist())
        if at < 9:
            text += f"Dropped 0 frames\nTriggered, Frame Id: {at}\nRetrieved.\n"
            text += f"Texture saved: texture/frame_{at:02d}.png\nScore: 0.9{at}\n"
    write(folder / "TestLog.txt", text + "Client disconnected.\n")


def console_of_a_maker(folder):
    """The controller's answers as they were received, above the pictures' names."""
    shoot(folder, "scan{}.png")
    text = "Connected.\n"
    for at, row in enumerate(angles_of("ZYX")):
        cells = " ".join(named("XYZABC", row, '{}="{:.9f}"'))
        text += f"<State><Position {cells}></Position></State>\nTriggering a scan...\n"
        text += f"saved <File>scan{at}.png</File> in 0.4 s\n"
    write(folder / "run.log", text)


def pictures_above_poses(folder):
    """A log of a pendant's lines, each below its picture's name; the last move was not made."""
    shoot(folder, "{}.png")
    text = "run 3 of 2026-07-14\n"
    for at, row in enumerate(vectors(1.0)):
        text += f"wrote {at}.png\n  actual p[{', '.join(f'{n:.12f}' for n in row)}]\n"
    write(folder / "run.txt", text + "wrote thumbs\n")


def among_measurements(folder):
    """Six numbers of a common stem between forces, accelerations and joints; a description."""
    write(folder / "about.yaml", "poses: state.json, base frame\nboard: charuco\n")
    for at, row in enumerate(angles_of("xyz", unit=1.0)):
        shoot_one(folder / f"s{at}/color.png", at)
        cv2.imwrite(str(folder / f"s{at}/depth.png"), np.full((4, 6), 900 + at, np.uint16))
        state: dict[str, object] = {"mode": "READY", "arm_voltage": 24.1 + at}
        for stem in ("imu_acceleration_", "tool_twist_linear_", "tool_pose_", "force_"):
            numbers = row[:3] if stem == "tool_pose_" else 0.1 * world()[0][at][0, :3]
            state |= {f"{stem}{axis}": float(n) for axis, n in zip("xyz", numbers, strict=True)}
        state |= {f"tool_pose_theta_{a}": float(n) for a, n in zip("xyz", row[3:], strict=True)}
        joints = [{"position": 7.0 * at + n, "velocity": 0.0} for n in range(6)]
        write(folder / f"s{at}/state.json", {"base": state, "actuators": joints})


def six_of(pose):
    """Millimetres and degrees about fixed axes."""
    return angles_of("xyz", poses=[pose])[0].tolist()


def lists_in_a_log(folder):
    """Poses as lists between words, in lines with times; a setting of as many numbers; a repeat."""
    shoot(folder, "shot_{}.png")
    text = "2025-05-21 10:04:12,385 [INFO] sdk 1.14\n2025-05-21 10:04:14,721 [INFO] tcp offset "
    text += "[0, 0, 0, 0, 0, 0]\n"
    for at, pose in enumerate(world()[0]):
        when = f"2025-05-21 10:{at:02d}:17,{592 + at}"
        text += f"{when} [INFO] moving to point {at + 1}/9\n"
        for again in range(1 + at % 2):
            moved = [*six_of(pose)[:3], *six_of(world()[0][at - 1 + again + (at + 1) % 2])[3:]]
            text += f"{when} [INFO] read_position(radian=False) -> (0, {moved})\n"
        joints = [11.5 * at + n for n in range(6)]
        text += f"{when} [INFO] get_servo_angle(radian=False) -> (0, {joints})\n"
        text += f"{when} [WARNING] retry 1\n" * (at % 3) + f"{when} [INFO] saved shot_{at}.png\n"
    write(folder / "run.log", text)


def lists_over_lines(folder):
    """Matrices as numpy prints them, which begin in a sentence, above their pictures' names."""
    shoot(folder, "shot_{}.png")
    text = "started\n"
    for at, pose in enumerate(world()[0]):
        rows = "\n".join(
            f" {row}" for row in str(pose.tolist())[1:-1].replace("], ", "]\n").split("\n")
        )
        text += f"10:0{at}:17 base to tool [{rows.replace(',', ' ').strip()}]\n"
        text += f"10:0{at}:18 saved shot_{at}.png\n"
    write(folder / "run.log", text)


def lists_beside_pictures(folder):
    """Picture and pose in one sentence of equal counts of commas; a line above the first."""
    shoot(folder, "shot_{}.png")
    lines = [f"10:0{at} saved shot_{at}.png at {six_of(p)} mm" for at, p in enumerate(world()[0])]
    write(folder / "run.log", "\n".join(lines))


def lists_alone(folder):
    """Poses between other words, without the pictures' names, in their order."""
    shoot(folder, "{}.png")
    lines = [f"[INFO] waypoint {at}\n[INFO] pose is {six_of(p)}" for at, p in enumerate(world()[0])]
    write(folder / "run.log", "started\n" + "\n".join([*lines[:4], "[WARNING] slow", *lines[4:]]))


def echoed(at, *, matrix=False):
    """A transform as ROS' tf_echo prints it, or tf2_echo."""
    pose = world()[0][at]
    turn = Rotation.from_matrix(pose[:3, :3])
    angles, second = turn.as_euler("xyz"), "- Rotation: " if matrix else "            "
    text = f"At time {1700132235.676 + 20 * at:.3f}\n- Translation: {pose[:3, 3].tolist()}\n"
    text += f"- Rotation: in Quaternion {turn.as_quat().tolist()}\n"
    text += f"{second}in RPY (radian) {angles.tolist()}\n"
    text += f"{second}in RPY (degree) {np.rad2deg(angles).tolist()}\n"
    rows = "".join(f"  {'  '.join(map(repr, row))}\n" for row in pose.tolist())
    return text + f"- Matrix:\n{rows}" * matrix


def tf_echo(folder):
    """Blocks below their pictures' names, and the command above."""
    shoot(folder / "pics", "left{:04d}.jpg")
    text = "rosrun tf tf_echo /base_link /tool0   (one block per picture)\n\n"
    order = [4 * at % 9 for at in range(9)]
    write(folder / "tf.txt", text + "\n".join(f"left{at:04d}.jpg\n{echoed(at)}" for at in order))


def tf2_echo(folder):
    """Blocks without names."""
    shoot(folder, "left{:04d}.jpg")
    write(folder / "tf.txt", "".join(echoed(at, matrix=True) for at in range(9)))


def cells_of(order, poses=None):
    return [[f"{number:.10f}" for number in row] for row in angles_of(order, poses=poses)]


def job(folder):
    """A Yaskawa's job: positions in pulses, those in the base, and its instructions."""
    shoot(folder, "P{:05d}.png")
    lines = ["/JOB", "//NAME EYE", "//POS", "///NPOS 1,0,0,9,0,0", "///POSTYPE PULSE", "///PULSE"]
    lines += ["C00000=-1234,5,77,88,1000,9", "///POSTYPE BASE", "///RECTAN", "///RCONF 1,0,0,0,0"]
    lines += [f"P{at:05d}={','.join(cells)}" for at, cells in enumerate(cells_of("xyz"))]
    lines += ["//INST", "///DATE 2025/11/04 16:20", "NOP"]
    for at in range(9):
        lines += [f"MOVJ P{at:05d} VJ=5.00", "TIMER T=1.00", "PULSE OT#(5) T=0.20"]
    write(folder / "EYE.JBI", "\r\n".join([*lines, "END"]))


def within_braces(folder):
    """An Epson's points, with others between, of keys that begin with their types."""
    shoot(folder / "images", "cal{:02d}.png")
    names = ["Home", *(f"cal{at:02d}" for at in range(9)), "Park"]
    text = 'VERSION=1.0\nsSignature="RC+"\nnNumberOfPoints=11\n'
    for at, (name, cells) in enumerate(zip(names, cells_of("ZYX", with_others(1, 1)), strict=True)):
        text += f'Point{at + 1} {{\n\tnNumber={3 * at}\n\tsLabel="{name}"\n\tsDescription=""\n'
        text += "".join(named("XYZUVW", cells, "\tr{}={}\n"))
        text += "\trR=0\n\tnHand=1\n\tbSimVisible=False\n}\n"
    write(folder / "Robot1.pts", text.replace("\n", "\r\n"))


def elements(folder):
    """A Staubli's points, as attributes beside joints and others."""
    shoot(folder / "photos", "pCalib_{}.png")
    name = "http://www.staubli.com/robotics/VAL3/Data/2"
    text = f'<?xml version="1.0" encoding="utf-8" ?>\n<Database xmlns="{name}">\n<Datas>\n'
    text += '<Data name="n" type="num" size="1"><Value key="0" value="9" /></Data>\n'
    joints = "".join(f'<Value key="{k}" j1="{k}" j2="-20" j3="9"/>' for k in range(4))
    others = "".join(
        f'<Value key="{k}" x="{400 + k}" y="{9 * k}" z="3{k}0.5" rx="180" ry="{k}" rz="9{k}"/>'
        for k in range(5)
    )
    text += f'<Data name="jPark" type="jointRx">{joints}</Data>\n<Data name="pPick">{others}</Data>'
    text += '\n<Data name="pCalib" size="9">\n<!-- taught by hand -->\n'
    for at, cells in enumerate(cells_of("XYZ")):
        inner = " ".join(named(("x", "y", "z", "rx", "ry", "rz"), cells, '{}="{}"'))
        text += f'  <Value key="{at}" {inner} shoulder="rfree" fatherId="world[0]" />\n'
    write(folder / "eye/eye.dtx", text + "</Data></Datas>\n</Database>\n")


def nested_elements(folder):
    """Elements of any names, whose positions and rotations are elements of their own."""
    shoot(folder, "{}.png")
    text = "<session>\n  <operator>M</operator>\n  <views>\n"
    for at, pose in enumerate(world()[0]):
        x, y, z, *turn = map(float, seven(pose))
        text += f'<view image="{at}.png"><robot><position x="{x}" y="{y}" z="{z}"/>'
        text += f"<quaternion>{' '.join(map(str, turn))}</quaternion></robot></view>\n"
    write(folder / "record.xml", text + "</views></session>\n")


def tf_echo_each(folder):
    """What tf_echo prints of each picture, again and again, in a file of its own."""
    shoot(folder, "left{:04d}.jpg")
    for at in range(9):
        write(folder / f"left{at:04d}.txt", echoed((at + 1) % 9) + 2 * echoed(at))


def sections(folder):
    """An INI with a section a pose, beside one of settings."""
    shoot(folder / "Images", "Cam1_{:04d}.png")
    text = "; HandEyeTool\n[Setup]\nRobot=KUKA KR6 R900\nPoseCount=9\n\n"
    for at, cells in enumerate(cells_of("ZYX")):
        text += f"[Pose{at + 1}]\nImage=Images\\Cam1_{at:04d}.png\n"
        text += "".join(named("XYZABC", cells, "{}={}\n")) + "Used=1\n\n"
    write(folder / "HandEye.ini", text.replace("\n", "\r\n"))


def table_of(folder: Path) -> None:
    rows = [",".join([f"color_{at:03d}", *cells]) for at, cells in enumerate(sevens())]
    write(folder / "poses.csv", "\n".join(["name,x_m,y_m,z_m,qx,qy,qz,qw", *rows]))


def named_with_depth(folder):
    """A table that names the images, and depth pictures of their numbers in another folder."""
    shoot(folder / "rgb", "color_{:03d}.png")
    for at in range(len(world()[0])):
        (folder / "depth").mkdir(exist_ok=True)
        cv2.imwrite(
            str(folder / f"depth/depth_{at:03d}.png"), np.full((400, 640), 900 + at, np.uint16)
        )
    table_of(folder)


def named_with_clouds(folder):
    """The same with organised clouds of the images' names."""
    shoot(folder / "rgb", "color_{:03d}.png")
    for at in range(len(world()[0])):
        (folder / "clouds").mkdir(exist_ok=True)
        (folder / f"clouds/color_{at:03d}.ply").write_bytes(
            ply_of(np.full((400, 640, 3), 0.9 + 0.001 * at))
        )
    table_of(folder)


def arrays_each(folder):
    """An array of the pose and one of the joint angles a picture, called as no depth picture is."""
    shoot(folder, "{}.png")
    angles = np.random.default_rng(0).uniform(-2, 2, (9, 7))
    for at, (pose, joints) in enumerate(
        zip(angles_of("xyz", unit=1, degrees=False), angles, strict=True)
    ):
        np.save(folder / f"{at}_xyzrpy.npy", pose)
        np.save(folder / f"{at}_angles.npy", joints)


def infos_as_texts(folder):
    """A text with the pose a picture, and one with the camera_info that ROS printed."""
    shoot(folder, "{}.png")
    for at, pose in enumerate(world()[0]):
        write(folder / f"{at}_robot_pose.txt", ", ".join(map(repr, map(float, seven(pose)))))
        info = f"header:\n  seq: {at}\nheight: 400\nwidth: 640\ndistortion_model: plumb_bob\n"
        info += "D: [0.0, 0.0, 0.0, 0.0, 0.0]\nK: [520.0, 0, 322.5, 0, 521.0, 198.0, 0, 0, 1]\n"
        write(folder / f"{at}_camera_info.txt", info)


def axis_first(folder):
    """Names that begin with the axis, sorted by these."""
    keys = ["x_pos", "y_pos", "z_pos", "x_rot", "y_rot", "z_rot", "w_rot"]
    rows = {
        str(at): dict(sorted(zip(keys, map(float, seven(pose)), strict=True)))
        for at, pose in enumerate(world()[0])
    }
    write(folder / "world_to_tip.json", json.dumps({"world_to_tip": rows}))
    shoot(folder, "{}.png")


def two_of_a_day(folder):
    """Pictures of another recording, fewer and in a folder of their own, beside."""
    np.savetxt(folder_of(folder) / "poses_7-30.csv", vectors(), fmt="%.12f", delimiter=",")
    shoot(folder / "2025_7-30", "{}.png")
    for at in range(5):
        shoot_one(folder / f"2025_8-15/{at}.png", at)


def folder_of(folder):
    folder.mkdir(parents=True, exist_ok=True)
    return folder


LAYOUTS: Mapping[str, Callable[[Path], None]] = {
    make.__name__: make
    for make in (
        stems_with_depth, two_folders, array, sixes, opencv_each, nested, mappings, blanks,
        inverted, krl, fanuc, rapid, other_language, parallel, printed, messages, unnamed_angles,
        program_beside, times_and_names, failed_rows, two_of_a_language, old_results,
        later_names, quaternion_first, three_deep, two_lists, poses_as_texts, keys_are_names,
        another_order, comment_above, beside_a_decoy, matlab, dense_log,
        two_sessions, several_bodies, sentence_above,
        sorted_as_text, called_by_words, a_folder_a_view, columns_as_lists,
        blocks_of_text, mappings_of_any_names, rounds, pictures_to_numbers, lines_with_brackets,
        calls_of_numpy,
        krl_with_a_retract, krl_from_one, krl_with_a_home_of_another_name, rapid_with_a_home,
        as_many_of_other_names, below_units, below_headings, points_of_a_table,
        below_a_preamble, below_tabs, halcon,
        console, console_of_a_maker, pictures_above_poses, among_measurements,
        lists_in_a_log, lists_beside_pictures, lists_alone, lists_over_lines,
        tf_echo, tf2_echo, tf_echo_each,
        job, within_braces, elements, nested_elements, sections,
        headings_in_turn, lines_of_lost_pictures, lines_of_few_pictures, letters_of_a_lost_picture,
        letters_of_a_picture_too_many, lines_before_the_first_picture, urscript_with_a_start,
        named_with_depth, named_with_clouds, arrays_each, infos_as_texts,
        axis_first, two_of_a_day,
    )
}  # fmt: skip


# Another one is read by the same; of the poses of some, many readings are tried.
ALIKE = {
    "another_order", "axis_first", "below_a_preamble", "below_headings", "below_tabs",
    "below_units", "beside_a_decoy", "blanks", "columns_as_lists", "comment_above", "elements",
    "headings_in_turn", "letters_of_a_lost_picture", "letters_of_a_picture_too_many",
    "lines_before_the_first_picture", "lines_with_brackets", "lists_alone", "lists_beside_pictures",
    "lists_in_a_log", "mappings_of_any_names", "opencv_each", "pictures_to_numbers", "sixes",
    "sorted_as_text", "tf2_echo", "times_and_names", "two_of_a_day",
}  # fmt: skip


@pytest.mark.parametrize(
    "make",
    [slow(make) if name in ALIKE else make for name, make in LAYOUTS.items()],
    ids=LAYOUTS.keys(),
)
def test_a_layout_comes_in_at_the_first_attempt(make, tmp_path):
    make(tmp_path / "in")
    poses, pictures, sample = world()
    target = sample.document["target"]
    done = visioncal(
        "convert", tmp_path / "in", tmp_path / "out", "--target", target, "--mount", "eye-in-hand"
    ).good()
    session = Session.load(tmp_path / "out")
    found = np.array([view.base_from_flange().as_matrix() for view in session.views])
    shown = []
    for view in session.views:
        data = np.frombuffer(session.images.read(view.image), np.uint8)
        stored = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        away = [np.mean(cv2.absdiff(stored, picture)) for picture in pictures]
        # JPEG changes grey levels by a few, and another view by tens.
        assert min(away) < 3
        shown.append(int(np.argmin(away)))
    assert sorted(shown) == [*range(9)]
    # Nine decimals of millimetres and degrees are written where a text has them.
    np.testing.assert_allclose(found, poses[shown], atol=1e-9)
    if make is stems_with_depth:
        assert [Path(view.depth).name for view in session.views][1] == "1.png"
        assert session.images.read(session.views[1].depth).startswith(b"\x89PNG")
        assert "The depth #.png (9 files) is of the same images" in done.err
        assert "Left aside, as rows differ in their shape: joints" in done.err
    assert make is not arrays_each or len(session.views[0].joints_rad) == 7
    assert make is not arrays_each or "depth" not in done.err
    if make is two_folders:
        assert "frame_#.png (9 files), Debug/rgb/frame_#_corners.png (9 files)" in done.err
    if make in (named_with_depth, named_with_clouds):
        for at, view in zip(shown, session.views, strict=True):
            depth = read_depth(session.images.read(view.depth), view.depth, (640, 400))
            # Of single precision.
            assert np.ptp(depth) == 0.0
            assert depth[0, 0] == pytest.approx(0.9 + 0.001 * at, abs=1e-6)
    if make is among_measurements:
        assert "it is the views' depth" in done.err
    if make in (sixes, blanks, inverted):
        assert "Found by the images: With the robot's" in done.err
    if make is rapid_with_a_home:
        assert "1 of 10 rows are left out, as they have neither" in done.err
        assert "calib.mod, line 2 (pHome)" in done.err
    if make in (nested, array, messages, unnamed_angles, infos_as_texts):
        assert session.camera is not None


def test_an_unknown_folder_is_described_with_the_command_that_takes_it(tmp_path, monkeypatch):
    """Two frames of one hand agree with the images alike."""
    monkeypatch.chdir(tmp_path)
    poses, _, sample = world()
    tool = np.eye(4)
    tool[:3, 3] = 0.02, 0.0, 0.11
    for at, pose in enumerate(poses):
        write(tmp_path / f"in/{at}.json", {"alpha": pose.tolist(), "beta": (pose @ tool).tolist()})
    shoot(tmp_path / "in", "{}.png")
    said = ("--target", sample.document["target"], "--mount", "eye-in-hand")
    words = describe(tmp_path / "in").words()
    assert "#.png (9 files): images, 640 x 400, 8-bit grey" in words
    assert "alpha: 4 x 4, " in words
    assert words.count("looks like a pose") == 2
    followed = follow("convert", "in", "out", *said)
    assert "beta: 4 x 4, " in followed.runs[0].refused().err
    followed.last.good()
    assert len(followed.done) == 1
    found = [view.base_from_flange().as_matrix() for view in Session.load("out").views]
    np.testing.assert_allclose(found, poses, atol=1e-12)


@pytest.mark.parametrize(("names", "pictures"), [("", "{}.png"), ("P", "P{}.png")])
def test_poses_are_never_paired_by_count_alone(tmp_path, monkeypatch, names, pictures):
    """Poses of another robot beside one picture less: nothing says which one has none."""
    monkeypatch.setattr(settling, "_TESTED", (6,))
    shoot(tmp_path / "in", pictures)
    poses = [np.array(pose) for pose in with_others(1, 1)]
    for at, pose in enumerate(poses):
        pose[:3, :3] = Rotation.random(random_state=at).as_matrix()
    if names:
        points = (f"{names}{at}" for at in range(20, 31))
        write(tmp_path / "in/calib.dat", "\n".join(krl_lines(points, poses)))
    else:
        np.savetxt(tmp_path / "in/poses.txt", [seven(pose) for pose in poses])
    said = ("--target", world()[2].document["target"], "--mount", "eye-in-hand")
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *said)
    done.refused("9 images", "11 poses", "neither names nor numbers", "--image-column")
    assert "remove the last" not in done.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_motions_between_poses_are_no_poses(tmp_path, mount):
    """Of motions, a fit to hand has the camera's place on the flange twice, with a good verdict."""
    poses, _, session = world()
    seen = np.array([view.cam_from_target().as_matrix() for view in session.views])
    robot = np.linalg.inv(poses[:-1]) @ poses[1:]
    camera = seen[:-1] @ np.linalg.inv(seen[1:])
    names = [f"{side}_{name}" for side in "AB" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    rows = [[*seven(a), *seven(b)] for a, b in zip(robot, camera, strict=True)]
    lines = [",".join(names), *(",".join(map(repr, map(float, row))) for row in rows)]
    write(tmp_path / "motions.csv", "\n".join(lines))
    done = visioncal("convert", tmp_path / "motions.csv", tmp_path / "out", "--mount", mount)
    done.refused("motions between two poses", "must be poses", "at each stop")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "words"), [("f 7\nr 1 2 3\nt 0 0 1\n", "f is 7"), ("f 2\nr 1 2\nt 0 0 1\n", "2 and 3")]
)
def test_a_pose_of_halcon_of_no_known_type_is_refused(tmp_path, text, words):
    halcon(tmp_path / "in")
    write(tmp_path / "in/robot_pose_03.dat", text)
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand")
    done.refused("robot_pose_03.dat", words)


@pytest.mark.parametrize(
    ("last", "words"),
    [
        ("1 2 3", "as many cells"),
        ("1,5 2 3", "Where commas are decimal"),
        ("started at 10:04:17,592 with [1.5, 2]", "as many cells"),
    ],
)
def test_a_table_of_uneven_rows_hears_of_commas_only_where_all_are_decimal(tmp_path, last, words):
    write(tmp_path / "in.txt", f"1 2 3 4 5 6 7\n1 2 3 4 5 6 7\n{last}\n")
    done = visioncal("convert", tmp_path / "in.txt", tmp_path / "out", "--mount", "eye-in-hand")
    assert ("ommas" in done.refused("cells", words).err) == ("ommas" in words)


@pytest.mark.slow
def test_rounded_quaternions_give_way_to_angles_of_more_digits_that_agree(tmp_path):
    """As tf_echo prints both, by three decimals."""
    poses, away = world()[0], []
    for name, wrong in (("agree", 0.0), ("differ", 1.0)):
        text = ""
        for at, pose in enumerate(poses):
            turn = Rotation.from_matrix(pose[:3, :3])
            quaternion, angles = turn.as_quat(), turn.as_euler("xyz", degrees=True)
            angles[2] += wrong
            text += f"At time {at}.5\n- Translation: {pose[:3, 3].tolist()}\n"
            text += f"- Rotation: in Quaternion {quaternion.round(3).tolist()}\n"
            text += f"            in RPY (degree) {angles.round(3).tolist()}\n"
        write(tmp_path / name / "tf.txt", text)
        shoot(tmp_path / name, "{}.png")
        said = ("--target", world()[2].document["target"], "--mount", "eye-in-hand")
        visioncal("convert", tmp_path / name, tmp_path / f"{name}_out", *said).good()
        views = Session.load(tmp_path / f"{name}_out").views
        found = np.array([view.base_from_flange().as_matrix()[:3, :3] for view in views])
        turned = Rotation.from_matrix(poses[:, :3, :3].transpose(0, 2, 1) @ found)
        away.append(np.rad2deg(turned.magnitude()).max())
    # Half a unit of the last decimal in three angles, and in four numbers of a quaternion.
    assert away[0] < 1e-3
    assert 1e-2 < away[1] < 0.12


def test_a_job_in_pulses_alone_is_refused(tmp_path):
    lines = "\n".join(f"C{at:05d}=-1234,5,77,88,1000,{at}" for at in range(9))
    write(tmp_path / "in/EYE.JBI", f"/JOB\n//POS\n///POSTYPE PULSE\n///PULSE\n{lines}\nEND\n")
    done = visioncal("convert", tmp_path / "in/EYE.JBI", tmp_path / "out", "--mount", "eye-in-hand")
    done.refused("9 positions are in pulses of the motors", "///POSTYPE BASE")


def test_xml_with_entities_is_refused(tmp_path):
    text = '<?xml version="1.0"?>\n<!DOCTYPE a [<!ENTITY b "c">]>\n<a><v x="1">&b;</v></a>'
    write(tmp_path / "in/eye.dtx", text)
    done = visioncal("convert", tmp_path / "in/eye.dtx", tmp_path / "out", "--mount", "eye-in-hand")
    done.refused("a document type is declared")


@pytest.mark.slow
def test_a_guess_needs_no_second_step_where_it_contradicts_nothing_stated(tmp_path):
    sixes(tmp_path / "in")
    said = ("--target", world()[2].document["target"], "--mount", "eye-in-hand")
    for name, more in (("plain", ()), ("guess", ("--guess",))):
        (tmp_path / name).mkdir()
        visioncal("convert", tmp_path / "in", tmp_path / name / "cell", *said, *more).good()
    plain, guess = (Session.load(tmp_path / name / "cell") for name in ("plain", "guess"))
    assert guess.digest() == plain.digest()
    stated = (*said, "--robot-form", "kuka", "--guess")
    done = visioncal("convert", tmp_path / "in", tmp_path / "stated", *stated)
    done.refused("better than what is stated", "--yes")
    visioncal("convert", tmp_path / "in", tmp_path / "stated", *stated, "--yes").good()
    found = [
        view.base_from_flange().as_matrix() for view in Session.load(tmp_path / "stated").views
    ]
    # Nine decimals are written.
    np.testing.assert_allclose(found, world()[0], atol=1e-9)


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


@pytest.mark.parametrize("said", ["console", "OpenCV", "headings alone", "ViSP"])
def test_matrices_below_headings_of_one_log_are_the_robot_s_and_the_camera_s(tmp_path, said):
    poses, _, _ = world()
    seen, text = poses[::-1], "started server\n" if said == "console" else ""
    for at, (flange, board) in enumerate(zip(poses, seen, strict=True)):
        if said == "console":
            text += f"[ INFO] [149.{at:03d}]: Transform Pair Added\nL2Norm EE: 0.{at} vs Cam:0.1\n"
        text += f"Pose {at}\n" * (said == "OpenCV")
        names = ("EE transform", "Cam transform")
        if said == "ViSP":
            text += f"Use fPe=pose_fPe_{at}.yaml\n" if at else "~$ ./calibrate\ncMo size=9\n"
            names = tuple(f"matrix {name}[{at}] (size ROWSxCOLL:4x4)" for name in ("wMe", "cMo"))
        for name, pose in zip(names, (flange, board), strict=True):
            rows = "\n".join("  ".join(map(repr, row)) for row in pose.tolist())
            if said == "OpenCV":
                # As C++ prints a cv::Mat.
                rows = ";\n ".join(", ".join(map(repr, row)) for row in pose.tolist())
                rows = f"[{rows}]"
            text += f"{name}: \n{rows}\n"
    write(tmp_path / "console.txt", text)
    foreign = read_foreign(tmp_path / "console.txt", ImportOptions(mount="eye-to-hand"))
    np.testing.assert_allclose(foreign.robot.poses(), poses, atol=1e-12)
    assert foreign.camera is not None
    np.testing.assert_allclose(foreign.camera.poses(), seen, atol=1e-12)


def test_a_header_in_a_comment_has_units_in_brackets_and_empty_ones(tmp_path):
    poses, _, _ = world()
    x, y, z, qx, qy, qz, qw = np.array([seven(pose) for pose in poses]).T
    columns = [1e9 * np.arange(len(x)), 1e3 * x, 1e3 * y, 1e3 * z, qw, qx, qy, qz]
    numbers = np.stack(columns, axis=1)
    header = ", ".join(
        [
            "#timestamp",
            *(f"p_RS_R_{axis} [mm]" for axis in "xyz"),
            *(f"q_RS_{n} []" for n in "wxyz"),
        ]
    )
    rows = (", ".join(map(repr, row)) for row in numbers.tolist())
    write(tmp_path / "robot.csv", "\n".join([header, *rows]))
    fields = read_fields(tmp_path / "robot.csv")
    names = pose_names(fields, (), "robot", ())
    found, notes, _ = poses_from(fields, names, ImportOptions().robot, "robot")
    np.testing.assert_allclose(found.poses(), poses, atol=1e-12)
    assert not notes


def test_messages_in_a_text_are_read_as_documents(tmp_path):
    """As `rostopic echo` prints them; and an angle about an axis, as an Ensenso's."""
    poses, _, _ = world()
    parts, records = [], []
    for pose in poses:
        x, y, z, qx, qy, qz, qw = map(float, seven(pose))
        place = f"  position: \n    x: {x!r}\n    y: {y!r}\n    z: {z!r}\n"
        turn = f"  orientation: \n    x: {qx!r}\n    y: {qy!r}\n    z: {qz!r}\n    w: {qw!r}\n"
        parts.append(f'header: \n  seq: 100\n  frame_id: "link_base"\npose: \n{place}{turn}')
        vector = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        angle = float(np.linalg.norm(vector))
        rotation = {"Angle": angle, "Axis": (vector / angle).tolist()}
        records.append({"Pattern": {"Rotation": rotation, "Translation": [x, y, z]}})
    write(tmp_path / "robot.txt", "---\n".join(parts))
    write(tmp_path / "board.json", json.dumps(records))
    said = ImportOptions(mount="eye-to-hand", camera_file=tmp_path / "board.json")
    foreign = read_foreign(tmp_path / "robot.txt", said)
    np.testing.assert_allclose(foreign.robot.poses(), poses, atol=1e-12)
    assert foreign.camera is not None
    np.testing.assert_allclose(foreign.camera.poses(), poses, atol=1e-12)


def test_numbered_columns_of_a_pose_and_of_joints_are_read(tmp_path):
    """As UR's own programs call them."""
    poses, _, _ = world()
    columns = ["timestamp", *(f"actual_{of}_{n}" for of in ("q", "TCP_pose") for n in range(6))]
    q = np.linspace(-1.0, 1.0, 6 * len(poses)).reshape(-1, 6)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    rows = np.column_stack([5.0 * np.arange(len(q)), q, poses[:, :3, 3], turns]).tolist()
    lines = (" ".join(map(repr, row)) for row in rows)
    write(tmp_path / "rtde.csv", "\n".join([" ".join(columns), *lines]))
    said = ImportOptions(robot=PoseImportOptions(form="ur"))
    fields = read_fields(tmp_path / "rtde.csv")
    foreign = foreign_from(fields, said)
    np.testing.assert_allclose(foreign.robot.poses(), poses, atol=1e-12)
    np.testing.assert_allclose(foreign.joints_rad, q, atol=1e-12)


@pytest.mark.parametrize("are_alone", [True, False])
def test_two_files_of_poses_ask_whose_they_are_with_the_command(tmp_path, monkeypatch, are_alone):
    """Alone, or beside joints of seven axes, the robot's raw stream and the camera's, twice."""
    monkeypatch.chdir(tmp_path)
    poses, _, session = world()
    seen = np.array([view.cam_from_target().as_matrix() for view in session.views])
    files = [("TrackerToFiducial", seen), ("RobotBaseToTip", poses)]
    if not are_alone:
        joints = np.arange(63.0).reshape(9, 7) / 63.0
        np.savetxt(folder_of(tmp_path / "in") / "joints.txt", joints)
        streams = {"camera_raw": seen, "camera_raw_again": seen, "arm_raw": poses}
        more = [(name, np.concatenate([each, each[1:-1]])) for name, each in streams.items()]
        files += [*more[:2], (more[2][0], more[2][1][:14])]
    for name, turned in files:
        vectors = Rotation.from_matrix(turned[:, :3, :3]).as_rotvec()
        rows = np.hstack([turned[:, :3, 3], vectors]).tolist()
        write(tmp_path / f"in/{name}.txt", "\n".join(" ".join(map(repr, row)) for row in rows))
    followed = follow("convert", "in", "out", "--mount", session.mount)
    assert "which are the robot's is not stated" in followed.runs[0].refused().err
    assert len(followed.runs) == 2
    view = Session.load(tmp_path / "out").views[0]
    np.testing.assert_allclose(view.base_from_flange().as_matrix(), poses[0], atol=1e-9)


@pytest.mark.parametrize("is_inverse", [False, True])
def test_the_numbers_of_one_side_never_serve_as_both(tmp_path, monkeypatch, is_inverse):
    """They agree with each other to the last digit, and say nothing of the camera."""
    monkeypatch.chdir(tmp_path)
    poses, _, session = world()
    sides = np.array([poses, np.linalg.inv(poses) if is_inverse else poses])
    records = [{"pose": a.tolist(), "board": b.tolist()} for a, b in sides.swapaxes(0, 1)]
    write(tmp_path / "in.json", json.dumps(records))
    said = ("--mount", "eye-in-hand", "--robot-key", "pose", "--camera-key", "board")
    for more in ((), ("--guess", "--yes")):
        refused = visioncal("convert", "in.json", "out", *said, *more).refused().err
        assert f"are {'inverse' if is_inverse else 'the same'} in all 9 rows" in refused
        assert "Name the poses of each with --robot-key and --camera-key" in refused
    # A session of such rows, written by other means.
    Session.assemble(
        {"schema": 1, "name": "out", "mount": "eye-in-hand"},
        ["view", *POSE, *MEASURED_CAM_POSE],
        [[*map(str, (at, *seven(a), *seven(b)))] for at, (a, b) in enumerate(sides.swapaxes(0, 1))],
        session.images,
    ).save(tmp_path / "out")
    assert "serve as both" in visioncal("calibrate", "out").refused().err
    assert "serve as both" in visioncal("doctor", "out").out


def test_files_of_two_sides_are_found_by_their_names(tmp_path, monkeypatch):
    """Keys of both are the same; the camera's pose is there as a matrix, too."""
    monkeypatch.chdir(tmp_path)
    poses, _, session = world()
    seen = [view.cam_from_target().as_matrix() for view in session.views]
    for at, (pose, board) in enumerate(zip(poses, seen, strict=True)):
        for side, each, more in (("hand", pose, {}), ("eye", board, {"T": board.tolist()})):
            parts = {"R": each[:3, :3].tolist(), "t": each[:3, 3:].tolist()}
            write(tmp_path / f"in/{side}/{side}_{at}.json", json.dumps(parts | more))
    tables = {"robotData": poses, "Vicon_Points": np.array(seen)}
    for name, each in tables.items():
        turns = Rotation.from_matrix(each[:, :3, :3]).as_euler("xyz")
        rows = np.hstack([1e3 * each[:, :3, 3], turns]).tolist()
        write(tmp_path / f"two/{name}.txt", "\n".join(" ".join(map(repr, row)) for row in rows))
    said = ("--mount", session.mount)
    for at, (source, more) in enumerate(
        [("in", ()), ("in", ("--robot-key", "R,t", "--camera-key", "R,t")), ("two", ())]
    ):
        visioncal("convert", source, f"out{at}", *said, *more).good()
        found = Session.load(tmp_path / f"out{at}").views
        sides = zip(found, poses, seen, strict=True)
        for view, pose, board in sides:
            np.testing.assert_allclose(view.base_from_flange().as_matrix(), pose, atol=1e-9)
            np.testing.assert_allclose(view.cam_from_target().as_matrix(), board, atol=1e-9)


def pairs():
    """(2, n, 4, 4) poses of the robot, and of the board as a camera sees it; and the mount."""
    poses, _, session = world()
    seen = [view.cam_from_target().as_matrix() for view in session.views]
    return np.array([poses, seen]), session.mount


def came_in(session):
    """The poses of both sides as they were read."""
    return np.array(
        [
            [view.base_from_flange().as_matrix() for view in session.views],
            [view.cam_from_target().as_matrix() for view in session.views],
        ]
    )


def test_structures_and_cells_of_matlab_are_read(tmp_path):
    (robot, camera), mount = pairs()
    cells = np.empty((1, len(camera)), dtype=object)
    for at, pose in enumerate(camera):
        cells[0, at] = pose
    run = {"robot": np.moveaxis(robot, 0, -1), "camera": cells}
    savemat(tmp_path / "in.mat", {"run": run, "name": "a"})
    visioncal("convert", tmp_path / "in.mat", tmp_path / "out", "--mount", mount).good()
    found = came_in(Session.load(tmp_path / "out"))
    np.testing.assert_allclose(found, [robot, camera], atol=1e-9)


def test_arrays_that_are_numbered_are_series_and_no_rows(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sides, mount = pairs()
    np.savez("in.npz", series_1=sides[0], series_2=sides[1])
    follow("convert", "in.npz", "out", "--mount", mount).last.good()
    np.testing.assert_allclose(came_in(Session.load("out")), sides, atol=1e-9)


def test_a_series_is_named_that_is_not_read(tmp_path, monkeypatch):
    """One in which the robot stands still is not read, however well both sides agree."""
    monkeypatch.chdir(tmp_path)
    sides, mount = pairs()
    records = [{"T_base_ee": a, "T_cam_board": b} for a, b in sides.swapaxes(0, 1).tolist()]
    write(tmp_path / "in.json", {"first": records[:1] * 8, "second": records})
    done = visioncal("convert", "in.json", "out", "--mount", mount).good()
    assert "second is read; left aside: first (8 rows)" in done.err
    np.testing.assert_allclose(came_in(Session.load("out")), sides, atol=1e-9)


def test_pictures_of_the_lens_do_not_change_pairs_that_do_not_fit(tmp_path):
    """Pairs of which no reading fits come in as they are, whatever pictures may be theirs."""
    sides, mount = pairs()
    for at in range(1, 14):
        shoot_one(tmp_path / f"in/lens/shot_{at:02d}.png", at % 9)
    tossed = np.random.default_rng(0).permutation(sides[1])
    np.savez(tmp_path / "in/pairs.npz", T_base_ee=sides[0], T_cam_board=tossed)
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", mount).good()
    assert "The images are left aside" in done.err
    np.testing.assert_allclose(
        came_in(Session.load(tmp_path / "out")), [sides[0], tossed], atol=1e-9
    )


@pytest.mark.parametrize("source", ["in.npz", *map(slow, ("in/", "./in")), "run.1", "."])
def test_pictures_within_arrays_come_in_by_the_printed_command(tmp_path, monkeypatch, source):
    """Files beside without pictures are kept; masks before the pictures are none."""
    monkeypatch.chdir(tmp_path)
    poses, pictures, session = world()
    if source == ".":
        Path("run").mkdir()
        monkeypatch.chdir("run")
    if source == "in.npz":
        np.savez("in.npz", T_base_ee=poses, rgb=np.repeat(np.array(pictures)[..., None], 3, -1))
    else:
        folder = Path(source)
        folder.mkdir(exist_ok=True)
        for at, (pose, picture) in enumerate(zip(poses, pictures, strict=True)):
            more = {"a_mask": picture, "empty": np.zeros_like(picture)}
            np.savez(folder / f"{at}.npz", T_base_ee=pose, **more, rgb=picture)
        np.savez(folder / "camera.npz", K=[[520.0, 0, 322.5], [0, 521, 198], [0, 0, 1]])
    said = ("--target", session.document["target"], "--mount", "eye-in-hand")
    refused = visioncal("convert", source, "out", *said).refused().err
    command, _, second = refused[refused.index("python -c") :].partition(" && ")
    subprocess.run(shlex.split(command.replace("python", sys.executable, 1)), check=True)
    visioncal(*shlex.split(second)[1:]).good()
    found = [view.base_from_flange().as_matrix() for view in Session.load("out").views]
    np.testing.assert_allclose(found, poses, atol=1e-9)


def test_series_of_pictures_in_several_files_are_converted_one_by_one(tmp_path):
    poses, pictures, session = world()
    for at in range(3):
        part = slice(3 * at, 3 * at + 3)
        arrays = {"rgb": np.array(pictures[part]), "depth_image": np.array(pictures[part])}
        np.savez(tmp_path / f"run_{at}.npz", T_base_ee=poses[part], **arrays)
    said = ("--target", session.document["target"], "--mount", "eye-in-hand")
    error = visioncal("convert", tmp_path, tmp_path / "out", *said).refused().err
    assert "'rgb' (3 x 400 x 640), 'depth_image' (3 x 400 x 640), but" in error
    assert "Convert the files one by one" in error


def test_an_undeclared_board_is_the_one_that_the_images_show(tmp_path, monkeypatch):
    """From `calibrate` of a folder on, what is printed leads to a session."""
    monkeypatch.chdir(tmp_path)
    stems_with_depth(tmp_path / "in")
    advised = visioncal("calibrate", "in").refused("asked for where no file beside").err
    refused = visioncal(*shlex.split(advised.partition("visioncal ")[2].partition(" && ")[0]))
    refused.refused("is not stated: a ChArUco board of 9 x 6 squares")
    command = next(line for line in refused.err.splitlines() if line.startswith("visioncal target"))
    visioncal(*shlex.split(command)[1:]).good()
    visioncal("convert", "in", "out", "--target", "board.toml", "--mount", "eye-in-hand").good()
    found = [view.base_from_flange().as_matrix() for view in Session.load("out").views]
    np.testing.assert_allclose(found, world()[0], atol=1e-9)


@pytest.mark.parametrize("has_matrices", [False, True])
def test_alternating_rows_of_both_sides_are_read_without_names(tmp_path, has_matrices):
    """Even and odd rows turn alike; of a pose that was written twice they are copies."""
    sides, mount = pairs()
    quaternions = Rotation.from_matrix(sides[..., :3, :3]).as_quat()
    rows = sides.reshape(2, -1, 16) if has_matrices else np.dstack([sides[..., :3, 3], quaternions])
    np.savetxt(tmp_path / "in.txt", rows.swapaxes(0, 1).reshape(-1, rows.shape[2]), fmt="%.12f")
    visioncal("convert", tmp_path / "in.txt", tmp_path / "out", "--mount", mount).good()
    np.testing.assert_allclose(came_in(Session.load(tmp_path / "out")), sides, atol=1e-9)
    np.savetxt(tmp_path / "twice.txt", np.repeat(rows[0], 2, axis=0))
    twice = visioncal("convert", tmp_path / "twice.txt", tmp_path / "two", "--mount", mount)
    twice.refused("18 poses of the robot, but neither images nor poses of the target")


@pytest.mark.parametrize("is_quaternion_first", [False, True])
def test_rows_of_a_slow_motion_are_no_sides_in_turn(tmp_path, is_quaternion_first):
    """Poses of a camera that a hand leads: neighbours turn nearly alike."""
    angles = np.linspace(0.0, 1.0, 18)[:, None] * [0.5, 0.3, -0.7]
    turned = Rotation.from_rotvec(angles).as_quat()
    places = 0.1 * angles + [0.4, -0.2, 0.9]
    rows = np.hstack(
        [np.roll(turned, 1, axis=1), places] if is_quaternion_first else [places, turned]
    )
    np.savetxt(tmp_path / "in.txt", rows, fmt="%.6f")
    assert [len(each) for each in reading.read_rows(tmp_path / "in.txt")] == [18]


def test_rows_of_a_raster_of_stops_are_sides_in_turn(tmp_path):
    """A raster of tilts turns from stop to stop as much as one stop on, and not across sides."""
    rng = np.random.default_rng(0)
    tilts = np.stack(np.meshgrid(*[np.linspace(-0.4, 0.4, 5)] * 2), axis=2).reshape(-1, 2)
    places = np.column_stack([0.4 + 0.2 * tilts[:, 0], 0.2 * tilts[:, 1], np.full(25, 0.5)])
    turned = Rotation.from_euler("xy", tilts) * Rotation.from_euler("x", 3.0)
    flange = RigidTransform.from_components(places, turned)
    mounted, board = (
        RigidTransform.from_components(place, Rotation.from_rotvec(turn))
        for place, turn in (([0.05, 0.0, 0.1], [0.1, 0.2, 1.5]), ([0.5, 0.1, 0.0], [0.2, 0.0, 0.4]))
    )
    seen = (flange * mounted).inv() * board
    # Places of both sides are known to 1 mm, turns to 0.2 deg.
    shifts, turns = rng.normal(0.0, 1e-3, (2, 25, 3)), rng.normal(0.0, 2e-3, (2, 25, 3))
    numbers = [
        np.hstack(
            [side.translation + shift, (side.rotation * Rotation.from_rotvec(turn)).as_quat()]
        )
        for side, shift, turn in zip((flange, seen), shifts, turns, strict=True)
    ]
    np.savetxt(tmp_path / "in.txt", np.stack(numbers, axis=1).reshape(50, 7), fmt="%.6f")
    assert [len(each) for each in reading.read_rows(tmp_path / "in.txt")] == [25]


def test_poses_of_the_board_are_not_taken_for_the_robot_s(tmp_path):
    """As many as the pictures, beside the robot's of two stops more; alone they are refused."""
    poses, pictures, session = world()
    seen = np.array([view.cam_from_target().as_matrix() for view in session.views])
    (tmp_path / "in/images").mkdir(parents=True)
    for at, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"in/images/image_{at + 1}.png"), picture)
    np.save(tmp_path / "in/board2camera.npy", seen)
    said = ("--target", session.document["target"])
    refused = visioncal(
        "convert", tmp_path / "in", tmp_path / "out", *said, "--mount", "eye-to-hand"
    )
    refused.refused("are those of the camera over the board", "--robot-key")
    np.save(tmp_path / "in/ee2base.npy", [*poses, *poses[[2, 5]]])
    source, mount = tmp_path / "in", ("--mount", "eye-in-hand")
    visioncal("convert", source, tmp_path / "out", *said, *mount).good()
    found = [view.base_from_flange().as_matrix() for view in Session.load(tmp_path / "out").views]
    np.testing.assert_allclose(found, poses, atol=1e-9)


def test_angles_that_turn_clockwise_are_read_by_the_printed_option(tmp_path):
    """Of all angles negated the rotations are transposed, which no form of poses says."""
    poses, _, session = world()
    shoot(tmp_path / "in", "{}.jpg")
    turns = -Rotation.from_matrix(poses[:, :3, :3]).as_euler("XYZ", degrees=True)
    rows = np.hstack([1e3 * poses[:, :3, 3], turns])
    write_table(tmp_path / "in/poses.csv", ("x", "y", "z", "rx", "ry", "rz"), rows)
    said = ("--target", session.document["target"], "--mount", "eye-in-hand")
    asked = visioncal("convert", tmp_path / "in", tmp_path / "out", *said)
    assert "Convert with --guess --yes" in asked.refused("rotations transposed").err
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *said, "--guess", "--yes")
    done.good()
    found = [view.base_from_flange().as_matrix() for view in Session.load(tmp_path / "out").views]
    np.testing.assert_allclose(found, poses, atol=1e-6)


def test_results_of_another_program_are_not_taken_for_its_records(tmp_path):
    """Tables of errors name the same pictures, and drawn ones; a log and a result have few rows."""
    poses, pictures, session = world()
    folder = tmp_path / "in"
    for name in ("images", "overlays", "tries", "records"):
        (folder / name).mkdir(parents=True)
    for at, (pose, picture) in enumerate(zip(poses, pictures, strict=True)):
        cv2.imwrite(str(folder / f"images/img_{at:03d}.png"), picture)
        cv2.imwrite(str(folder / f"overlays/record_{at:03d}_axes.png"), picture)
        record = {"image": f"img_{at:03d}.png", "gripper_pose": pose.tolist()}
        write(folder / f"records/record_{at:03d}.json", record)
    names = [(f"img_{at:03d}.png", f"record_{at:03d}_axes.png") for at in range(len(poses))]
    rows = [f"{image},{drawn},{at}" for at, (image, drawn) in enumerate(names)]
    write(folder / "overlays/summary.csv", "\n".join(["image,overlay,err_mm", *rows]))
    for at in range(3):
        cv2.imwrite(str(folder / f"tries/try_{at}.png"), pictures[0])
    tries = [f"try_{at}.png,{at}" for at in range(3)]
    write(folder / "tries/log.csv", "\n".join(["img,z_m", *tries]))
    np.savez(folder / "result.npz", R_cam2base=np.eye(3), t_cam2base=np.ones(3))
    said = ("--target", session.document["target"], "--mount", "eye-in-hand")
    visioncal("convert", folder, tmp_path / "out", *said).good()
    views = Session.load(tmp_path / "out").views
    found = [view.base_from_flange().as_matrix() for view in views]
    np.testing.assert_allclose(found, poses, atol=1e-9)
    assert [Path(view.image).name for view in views] == [image for image, _ in names]


def test_angles_of_two_runs_are_no_sides(tmp_path):
    """By the files' name they are joints, or by their numbers those of one motion."""
    (tmp_path / "in").mkdir()
    rng = np.random.default_rng(0)
    angles = rng.uniform(-2, 2, (2, 9, 6))
    for name, each in zip(("qs_8", "qs_rand_8"), angles, strict=True):
        np.savetxt(tmp_path / f"in/{name}.txt", each)
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand")
    done.refused("there are joint angles", "--robot-model")
    (tmp_path / "again").mkdir()
    for name in ("first", "second"):
        np.savetxt(tmp_path / f"again/{name}.txt", angles[0] + rng.normal(scale=1e-3, size=(9, 6)))
    done = visioncal("convert", tmp_path / "again", tmp_path / "out", "--mount", "eye-in-hand")
    done.refused("nearly the same 9 rows as", "as of two runs of one side")


@pytest.mark.parametrize("names", [("g2b", "t2c"), ("b2e", "o2c")])
def test_poses_are_read_by_the_initials_of_their_frames(tmp_path, names):
    sides, mount = pairs()
    robot = sides[0] if names[0] == "g2b" else np.linalg.inv(sides[0])
    arrays = {f"T_{names[1]}": sides[1], f"T_{names[0]}": robot, "T_c2g": np.eye(4)}
    np.savez(tmp_path / "in.npz", **arrays)
    visioncal("convert", tmp_path / "in.npz", tmp_path / "out", "--mount", mount).good()
    np.testing.assert_allclose(came_in(Session.load(tmp_path / "out")), sides, atol=1e-9)


def test_axis_times_angle_is_a_rotation_and_acceleration_is_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sides, mount = pairs()
    for name, poses in zip(("BaseToEndEffector", "CameraToFiducial"), sides, strict=True):
        rows = np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()])
        np.savetxt(f"{name}.txt", rows, header="x y z ax ay az")
    visioncal("convert", ".", tmp_path / "out", "--mount", mount).good()
    np.testing.assert_allclose(came_in(Session.load(tmp_path / "out")), sides, atol=1e-9)
    numbers = {name: np.full(9, 9.81) for name in ("x", "y", "z", "ax", "ay", "az")}
    fields = Fields("imu", tmp_path, ("",) * 9, numbers)
    assert possible_poses(fields, by_shape=False) == []


@pytest.mark.parametrize("letters", ["m", "t", "target"])
def test_columns_joined_to_letters_are_a_pose_of_their_own(tmp_path, monkeypatch, letters):
    """As `mx .. mqw` of a marker beside the plain names of the robot's pose."""
    monkeypatch.chdir(tmp_path)
    sides, mount = pairs()
    names = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    rows = np.array([[*seven(a), *seven(b)] for a, b in zip(*sides, strict=True)])
    write_table(tmp_path / "log.csv", [*names, *(letters + name for name in names)], rows)
    follow("convert", "log.csv", "out", "--mount", mount).last.good()
    np.testing.assert_allclose(came_in(Session.load(tmp_path / "out")), sides, atol=1e-9)


def test_points_of_a_camera_are_read_from_a_file_beside_the_robot_s_poses(tmp_path):
    """A matrix a row and homogeneous points in files of any names; no command is needed."""
    poses, seen = pairs()[0]
    write(tmp_path / "in/rt.txt", "\n".join(" ".join(map(str, each.ravel())) for each in poses))
    points = [" ".join(map(str, [*each[:3, 3], 1.0])) for each in seen]
    write(tmp_path / "in/psi.txt", "\n".join(points))
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand").good()
    assert "psi are taken for points that the camera measured, in m" in done.err
    session = Session.load(tmp_path / "out")
    assert session.document["camera"] == {"model": "points"}
    found = [view.base_from_flange().as_matrix() for view in session.views]
    np.testing.assert_allclose(found, poses, atol=1e-9)


@pytest.mark.parametrize("is_one_file", [False, True])
def test_pairs_of_points_lead_to_the_camera_s_frame(tmp_path, monkeypatch, is_one_file):
    """They have no rotations: the printed command fits the camera's frame to them."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(7)
    truth, ours = world()[0][0], rng.uniform(-0.3, 0.3, (12, 3))
    theirs = (ours - truth[:3, 3]) @ truth[:3, :3] + rng.normal(scale=2e-4, size=ours.shape)
    if is_one_file:
        names = [f"{side}_{axis}" for side in ("cam", "gt") for axis in "xyz"]
        sides = {"camera": theirs, "robot": ours}
        records = [
            {side: dict(zip("xyz", each[at].tolist(), strict=True)) for side, each in sides.items()}
            for at in range(12)
        ]
        # No poses, and rows whose names count.
        corners = {str(at): [0.1 * at, 0.2, 0.3] for at in range(4)}
        write(tmp_path / "in/pairs.json", {"points": records, "corners": corners})
    else:
        (tmp_path / "in").mkdir()
        np.savetxt(tmp_path / "in/pos_hand.txt", ours)
        np.savetxt(tmp_path / "in/pos_eye.txt", 1e3 * theirs)
    refused = visioncal("convert", "in", "out", "--mount", "eye-to-hand")
    refused.refused("12 pairs of points without rotations: a rigid motion maps")
    command = refused.err[refused.err.index("visioncal fixture") :]
    visioncal(*shlex.split(command)[1:]).good()
    found = FrameFile.load("frames.json").frames["base_from_camera"].edge.matrix
    np.testing.assert_allclose(found, truth, atol=2e-3)
    if is_one_file:
        (tmp_path / "in/pairs.json").unlink()
        write_table(tmp_path / "in/pairs.csv", names, np.hstack([theirs, rng.permutation(ours)]))
        refused = visioncal("convert", "in", "out", "--mount", "eye-to-hand")
        refused.refused("12 pairs of points without rotations, and no rigid motion maps")


def test_arrays_without_rows_are_refused(tmp_path):
    np.savez(tmp_path / "in.npz", angles=np.zeros((0, 7)), poses=np.zeros((0, 4, 4)))
    error = visioncal("convert", tmp_path / "in.npz", tmp_path / "out").refused().err
    assert "in.npz has no list with one entry per pose: it is empty" in error


def test_quaternions_without_their_real_part_are_read(tmp_path, monkeypatch):
    """Three numbers of them are a form; half turns made of these are named as what they are."""
    monkeypatch.chdir(tmp_path)
    poses, _, session = world()
    seen = np.array([view.cam_from_target().as_matrix() for view in session.views])
    sides = {"robot": poses, "cam": seen}
    names = [f"{side}_{name}" for side in sides for name in ("x", "y", "z", "qx", "qy", "qz")]
    vectors = {
        side: Rotation.from_matrix(each[:, :3, :3]).as_quat(canonical=True)[:, :3]
        for side, each in sides.items()
    }
    rows = np.hstack([part for s, each in sides.items() for part in (each[:, :3, 3], vectors[s])])
    rows = [",".join(map(repr, row)) for row in rows.tolist()]
    write(tmp_path / "in.csv", "\n".join([",".join(names), *rows]))
    visioncal("convert", "in.csv", "out", "--mount", session.mount).good()
    for view, pose, board in zip(Session.load("out").views, poses, seen, strict=True):
        np.testing.assert_allclose(view.base_from_flange().as_matrix(), pose, atol=1e-9)
        np.testing.assert_allclose(view.cam_from_target().as_matrix(), board, atol=1e-9)
    half = seen.copy()
    half[:, :3, :3] = Rotation.from_quat(np.pad(vectors["cam"], ((0, 0), (0, 1)))).as_matrix()
    records = zip(poses.tolist(), half.tolist(), strict=True)
    write(tmp_path / "half.json", [{"T_base_ee": a, "T_cam_board": b} for a, b in records])
    visioncal("convert", "half.json", "turned", "--mount", session.mount).good()
    assert "The target's rotations are half turns" in visioncal("doctor", "turned").out


@pytest.mark.parametrize(("real", "at"), [("qs", 3), ("q_w", 3), ("rw", 0)])
def test_a_quaternions_real_part_is_found_under_any_name(tmp_path, real, at):
    """It makes quaternions of either sign unit ones, whatever its column is called."""
    sides, mount = pairs()
    names, columns = [], []
    for side, poses in zip(("robot", "cam"), sides, strict=True):
        last = ["qx", "qy", "qz"]
        last.insert(at, real)
        names += [f"{side}_{name}" for name in ("x", "y", "z", *last)]
        turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
        turns[::2] *= -1
        columns += [poses[:, :3, 3], np.roll(turns, at - 3, axis=1)]
    write_table(tmp_path / "in.csv", names, np.hstack(columns))
    visioncal("convert", tmp_path / "in.csv", tmp_path / "out", "--mount", mount).good()
    np.testing.assert_allclose(came_in(Session.load(tmp_path / "out")), sides, atol=1e-9)


@pytest.mark.parametrize("tracker", ["vicon", "mocap"])
def test_motion_capture_is_the_robots_where_no_other_is(tmp_path, tracker):
    sides, mount = pairs()
    robot, board = np.array([[seven(pose) for pose in poses] for poses in sides])
    last = ("x", "y", "z", "qx", "qy", "qz", "qw")
    names = [f"{tracker}_{name}" for name in last]
    shoot(tmp_path / "shot", "{}.png")
    write_table(tmp_path / "shot/poses.csv", names, robot)
    said = ("--mount", mount, "--target", "charuco_9x6_30mm")
    visioncal("convert", tmp_path / "shot", tmp_path / "a", *said).good()
    found = [view.base_from_flange().as_matrix() for view in Session.load(tmp_path / "a").views]
    np.testing.assert_allclose(found, sides[0], atol=1e-9)
    for other in ("board", "camera"):
        table = tmp_path / f"{other}.csv"
        of_robot = [name.replace("_", "_hand_") if other == "camera" else name for name in names]
        columns = [*of_robot, *(f"{other}_{name}" for name in last)]
        write_table(table, columns, np.hstack([robot, board]))
        visioncal("convert", table, tmp_path / f"of_{other}", "--mount", mount).good()
        found = came_in(Session.load(tmp_path / f"of_{other}"))
        np.testing.assert_allclose(found, sides, atol=1e-9)


def test_a_contradicted_mount_is_reported_before_a_form_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    poses, _, session = world()
    seen = [view.cam_from_target().as_matrix() for view in session.views]
    other = "eye-to-hand" if session.mount == "eye-in-hand" else "eye-in-hand"
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    rows = np.hstack([poses[:, :3, 3], turns]).tolist()
    boards = [{"pose": row, "board": at.tolist()} for row, at in zip(rows, seen, strict=True)]
    write(tmp_path / "in.json", json.dumps(boards))
    refused = visioncal("convert", "in.json", "out", "--mount", other).refused().err
    assert "the camera is not mounted as stated" in refused
    assert f"Give --mount {session.mount}" in refused


def test_moves_of_a_urscript_are_poses_of_the_tool_that_it_sets(tmp_path):
    """In a text of any ending; a named pose, one by a literal, and moves of joints between."""
    poses, _, _ = world()
    numbers = [[*p[:3, 3], *Rotation.from_matrix(p[:3, :3]).as_rotvec()] for p in poses]
    literals = [f"p[{', '.join(map(repr, map(float, each)))}]" for each in numbers]
    lines = ["def Program():", "  Tool = p[0, 0, 0.215, 1.2092, -1.2092, 1.2092]", "  Weight = 3"]
    lines += [
        "  set_tcp(Tool)",
        f"  first = {literals[0]}",
        "  movej([0.7, -1.5, 1.5, -1.5, -1.5, 0])",
    ]
    for at in ("first", *literals[1:]):
        lines += [f"  movel({at}, a=3.1416, v=0.5, r=0)", '  popup("wait", blocking=True)']
    write(
        tmp_path / "in/program.txt",
        "\n".join([*lines, "  movej([0.7, -1.5, 1.5, -1.5, -1.5, 0])", "end"]),
    )
    shoot(tmp_path / "in", "{}.png")
    foreign = read_foreign(tmp_path / "in", ImportOptions(mount="eye-in-hand"))
    np.testing.assert_allclose(foreign.robot.poses(), poses, atol=1e-12)
    assert foreign.form == "ur"
    assert [image.stem for image in foreign.images] == [*map(str, range(len(poses)))]
    assert any("a tool whose tip is 215 mm from the flange" in note for note in foreign.notes)


def test_files_that_are_each_a_recording_are_named_at_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    poses, _, session = world()
    rows = [
        {"robot_pose": pose.tolist(), "target_pose": view.cam_from_target().as_matrix().tolist()}
        for pose, view in zip(poses, session.views, strict=True)
    ]
    for name, count in (("merged", 9), ("with_filter", 7), ("plain", 8)):
        write(tmp_path / f"my runs/{name}.json", json.dumps(rows[:count]))
    for at in range(9):
        write(tmp_path / f"my runs/code/file{'abcdefghi'[at]}.h", "int main;")
    followed = follow("convert", "my runs", "out", "--mount", session.mount)
    refused = followed.runs[0].refused().err
    assert "3 files that are each a recording: merged.json (9 rows)" in refused
    assert len(followed.runs) == 2
    assert len(Session.load(tmp_path / "out").views) == 9
    # Of code a count suffices.
    listed = describe(tmp_path / "my runs").words()
    assert "9 kinds not read" in listed
    assert listed.count("code/") == 3


@pytest.mark.slow
@pytest.mark.parametrize("is_listed", [False, True])
def test_files_of_a_recording_each_that_differ_in_numbers_are_named(tmp_path, is_listed):
    poses, _, session = world()
    for name, count in (("run_1", 6), ("run_2", 9)):
        rows = vectors()[:count]
        if is_listed:
            seen = (view.cam_from_target().as_matrix() for view in session.views)
            records = [
                {"id": at, "robot_coords": row.tolist(), "board_pose": pose.tolist()}
                for at, (row, pose) in enumerate(zip(rows, seen, strict=False))
            ]
            write(tmp_path / f"in/{name}.json", json.dumps(records))
        else:
            (tmp_path / "in").mkdir(exist_ok=True)
            np.savetxt(tmp_path / f"in/{name}.csv", rows, fmt="%.12f", delimiter=",")
            shoot(tmp_path / "in", "{}.png")
    board = () if is_listed else ("--target", session.document["target"])
    followed = follow(
        "convert", tmp_path / "in", tmp_path / "out", "--mount", session.mount, *board
    )
    assert "2 files that are each a recording: run_1" in followed.runs[0].refused().err
    assert len(followed.runs) == 2
    read = Session.load(tmp_path / "out")
    found = np.array([view.base_from_flange().as_matrix() for view in read.views])
    np.testing.assert_allclose(found, poses, atol=1e-9)


@pytest.mark.parametrize("ending", ["toml", "yaml", "json"])
def test_a_board_that_a_file_beside_describes_need_not_be_named(tmp_path, ending):
    poses, _, session = world()
    table_of(folder_of(tmp_path / "in"))
    shoot(tmp_path / "in", "color_{:03d}.png")
    board = target_document(session.target)
    settings = {
        "num_X": board["columns"],
        "num_Y": board["rows"],
        "len_squares": board["square_m"],
        "len_markers": board["marker_m"],
        "markers_dictionary": board["dictionary"],
    }
    text = tomli_w.dumps(board) if ending == "toml" else json.dumps(settings)
    write(tmp_path / f"in/board.{ending}", text)
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", session.mount).good()
    assert f"The board is that of board.{ending}" in done.err
    read = Session.load(tmp_path / "out")
    assert replace(read.target, name="") == replace(session.target, name="")
    assert len(read.views) == len(poses)


def test_stored_poses_of_the_target_are_read_where_the_images_are_of_another_motion(tmp_path):
    poses, _, session = world()
    seen = [view.cam_from_target().as_matrix() for view in session.views]
    for at, pose in enumerate(poses):
        rows = {"T_gripper2base": pose.tolist(), "T_target2cam": seen[at].tolist()}
        write(tmp_path / f"in/{at}.json", rows)
        shoot_one(tmp_path / f"in/{at}.png", (0, 5, 7, 2, 8, 1, 3, 6, 4)[at])
    said = ("--mount", session.mount, "--target", session.document["target"])
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    assert "The images are left aside: no reading" in done.err
    last = Session.load(tmp_path / "out").views[-1]
    np.testing.assert_allclose(last.cam_from_target().as_matrix(), seen[-1], atol=1e-9)


def test_a_result_of_one_pose_is_no_recording_beside_rows(tmp_path):
    np.savetxt(folder_of(tmp_path) / "hand_angle.txt", vectors(1.0), delimiter=", ")
    results = {f"T_my{at}": world()[0][at].tolist() for at in (1, 2)}
    for ending in ("json", "yaml"):
        write(tmp_path / f"T_cam2base.{ending}", results)
    (rank, rows, _), (later, *_) = proposed(describe(tmp_path), ImportOptions())
    assert len(rows) == len(world()[0])
    assert rank < later


def test_joints_of_a_gripper_and_settings_of_each_row_are_none_of_the_arm(tmp_path):
    """Nine joints of an arm of seven with two fingers, beside the shape of each image."""
    rng = np.random.default_rng(0)
    q = np.hstack([rng.uniform(-1.5, -0.5, (9, 7)), np.full((9, 2), 0.04)])
    for at, row in enumerate(q.tolist()):
        record = {"joint_values": row, "image_shape": [720, 1280, 3]}
        write(tmp_path / f"in/view_{at}.json", json.dumps(record))
    shoot(tmp_path / "in", "view_{}.png")
    foreign = read_foreign(tmp_path / "in", ImportOptions(mount="eye-in-hand", robot_model="panda"))
    np.testing.assert_allclose(foreign.joints_rad, q[:, :7])
    assert "meas_x_m" not in foreign.columns
    assert any("Of 9 joint angles a row the first 7 are taken" in note for note in foreign.notes)


@pytest.mark.parametrize("is_printed", [False, True])
def test_joints_are_in_the_order_of_the_arm_s_names(tmp_path, is_printed):
    """ROS writes the joints of a message in the order of the alphabet."""
    poses, _, _ = world()
    names = Robot.from_document(read_robot_document("ur5e")).joint_names
    q = np.linspace(-1.0, 1.0, 6 * len(poses)).reshape(-1, 6)
    order = np.argsort(names)
    columns, cells = [names[at] for at in order], q[:, order].tolist()
    if is_printed:
        columns = [f"field.{of}{at}" for of in ("name", "position", "velocity") for at in range(6)]
        cells = [[*np.array(names)[order].tolist(), *row, *6 * [0.1]] for row in cells]
    seen = [f"marker_{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    rows = (
        ",".join(map(str, [*row, *seven(pose)])) for row, pose in zip(cells, poses, strict=True)
    )
    write(tmp_path / "samples.csv", "\n".join([",".join([*columns, *seen]), *rows]))
    said = ImportOptions(mount="eye-to-hand", robot_model="ur5e")
    foreign = read_foreign(tmp_path / "samples.csv", said)
    np.testing.assert_allclose(foreign.joints_rad, q, atol=1e-12)
    assert foreign.camera is not None
    np.testing.assert_allclose(foreign.camera.poses(), poses, atol=1e-12)


@pytest.mark.parametrize("said", [(), ("--robot-columns", "x,y,z,rx,ry,rz")])
def test_poses_of_six_columns_are_no_joint_angles_of_an_arm_of_six(tmp_path, said):
    poses = world()[0]
    rows = [[*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_rotvec()] for pose in poses]
    table = [f"{at}.png,{','.join(map(repr, map(float, row)))}" for at, row in enumerate(rows)]
    write(tmp_path / "in/log.csv", "\n".join(["image,x,y,z,rx,ry,rz", *table]))
    for at in range(len(poses)):
        cv2.imwrite(str(tmp_path / f"in/{at}.png"), np.full((60, 80), at, dtype=np.uint8))
    how = ("--mount", "eye-to-hand", "--robot-model", "ur5e", "--robot-form", "ur", *said)
    how += ("--target", "charuco_9x6_30mm")
    visioncal("convert", tmp_path / "in", tmp_path / "out", *how).good()
    first = Session.load(tmp_path / "out").views[0]
    assert first.joints_rad is None
    assert first.reading_m is None
    np.testing.assert_allclose(first.base_from_flange().as_matrix(), poses[0], atol=1e-9)


def test_rows_of_joints_and_of_a_tracker_belong_together_by_their_id(tmp_path):
    """One id is missing, others are in another order, and a title stands above the header."""
    poses = world()[0]
    joints = [f"{at},{','.join(f'{30.0 * at + n:.1f}' for n in range(6))}" for at in range(9)]
    rows = []
    for at in (4 * k % 9 for k in range(1, 9)):
        x, y, z, *turn = seven(poses[at])
        rows.append(",".join([str(at), *(f"{n:.12f}" for n in [*turn, x, y, z]), "0.0002"]))
    header = "id,Rotation.X,Rotation.Y,Rotation.Z,Rotation.W,Position.X,Position.Y,Position.Z,Error"
    title = "Format Version,1.23,Take Name,calib"
    write(tmp_path / "in/ur.csv", "\n".join(["id,base,shoulder,elbow,w1,w2,w3", *joints]))
    write(tmp_path / "in/body.csv", "\n".join([title, header, *rows]))
    said = ("--mount", "eye-to-hand", "--robot-model", "ur10")
    visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    views = Session.load(tmp_path / "out").views
    found = np.array([view.cam_from_target().as_matrix() for view in views])
    ids = [round(np.rad2deg(view.joints_rad[0]) / 30.0) for view in views]
    assert sorted(ids) == [*range(1, 9)]
    np.testing.assert_allclose(found, poses[ids], atol=1e-11)


@pytest.mark.parametrize(
    ("name", "target", "words"),
    [
        slow("npz-base2ee", "checkerboard_4x7_33mm", "The poses fit as first read"),
        slow(
            "rpy-unstated", "checkerboard_11x8_20mm", "as Euler angles xyz about fixed axes in rad"
        ),
    ],
)
def test_cases_of_the_field_come_in(tmp_path, name, target, words):
    if not FIELD.is_dir():
        pytest.skip("the cases of the field are not here (../shared/data)")
    out = tmp_path / "out"
    done = visioncal("convert", FIELD / name, out, "--target", target, "--mount", "eye-in-hand")
    assert words in done.good().err


@pytest.mark.slow
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


@pytest.mark.parametrize("others", [(), ("second.urdf",), ("renamed",), ("broken",), ("linked",)])
def test_the_only_urdf_beside_a_table_gives_its_arm_by_the_names_of_its_joints(tmp_path, others):
    arm, names = (
        of_urdf(),
        [f"cam_{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")],
    )
    rng, joints = np.random.default_rng(3), [*arm.joint_names]
    header = [f"{name}_moved" for name in joints] if "renamed" in others else joints
    rows = rng.uniform(-1.0, 1.0, (9, len(joints) + 7)).round(6)
    rows[:, -4:] /= np.linalg.norm(rows[:, -4:], axis=1, keepdims=True)
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    write(tmp_path / "in/log.csv", "\n".join([",".join([*header, *names]), *lines]))
    for name in ("arm.urdf", *(name for name in others if name.endswith(".urdf"))):
        write(tmp_path / "in" / name, URDF.partition("<joint")[0] if "broken" in others else URDF)
    if "linked" in others:
        (tmp_path / "in/arm.urdf").rename(tmp_path / "arm.urdf")
        (tmp_path / "in/arm.urdf").symlink_to(tmp_path / "arm.urdf")
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand")
    if others:
        done.refused("Any of these may be the robot's poses")
        return
    assert "are the joints of arm.urdf, to its flange" in done.good().err
    view = Session.load(tmp_path / "out").views[0]
    assert view.joints_rad == pytest.approx(rows[0, : len(joints)])
    # The note says that --tip names another, which needs no robot by name then.
    said = ("--mount", "eye-in-hand", "--tip", "d")
    visioncal("convert", tmp_path / "in", tmp_path / "other", *said).good()
    assert 'tip = "d"' in (tmp_path / "other/session.toml").read_text()


def test_a_tip_of_no_usual_name_is_that_of_the_arm_that_is_named(tmp_path):
    """As of makers that call the flange after the last link."""
    rows = np.random.default_rng(3).uniform(-1.0, 1.0, (9, 10)).round(6)
    rows[:, -4:] /= np.linalg.norm(rows[:, -4:], axis=1, keepdims=True)
    header = [
        *of_urdf().joint_names,
        *(f"cam_{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")),
    ]
    log, arm = tmp_path / "in/log.csv", tmp_path / "arm.urdf"
    log.parent.mkdir()
    write_table(log, header, rows)
    write(arm, URDF.replace('"flange"', '"arm_link8"'))
    said = ("--mount", "eye-in-hand", "--robot-model", arm)
    visioncal("convert", log, tmp_path / "out", *said).refused("no tool0 or flange", "--tip")
    visioncal("convert", log, tmp_path / "out", *said, "--tip", "arm_link8").good()
    assert Session.load(tmp_path / "out").views[0].joints_rad == pytest.approx(rows[0, :3])


@pytest.mark.parametrize("ending", [".txt", ".mat"])
def test_matrices_as_programs_print_them_alone_are_poses(tmp_path, ending):
    """Those of OpenCV, whose rows end with semicolons, and the text that MATLAB saves."""
    robot, names = np.array(world()[0]), {"hand": 0, "eye": 1}
    sides = [robot, np.array([view.cam_from_target().as_matrix() for view in world()[2].views])]
    for name, side in names.items():
        if ending == ".mat":
            text = "\n".join(
                "  ".join(f"{value: .16e}" for value in seven(pose)) for pose in sides[side]
            )
        else:
            rows = (
                ";\n ".join(", ".join(map(repr, row)) for row in pose.tolist())
                for pose in sides[side]
            )
            text = "\n".join(f"[{each}]" for each in rows)
        write(tmp_path / f"in/{name}{ending}", text)
    visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand").good()
    views = Session.load(tmp_path / "out").views
    found = np.array([view.base_from_flange().as_matrix() for view in views])
    np.testing.assert_allclose(found, robot, atol=1e-12)


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        (np.eye(3)[[2, 0, 1]], ("along the camera's x", "camera_link")),
        (np.eye(3), ()),
        (np.diag([1.0, -1.0, -1.0]), ("along the camera's -z", "OpenGL", "--camera-inverse")),
    ],
    ids=["camera_link", "lens", "OpenGL"],
)
def test_targets_beside_the_axis_of_a_lens_are_noted(tmp_path, turn, words):
    """As of poses in camera_link, whose x is a lens's z."""
    seen = np.array([view.cam_from_target().as_matrix() for view in world()[2].views])
    rows = [
        [
            *seven(a),
            *seven(RigidTransform.from_rotation(Rotation.from_matrix(turn)).as_matrix() @ b),
        ]
        for a, b in zip(world()[0], seen, strict=True)
    ]
    names = [f"{s}_{n}" for s in ("robot", "cam") for n in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    write_table(tmp_path / "log.csv", names, np.array(rows))
    said = ("--mount", "eye-in-hand", "--robot-columns", ",".join(names[:7]))
    said = (*said, "--camera-columns", ",".join(names[7:]))
    done = visioncal("convert", tmp_path / "log.csv", tmp_path / "out", *said).good()
    assert ("The targets stand" in done.err) == bool(words)
    assert all(word in done.err for word in words)


@pytest.mark.parametrize("names", ["image_{}.png", "image ({}).png"])
def test_the_first_picture_of_a_series_may_have_no_number(tmp_path, names):
    """As programs and systems name copies: image.png, image_1.png; image.png, image (2).png."""
    first = 2 if "(" in names else 1
    for at in range(9):
        name = names.format(at - 1 + first) if at else "image.png"
        shoot_one(tmp_path / "in" / name, at)
    np.savetxt(tmp_path / "in/poses.txt", angles_of("xyz"))
    write(tmp_path / "board.toml", tomli_w.dumps(target_document(world()[2].target)))
    said = ("--target", tmp_path / "board.toml", "--mount", "eye-in-hand")
    visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    views = Session.load(tmp_path / "out").views
    assert [Path(view.image).name for view in views][:2] == ["image.png", names.format(first)]
    found = np.array([view.base_from_flange().as_matrix() for view in views])
    np.testing.assert_allclose(found, world()[0], atol=1e-9)


@pytest.mark.slow
def test_images_are_searched_once_where_few_rows_decide_nothing(tmp_path, monkeypatch):
    session = world()[2]
    shoot(tmp_path / "in", "img{:02d}.png")
    np.save(tmp_path / "in/poses.npy", angles_of("xyz"))
    write(tmp_path / "board.toml", tomli_w.dumps(target_document(session.target)))
    find, searched = detect.find_corners, list[int]()

    def counted(image, target, view, **options):
        searched.append(view)
        return find(image, target, view, **options)

    def undecided(*_, **__):
        raise DataError("No reading agrees.")

    monkeypatch.setattr(detect, "find_corners", counted)
    # However many readings are tried, and whatever each of them takes.
    monkeypatch.setattr(settling, "guess_from_camera_poses", undecided)
    monkeypatch.setattr(settling, "_TESTED", (6, 9))
    options = ("--target", tmp_path / "board.toml", "--mount", "eye-in-hand")
    assert visioncal("convert", tmp_path / "in", tmp_path / "out", *options).status == 2
    assert len(searched) == 9


def test_a_source_is_searched_and_read_once_for_all_its_readings(tmp_path, monkeypatch):
    shoot(tmp_path / "shots", "img{:02d}.png")
    rows = [[*seven(pose), *seven(np.linalg.inv(pose))] for pose in world()[0]]
    names = " ".join(f"{word}{at}" for word in "mn" for at in range(7))
    lines = [names, *(" ".join(map(repr, map(float, row))) for row in rows)]
    write(tmp_path / "in/poses.txt", "\n".join(lines))
    done = list[str]()

    def counting(module, name):
        call = getattr(module, name)

        def counted(path):
            done.append(path.name)
            return call(path)

        monkeypatch.setattr(module, name, counted)

    counting(file_search, "files_in")
    counting(reading, "read_plain_text")
    counting(tables, "read_plain_text")
    requested = ImportOptions(images=tmp_path / "shots", target="charuco_9x6_30mm")
    foreign = read_foreign(tmp_path / "in", requested)
    assert len(foreign.rivals) > 1
    assert sorted(done) == ["in", "poses.txt", "shots"]


def test_a_disk_is_looked_through_less_deep_than_a_recording(tmp_path, monkeypatch):
    deep = tmp_path.joinpath(*"abcde")
    deep.mkdir(parents=True)
    for folder in (tmp_path, deep):
        (folder / "log.csv").write_text("x\n1\n")
    assert [group.label for group in file_search.groups_in(tmp_path)] == [
        "a/b/c/d/e/log.csv",
        "log.csv",
    ]
    monkeypatch.setattr(file_search, "_FEW_FILES", 2)
    assert [group.label for group in file_search.groups_in(tmp_path)] == ["log.csv"]


def test_joint_angles_eight_folders_deep_ask_for_their_arm(tmp_path):
    inner = tmp_path / "in/data/2024/run1/left/poses/tables"
    inner.mkdir(parents=True)
    seen = [" ".join(map(str, seven(pose))) for pose in world()[0]]
    (inner / "target_poses.txt").write_text("\n".join(seen))
    angles = np.random.default_rng(0).uniform(-90.0, 200.0, (len(seen), 6)).round(3)
    np.savetxt(inner / "robot_joints.txt", angles, fmt="%.3f")
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand")
    assert done.status == 2
    assert "joint angles and no poses of the robot" in done.err
    assert "Name the arm with --robot-model" in done.err
