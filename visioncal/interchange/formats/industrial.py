"""Samples of ROS: industrial_calibration, robot_cal_tools, easy_handeye2 and MoveIt.

Each states what a table of any origin leaves open: the names of its fields, their form and unit.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2

from visioncal.core.codec import wrong_value
from visioncal.core.documents.structured import read_yaml
from visioncal.core.documents.values import mapping
from visioncal.core.errors import DataError
from visioncal.core.types import Mount
from visioncal.interchange.formats.columns import foreign_from
from visioncal.interchange.formats.documents import read_document
from visioncal.interchange.formats.fields import fields_of_records
from visioncal.interchange.formats.file_search import files_in, head, path_inside
from visioncal.interchange.formats.foreign import (
    ForeignFormat,
    ForeignRecording,
    ImportOptions,
    PoseImportOptions,
)
from visioncal.interchange.formats.intrinsics import intrinsics_from
from visioncal.interchange.formats.keys import number_in
from visioncal.interchange.formats.reading import fields_of_document, flattened

_NONE = PoseImportOptions()
# easy_handeye's lists of the robot's poses and of the marker's.
_SAMPLE_LISTS = ("hand_world_samples", "camera_marker_samples")
_EASY_MOUNTS: Mapping[str, Mount] = {"eye_in_hand": "eye-in-hand", "eye_on_base": "eye-to-hand"}


def _quaternions(*names: str, inverse: bool | None = None) -> PoseImportOptions:
    """Positions [m] and quaternions x, y, z, w in some fields."""
    return PoseImportOptions(names, "quaternion-xyzw", "m", inverse)


def _easy_handeye_file(path: Path) -> Path | None:
    """The file of samples: `path` itself, or the only one in a folder."""
    found = []
    for file in files_in(path) or (path,):
        words = head(file) if file.suffix in (".samples", ".yaml", ".yml") else ""
        pair = ("robot:", "tracking:") if "robot:" in words else _SAMPLE_LISTS
        if file.suffix == ".samples" or all(word in words for word in ("samples:", *pair)):
            found.append(file)
    return found[0] if len(found) == 1 else None


def _stated_mount(document: object) -> Mount | None:
    """The mount in the parameters of easy_handeye, whose older ones have `eye_on_hand`."""
    content = document if isinstance(document, Mapping) else {}
    parameters = content.get("parameters")
    stated = {**content, **(parameters if isinstance(parameters, Mapping) else {})}
    if isinstance(stated.get("eye_on_hand"), bool):
        return "eye-in-hand" if stated["eye_on_hand"] else "eye-to-hand"
    return _EASY_MOUNTS.get(str(stated.get("calibration_type")))


def _read_easy_handeye(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads samples: `robot` and `tracking` as geometry_msgs/Transform, in one list or two."""
    file = _easy_handeye_file(path) or path
    document = mapping(read_yaml(file), str(file))
    samples = document.get("samples", document if {*_SAMPLE_LISTS} <= {*document} else None)
    if isinstance(samples, Mapping):
        # As the services of ROS 1 have them, with or without a header.
        robot, camera = (
            each.get("transforms") if isinstance(each, Mapping) else each
            for each in map(samples.get, _SAMPLE_LISTS)
        )
        if not (isinstance(robot, list) and isinstance(camera, list) and len(robot) == len(camera)):
            raise DataError(
                f"{file}: {' and '.join(_SAMPLE_LISTS)} are not two lists of one length.",
                culprits=[str(file)],
            )
        pairs = zip(robot, camera, strict=True)
        samples = [{"robot": first, "tracking": second} for first, second in pairs]
    fields = fields_of_document(samples, file)
    result, notes = file.with_suffix(".calib"), list[str]()
    stated = _stated_mount(document)
    if stated is None and result.is_file():
        stated = _stated_mount(read_yaml(result))
    mount = requested.mount or stated
    if stated not in (None, mount):
        notes.append(f"easy_handeye's own parameters state {stated}; {mount} is taken, as asked.")
    seen = "tracking" if "tracking.translation" in fields.numbers else "optical"
    # With the camera on the base the sampler stores the robot's pose inverted, so that one solver
    # serves both (easy_handeye2, HandeyeSampler).
    requested = requested.with_poses(
        _quaternions("robot.translation", "robot.rotation", inverse=mount == "eye-to-hand"),
        _quaternions(f"{seen}.translation", f"{seen}.rotation"),
    )
    note = (
        "inverted, as easy_handeye2 stores them with the camera on the base"
        if requested.robot.inverse
        else "as they stand, as with the camera in the hand"
    )
    foreign = foreign_from(fields, requested)
    notes += [*foreign.notes, f"The robot's poses are read {note}."]
    return replace(foreign, mount=mount, notes=tuple(notes))


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
    document, names = read_document(path), ("effector_wrt_world", "object_wrt_sensor")
    if isinstance(document, list):
        document = [
            dict(zip(names, sample, strict=False)) if isinstance(sample, list) else sample
            for sample in document
        ]
    robot, camera = (PoseImportOptions((name,), unit="m") for name in names)
    return foreign_from(fields_of_document(document, path), requested.with_poses(robot, camera))


