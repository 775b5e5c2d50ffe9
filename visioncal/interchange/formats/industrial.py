"""Samples of ROS: industrial_calibration, robot_cal_tools, easy_handeye2 and MoveIt."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.documents import as_numbers, mapping, number, read_json
from visioncal.core.documents.structured import read_yaml
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.file_search import (
    files_in,
    head,
    images_named,
    number_in,
    path_inside,
)
from visioncal.interchange.formats.foreign import ForeignFormat, ForeignRecording, ImportOptions
from visioncal.interchange.formats.intrinsics import intrinsics_from
from visioncal.interchange.formats.poses import as_matrix, matrix_numbers


def _is_easy_handeye(path: Path) -> bool:
    if not path.is_file():
        return False
    words = head(path)
    return path.suffix == ".samples" or (
        "samples:" in words and "robot:" in words and "tracking:" in words
    )


def _read_easy_handeye(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads a .samples file: a list of `robot` and `tracking` as geometry_msgs/Transform."""
    # With the camera on the base the sampler stores the robot's pose inverted, so that one solver
    # serves both (easy_handeye2, HandeyeSampler); the file itself does not say which it is.
    document = mapping(read_yaml(path), str(path))
    samples = _rows(document.get("samples"), f"{path}: samples")
    robot, camera, places = [], [], []
    for at, sample in enumerate(samples):
        where = f"{path.name}: sample {at}"
        entry = mapping(sample, where)
        robot.append(_transform(entry.get("robot"), f"{where}: robot"))
        camera.append(_transform(entry.get("tracking", entry.get("optical")), f"{where}: tracking"))
        places.append(where)
    inverse = requested.mount == "eye-to-hand"
    poses = requested.robot.applied_to(_numbers(robot, places, inverse=inverse))
    note = (
        "inverted, as easy_handeye2 stores them with the camera on the base"
        if poses.reading.inverse
        else "as they stand, as with the camera in the hand"
    )
    return ForeignRecording(
        name=path.stem,
        robot=poses,
        camera=requested.camera.applied_to(_numbers(camera, places, inverse=False)),
        notes=(f"The robot's poses are read {note}.",),
    )


def _transform(value: object, where: str) -> list[float]:
    content = mapping(value, where)
    position = mapping(content.get("translation"), f"{where}: translation")
    rotation = mapping(content.get("rotation"), f"{where}: rotation")
    return [
        *(number(position.get(name), f"{where}: translation: {name}") for name in "xyz"),
        *(number(rotation.get(name), f"{where}: rotation: {name}") for name in "xyzw"),
    ]


def _numbers(rows: list[list[float]], places: list[str], *, inverse: bool) -> PoseNumbers:
    numbers = np.array(rows)
    return PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(inverse=inverse), tuple(places))


def _is_moveit(path: Path) -> bool:
    if not path.is_file():
        return False
    words = head(path)
    named = "effector_wrt_world" in words and "object_wrt_sensor" in words
    nested = path.suffix.lower() == ".json" and "".join(words.split())[:4] == "[[[["
    return named or nested


