"""Poses of the target as programs of calibration store them, and what keeps a source unread."""

import json
import shlex
import shutil
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
from scipy.io.matlab import MatlabOpaque
from scipy.spatial.transform import Rotation
from support.commands import visioncal
from support.fuzz.mistakes import numbers
from support.samples import made_up

from visioncal.calibration.guess.recording import Recording
from visioncal.calibration.guess.search import turns_alike
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert
from visioncal.interchange.formats import rereading
from visioncal.interchange.formats.documents import read_document
from visioncal.interchange.formats.joints import joint_names
from visioncal.interchange.formats.poses import possible_poses
from visioncal.interchange.formats.reading import read_fields
from visioncal.interchange.formats.sources import describe
from visioncal.session import Session


@lru_cache
def world():
    """The robot's poses (n, 4, 4), those of the target in the camera, and the mount."""
    session = made_up(9, images=False).session
    poses = np.array([view.base_from_flange().as_matrix() for view in session.views])
    seen = np.array([view.cam_from_target().as_matrix() for view in session.views])
    return poses, seen, session.mount


def halves(poses):
    """(n, 3) positions and (n, 3) rotation vectors."""
    return poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()


def write(path: Path, document: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(document if isinstance(document, str) else json.dumps(document))


def listed(name, rows):
    """A matrix in OpenCV's YAML."""
    cells = ", ".join(map(repr, np.ravel(rows).tolist()))
    shape = f"   rows: {len(rows)}\n   cols: {np.size(rows[0])}\n   dt: d\n"
    return f"{name}: !!opencv-matrix\n{shape}   data: [ {cells} ]\n"


def opencv_s_calibration(folder, names=("extrinsic_parameters",)):
    """Extrinsic parameters with the rotation first, beside one XML a pose of numbered values."""
    poses, seen, _ = world()
    for at, pose in enumerate(poses):
        turn = Rotation.from_matrix(pose[:3, :3])
        w, v = turn.as_quat()[3], turn.as_quat()[:3]
        values = [*pose[:3, 3], w, *v, *turn.as_euler("xyz")]
        lines = (
            f"<Position{n}>{each!r}</Position{n}>" for n, each in enumerate(map(float, values))
        )
        text = "\n".join(lines)
        head = '<?xml version="1.0"?>\n<opencv_storage>'
        write(folder / f"poses/robot{at}.xml", f"{head}\n{text}\n</opencv_storage>\n")
    place, turn = halves(seen)
    lens = listed("camera_matrix", np.array([[520.0, 0, 320], [0, 520, 200], [0, 0, 1]]))
    halves_of = np.split(np.hstack([turn, place]), len(names), axis=1)
    rows = "".join(map(listed, names, halves_of))
    size = "image_width: 640\nimage_height: 400\n"
    write(folder / "camera_data.yml", f"%YAML:1.0\n---\n{size}{lens}{rows}")


def opencv_s_vectors(folder):
    """Vectors of calibrateCamera by their own names, beside its matrix."""
    opencv_s_calibration(folder, ("rotation_vectors", "translation_vectors"))


def assigned_lists(folder):
    """Lists of lists in lines of a text, each a rotation by rows and then a position."""
    sides = zip(("UR_pose", "Camera_to_object"), world(), strict=False)
    rows = (
        (name, [[*pose[:3, :3].ravel().tolist(), *pose[:3, 3].tolist()] for pose in poses])
        for name, poses in sides
    )
    write(folder / "run.txt", "\n".join(f"{name} = {each}" for name, each in rows))


def counted_rows(folder):
    """Arrays whose first columns count the rows and name the marker."""
    poses, seen, _ = world()
    place, turn = halves(seen)
    count = np.arange(1.0, 10.0)[:, None]
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    folder.mkdir()
    np.savez(
        folder / "data.npz",
        gripper_pose=np.hstack([poses[:, :3, 3], quaternions]),
        Target_tvecs=np.hstack([count, np.ones((9, 1)), place]),
        Target_rvecs=np.hstack([count, turn]),
    )


def vectors_by_name(folder):
    """A mapping of the views' names for each half of a pose."""
    poses, seen, _ = world()
    parts = zip(("translational", "rotational"), halves(seen), strict=True)
    write(
        folder / "board.json",
        {
            f"{part}_vectors": {f"image{at}": [[x] for x in row] for at, row in enumerate(rows)}
            for part, rows in ((part, each.tolist()) for part, each in parts)
        },
    )
    numbers = enumerate(np.hstack(halves(poses)).tolist())
    names = ("x", "y", "z", "rx", "ry", "rz")
    rows = {f"p{at}": dict(zip(names, row, strict=True)) for at, row in numbers}
    write(folder / "robot.json", {"Poses": rows})


def in_turn_above_a_result(folder):
    """Angles of the robot and quaternions of the target in turn, above a printed matrix."""
    poses, seen, _ = world()
    lines = []
    for pose, board in zip(poses, seen, strict=True):
        turn = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", degrees=True)
        place = (1e3 * pose[:3, 3]).tolist()
        lines.append(f"hand,{','.join(map(repr, [*place, *turn.tolist()]))},")
        quaternion = Rotation.from_matrix(board[:3, :3]).as_quat().tolist()
        lines.append(f"eye,{','.join(map(repr, [*board[:3, 3].tolist(), *quaternion]))}")
    write(folder / "run.csv", "\n".join([*lines, "", str(poses[0])]))


def copied(folder):
    """The target's poses once more beside the robot's, under a name of neither side."""
    poses, seen, _ = world()
    pairs = [*zip(poses.tolist(), seen.tolist(), strict=True)]
    write(folder / "seen.json", [{"tag_pose": board} for _, board in pairs])
    records = [{"T_measured": board, "T_nominal": pose} for pose, board in pairs]
    write(folder / "transforms.json", records)


def called_by_an_equation(folder):
    """Matrices as CamOdoCal keeps them, beside its settings."""
    poses, seen, _ = world()
    pairs = enumerate(zip(poses, seen, strict=True))
    text = "".join(
        listed(f"T{n}_{at}", each) for at, pair in pairs for n, each in enumerate(pair, 1)
    )
    write(folder / "pairs.yml", f"%YAML:1.0\nframeCount: {len(poses)}\n{text}")
    write(folder / "config.json", {"load": "./pairs.yml", "summary": 1})


def called_by_initials(folder):
    """Columns of the hand and of the eye."""
    names = [f"{side}_{each}" for side in "he" for each in ("x", "y", "z", "rx", "ry", "rz")]
    poses, seen, _ = world()
    rows = np.column_stack([np.arange(len(poses)), *halves(poses), *halves(seen)])
    lines = (",".join(map(repr, row)) for row in rows.tolist())
    write(folder / "run.csv", "\n".join([",".join(["id", *names]), *lines]))


@pytest.mark.parametrize(
    "make",
    [
        assigned_lists,
        called_by_an_equation,
        called_by_initials,
        copied,
        opencv_s_calibration,
        opencv_s_vectors,
        counted_rows,
        vectors_by_name,
        in_turn_above_a_result,
    ],
)
def test_poses_of_the_target_come_in_as_programs_store_them(make, tmp_path):
    poses, seen, mount = world()
    make(tmp_path / "in")
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", mount).good()
    # Vectors by name need no form.
    assert "--camera-form" not in done.err
    found = Session.load(tmp_path / "out").views
    for view, pose, board in zip(found, poses, seen, strict=True):
        np.testing.assert_allclose(view.base_from_flange().as_matrix(), pose, atol=1e-9)
        np.testing.assert_allclose(view.cam_from_target().as_matrix(), board, atol=1e-9)


def test_vectors_of_a_calibration_without_a_robot_are_the_target_s(tmp_path):
    opencv_s_vectors(tmp_path / "in")
    shutil.rmtree(tmp_path / "in/poses")
    refused = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand")
    refused.refused("Any of these may be the robot's poses", "are the target's")


def test_letters_below_a_heading_say_the_order_of_a_quaternion(tmp_path):
    """Beside the camera's points, and a few rows of another run in a folder within."""
    poses, seen, _ = world()
    for folder, count in ((tmp_path / "in", 9), (tmp_path / "in/scripts", 4)):
        lines = list[str]()
        for pose in poses[:count]:
            x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
            rows = {"translation": (*"xyz",), "rotation": (*"wxyz",)}
            values = (pose[:3, 3].tolist(), (w, x, y, z))
            for (name, letters), each in zip(rows.items(), values, strict=True):
                lines += [f"{name}:", *(f"{a}: {v!r}" for a, v in zip(letters, each, strict=True))]
        write(folder / "frames.txt", "\n".join(lines))
        points = (",".join(map(repr, row)) for row in seen[:count, :3, 3].tolist())
        write(folder / "points.txt", "\n".join(points))
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand").good()
    # Points test no form.
    assert "stays as first read" not in done.err
    views = Session.load(tmp_path / "out").views
    found = np.array([view.base_from_flange().as_matrix() for view in views])
    np.testing.assert_allclose(found, poses, atol=1e-9)


def corners_px(seen):
    """(n, 130, 2) corners of checkerboard_13x10_15mm in images of 640 x 400 px."""
    grid = np.stack(np.meshgrid(np.arange(13), np.arange(10)), axis=-1).reshape(-1, 2)
    points = np.hstack([0.015 * grid, np.zeros((130, 1)), np.ones((130, 1))])
    lens = np.array([[520.0, 0, 320], [0, 520, 200], [0, 0, 1]])
    shown = np.einsum("ij,njk,mk->nmi", lens, seen[:, :3], points)
    return shown[..., :2] / shown[..., 2:]


@pytest.mark.parametrize("is_of_opencv", [True, False])
def test_corners_of_another_program_are_the_session_s(tmp_path, is_of_opencv):
    """One file a view beside a table that names them, or the points of OpenCV's calibration."""
    poses, seen, mount = world()
    px = corners_px(seen)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz", degrees=True)
    rows = np.hstack([poses[:, :3, 3], turns])
    said = ["--mount", mount, "--target", "checkerboard_13x10_15mm"]
    if is_of_opencv:
        opencv_s_calibration(tmp_path / "in")
        matrix = listed("image_points", px).replace("cols: 260", "cols: 130")
        with (tmp_path / "in/camera_data.yml").open("a") as file:
            file.write(matrix.replace("dt: d", 'dt: "2d"'))
    else:
        lines = ["file_name,x,y,z,rx(deg),ry(deg),rz(deg)"]
        for at, row in enumerate(rows.tolist()):
            write(tmp_path / f"in/shot_{at}.json", {"corners": {"pixel": px[at].tolist()}})
            lines.append(",".join([f"shot_{at}.json", *map(repr, row)]))
        write(tmp_path / "in/rows.csv", "\n".join(lines))
        done = visioncal("convert", tmp_path / "in", tmp_path / "out", *said)
        done.refused("the corners do not say for which size", "--resolution")
        lacking = visioncal("convert", tmp_path / "in", tmp_path / "out", *said[:2])
        lacking.refused("there are corners, but their target is not known", "--target")
        said += ["--resolution", "640,400"]
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    assert "Found by the corners" in done.err
    session = Session.load(tmp_path / "out")
    for view, pose, points in zip(session.views, poses, px, strict=True):
        np.testing.assert_allclose(view.base_from_flange().as_matrix(), pose, atol=1e-9)
        np.testing.assert_allclose(session.corners[view.number].px, points, atol=1e-6)


@pytest.mark.parametrize("away_deg", [0.0, 3.0])
@pytest.mark.parametrize("left_stands", [True, False])
def test_of_many_links_the_one_that_turns_as_the_board_is_taken(tmp_path, away_deg, left_stands):
    """By the corners; where it agrees too badly, too, it is the one that is asked for."""
    poses, seen = turning(12)
    rng = np.random.default_rng(3)
    away = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(away_deg), (12, 3))).as_matrix()
    other = np.tile(poses[:1], (12, 1, 1)) if left_stands else poses[rng.permutation(12)]
    right = poses.copy()
    right[:, :3, :3] = poses[:, :3, :3] @ away
    sides = {"left_hand": other, "right_hand": right}
    rows = [
        {"corners": px.tolist()}
        | {
            name: {
                "position": link[at, :3, 3].tolist(),
                "orientation": Rotation.from_matrix(link[at, :3, :3]).as_quat().tolist(),
            }
            for name, link in sides.items()
        }
        for at, px in enumerate(corners_px(seen))
    ]
    write(tmp_path / "in.json", rows)
    said = ["--mount", "eye-in-hand", "--target", "checkerboard_13x10_15mm"]
    done = visioncal(
        "convert", tmp_path / "in.json", tmp_path / "out", *said, "--resolution", "640,400"
    )
    if away_deg:
        said = done.refused("Any of these may be the robot's poses").err
        command = shlex.split(said.splitlines()[-1])
        assert command[-1] == "right_hand.position,right_hand.orientation"
    else:
        done.good()
        found = Session.load(tmp_path / "out").views
        for view, pose in zip(found, poses, strict=True):
            np.testing.assert_allclose(view.base_from_flange().as_matrix(), pose, atol=1e-9)


