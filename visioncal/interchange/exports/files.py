"""Lenses and 4x4 matrices as other programs store them: ROS, Kalibr, OpenCV, Zivid, plain text."""

from collections.abc import Iterator

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import one_line
from visioncal.core.types import Camera, FloatArray
from visioncal.interchange.exports.content import (
    Content,
    ExportFormat,
    comments,
    numbers,
    rows,
    yaml_text,
)
from visioncal.vision.camera import matrix_3x3

# By number of coefficients: OpenCV's five, eight, and the fisheye's four.
_ROS_MODELS = {5: "plumb_bob", 8: "rational_polynomial", 4: "equidistant"}


def _camera_of(content: Content) -> Camera:
    """The camera with its field refitted into its coefficients, by one of `_ROS_MODELS`."""
    if content.refitted_lens is None:
        raise DataError(
            "This calibration has no camera: its session brought measured poses of the target, "
            "and no images.",
            next_step="Export its transform, as with --to ros.",
        )
    camera = content.refitted_lens.camera
    if len(camera.distortion) not in _ROS_MODELS:
        raise DataError(
            f"The lens has {len(camera.distortion)} coefficients; 4 (fisheye), 5 or 8 (brown) are "
            "needed.",
            culprits=["camera.distortion"],
        )
    return camera


def _lens_notes(content: Content) -> list[str]:
    estimated = content.lens is not None and content.lens.estimated
    how = "estimated from the session's images" if estimated else "as the session gave it"
    field_notes = [content.field_error_words] if content.field_error_words else []
    return [content.origin, f"verdict {content.verdict.status}; the lens is {how}", *field_notes]


def _warn_of_field(content: Content) -> Iterator[str]:
    """Warns of the remaining error of a lens with a field."""
    if content.field_error_words:
        yield f"{content.field_error_words}."


def _array(matrix: FloatArray) -> dict[str, int | list[float]]:
    return {"rows": matrix.shape[0], "cols": matrix.shape[1], "data": numbers(matrix)}


def _write_camera_info(content: Content) -> str:
    """Writes a camera_info file (image_common, camera_calibration_parsers/src/parse_yml.cpp)."""
    # Models by sensor_msgs/distortion_models.hpp. A single camera is not rectified: R is the
    # identity, and P repeats the camera matrix.
    camera = _camera_of(content)
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
    return comments("#", _lens_notes(content)) + yaml_text(document, short_lists=True)


def _write_kalibr(content: Content) -> str:
    """Writes a camchain.yaml (Kalibr's wiki, "Yaml formats") of one camera."""
    # Without `T_cam_imu`, from an inertial sensor to the camera: none was calibrated.
    camera = _camera_of(content)
    coefficients = numbers(camera.distortion)
    if camera.model == "brown":
        beyond = [coefficient for coefficient in coefficients[4:] if coefficient != 0.0]
        if beyond:
            raise DataError(
                "Kalibr's radtan has the coefficients k1, k2, p1 and p2, but this lens has "
                f"{len(beyond)} more that are not zero: "
                f"{', '.join(f'{value:.3g}' for value in beyond)}.",
                culprits=["camera.distortion"],
                next_step="Leaving them out would bend the image: export with --to camera-info or "
                "opencv.",
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
    return comments("#", _lens_notes(content)) + yaml_text(document, short_lists=True)


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
    if content.refitted_lens is not None:
        camera = content.refitted_lens.camera
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


FILES = (
    ExportFormat(
        "camera-info",
        "the lens as ROS's camera_info YAML [px]",
        _write_camera_info,
        holds="lens",
        frames={"cam": "camera"},
        warn=_warn_of_field,
    ),
    ExportFormat(
        "kalibr",
        "the lens as Kalibr's camchain.yaml [px]",
        _write_kalibr,
        holds="lens",
        frames={"cam": "camera"},
        warn=_warn_of_field,
    ),
    ExportFormat(
        "opencv",
        "OpenCV's FileStorage: transform, R, t and any lens [m]",
        _write_opencv,
        warn=_warn_of_field,
        carries_lens=True,
    ),
    ExportFormat("zivid", "a Matrix4x4 of Zivid's SDK as YAML [mm]", _write_zivid),
    ExportFormat(
        "text",
        "the 4x4 matrix as text, as numpy.loadtxt reads it [m]",
        _write_text,
        write_all=lambda contents: "".join(map(_write_text, contents)),
    ),
)
