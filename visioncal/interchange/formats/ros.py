"""Samples of ROS's easy_handeye2 and of MoveIt."""

from pathlib import Path

import numpy as np

from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.documents import mapping, number, read_json
from visioncal.core.documents.structured import read_yaml
from visioncal.core.errors import DataError
from visioncal.interchange.formats.file_search import head
from visioncal.interchange.formats.foreign import ForeignFormat, ForeignRecording, ImportOptions
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