@pytest.mark.parametrize("names", [("robot", "tool"), ("left", "right")])
def test_the_fields_that_agree_best_are_named_in_a_command_as_typed(tmp_path, names):
    """Where letters of their names are in the options and in the folder, too."""
    poses, seen = turning(12)
    rng = np.random.default_rng(3)
    away = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(3.0), (12, 3))).as_matrix()
    closest = poses.copy()
    closest[:, :3, :3] = poses[:, :3, :3] @ away
    links = zip(names, (poses[rng.permutation(12)], closest), strict=True)
    sides = {
        name: np.hstack([link[:, :3, 3], Rotation.from_matrix(link[:, :3, :3]).as_quat()])
        for name, link in links
    }
    rows = [
        {"corners": px.tolist()} | {name: rows[at].tolist() for name, rows in sides.items()}
        for at, px in enumerate(corners_px(seen))
    ]
    write(tmp_path / "in.json", rows)
    typed = ["convert", tmp_path / "in.json", tmp_path / f"out of {names[0]}"]
    typed += ["--mount", "eye-in-hand", "--target", "checkerboard_13x10_15mm"]
    typed += ["--resolution", "640,400"]
    said = visioncal(*typed).refused("Any of these may be the robot's poses").err
    command = shlex.split(said.splitlines()[-1])
    assert command[1 : 1 + len(typed)] == [*map(str, typed)]
    options = command[1 + len(typed) :]
    given = dict(zip(options[::2], options[1::2], strict=True))
    assert given.pop("--robot-key") == names[1]
    assert given in ({}, {"--camera-key": names[0]})


