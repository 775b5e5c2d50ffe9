"""A transform for ROS, and lenses and 4x4 matrices as Kalibr, OpenCV, Zivid and others store them.

A robot's ROS description calls the controller's own base frame `base`, and the frame of poses that
the controller reports without a tool `tool0` (ROS-Industrial, draft REP 199; Universal Robots,
ur_description, doc/robot_frames.rst). Its `base_link` and `flange` may be rotated against those: a
UR's `base_link` by 180 degrees about z. Our camera frame, z forward and x right, is REP 103's
optical frame.
"""

import json
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np

from visioncal.core.conventions import POSE_FORMS, write_pose
from visioncal.core.errors import DataError
from visioncal.core.files import one_line
from visioncal.core.number_format import known_name
from visioncal.core.types import FloatArray
from visioncal.core.verdict import AGAIN
from visioncal.interchange.exports.content import (
    LENS_FORMAT,
    Content,
    ExportFormat,
    camera_of,
    comments,
    lens_notes,
    numbers,
    rows,
    warn_of_field,
    xml_comments,
    yaml_text,
)
from visioncal.vision.camera import matrix_3x3

# By number of coefficients: OpenCV's five, eight, and the fisheye's four.
_ROS_MODELS = {5: "plumb_bob", 8: "rational_polynomial", 4: "equidistant"}


def _array(matrix: FloatArray) -> dict[str, int | list[float]]:
    return {"rows": matrix.shape[0], "cols": matrix.shape[1], "data": numbers(matrix)}


def _write_camera_info(content: Content) -> str:
    """Writes a camera_info file (image_common, camera_calibration_parsers/src/parse_yml.cpp)."""
    # Models by sensor_msgs/distortion_models.hpp. A single camera is not rectified: R is the
    # identity, and P repeats the camera matrix.
    camera = camera_of(content)
    matrix = matrix_3x3(camera)
    document = {
        "image_width": camera.resolution[0],
        "image_height": camera.resolution[1],
        "camera_name": content.child,
        "camera_matrix": _array(matrix),
        "distortion_model": _ROS_MODELS[len(camera.distortion)],
        "distortion_coefficients": _array(camera.distortion[None]),
        "rectification_matrix": _array(np.eye(3)),
        "projection_matrix": _array(np.hstack([matrix, np.zeros((3, 1))])),
    }
    return comments("#", lens_notes(content)) + yaml_text(document, short_lists=True)


def _write_kalibr(content: Content) -> str:
    """Writes a camchain.yaml (Kalibr's wiki, "Yaml formats") of one camera."""
    # Without `T_cam_imu`, from an inertial sensor to the camera: none was calibrated.
    camera = camera_of(content)
    coefficients = numbers(camera.distortion)
    if camera.model == "brown":
        beyond = [coefficient for coefficient in coefficients[4:] if coefficient != 0.0]
        if beyond:
            raise DataError(
                "Kalibr's radtan has the coefficients k1, k2, p1 and p2, but this lens has "
                f"{len(beyond)} more that are not zero: "
                f"{', '.join(f'{value:.3g}' for value in beyond)}.",
                culprits=["camera.distortion"],
                next_step="Leaving them out would bend the image: --lens radtan writes the nearest "
                f"lens without, and says how far it departs. Run: {AGAIN} --lens radtan",
            )
        coefficients = coefficients[:4]
    document = {
        "cam0": {
            "camera_model": "pinhole",
            "intrinsics": numbers(camera.matrix),
            "distortion_model": "radtan" if camera.model == "brown" else "equidistant",
            "distortion_coeffs": coefficients,
            "resolution": list(camera.resolution),
            "rostopic": f"/{content.child}/image_raw",
        }
    }
    return comments("#", lens_notes(content)) + yaml_text(document, short_lists=True)


def _write_text(content: Content) -> str:
    lines = [" ".join(map(repr, row)) for row in rows(content.matrix)]
    notes = comments("#", content.notes)
    return notes + "\n".join(lines) + "\n"


