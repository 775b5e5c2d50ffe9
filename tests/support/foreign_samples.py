"""Small recordings in the forms of others, all of the same poses."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import exp, invert
from visioncal.interchange.formats import ImportOptions, PoseImportOptions

COUNT = 9
CHARUCO = "charuco_5x7_36.195mm_18.256mm_DICT_6X6_250"


def _world():
    rng = np.random.default_rng(3)
    home = exp(np.array([2.0, 0.4, 0.3, 0.4, -0.2, 0.5]))
    covariance = rng.uniform(-1, 1, (COUNT, 6)) * [0.5, 0.5, 0.9, 0.1, 0.1, 0.1]
    base_from_flange = home @ exp(covariance)
    flange_from_cam = exp(np.array([0.1, -0.2, 1.5, 0.05, 0.01, 0.08]))
    base_from_target = home @ flange_from_cam @ exp(np.array([0.1, 0, 0, -0.1, -0.05, 0.6]))
    return base_from_flange, invert(base_from_flange @ flange_from_cam) @ base_from_target


BASE_FROM_FLANGE, CAM_FROM_TARGET = _world()


@dataclass(frozen=True)
class Recording:
    """A recording that was written: where it lies, and what the user says of it."""

    source: Path
    requested: ImportOptions


def quaternions(poses):
    """(n, 7) position and quaternion x, y, z, w."""
    return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])


def vectors(poses):
    """(n, 6) position and rotation vector."""
    return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()])


def picture(path: Path, size=(64, 48)):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((size[1], size[0]), 90, np.uint8))


def _write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def _in_hand(path: Path, text: str) -> Recording:
    return Recording(_write(path, text), ImportOptions(mount="eye-in-hand"))


def _keyed(row) -> str:
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    return "".join(f"{name}: {value!r}\n" for name, value in zip(names, row.tolist(), strict=True))


def industrial(folder: Path) -> Recording:
    rows = ""
    for at, row in enumerate(quaternions(BASE_FROM_FLANGE)):
        _write(folder / f"poses/{at}.yaml", _keyed(row))
        picture(folder / f"images/{at}.png")
        rows += f"  - image: images/{at}.png\n    pose: poses/{at}.yaml\n"
    text = f"data:\n{rows}" + (
        "target_finder:\n  type: CharucoGridTargetFinder\n  rows: 7\n  cols: 5\n"
        "  chessboard_dim: 0.036195\n  aruco_marker_dim: 0.018256\n  dictionary: 10\n"
        "intrinsics: {fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0}\nstatic_camera: false\n"
    )
    _write(folder / "cal_data.yaml", text)
    return Recording(folder, ImportOptions())


def kinematics(folder: Path) -> Recording:
    text = ""
    for at, row in enumerate(quaternions(CAM_FROM_TARGET)):
        pose = _keyed(row).replace("\n", "\n    ")
        text += f"'15937{at:03d}':\n  camera_joints: []\n  pose:\n    {pose}\n"
        text += f"  target_joints:\n  - {0.1 * at}\n  - {0.2 * at}\n"
    return Recording(_write(folder / "measurements.yaml", text), ImportOptions())


def visp(folder: Path) -> Recording:
    for at, row in enumerate(vectors(BASE_FROM_FLANGE), start=1):
        data = "".join(f"  - [{value!r}]\n" for value in row.tolist())
        _write(folder / f"arm_pose_rPe_{at}.yaml", f"rows: 6\ncols: 1\ndata:\n{data}")
        picture(folder / f"arm_image-{at}.png")
    _write(
        folder / "arm_camera.xml",
        '<?xml version="1.0"?>\n<root><!-- a camera --><camera><name>Camera</name>'
        "<image_width>64</image_width><image_height>48</image_height><model>"
        "<type>perspectiveProjWithDistortion</type><px>60.5</px><py>60.25</py><u0>32.5</u0>"
        "<v0>24.5</v0><kud>-0.125</kud><kdu>0.13</kdu></model></camera></root>\n",
    )
    _write(folder / "chessboard-data.txt", "Chessboard\n9 x 6\nsquare size: 0.0236 m\n")
    return Recording(folder, ImportOptions(mount="eye-in-hand"))


def zivid(folder: Path) -> Recording:
    for at, pose in enumerate(BASE_FROM_FLANGE, start=1):
        rows = pose.copy()
        rows[:3, 3] *= 1e3
        data = ",\n".join(f"      {row}" for row in rows.tolist())
        text = "__version__:\n  serializer: 1\n  data: 1\nFloatMatrix:\n  Data:\n    [\n"
        _write(folder / f"pos{at:02d}.yaml", f"{text}{data}\n    ]\n")
        picture(folder / f"img{at:02d}.png")
    return Recording(folder, ImportOptions(mount="eye-in-hand", target="checkerboard_9x6_25mm"))


def _ros_transform(row, indent: str) -> str:
    x, y, z, qx, qy, qz, qw = row.tolist()
    return (
        f"{indent}translation: {{x: {x!r}, y: {y!r}, z: {z!r}}}\n"
        f"{indent}rotation: {{x: {qx!r}, y: {qy!r}, z: {qz!r}, w: {qw!r}}}\n"
    )


def easy_handeye_file(path: Path, robot_poses, camera_poses) -> Path:
    text = "samples:\n"
    for robot, camera in zip(quaternions(robot_poses), quaternions(camera_poses), strict=True):
        text += f"- robot:\n{_ros_transform(robot, '    ')}"
        text += f"  tracking:\n{_ros_transform(camera, '    ')}"
    return _write(path, text)


def easy_handeye(folder: Path) -> Recording:
    source = easy_handeye_file(folder / "cell.samples", BASE_FROM_FLANGE, CAM_FROM_TARGET)
    return Recording(source, ImportOptions(mount="eye-in-hand"))


def moveit_json(folder: Path) -> Recording:
    pairs = np.stack([BASE_FROM_FLANGE, CAM_FROM_TARGET], axis=1).tolist()
    return _in_hand(folder / "pairs.json", json.dumps(pairs))


def views_json(folder: Path) -> Recording:
    """One file a view; the robot's matrix by columns, as libfranka has it."""
    for at, (robot, camera) in enumerate(
        zip(BASE_FROM_FLANGE, vectors(CAM_FROM_TARGET), strict=True)
    ):
        record = {
            "O_T_EE": robot.T.reshape(-1).tolist(),
            "board": {"rvec": camera[3:, None].tolist(), "tvec": camera[:3, None].tolist()},
            "joint_pose": [0.1 * at] * 7,
            "seen": True,
        }
        _write(folder / f"pose_{at:02d}.json", json.dumps(record))
    return Recording(folder, ImportOptions(mount="eye-in-hand"))