def test_extrinsic_parameters_of_opencv_are_vectors_alone(tmp_path):
    seen = world()[1]
    place, turn = halves(seen)
    lens = listed("camera_matrix", np.array([[520.0, 0, 320], [0, 520, 200], [0, 0, 1]]))

    def read(**arrays):
        rows = "".join(listed(name, array) for name, array in arrays.items())
        write(tmp_path / "lens.yml", f"%YAML:1.0\n---\n{lens}{rows}")
        document = read_document(tmp_path / "lens.yml")
        names = ("board_to_camera_rvecs", "board_to_camera_tvecs")
        return [document.get(f"extrinsic_parameters.{name}") for name in names]

    for given in (
        {"extrinsic_parameters": np.hstack([turn, place])},
        {"rotation_vectors": turn, "translation_vectors": place},
        {"rotation_vectors": turn.T, "translation_vectors": place.T},
    ):
        np.testing.assert_array_equal(read(**given), [turn, place])
    matrices = seen[:, :3, :3].reshape(-1, 9)
    for other in (
        {"extrinsic_parameters": np.hstack([matrices, place])},
        {"extrinsic_parameters": seen[0, :3]},
        {"rotation_vectors": matrices, "translation_vectors": place},
        {"rotation_vectors": turn, "translation_vectors": place[1:]},
    ):
        assert read(**other) == [None, None]