def _write_opencv(content: Content) -> str:
    """Writes OpenCV's FileStorage, by OpenCV itself."""
    # The lens has the names of OpenCV's own calibration (samples/cpp/calibration.cpp).
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for line in filter(None, (*content.notes, content.field_error_words)):
        storage.writeComment(one_line(line), append=False)
    storage.write("parent", content.parent)
    storage.write("child", content.child)
    storage.write("transform", content.matrix)
    storage.write("R", content.matrix[:3, :3].copy())
    storage.write("t", content.matrix[:3, 3:].copy())
    if (camera := content.camera) is not None:
        storage.write("image_width", camera.resolution[0])
        storage.write("image_height", camera.resolution[1])
        storage.write("distortion_model", camera.model)
        storage.write("camera_matrix", matrix_3x3(camera))
        storage.write("distortion_coefficients", camera.distortion.reshape(1, -1).copy())
    return storage.releaseAndGetString()


def _write_zivid(content: Content) -> str:
    """Writes the file that Matrix4x4 of Zivid's SDK loads, in millimetres."""
    # Fields as in zivid-python, Matrix4x4.save, and zivid-python-samples, save_load_matrix.py.
    # Without a comment, as the SDK's own parser is not public.
    matrix_mm: FloatArray = content.matrix.copy()
    matrix_mm[:3, 3] *= 1e3
    version = yaml_text({"__version__": {"serializer": 1, "data": 1}})
    return version + yaml_text({"FloatMatrix": {"Data": rows(matrix_mm)}}, short_lists=True)


def _write_oak(content: Content) -> str:
    """Writes the lens into an OAK's own calibration; raises DataError without it."""
    # depthai, EepromData: one matrix a camera at one size of its sensor, from which those of other
    # sizes follow by scaling to cover and cropping about the middle; 14 coefficients.
    camera, names = camera_of(content), [f"CAM_{letter}" for letter in "ABCDEFGHIJ"]
    socket = known_name("camera of an OAK", content.child, names, next_step="Name it with --child.")
    step = "Save it with CalibrationHandler.eepromToJsonFile, and name that file with --onto."
    try:
        document = json.loads(content.onto or "")
        entry = dict(document["cameraData"])[names.index(socket)]
        size = (int(entry["width"]), int(entry["height"]))
    except (ValueError, KeyError, TypeError) as error:
        why = "is needed, of which all else is kept" if content.onto is None else "is none of it"
        raise DataError(
            f"oak: the device's own calibration with {socket} {why}.",
            culprits=["--onto"],
            next_step=step,
        ) from error
    (width, height), (wide, high) = camera.resolution, size if min(size) > 0 else camera.resolution
    if wide / high > 1.5 > width / height:
        raise DataError(
            f"oak: the device's own calibration is of {wide} x {high} pixels, and this lens of "
            f"{width} x {height}, which depthai takes for another part of the sensor.",
            culprits=["--onto"],
            next_step="Calibrate with pictures of the proportions of the device's calibration.",
        )
    scale, matrix = max(width / wide, height / high), matrix_3x3(camera)
    matrix[:2, 2] += 0.5 * np.array([wide * scale - width, high * scale - height])
    matrix[:2] /= scale
    padded = np.pad(camera.distortion, (0, 14 - len(camera.distortion)))
    entry |= {"intrinsicMatrix": rows(matrix), "distortionCoeff": numbers(padded)}
    entry |= {"width": wide, "height": high, "cameraType": int(camera.model == "fisheye")}
    return json.dumps(document, indent=1) + "\n"


FILES = (
    LENS_FORMAT("camera-info", "the lens as ROS's camera_info YAML [px]", _write_camera_info),
    LENS_FORMAT(
        "oak",
        "the lens in an OAK's own calibration, --onto FILE; --child names the socket [px]",
        _write_oak,
        takes=frozenset({"lens", "onto"}),
        frames={"cam": "CAM_A"},
    ),
    LENS_FORMAT("kalibr", "the lens as Kalibr's camchain.yaml [px]", _write_kalibr),
    ExportFormat(
        "opencv",
        "OpenCV's FileStorage: transform, R, t and any lens [m]",
        _write_opencv,
        takes=frozenset({"lens"}),
        warn=warn_of_field,
    ),
    ExportFormat(
        "zivid", "a Matrix4x4 of Zivid's SDK as YAML [mm]", _write_zivid, has_comments=False
    ),
    ExportFormat(
        "text",
        "the 4x4 matrix as text, as numpy.loadtxt reads it [m]",
        _write_text,
        write_all=lambda contents: "".join(map(_write_text, contents)),
    ),
)


