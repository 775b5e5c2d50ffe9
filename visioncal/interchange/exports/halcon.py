"""HALCON's pose files and camera parameters (MVTec, "HALCON Operator Reference").

Its camera frame is ours: z forward, x right, and whole numbers are the centres of pixels.
"""

from functools import lru_cache

import numpy as np

from visioncal.core.conventions import POSE_FORMS, write_pose
from visioncal.core.number_format import figure, rounded_up
from visioncal.core.types import Camera, FloatArray
from visioncal.interchange.exports.content import (
    LENS_FORMAT,
    Content,
    ExportFormat,
    camera_of,
    comments,
    lens_notes,
    numbers,
    warn_of_field,
)
from visioncal.interchange.exports.lenses import seen_rays


def _write_pose(content: Content) -> str:
    """Writes a pose as write_pose does: code 0 of create_pose, `Rp+T`, `gba`, `point`."""
    x, y, z, *angles = numbers(write_pose(content.matrix, POSE_FORMS["staubli"]))
    return (
        f"{comments('#', content.notes)}# 3D POSE PARAMETERS: rotation and translation\n\n"
        "# Used representation type:\nf 0\n\n"
        f"# Rotation angles [deg] or Rodriguez vector:\nr {' '.join(map(repr, angles))}\n\n"
        f"# Translation vector (x y z [m]):\nt {x / 1e3!r} {y / 1e3!r} {z / 1e3!r}\n"
    )


# The file and its warning say what it leaves.
@lru_cache(maxsize=1)
def _polynomial(camera: Camera) -> tuple[FloatArray, float]:
    """Coefficients of `area_scan_polynomial`, and what they leave of the lens at most [px].

    The model turns distorted places u, v of the image plane [m] into undistorted ones
    (calibrate_cameras): u + u (K1 r^2 + K2 r^4 + K3 r^6) + P1 (r^2 + 2 u^2) + 2 P2 u v, and v
    likewise, linear in the coefficients: they are those nearest to the lens's own inverse.

    Returns:
        (5,) coefficients in units of the focal length, and the largest distance [px].

    Raises:
        DataError: The lens sees rays that no plane image holds.
    """
    px, rays = seen_rays(camera, "HALCON's polynomial model")
    focal_px, centre = camera.matrix[:2], camera.matrix[2:]
    # In focal lengths, so that columns are of one order.
    u, v = x = ((px - centre) / focal_px).T
    r2 = u * u + v * v
    radial = x[:, None] * np.array([r2, r2**2, r2**3])
    columns = [[r2 + 2 * u * u, 2 * u * v], [2 * u * v, r2 + 2 * v * v]]
    by_coefficient = np.concatenate([radial, np.array(columns)], axis=1)
    design = by_coefficient.transpose(0, 2, 1).reshape(-1, 5)
    design *= np.repeat(focal_px, len(px))[:, None]
    wanted = ((rays.T - x) * focal_px[:, None]).ravel()
    found = np.linalg.lstsq(design, wanted, rcond=None)[0]
    return found, rounded_up(float(np.abs(design @ found - wanted).max()))


def _write_camera(content: Content) -> str:
    """Writes the file that read_cam_par reads: group `Camera: Parameter`, polynomial model."""
    camera = camera_of(content)
    fx, fy, cx, cy = camera.matrix.tolist()
    coefficients, left_px = _polynomial(camera)
    # Images determine the ratio of focal length and pixel alone: any width [m] is the same map.
    width = 5e-6
    coefficients = coefficients / (width * fx) ** np.array([2.0, 4.0, 6.0, 1.0, 1.0])
    reals = {"Focus:foc": width * fx}
    reals |= {f"Poly{at}:poly{at}": value for at, value in enumerate(coefficients.tolist(), 1)}
    reals |= {"Sx:sx": width, "Sy:sy": width * fx / fy, "Cx:cx": cx, "Cy:cy": cy}
    sides = dict(zip(("ImageWidth:imgw", "ImageHeight:imgh"), camera.resolution, strict=True))
    entries = [f"{name}: {value!r};\n  DOUBLE::;\n" for name, value in reals.items()]
    entries += [f"{name}: {value};\n  INT:1:32767;\n" for name, value in sides.items()]
    notes = [
        *lens_notes(content),
        f"HALCON's polynomial model leaves at most {figure(left_px)} px of this lens",
        f"Focus, Sx and Sy are for pixels {1e6 * width:g} um wide; their ratio is calibrated",
    ]
    head = '# INTERNAL CAMERA PARAMETERS\n\nParGroup: Camera: Parameter;\n  "Parameters";\n\n'
    return comments("#", notes) + head + "\n".join(entries)


def _warn_of_camera(content: Content) -> list[str]:
    left_px = _polynomial(camera_of(content))[1]
    words = f"HALCON's polynomial model departs from this lens by up to {figure(left_px)} px."
    return [*warn_of_field(content), *[words] * (left_px > 0.05)]


HALCON = (
    ExportFormat("halcon", "a pose file of HALCON's read_pose [m, deg, code 0]", _write_pose),
    LENS_FORMAT(
        "halcon-camera",
        "the lens for HALCON's read_cam_par: area_scan_polynomial [m, px]",
        _write_camera,
        warn=_warn_of_camera,
    ),
)