@pytest.mark.parametrize("letters", ["xyzw", "wxyz"])
def test_a_heading_names_all_numbers_below_it(tmp_path, letters):
    poses, _, _ = world()
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    text = ""
    for at, (place, turn) in enumerate(zip(poses[:, :3, 3], quaternions, strict=True)):
        named = dict(zip("xyzw", turn.tolist(), strict=True))
        parts = {"grip_place": zip("xyz", place.tolist(), strict=True)}
        parts["grip_turn"] = [(name, named[name]) for name in letters]
        text += f"image{at}.png\n"
        for heading, numbers_of in parts.items():
            text += f"{heading}:\n" + "".join(f"{name}: {n!r}\n" for name, n in numbers_of)
        write(tmp_path / f"in/image{at}.png", "")
        cv2.imwrite(str(tmp_path / f"in/image{at}.png"), np.full((40, 60), at, np.uint8))
    write(tmp_path / "in/log.txt", text)
    said = ("--mount", "eye-in-hand", "--robot-key", "grip_place,grip_turn", "--target")
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *said, "checkerboard_9x6_25mm")
    done.good()
    found = [view.base_from_flange().as_matrix() for view in Session.load(tmp_path / "out").views]
    np.testing.assert_allclose(found, poses, atol=1e-9)


def test_rotations_stand_first_in_rows_of_which_some_are_missing(tmp_path):
    poses, seen, mount = world()
    for name, side, first in (("gripper2base", poses, 1), ("target2cam", seen, 1)):
        places, turns = halves(side)
        rows = np.column_stack([np.arange(first, first + len(side)), turns, 1e3 * places])
        np.savetxt(tmp_path / f"{name}.csv", rows, fmt="%d" + ", %.12f" * 6)
    # Files of a tracker, of more views than were seen.
    for at in range(25):
        write(tmp_path / f"vicon/aa{at + 1}.csv", "1,2,3\n" * (4 + at))
    visioncal("convert", tmp_path, tmp_path / "out", "--mount", mount).good()
    read = Session.load(tmp_path / "out")
    found = np.array([view.base_from_flange().as_matrix() for view in read.views])
    np.testing.assert_allclose(found, poses, atol=1e-9)