ROS_FRAMES: Mapping[str, str] = {
    "base": "base",
    "flange": "tool0",
    "cam": "camera_optical_frame",
    "depth": "camera_depth_optical_frame",
}
_MEANINGS: Mapping[str, str] = {
    "base": "the controller's own base frame; base_link may differ (on a UR it is turned by "
    "180 deg about z)",
    "flange": "the frame of the session's robot poses, which is the robot's tool0 where they were "
    "reported without a tool",
    "cam": "the camera's optical frame: z forward, x right, y down",
    "depth": "the depth camera's optical frame, which its clouds are in",
    "target": "the frame of the printed target",
    "tool": "the tool's frame: its origin is the tool's centre point",
    "fixture": "the fixture's own frame",
}
_NUMBERS = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")


def _write_urdf_all(contents: Sequence[Content]) -> str:
    """Writes a document for `xacro:include`, with the children's links and the joints.

    `rpy` rotates about the parent's fixed axes, x first, then y, then z: the rotation is Rz(yaw)
    Ry(pitch) Rx(roll) (ROS wiki, urdf/XML/joint; urdfdom, Rotation::setFromRPY).
    """
    # A cell's root is only a parent, and no robot's description has a link for it.
    roots = {content.parent for content in contents if content.frames[0] == "cell"}
    links = "".join(f'  <link name="{root}"/>\n' for root in sorted(roots))
    joints = "".join(map(_urdf_joint, contents))
    return f'<?xml version="1.0"?>\n<robot name="visioncal">\n{links}{joints}</robot>\n'


def _urdf_joint(content: Content) -> str:
    pose = [repr(number) for number in numbers(write_pose(content.matrix, POSE_FORMS["rpy"]))]
    joint = f"{content.parent}-{content.child}".replace("/", "_")
    return (
        f"{xml_comments('  ', _ros_notes(content))}"
        f'  <link name="{content.child}"/>\n'
        f'  <joint name="{joint}" type="fixed">\n'
        f'    <parent link="{content.parent}"/>\n'
        f'    <child link="{content.child}"/>\n'
        f'    <origin xyz="{" ".join(pose[:3])}" rpy="{" ".join(pose[3:])}"/>\n'
        "  </joint>\n"
    )


def _write_launch(contents: Sequence[Content]) -> str:
    """Writes a launch file (tf2_ros, static_transform_publisher's named options)."""
    if len(contents) == 1:
        what = f"where {contents[0].child} is in {contents[0].parent}"
        notes = _ros_notes(contents[0])
    else:
        what = "where all frames of a cell are"
        notes = [contents[0].origin, *(note for one in contents for note in one.notes[1:])]
    nodes = ""
    for content in contents:
        pose = numbers(write_pose(content.matrix, POSE_FORMS["ros"]))
        options = {"--frame-id": content.parent, "--child-frame-id": content.child} | {
            option: repr(number) for option, number in zip(_NUMBERS, pose, strict=True)
        }
        # Frame names are letters, digits and _ / - . only, so that quotes are safe.
        arguments = "".join(
            f'                "{option}",\n                "{value}",\n'
            for option, value in options.items()
        )
        nodes += (
            "        Node(\n"
            '            package="tf2_ros",\n'
            '            executable="static_transform_publisher",\n'
            '            output="log",\n'
            f"            arguments=[\n{arguments}            ],\n"
            "        ),\n"
        )
    return (
        f'"""Publishes {what}."""\n\n{comments("#", notes)}'
        "from launch import LaunchDescription\n"
        "from launch_ros.actions import Node\n"
        "\n\n"
        "def generate_launch_description() -> LaunchDescription:\n"
        f"    nodes = [\n{nodes}    ]\n"
        "    return LaunchDescription(nodes)\n"
    )


