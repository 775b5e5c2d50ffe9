"""Lens formats: ROS's camera_info and Kalibr's camera chain."""

from collections.abc import Iterator

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import Camera, FloatArray
from visioncal.interchange.exports.content import (
    Content,
    ExportFormat,
    comments,
    numbers,
    yaml_text,
)
from visioncal.vision.camera import matrix_3x3

# By number of coefficients: OpenCV's five, eight, and the fisheye's four.
_ROS_MODELS = {5: "plumb_bob", 8: "rational_polynomial", 4: "equidistant"}


def camera_of(content: Content) -> Camera:
    """The camera with its field refitted into its coefficients; its lens is one of `_ROS_MODELS`.

    Raises:
        DataError: There is none, or it has another number of coefficients.
    """
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


def _notes(content: Content) -> list[str]:
    estimated = content.lens is not None and content.lens.estimated
    how = "estimated from the session's images" if estimated else "as the session gave it"
    field_notes = [content.field_error_words] if content.field_error_words else []
    return [content.origin, f"verdict {content.verdict.status}; the lens is {how}", *field_notes]


def warn_of_field(content: Content) -> Iterator[str]:
    """Warns of the remaining error of a lens with a field."""
    if content.field_error_words:
        yield f"{content.field_error_words}."


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
    return comments("#", _notes(content)) + yaml_text(document, short_lists=True)


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
    return comments("#", _notes(content)) + yaml_text(document, short_lists=True)


LENSES = tuple(
    ExportFormat(name, words, write, holds="lens", frames={"cam": "camera"}, warn=warn_of_field)
    for name, words, write in (
        ("camera-info", "the lens as ROS's camera_info YAML [px]", _write_camera_info),
        ("kalibr", "the lens as Kalibr's camchain.yaml [px]", _write_kalibr),
    )
)