def views_npz(folder: Path) -> Recording:
    folder.mkdir(parents=True, exist_ok=True)
    for at, (robot, camera) in enumerate(
        zip(BASE_FROM_FLANGE, vectors(CAM_FROM_TARGET), strict=True)
    ):
        millimetres = robot.copy()
        millimetres[:3, 3] *= 1e3
        np.savetxt(folder / f"pose_{at:03d}.txt", millimetres, fmt="%.17g")
        np.savez(folder / f"boardpose_{at:03d}.npz", rvec=camera[3:, None], tvec=camera[:3, None])
    return Recording(folder, ImportOptions(mount="eye-in-hand", robot=PoseImportOptions(unit="mm")))


def opencv_matrices(folder: Path) -> Recording:
    text = "%YAML:1.0\n---\n"
    for at, poses in enumerate(zip(BASE_FROM_FLANGE, CAM_FROM_TARGET, strict=True)):
        for name, pose in zip(("base_T_ee", "camera_T_target"), poses, strict=True):
            data = ", ".join(map(repr, pose.reshape(-1).tolist()))
            text += f"{name}_{at}: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n"
            text += f"   data: [ {data} ]\n"
    return _in_hand(folder / "poses.yml", text)


def kuka_csv(folder: Path) -> Recording:
    angles = Rotation.from_matrix(BASE_FROM_FLANGE[:, :3, :3]).as_euler("ZYX", degrees=True)
    rows = np.hstack([1e3 * BASE_FROM_FLANGE[:, :3, 3], angles, quaternions(CAM_FROM_TARGET)])
    names = "X,Y,Z,A,B,C,cam_x,cam_y,cam_z,cam_qx,cam_qy,cam_qz,cam_qw,operator"
    text = names + "\n" + "".join(f"{','.join(map(repr, row))},Ann\n" for row in rows.tolist())
    camera = tuple(names.split(",")[6:13])
    return Recording(
        _write(folder / "log.csv", text),
        ImportOptions(
            mount="eye-in-hand",
            robot=PoseImportOptions(("X", "Y", "Z", "A", "B", "C"), form="kuka"),
            camera=PoseImportOptions(camera),
        ),
    )