def _message(content: Content) -> dict[str, dict[str, float]]:
    """Builds the fields of geometry_msgs/msg/Transform: metres, and a quaternion x, y, z, w."""
    x, y, z, qx, qy, qz, qw = numbers(write_pose(content.matrix, POSE_FORMS["ros"]))
    return {
        "translation": {"x": x, "y": y, "z": z},
        "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
    }


def _write_transform(content: Content) -> str:
    """Writes the fields of geometry_msgs/msg/TransformStamped (ROS 2, common_interfaces)."""
    document = {
        "header": {"frame_id": content.parent},
        "child_frame_id": content.child,
        "transform": _message(content),
    }
    return comments("#", _ros_notes(content)) + yaml_text(document)


def _write_easy_handeye(version: int, content: Content) -> str:
    """Writes what easy_handeye of ROS 1, or easy_handeye2, keeps in its calibrations' folder."""
    # The fields are those that `to_dict` of the former's handeye_calibration.py writes, and those
    # of the latter's message HandeyeCalibration (easy_handeye2_msgs, msg/), as their publishers
    # read them: the pose of `tracking_base_frame` in the effector's frame, or in the base's for a
    # fixed camera.
    in_hand = content.mount == "eye-in-hand"
    frames = {
        "robot_base_frame": ROS_FRAMES["base"] if in_hand else content.parent,
        "robot_effector_frame": content.parent if in_hand else ROS_FRAMES["flange"],
        "tracking_base_frame": content.child,
        "tracking_marker_frame": "target",
    }
    message = _message(content)
    if version == 1:
        names = {"namespace": "/visioncal/", "eye_on_hand": in_hand, **frames}
        flat = message["translation"] | {f"q{k}": v for k, v in message["rotation"].items()}
        transformation: dict[str, Any] = {"transformation": flat}
        file = "~/.ros/easy_handeye/visioncal.yaml"
    else:
        kind = "eye_in_hand" if in_hand else "eye_on_base"
        names = {"name": "visioncal", "calibration_type": kind, **frames}
        names["freehand_robot_movement"] = True
        transformation = {"transform": message}
        file = "~/.ros2/easy_handeye2/calibrations/visioncal.calib"
    group = {"move_group_namespace": "/", "move_group": "manipulator"}
    notes = comments("#", [*_ros_notes(content), f"its publisher finds it as {file}"])
    return notes + yaml_text({"parameters": {**names, **group}, **transformation})


def _ros_notes(content: Content) -> list[str]:
    """Says in lines for a comment what the transform is, its quality, and what its frames are."""
    names = zip((content.parent, content.child), content.frames, strict=True)
    meanings = [f"{name}: {_MEANINGS[frame]}" for name, frame in names if frame in _MEANINGS]
    return [*content.notes, *meanings]


_ROS_FORMAT = partial(ExportFormat, frames=ROS_FRAMES)
ROS_FORMATS = (
    _ROS_FORMAT(
        "ros",
        "YAML with the fields of ROS 2's TransformStamped [m, quaternion x, y, z, w]",
        _write_transform,
        # A document of YAML for each transform.
        write_all=lambda contents: "---\n".join(map(_write_transform, contents)),
    ),
    _ROS_FORMAT(
        "ros-launch",
        "a ROS 2 launch file with a static_transform_publisher [m, quaternion]",
        lambda content: _write_launch([content]),
        write_all=_write_launch,
    ),
    _ROS_FORMAT(
        "moveit",
        "the launch file that MoveIt's hand-eye calibration writes, as ros-launch [m, quaternion]",
        lambda content: _write_launch([content]),
        write_all=_write_launch,
    ),
    _ROS_FORMAT(
        "easy-handeye",
        "a calibration of ROS 1's easy_handeye, YAML [m, quaternion x, y, z, w]",
        partial(_write_easy_handeye, 1),
        holds="hand-eye",
    ),
    _ROS_FORMAT(
        "easy-handeye2",
        "a .calib of easy_handeye2 [m, quaternion x, y, z, w]",
        partial(_write_easy_handeye, 2),
        holds="hand-eye",
    ),
    _ROS_FORMAT(
        "urdf",
        "a link and a fixed joint for a URDF or xacro [m, rad about fixed x, y, z]",
        lambda content: _write_urdf_all([content]),
        write_all=_write_urdf_all,
    ),
)
