"""Calibration stored in an OAK: reading the factory's intrinsics, and writing ours.

Depthai's CalibrationHandler uses single precision, lengths in centimetres, and one matrix per
camera at one size of the sensor, from which others follow by scaling to cover and cropping about
the middle; distortion is OpenCV's 14 coefficients, or the fisheye's 4.
"""

import json
from types import ModuleType

import numpy as np

from visioncal.core.errors import DataError, DriverError
from visioncal.core.types import Camera, FloatArray
from visioncal.live.drivers.extras import Handle, depthai
from visioncal.vision.camera import matrix_3x3

SOCKETS = tuple(f"CAM_{letter}" for letter in "ABCDEFGHIJ")
_COEFFICIENTS = 14


def factory_intrinsics(handler: Handle, socket: str, resolution: tuple[int, int]) -> Camera:
    """Reads a camera's intrinsics from a device's calibration.

    Args:
        handler: Its CalibrationHandler.
        socket: The camera, such as `CAM_A`.
        resolution: (width, height) of the pictures, scaled and cropped from the sensor's [px].

    Raises:
        DriverError: It has none of this camera, or its lens model is not supported.
    """
    dai = depthai()
    board_socket = _socket_of(dai, socket)
    try:
        matrix = np.array(handler.getCameraIntrinsics(board_socket, *resolution), dtype=float)
        coefficients = np.array(handler.getDistortionCoefficients(board_socket), dtype=float)
        model = handler.getDistortionModel(board_socket)
    except RuntimeError as error:
        raise DriverError(
            f"The device has no calibration of {socket}: {error}.",
            culprits=[socket],
            next_step="Leave the intrinsics out: they are then estimated from the images.",
        ) from error
    intrinsics = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    if model == dai.CameraModel.Fisheye:
        return Camera("fisheye", resolution, intrinsics, coefficients[:4])
    if model == dai.CameraModel.Perspective:
        return Camera("brown", resolution, intrinsics, _brown(coefficients, socket))
    raise DriverError(
        f"The device's lens {socket} is of the model {model.name}; Perspective or Fisheye is "
        "needed.",
        culprits=[socket],
        next_step="Leave the intrinsics out: they are then estimated from the images.",
    )


def calibration_json(camera: Camera, socket: str, onto: str | None = None) -> str:
    """Writes a camera's intrinsics as the JSON of a device's calibration.

    Args:
        camera: The intrinsics.
        socket: The camera of the device, such as `CAM_A`.
        onto: The device's own JSON, of which all else is kept: the board, the other cameras and
            their extrinsics; None for a calibration of this camera alone.

    Raises:
        DriverError: Depthai is not installed.
        DataError: There is no such socket, or `onto` is no calibration of an OAK.
    """
    dai = depthai()
    board_socket = _socket_of(dai, socket)
    handler = dai.CalibrationHandler() if onto is None else _read(dai, onto)
    size = _sensor_size(handler, board_socket) or camera.resolution
    matrix = _sensor_matrix(camera, size)
    handler.setCameraIntrinsics(board_socket, matrix.tolist(), *size)
    fisheye = camera.model == "fisheye"
    padded = np.pad(camera.distortion, (0, _COEFFICIENTS - len(camera.distortion)))
    handler.setDistortionCoefficients(board_socket, padded.tolist())
    handler.setCameraType(
        board_socket, dai.CameraModel.Fisheye if fisheye else dai.CameraModel.Perspective
    )
    return json.dumps(handler.eepromToJson(), indent=1) + "\n"


def _socket_of(dai: ModuleType, socket: str) -> Handle:
    if socket not in SOCKETS:
        raise DataError(
            f"An OAK has no camera {socket!r}; {SOCKETS[0]} to {SOCKETS[-1]} are the names.",
            culprits=[socket],
        )
    return getattr(dai.CameraBoardSocket, socket)


def _brown(coefficients: FloatArray, socket: str) -> FloatArray:
    """The first 5 or 8 of 14 coefficients, where the others are zero."""
    tail = coefficients[8:]
    if np.any(tail != 0.0):
        raise DriverError(
            f"The device's lens {socket} has thin-prism or tilt coefficients up to "
            f"{np.abs(tail).max():.3g}, which our model has not; zeros are needed.",
            culprits=[socket],
            next_step="Leave the intrinsics out: they are then estimated from the images.",
        )
    rational = np.any(coefficients[5:8] != 0.0)
    return np.pad(coefficients, (0, max(8 - len(coefficients), 0)))[: 8 if rational else 5]


def _read(dai: ModuleType, text: str) -> Handle:
    try:
        content = json.loads(text)
        cameras = content["cameraData"]
        handler = dai.CalibrationHandler.fromJson(content)
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise DataError(
            f"This is no calibration of an OAK: {error}.",
            culprits=["--onto"],
            next_step="Save the device's own with CalibrationHandler.eepromToJsonFile.",
        ) from error
    if not cameras:
        raise DataError("This calibration of an OAK has no cameras.", culprits=["--onto"])
    return handler


def _sensor_size(handler: Handle, board_socket: Handle) -> tuple[int, int] | None:
    """Resolution of the matrix in the device's calibration [px]; None without one."""
    if not handler.hasCameraCalibration(board_socket):
        return None
    _, width, height = handler.getDefaultIntrinsics(board_socket)
    return (int(width), int(height)) if width > 0 and height > 0 else None


def _sensor_matrix(camera: Camera, size: tuple[int, int]) -> FloatArray:
    """Matrix (3, 3) at the sensor's size: the inverse of scaling to cover, and cropping."""
    (width, height), (wide, high) = camera.resolution, size
    scale = max(width / wide, height / high)
    matrix = matrix_3x3(camera)
    matrix[:2, 2] += 0.5 * np.array([wide * scale - width, high * scale - height])
    matrix[:2] /= scale
    return matrix