def plain_table(folder: Path) -> Recording:
    rows = np.hstack([quaternions(BASE_FROM_FLANGE), quaternions(CAM_FROM_TARGET)])
    folder.mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / "poses.txt", rows, fmt="%.17g", header="robot, camera")
    return Recording(folder / "poses.txt", ImportOptions(mount="eye-in-hand"))


def _matrices_in_files(folder: Path, join: Callable[[np.ndarray], np.ndarray]) -> Recording:
    folder.mkdir(parents=True, exist_ok=True)
    for name, poses in (("robot", BASE_FROM_FLANGE), ("camera", CAM_FROM_TARGET)):
        np.savetxt(folder / f"{name}.csv", join(poses), "%.17g", delimiter=",")
    requested = ImportOptions(mount="eye-in-hand", camera_file=folder / "camera.csv")
    return Recording(folder / "robot.csv", requested)


def matrices_below(folder: Path) -> Recording:
    return _matrices_in_files(folder, np.vstack)


def matrices_in_rows(folder: Path) -> Recording:
    """The upper three rows of a matrix a line."""
    return _matrices_in_files(folder, lambda poses: poses[:, :3].reshape(-1, 12))


def numbered_yaml(folder: Path) -> Recording:
    """A mapping from numbers to matrices each for the robot and for the camera."""
    sides = {"base_T_ee": BASE_FROM_FLANGE, "cam_T_board": CAM_FROM_TARGET}
    text = ""
    for name, poses in sides.items():
        rows = poses.reshape(-1, 16).tolist()
        text += f"{name}:\n" + "".join(f"  '{at}': {row}\n" for at, row in enumerate(rows, 1))
    return _in_hand(folder / "log.yml", text)


def lettered_quaternions(folder: Path) -> Recording:
    """Records whose names say the unit and the order of quaternions."""
    sides = (quaternions(poses).tolist() for poses in (BASE_FROM_FLANGE, CAM_FROM_TARGET))
    rows = [
        {
            "robot": {"position_m": robot[:3], "quaternion_wxyz": [robot[6], *robot[3:6]]},
            "target": {"position_m": target[:3], "quaternion_xyzw": target[3:]},
        }
        for robot, target in zip(*sides, strict=True)
    ]
    document = json.dumps({"samples": rows})
    return _in_hand(folder / "log.json", document)


def printed_lists(folder: Path) -> Recording:
    """Rows as a program prints them, under a remark in another encoding."""
    rows = np.hstack([quaternions(BASE_FROM_FLANGE), quaternions(CAM_FROM_TARGET)])
    recording = Recording(folder / "log.txt", ImportOptions(mount="eye-in-hand"))
    text = "".join(f"pose {at}: {row}\n" for at, row in enumerate(rows.tolist()))
    _write(recording.source, text)
    recording.source.write_bytes("# größer\n".encode("latin-1") + text.encode())
    return recording


def scripted(folder: Path) -> Recording:
    """Lists in a Python program that solves by them."""
    text = "import numpy as np\nK = np.array([[900.0, 0, 640], [0, 900.0, 360], [0, 0, 1]])\n"
    for name, poses in (("robot_poses", BASE_FROM_FLANGE), ("marker_in_cam", CAM_FROM_TARGET)):
        rows = ",\n    ".join(map(repr, quaternions(poses).tolist()))
        text += f"{name} = np.array([  # x y z, x y z w\n    {rows},\n])\n"
    return _in_hand(folder / "handeye.py", f"{text}print(robot_poses.shape)\n")