def test_a_command_names_two_sides_of_as_many_rows(tmp_path):
    """Beside a lens of its own pictures, whose vectors are more than the robot's poses."""
    poses, seen, mount = world()
    place, turn = halves(seen)
    more = np.concatenate([place[::-1] + 0.3, place + 0.1])
    rows = {f"Matrix{at:02d}": pose for at, pose in enumerate(poses)}
    text = "".join(listed(name, pose) for name, pose in rows.items())
    write(tmp_path / "in/handEye.yml", f"%YAML:1.0\n{text}")
    for name, each in (("lens", (more, np.concatenate([turn, turn]))), ("seen", (place, turn))):
        parts = zip(("TranslationVectors", "RotationVectors"), each, strict=True)
        vectors = [(f"{part}{at:02d}", row) for part, rows in parts for at, row in enumerate(rows)]
        text = "".join(listed(part, row[:, None]) for part, row in vectors)
        write(tmp_path / f"in/{name}.yml", f"%YAML:1.0\n{text}")
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", mount)
    command = shlex.split(done.refused("handEye.yml").err.splitlines()[-1])
    assert [*map(Path, (command[2], command[-1]))] == [
        tmp_path / "in/handEye.yml", tmp_path / "in/seen.yml",
    ]  # fmt: skip
    visioncal(*command[1:]).good()


def test_no_field_is_proposed_for_both_sides(tmp_path):
    pose = world()[0][:, :3]
    turns = Rotation.from_matrix(pose[:, :, :3])
    rows = np.hstack([pose[:, :, 3], turns.as_quat(), turns.as_euler("xyz")])
    for at, row in enumerate(rows.tolist()):
        write(tmp_path / f"in/{at}.json", {f"v{n}": each for n, each in enumerate(row)})
    refused = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "eye-in-hand")
    command = shlex.split(refused.refused("--robot-key").err.splitlines()[-1])
    assert command[-2:] == ["--robot-key", "v0,v1,v2,v3,v4,v5,v6"]


def test_pairs_of_matrices_in_one_array_are_named_apart(tmp_path):
    poses, seen, mount = world()
    write(tmp_path / "in.json", {"transform set": np.stack([poses, seen], axis=1).tolist()})
    refused = visioncal("convert", tmp_path / "in.json", tmp_path / "out", "--mount", mount)
    command = shlex.split(refused.refused("--robot-key").err.splitlines()[-1])
    assert command[-3::2] == ["transform set.0", "transform set.1"]
    visioncal(*command[1:]).good()
    last = Session.load(tmp_path / "out").views[-1]
    np.testing.assert_allclose(last.base_from_flange().as_matrix(), poses[-1], atol=1e-9)


def test_a_sensor_beside_a_camera_is_the_arm_s(tmp_path):
    """As of an electromagnetic tracker: both words are a camera's."""
    rows = []
    for pair in zip(*world()[:2], strict=True):
        sides = zip(("camera", "sensor"), pair[::-1], strict=True)
        rows.append(
            {
                name: {
                    "position": pose[:3, 3].tolist(),
                    "orientation": Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(),
                }
                for name, pose in sides
            }
        )
    write(tmp_path / "in.json", rows)
    refused = visioncal("convert", tmp_path / "in.json", tmp_path / "out", "--mount", world()[2])
    command = shlex.split(refused.refused("--robot-key").err.splitlines()[-1])
    assert command[-4:] == [
        "--robot-key", "sensor.position,sensor.orientation",
        "--camera-key", "camera.position,camera.orientation",
    ]  # fmt: skip


