"""Boards, cameras and sweeps of simulated cells, with their errors."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import Camera, Target
from visioncal.simulation.optics import inaccurate_camera, wide_camera

_APRILTAGS = "DICT_APRILTAG_36h11"


def _tags() -> Target:
    """Seven tags of 40 to 60 mm on a plate, with measured corners."""
    tags = (
        *((3, 0.000, 0.000, 0.050), (17, 0.085, 0.010, 0.040), (42, 0.160, 0.000, 0.060)),
        *((5, 0.010, 0.075, 0.040), (101, 0.140, 0.085, 0.050), (64, 0.075, 0.070, 0.045)),
        (9, 0.205, 0.090, 0.040),
    )
    points = [
        (x + dx * side, y + dy * side, 0.0)
        for _, x, y, side in tags
        for dx, dy in ((0, 0), (1, 0), (1, 1), (0, 1))
    ]
    return Target(
        name="tags",
        kind="points",
        columns=len(points),
        rows=1,
        square_m=0.245,
        square_sigma_m=0.0,
        dictionary=_APRILTAGS,
        points_m=tuple(points),
        point_numbers=tuple(range(len(points))),
        point_tags=tuple((tag[0], corner) for tag in tags for corner in range(4)),
    )


# Boards with square sides and their sigmas [m]: a ChArUco board, a checkerboard whose colours
# determine corner 0, an AprilGrid as on Kalibr's pages, circles of 14 mm in shifted rows, and a
# symmetric grid of circles of 15 mm.
_CHARUCO = Target(
    "charuco_9x6_30mm", "charuco", 9, 6, 0.030, 3e-5, marker_m=0.022, dictionary="DICT_5X5_100"
)
_CHECKERBOARD = Target("checkerboard_9x6_25mm", "checkerboard", 9, 6, 0.025, 2.5e-5)
_APRILGRID = Target(
    name="aprilgrid_6x4_32mm",
    kind="aprilgrid",
    columns=6,
    rows=4,
    square_m=0.032,
    square_sigma_m=3.2e-5,
    dictionary=_APRILTAGS,
    marker_id=0,
    spacing=0.3,
    border=2,
)
_CIRCLES = Target(
    "circles_5x9_20mm_asymmetric", "circles", 5, 9, 0.020, 2e-5, diameter_m=0.014, asymmetric=True
)
_SYMMETRIC = Target("circles_8x6_30mm", "circles", 8, 6, 0.030, 3e-5, diameter_m=0.015)
BOARDS: Mapping[str, Target] = {
    "charuco": _CHARUCO,
    "checkerboard": _CHECKERBOARD,
    "aprilgrid": _APRILGRID,
    "circles": _CIRCLES,
    "symmetric-circles": _SYMMETRIC,
    "tags": _tags(),
}
TARGETS: Mapping[str, Target] = {board.name: board for board in BOARDS.values()}


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraOptions:
    """A camera with its stated intrinsics and the quality of its images."""

    camera: Camera = field(default_factory=wide_camera)  # True optics.
    state_intrinsics: bool = True  # Whether the session states the intrinsics.
    # Error of the stated intrinsics, as root mean square over the image [px].
    lens_mismatch_px: float = 0.0
    blur_px: float = 0.7  # Defocus of rendered images, as a Gaussian's sigma [px].
    image_noise: float = 2.0  # Noise of rendered images [grey levels].
    vignetting: float = 0.2  # Relative loss of light in the image's corners.
    jpeg_quality: int | None = None  # 1 to 100; None writes lossless PNG.

    def stated(self, rng: np.random.Generator) -> Camera:
        """The intrinsics as the session states them."""
        return inaccurate_camera(self.camera, self.lens_mismatch_px, rng)


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """Timing and noise of a sweep."""

    stops: int = 12  # Number of postures on its path.
    pace_s: float = 1.7  # Time between postures [s].
    robot_hz: float = 125.0  # Samples of the controller per second.
    frames_hz: float = 30.0  # Frames of the camera per second.
    # Time from an image's first row to its last, with the stamp at the middle [s]; 0 for a global
    # shutter.
    readout_s: float = 0.0
    # Offset of the camera's clock relative to the controller's [s].
    camera_minus_robot_s: float = 0.0
    jitter_s: float = 0.0  # Standard deviation of the camera's stamps [s].
    encoder_sigma_rad: float = 2e-6  # Noise of the reported joint angles [rad].

    def __post_init__(self) -> None:
        if self.stops < 2 or min(self.pace_s, self.robot_hz, self.frames_hz) <= 0.0:
            raise DataError("simulation: a sweep needs two stops, and times and rates above 0.")