EASY_HANDEYE = ForeignFormat(
    "easy-handeye2",
    "samples of easy_handeye and easy_handeye2",
    lambda path: _easy_handeye_file(path) is not None,
    _read_easy_handeye,
)
MOVEIT = ForeignFormat("moveit", "MoveIt's hand-eye samples", _is_moveit, _read_moveit)


# Other formats have the pose itself under this key.
_NAMED_POSE = re.compile(r"\bpose: *[\"']?[^\n\"'\[{,]+\.ya?ml\b", re.IGNORECASE)
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")


def _hand_eye_file(path: Path) -> Path | None:
    for file in files_in(path) or (path,):
        words = head(file) if file.suffix.lower() in (".yaml", ".yml") else ""
        if "data:" in words and "image:" in words and _NAMED_POSE.search(words):
            return file
    return None


def _kinematic_file(path: Path) -> Path | None:
    return next((at for at in files_in(path) or (path,) if "target_joints:" in head(at)), None)


def _read_hand_eye(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads cal_data.yaml with a pose file and an image in each row."""
    # Poses are of the robot's flange in its base; `static_camera` gives the mount.
    file = _hand_eye_file(path) or path
    document = mapping(read_yaml(file), str(file))
    rows = document.get("data")
    if not isinstance(rows, list) or not rows:
        raise DataError(f"{file}: data holds no rows of pose and image.", culprits=[str(file)])
    records, places = [], []
    for at, row in enumerate(rows):
        entry = mapping(row, f"{file}: data, row {at}")
        name = entry.get("pose")
        if not isinstance(name, str):
            raise DataError(f"{file}: data, row {at} names no pose.", culprits=[str(file)])
        stored = path_inside(file.parent, name)
        image = str(entry.get("image") or "")
        records.append({**flattened(mapping(read_yaml(stored), str(stored))), "image": image})
        places.append(name)
    static = document.get("static_camera")
    if not isinstance(static, bool | None):
        raise wrong_value(static, "true or false", f"{file}: static_camera")
    views = tuple(index for name in places if (index := number_in(name)) is not None)
    views = views if len(set(views)) == len(places) else ()
    fields = fields_of_records(records, places, file.parent.name, file.parent, views)
    requested = replace(requested, image=requested.image or "image")
    foreign = foreign_from(fields, requested.with_poses(_quaternions(*_POSE), _NONE))
    notes = [*foreign.notes]
    # The user's options replace what the source states.
    lens = None
    if "intrinsics" in document and not requested.intrinsics:
        lens, _ = intrinsics_from(document, str(file))
        notes.append(
            "The intrinsics of the source have no distortion; it is taken for zero. "
            "--intrinsics estimate leaves them out."
        )
    target = None if requested.target else _target(document, notes)
    mount: Mount = "eye-to-hand" if static else "eye-in-hand"
    mounted = replace(foreign, mount=None if static is None else mount)
    return replace(mounted, target=target, lens=lens, notes=tuple(notes))


def _target(document: Mapping[str, Any], notes: list[str]) -> dict[str, Any] | None:
    finder = document.get("target_finder")
    if not isinstance(finder, Mapping):
        return None
    kind = str(finder.get("type", ""))
    if "Charuco" not in kind:
        notes.append(f"The target finder {kind[:60]!r} has no twin here; name the target.")
        return None
    dictionary = finder.get("dictionary")
    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
    # Its values are checked where the target is read.
    return {
        "kind": "charuco",
        "columns": finder.get("cols"),
        "rows": finder.get("rows"),
        "square_m": finder.get("chessboard_dim"),
        "marker_m": finder.get("aruco_marker_dim"),
        "dictionary": next((n for n in names if getattr(cv2.aruco, n) == dictionary), dictionary),
        "legacy": False,
    }


def _read_kinematics(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads kinematic measurements: cam_from_target with the joints of one chain."""
    file = _kinematic_file(path) or path
    document = mapping(read_yaml(file), str(file))
    fields = fields_of_document(document, file)
    chains = ("camera_joints", "target_joints")
    moving = [name for name in chains if name in fields.numbers and fields.numbers[name].size]
    if len(moving) != 1:
        raise DataError(
            f"{file}: {' and '.join(moving) or 'no chain'} with joints, but must be one, with "
            "the same joints in every row.",
            culprits=[str(file)],
        )
    requested = replace(requested, joints=requested.joints or tuple(moving))
    camera = _quaternions(*(f"pose.{name}" for name in _POSE))
    return replace(
        foreign_from(fields, requested.with_poses(_NONE, camera)),
        mount="eye-to-hand" if moving == ["target_joints"] else "eye-in-hand",
        columns={"source_row": tuple(map(str, document))},
    )


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