def test_pictures_of_a_page_are_none_of_rows_that_have_both_sides(tmp_path):
    counted_rows(tmp_path / "in")
    for at in (14, 17, 21):
        write(tmp_path / f"in/docs/page_{at}.png", "")
        cv2.imwrite(str(tmp_path / f"in/docs/page_{at}.png"), np.full((40, 60), at, np.uint8))
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", world()[2]).good()
    assert "The images are left aside" in done.err
    assert len(Session.load(tmp_path / "out").views) == 9


@pytest.mark.parametrize(("is_copied", "count"), [(False, 9), (True, 9), (True, 11)])
def test_images_of_two_cameras_are_asked_for_though_rows_have_both_sides(
    tmp_path, is_copied, count
):
    """A folder of the same pictures is no other camera's, where each row has one."""
    counted_rows(tmp_path / "in")
    for at in range(count):
        for shift, side in enumerate(("left", "right")):
            level = at if is_copied else at + shift
            write(tmp_path / f"in/{side}/{at}.png", "")
            cv2.imwrite(str(tmp_path / f"in/{side}/{at}.png"), np.full((40, 60), level, np.uint8))
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", world()[2])
    if is_copied and count == 9:
        done.good()
    else:
        done.refused("Each row has several images", "--images")


def turning(count):
    """Poses of a robot that turns far, and of the target in its camera, as `world`."""
    rng = np.random.default_rng(1)
    seen = np.tile(np.eye(4), (count, 1, 1))
    angles = rng.uniform(-1.0, 1.0, (count, 3)) * (80.0, 35.0, 35.0)
    seen[:, :3, :3] = Rotation.from_euler("zyx", angles, degrees=True).as_matrix()
    seen[:, :3, 3] = rng.uniform((-0.1, -0.1, 0.5), (0.0, 0.0, 0.7), (count, 3))
    target, camera = exp(np.array([[3.0, 0.1, 0.2, 0.5, 0.1, 0.05], [0.1, 0.2, 0.3, 0, 0, 0.1]]))
    return target @ invert(seen) @ invert(camera), seen


@pytest.mark.slow
@pytest.mark.parametrize("fails", [False, True])
def test_angles_come_first_where_some_rows_have_no_corners(fails, tmp_path, monkeypatch):
    """Rows are compared with those that have corners; an error of one reading ends nothing."""

    def faulty(*_):
        raise DataError("a fault of one reading")

    if fails:
        monkeypatch.setattr(rereading, "may_agree", faulty)
    poses, seen = turning(12)
    px = corners_px(seen)
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz", degrees=True)
    rows = np.hstack([angles, 1e3 * poses[:, :3, 3]]).tolist()
    corners = [None if at in (0, 2) else each.tolist() for at, each in enumerate(px)]
    pairs = zip(rows, corners, strict=True)
    write(tmp_path / "in.json", [{"pose": pose, "corners": each} for pose, each in pairs])
    options = ["--mount", "eye-in-hand", "--target", "checkerboard_13x10_15mm"]
    options += ["--resolution", "640,400", "--robot-key", "pose"]
    visioncal("convert", tmp_path / "in.json", tmp_path / "out", *options).good()
    views = Session.load(tmp_path / "out").views
    found = [view.base_from_flange().as_matrix() for view in views]
    np.testing.assert_allclose(found, np.delete(poses, (0, 2), axis=0), atol=1e-6)