def _read_moveit(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads MoveIt's samples: the effector in the world, the object in the sensor, as matrices."""
    # A list of mappings, as its panel saves them, or of pairs, as its tests have them.
    document = read_json(path) if path.suffix.lower() == ".json" else read_yaml(path)
    robot, camera, places = [], [], []
    for at, sample in enumerate(_rows(document, str(path))):
        where = f"{path.name}: sample {at}"
        if isinstance(sample, list) and len(sample) == 2:
            first, second = sample
        else:
            entry = mapping(sample, where)
            first, second = entry.get("effector_wrt_world"), entry.get("object_wrt_sensor")
        robot.append(as_matrix(first, f"{where}: effector_wrt_world"))
        camera.append(as_matrix(second, f"{where}: object_wrt_sensor"))
        places.append(where)
    return ForeignRecording(
        name=path.stem,
        robot=requested.robot.applied_to(matrix_numbers(np.array(robot), places)),
        camera=requested.camera.applied_to(matrix_numbers(np.array(camera), places)),
    )


def _rows(value: object, where: str) -> list[object]:
    if not isinstance(value, list) or not value:
        raise DataError(f"{where} is no list of samples.", culprits=[where])
    return value


EASY_HANDEYE = ForeignFormat(
    "easy-handeye2", "easy_handeye2's .samples", _is_easy_handeye, _read_easy_handeye
)
MOVEIT = ForeignFormat("moveit", "MoveIt's hand-eye samples", _is_moveit, _read_moveit)


# Other formats have the pose itself under this key.
_NAMED_POSE = re.compile(r"\bpose: *[\"']?[^\n\"'\[{,]+\.ya?ml\b", re.IGNORECASE)
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")


def _hand_eye_file(path: Path) -> Path | None:
    files = files_in(path) if path.is_dir() else (path,)
    for file in files:
        if file.suffix.lower() in (".yaml", ".yml"):
            words = head(file)
            if "data:" in words and "image:" in words and _NAMED_POSE.search(words):
                return file
    return None


def _kinematic_file(path: Path) -> Path | None:
    files = files_in(path) if path.is_dir() else (path,)
    return next((file for file in files if "target_joints:" in head(file)), None)


def _read_hand_eye(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads cal_data.yaml with a pose file and an image in each row."""
    # Poses are of the robot's flange in its base; `static_camera` gives the mount.
    file = _required(_hand_eye_file(path), path, "a cal_data.yaml with pose and image rows")
    document = mapping(read_yaml(file), str(file))
    rows = document.get("data")
    if not isinstance(rows, list) or not rows:
        raise DataError(f"{file}: data holds no rows of pose and image.", culprits=[str(file)])
    names, poses, places = [], [], []
    for at, row in enumerate(rows):
        entry = mapping(row, f"{file}: data, row {at}")
        name = entry.get("pose")
        if not isinstance(name, str):
            raise DataError(f"{file}: data, row {at} names no pose.", culprits=[str(file)])
        stored = path_inside(file.parent, name)
        poses.append(_pose_numbers(read_yaml(stored), str(stored)))
        places.append(name)
        names.append(str(entry["image"]) if entry.get("image") else None)
    numbers = np.array(poses)
    static = document.get("static_camera")
    if not isinstance(static, bool | None):
        raise DataError(
            f"{file}: static_camera is {static!r}; true or false is needed.", culprits=[str(file)]
        )
    notes: list[str] = []
    # The user's options replace what the source states.
    lens = None
    if "intrinsics" in document and not requested.intrinsics:
        lens, _ = intrinsics_from(document, str(file))
        notes.append(
            "The intrinsics of the source have no distortion; it is taken for zero. "
            "--intrinsics estimate leaves them out."
        )
    target = None if requested.target else _target(document, notes)
    numbered = [number_in(place) for place in places]
    views = tuple(index for index in numbered if index is not None)
    return ForeignRecording(
        name=file.parent.name,
        robot=requested.robot.applied_to(
            PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), tuple(places))
        ),
        images=images_named(names, file.parent, requested.images),
        mount=None if static is None else "eye-to-hand" if static else "eye-in-hand",
        target=target,
        lens=lens,
        views=views if len(set(views)) == len(places) else (),
        notes=tuple(notes),
    )


def _pose_numbers(value: object, where: str) -> list[float]:
    """Reads x, y, z, qx, qy, qz, qw [m]."""
    content = mapping(value, where)
    return [number(content.get(name), f"{where}: {name}") for name in _POSE]


def _target(document: Mapping[str, Any], notes: list[str]) -> dict[str, Any] | None:
    finder = document.get("target_finder")
    if not isinstance(finder, Mapping):
        return None
    kind = str(finder.get("type", ""))
    if "Charuco" not in kind:
        notes.append(f"The target finder {kind[:60]!r} has no twin here; name the target.")
        return None
    where, dictionary = "target_finder", finder.get("dictionary")
    if not isinstance(dictionary, str):
        wanted = _integer(dictionary, f"{where}: dictionary")
        names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
        dictionary = next((name for name in names if getattr(cv2.aruco, name) == wanted), None)
        if dictionary is None:
            raise DataError(
                f"{where}: dictionary is {wanted}, which OpenCV does not have.",
                culprits=[f"{where}: dictionary"],
            )
    return {
        "kind": "charuco",
        "columns": _integer(finder.get("cols"), f"{where}: cols"),
        "rows": _integer(finder.get("rows"), f"{where}: rows"),
        "square_m": number(finder.get("chessboard_dim"), f"{where}: chessboard_dim"),
        "marker_m": number(finder.get("aruco_marker_dim"), f"{where}: aruco_marker_dim"),
        "dictionary": dictionary,
        "legacy": False,
    }


def _integer(value: object, where: str) -> int:
    parsed = number(value, where)
    if parsed % 1:
        raise DataError(f"{where} is {parsed}; a whole number is needed.", culprits=[where])
    return int(parsed)


def _read_kinematics(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads kinematic measurements: cam_from_target with the joints of either chain."""
    file = _required(_kinematic_file(path), path, "a file with camera_joints and target_joints")
    document = mapping(read_yaml(file), str(file))
    poses = []
    joints: dict[str, list[FloatArray]] = {"camera_joints": [], "target_joints": []}
    for name, row in document.items():
        entry = mapping(row, f"{file}: {name}")
        poses.append(_pose_numbers(entry.get("pose"), f"{file}: {name}: pose"))
        for chain, values in joints.items():
            values.append(as_numbers(entry.get(chain, []), f"{file}: {name}: {chain}").reshape(-1))
    moving = [name for name, values in joints.items() if any(len(row) for row in values)]
    counts = {len(row) for name in moving for row in joints[name]}
    if len(moving) != 1 or len(counts) != 1:
        raise DataError(
            f"{file}: {' and '.join(moving) or 'no chain'} with {sorted(counts)} joints; one chain "
            "with the same joints in every row is needed.",
            culprits=[str(file)],
        )
    numbers = np.array(poses)
    places = tuple(f"{file.name}: {name}" for name in document)
    camera = PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(), places)
    return ForeignRecording(
        name=file.stem,
        robot=PoseNumbers.empty(places),
        camera=requested.camera.applied_to(camera),
        joints_rad=np.array(joints[moving[0]]),
        mount="eye-to-hand" if moving == ["target_joints"] else "eye-in-hand",
        columns={"source_row": tuple(str(name) for name in document)},
    )


def _required(path: Path | None, source: Path, needed: str) -> Path:
    if path is None:
        raise DataError(f"{source} has not {needed}.", culprits=[str(source)])
    return path


HAND_EYE = ForeignFormat(
    "industrial-calibration",
    "ROS-Industrial's cal_data.yaml with poses and images",
    lambda path: _hand_eye_file(path) is not None,
    _read_hand_eye,
)
KINEMATICS = ForeignFormat(
    "industrial-kinematics",
    "ROS-Industrial's kinematic measurements",
    lambda path: _kinematic_file(path) is not None,
    _read_kinematics,
)