def headed_units(folder: Path) -> Recording:
    """A header in a comment, with the units of its columns."""
    angles = Rotation.from_matrix(BASE_FROM_FLANGE[:, :3, :3]).as_euler("xyz", degrees=True)
    rows = np.hstack([1e3 * BASE_FROM_FLANGE[:, :3, 3], angles])
    names = "file, X(mm), Y(mm), Z(mm), roll [deg], pitch [deg], yaw [deg]"
    text = f"# columns: {names.replace(' [', '[')}\n"
    for at, row in enumerate(rows.tolist()):
        text += f"shot{at}.png, {', '.join(map(repr, row))}\n"
        picture(folder / f"shot{at}.png")
    requested = ImportOptions(mount="eye-in-hand", target=CHARUCO)
    return Recording(_write(folder / "robot.txt", text), requested)


def ros_poses(folder: Path) -> Recording:
    """Two lists of messages."""
    lists = {}
    for name, poses, place, turn in (
        ("robot_poses", BASE_FROM_FLANGE, "position", "orientation"),
        ("marker_transforms", CAM_FROM_TARGET, "translation", "rotation"),
    ):
        lists[name] = [
            {
                place: dict(zip("xyz", row, strict=False)),
                turn: dict(zip("xyzw", row[3:], strict=True)),
            }
            for row in quaternions(poses).tolist()
        ]
    return _in_hand(folder / "log.json", json.dumps({"count": COUNT, **lists}))


def visp_seen(folder: Path) -> Recording:
    """ViSP's poses of the object in the camera, without images."""
    for name, poses in (("fPe", BASE_FROM_FLANGE), ("cPo", CAM_FROM_TARGET)):
        for at, row in enumerate(vectors(poses), start=1):
            data = "".join(f"  - [{value!r}]\n" for value in row.tolist())
            _write(folder / f"pose_{name}_{at}.yaml", f"rows: 6\ncols: 1\ndata:\n{data}")
    return Recording(folder, ImportOptions(mount="eye-in-hand"))


def stacked_npz(folder: Path) -> Recording:
    folder.mkdir(parents=True, exist_ok=True)
    camera = vectors(CAM_FROM_TARGET)
    np.savez_compressed(
        folder / "all.npz",
        R_gripper2base=BASE_FROM_FLANGE[:, :3, :3],
        t_gripper2base=BASE_FROM_FLANGE[:, :3, 3, None],
        rvecs=camera[:, 3:],
        tvecs=camera[:, :3],
    )
    return Recording(folder / "all.npz", ImportOptions(mount="eye-in-hand"))


def keyed_json(folder: Path) -> Recording:
    angles = Rotation.from_matrix(BASE_FROM_FLANGE[:, :3, :3]).as_euler("xyz").tolist()
    places = [dict(zip("xyz", place, strict=True)) for place in BASE_FROM_FLANGE[:, :3, 3].tolist()]
    rows = [
        {"robot_pose": {"position": place, "rpy": rpy}, "b": b}
        for place, rpy, b in zip(places, angles, invert(CAM_FROM_TARGET).tolist(), strict=True)
    ]
    names = tuple(f"robot_pose.position.{name}" for name in "xyz")
    return Recording(
        _write(folder / "log.json", json.dumps({"samples": rows})),
        ImportOptions(
            mount="eye-in-hand",
            robot=PoseImportOptions((*names, "robot_pose.rpy"), form="rpy"),
            camera=PoseImportOptions(("b",), inverse=True),
        ),
    )


def images_and_table(folder: Path) -> Recording:
    rows = quaternions(BASE_FROM_FLANGE).tolist()
    text = "x;y;z;qw;qx;qy;qz;lamp\n"
    for at, (x, y, z, qx, qy, qz, qw) in enumerate(rows):
        cells = (x, y, z, qw, qx, qy, qz)
        text += ";".join(repr(cell).replace(".", ",") for cell in cells) + ";on\n"
        picture(folder / f"shot{at}.png")
    _write(folder / "robot.csv", text)
    names = ("x", "y", "z", "qw", "qx", "qy", "qz")
    requested = ImportOptions(mount="eye-in-hand", target=CHARUCO, robot=PoseImportOptions(names))
    return Recording(folder, requested)