def test_readings_that_a_search_finds_are_no_other_motion():
    """With half of the rows apart, after whole turns were lost, and by too few rows."""
    poses, seen = turning(12)
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX", degrees=True)
    apart = replace(numbers(poses, "rotation-vector"), rotations=angles[:, ::-1])
    apart = apart.rows(np.array([*range(6), 7, 8, 9, 10, 11, 6]))
    lost = poses.copy()
    lost[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    few = numbers(poses[::-1])
    few.positions[3:] = np.nan
    for robot in (apart, numbers(lost), few):
        assert turns_alike(Recording(robot, numbers(seen), "eye-in-hand", is_measured=True))


def test_other_motions_are_known_by_their_turns_before_any_fit():
    """Of many tables, or fields, those that turn otherwise under any reading need no search."""
    poses, seen, mount = world()
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("zyx", degrees=True)
    robot = replace(numbers(poses, "rotation-vector"), rotations=angles)
    assert turns_alike(Recording(robot, numbers(seen), mount, is_measured=True))
    other = replace(robot, rotations=np.random.default_rng(0).uniform(-90.0, 90.0, (9, 3)))
    assert not turns_alike(Recording(other, numbers(seen), mount, is_measured=True))


@pytest.mark.slow
def test_a_fault_of_the_images_precedes_the_question_of_the_form(tmp_path, monkeypatch):
    sample = made_up(9).session
    sample.save(tmp_path / "shots")
    poses = np.array([view.base_from_flange().as_matrix() for view in sample.views])
    rows = np.hstack(halves(poses))
    said = ("--images", tmp_path / "shots/images", "--mount", sample.mount)
    np.savetxt(tmp_path / "rows.txt", rows)
    other = ("--target", "checkerboard_31x28_20mm")
    done = visioncal("convert", tmp_path / "rows.txt", tmp_path / "out", *said, *other).refused()
    words = done.err.partition("error: ")[2]
    assert words.index("board") < words.index("form of the robot's rotations")
    # Rows of one rotation determine nothing, whatever the images show.
    rows[:, 3:] = rows[0, 3:]
    np.savetxt(tmp_path / "still.txt", rows)

    def searched(*_, **__):
        raise AssertionError("an image was searched")

    monkeypatch.setattr(rereading, "_measured", searched)
    said = (*said, "--target", sample.document["target"])
    done = visioncal("convert", tmp_path / "still.txt", tmp_path / "out", *said)
    done.refused("the same in all 9 rows", "tilted by 20 to 40 degrees")


@pytest.mark.slow
def test_rows_of_another_recording_are_doubted_before_their_form(tmp_path):
    poses, seen, mount = world()
    rng = np.random.default_rng(0)
    turns = Rotation.random(9, random_state=rng).as_rotvec()
    rows = np.hstack([rng.uniform(-1.0, 1.0, (9, 3)), turns]).tolist()
    records = [{"pose": a, "board": b.tolist()} for a, b in zip(rows, seen, strict=True)]
    write(tmp_path / "in.json", records)
    done = visioncal("convert", tmp_path / "in.json", tmp_path / "out", "--mount", mount)
    words = done.refused("No reading that was tried stands out").err
    assert words.index("these rows are those of these images") < words.index(
        "Else give --robot-form"
    )
    # Columns that are one pose are described in one line.
    pose = np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
    np.savetxt(tmp_path / "rows.txt", pose)
    assert "1, 2, 3, 4, 5, 6, 7: look like a pose" in describe(tmp_path / "rows.txt").words()


@pytest.mark.parametrize("form", ["braces", "OpenCV"])
def test_rows_within_a_program_in_cpp_are_read_where_it_is_named(tmp_path, form):
    poses = world()[0]
    numbers = np.hstack([1e3 * poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()])
    rows = [", ".join(map(repr, row)) for row in numbers.tolist()]
    if form == "braces":
        lines = "".join(f"    {{{row}}},  // a view\n" for row in rows)
        text = f"std::vector<std::vector<double>> tool = {{\n{lines}}};\nint lens[2] = {{1, 2}};\n"
    else:
        lines = ",\n    ".join(rows)
        text = f"Mat tool = (cv::Mat_<double>(9, 6) <<\n    {lines});\n"
    write(tmp_path / "solve.cpp", f"int main() {{\n{text}    return 0.5 > 0.25;\n}}\n")
    fields = read_fields(tmp_path / "solve.cpp")
    np.testing.assert_array_equal(fields.column("tool"), numbers)
    # Beside pictures it is a program's own code.
    assert "1 kind not read: solve.cpp" in describe(tmp_path).words()


def test_a_file_called_joints_without_a_header_has_no_poses(tmp_path):
    angles = np.linspace(-80.0, 80.0, 60).reshape(10, 6)
    np.savetxt(tmp_path / "joints_tool.txt", angles)
    fields = read_fields(tmp_path / "joints_tool.txt")
    assert not possible_poses(fields)
    assert joint_names(fields, ()) == tuple(f"joint_{at}" for at in range(1, 7))


def readings_beside_joints(path):
    """A table of joint angles and of the poses that an instrument read there, named behind."""
    session, seen = made_up(9, images=False).session, world()[1]
    names = [f"{each}_r" for each in ("px", "py", "pz", "rx", "ry", "rz")]
    joints = [view.joints_rad for view in session.views]
    rows = np.hstack([joints, *halves(seen)]).tolist()
    header = ",".join([*(f"q{at}" for at in range(1, 7)), *names])
    write(path, "\n".join([header, *(",".join(map(repr, row)) for row in rows)]))
    return seen


def test_poses_beside_joints_are_those_that_were_seen(tmp_path):
    seen = readings_beside_joints(tmp_path / "in/data.csv")
    said = ["--mount", world()[2], "--robot-model", "ur10e"]
    visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    # Joints that the user names change nothing.
    said += ["--joint-columns", ",".join(f"q{at}" for at in range(1, 7))]
    visioncal("convert", tmp_path / "in", tmp_path / "again", *said).good()
    for folder in ("out", "again"):
        last = Session.load(tmp_path / folder).views[-1]
        np.testing.assert_allclose(last.cam_from_target().as_matrix(), seen[-1], atol=1e-9)
    readings_beside_joints(tmp_path / "in/data_old.csv")
    done = visioncal("convert", tmp_path / "in", tmp_path / "third", *said)
    assert "data.csv" in done.refused("2 files that are each a recording").err.splitlines()[-1]


def test_a_pose_of_a_frame_is_not_taken_for_a_recording(tmp_path):
    rows = np.random.default_rng(1).uniform(-900, 900, (20, 21))
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",")
    write(tmp_path / "reference.csv", "950.252 6.944 649.166 -178.998 -50.508 0.790\n")
    refused = visioncal("convert", tmp_path, tmp_path / "out", "--mount", "eye-to-hand")
    last = refused.refused("run.csv: 20 rows", "may be the robot's poses").err.splitlines()[-1]
    assert last.startswith("Name them with --robot-columns, or the joint angles")


