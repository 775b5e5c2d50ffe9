"""Factory calibration stored in an OAK.

Depthai's CalibrationHandler uses single precision, and one matrix per camera at one size of the
sensor, from which others follow by scaling to cover and cropping about the middle; distortion is
OpenCV's 14 coefficients, or the fisheye's 4.
"""

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.types import Camera, FloatArray
from visioncal.live.drivers.extras import Handle, depthai


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
    board_socket = getattr(dai.CameraBoardSocket, socket)
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