def streams(folder: Path) -> Recording:
    """Two streams of one motion, the camera's 0.1 s ahead."""
    folder.mkdir(parents=True, exist_ok=True)
    times_s = np.arange(0, 6, 0.05)
    swing = np.sin(np.outer(times_s, [1.1, 1.7, 2.3, 0.7, 1.3, 1.9]) + np.arange(6)) * 0.3
    for name, poses, ahead_s in (("robot", exp(swing), 0), ("camera", invert(exp(swing)), 0.1)):
        rows = np.hstack([times_s[:, None] + ahead_s, quaternions(poses)])
        np.savetxt(folder / f"{name}.csv", rows, "%.9f", delimiter=",")
    requested = ImportOptions(mount="eye-in-hand", camera_file=folder / "camera.csv")
    return Recording(folder / "robot.csv", requested)


def separate_lens(folder: Path) -> Recording:
    """Poses and images with intrinsics in a file of their own."""
    recording = images_and_table(folder / "images")
    text = "%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\n"
    text += "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    text += "   data: [ 60., 0., 32., 0., 60., 24., 0., 0., 1. ]\n"
    text += "distortion_coefficients: [-0.25, 0.125, 0, 0, 0]\n"
    lens = _write(folder / "lens.yml", text)
    return replace(recording, requested=replace(recording.requested, intrinsics=str(lens)))


def alternating(folder: Path) -> Recording:
    """Lines of the hand and of the eye in turn, without a header."""
    pairs = zip(quaternions(BASE_FROM_FLANGE), quaternions(CAM_FROM_TARGET), strict=True)
    rows = (("hand", hand.tolist(), "eye", eye.tolist()) for hand, eye in pairs)
    text = "".join(f"{_joined(a, x)}{_joined(b, y)}" for a, x, b, y in rows)
    return _in_hand(folder / "pairs.csv", text)


def halves(folder: Path) -> Recording:
    """The robot's poses, an empty line, and the target's."""
    sides = (quaternions(at).tolist() for at in (BASE_FROM_FLANGE, CAM_FROM_TARGET))
    blocks = ("\n".join(" ".join(map(repr, row)) for row in rows) for rows in sides)
    return _in_hand(folder / "data.txt", "\n\n\n".join(blocks) + "\n")


def counted_rows(folder: Path) -> Recording:
    """Files whose rows begin with their number, and have the rotation before the position [mm]."""
    for name, poses in (("gripper2base", BASE_FROM_FLANGE), ("target2cam", CAM_FROM_TARGET)):
        flat = vectors(poses)
        rows = np.hstack([flat[:, 3:], 1e3 * flat[:, :3]]).tolist()
        numbers = (3 * at // 2 + 1 for at in range(len(rows)))
        text = "".join(_joined(str(at), row) for at, row in zip(numbers, rows, strict=True))
        _write(folder / f"{name}.csv", text)
    return Recording(folder, ImportOptions(mount="eye-in-hand"))


def _joined(first: str, numbers: list[float]) -> str:
    return ", ".join([first, *map(repr, numbers)]) + "\n"


RECORDINGS: Mapping[str, Callable[[Path], Recording]] = {
    make.__name__: make
    for make in (
        industrial, kinematics, visp, zivid, easy_handeye, moveit_json, views_json,
        views_npz, opencv_matrices, kuka_csv, plain_table, stacked_npz, keyed_json,
        images_and_table, matrices_below, matrices_in_rows, numbered_yaml,
        lettered_quaternions, printed_lists, scripted, headed_units, ros_poses, visp_seen,
        alternating, halves, counted_rows,
    )
}  # fmt: skip

# Those whose poses are not the world's, or are in several files.
MORE_RECORDINGS: Mapping[str, Callable[[Path], Recording]] = {
    recording.__name__: recording for recording in (streams, separate_lens)
}