def test_points_beside_pictures_need_no_board(tmp_path):
    """A ball's centre in records beside a picture each, and the arm before and after it."""
    for at, pose in enumerate(world()[0]):
        arm = {"before": {"O_T_EE": pose.T.ravel().tolist()}}
        arm["after"] = {"O_T_EE": (pose.T + np.eye(4)[3:] * [1e-6, 0, 0, 0]).ravel().tolist()}
        centre = (invert(pose[None])[0] @ [0.1, 0.2, 0.3, 1.0])[:3].tolist()
        write(tmp_path / f"in/p{at}/record.json", {"robot": arm, "ball": {"centre_m": centre}})
        cv2.imwrite(str(tmp_path / f"in/p{at}/view.png"), np.full((40, 60), 9 * at, np.uint8))
    said = ["--mount", "eye-in-hand", "--camera-key", "ball.centre_m"]
    visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    assert Session.load(tmp_path / "out").cameras[""].seeing == "points"


def test_files_of_objects_say_how_to_write_them(tmp_path, monkeypatch):
    """A table of MATLAB, a pickle, and a workbook."""
    write(tmp_path / "in/frame.pkl", "numbers 0.1 0.2 0.3 0.4 0.5 0.6")
    write(tmp_path / "in/wood.p", "numbers 0.1 0.2 0.3 0.4 0.5 0.6")
    write(tmp_path / "in/read.m", "T = 1;")
    write(tmp_path / "in/run.xlsx", "numbers 0.1 0.2 0.3 0.4 0.5 0.6")
    write(tmp_path / "in/poses.mat", "a file of MATLAB")
    table = MatlabOpaque(np.zeros(1, [("s0", "O"), ("s1", "O"), ("s2", "O"), ("arr", "O")]))
    monkeypatch.setattr(scipy.io, "loadmat", lambda _: {"__version__": "1.0", "T": table})
    words = describe(tmp_path / "in").words()
    assert "frame.pkl: a pickle, which runs code when it is opened" in words
    assert "wood.p: a pickle" in words
    assert "run.xlsx: a workbook: save its sheet with the poses as .csv" in words
    assert "poses.mat holds no arrays of numbers: its values are a table" in words
    assert "1 kind not read: read.m" in words
    with pytest.raises(DataError, match=r"writetable\(T, 'poses.csv'\)"):
        read_fields(tmp_path / "in/poses.mat")
