"""Intrinsics of resized, cropped or turned images."""

from collections.abc import Mapping
from fractions import Fraction

import numpy as np

from visioncal.calibration.stages.pnp import estimate_poses
from visioncal.core.errors import DataError
from visioncal.core.types import Camera, Corners, FloatArray, Target

# Largest relative difference of the scales of both sides for resized images; others were cropped.
_SAME_SHAPE = 0.02
# Least scale of resized images, the largest denominator of the usual ratios, and the relative
# accuracy of focal lengths by images.
_LEAST_SCALE, _LARGEST_DENOMINATOR, _SAME_SCALE = 1.1, 8, 0.02
# A half turn of images shifts the principal point by more than the first [px], to its prediction
# within the second share of the shift; focal lengths change by less than the third share.
_LEAST_TURN_PX, _SAME_TURN, _SAME_FOCUS = 3.0, 0.15, 0.005


def other_size_step(
    stated: Camera, size: tuple[int, int], corners: Mapping[int, Corners], target: Target
) -> tuple[str, str]:
    """Explains images of another size than stated, by the corners of some of them.

    Returns:
        What happened to the images, empty where unknown; and what to write in [camera].
    """
    step = f"In session.toml, write resolution = [{size[0]}, {size[1]}]"
    scales = size[0] / stated.resolution[0], size[1] / stated.resolution[1]
    if size == stated.resolution[::-1]:
        how, lens = _direction_of_turn(stated, corners, target)
        if not how:
            return "", step
        step += f" and {_written('matrix', lens.matrix, '.2f')}"
        if np.any(stated.distortion[2:4]) and stated.model == "brown":
            step += f" and {_written('distortion', lens.distortion, '.6g')}"
        return (
            f"the images were turned by 90 degrees {how} after the matrix was made",
            f"{step}; the camera's frame turns with them",
        )
    if abs(scales[0] / scales[1] - 1.0) < _SAME_SHAPE:
        matrix = scaled_matrix(stated.matrix, scales[0])
        return "", f"{step} and {_written('matrix', matrix, '.2f')}"
    return "", f"{step}, and delete matrix and distortion: they are of other images"


def _written(key: str, values: FloatArray, form: str) -> str:
    return f"{key} = [{', '.join(format(value, form) for value in values.tolist())}]"


def scaled_matrix(matrix: FloatArray, scale: float) -> FloatArray:
    """Camera matrix fx, fy, cx, cy of resized images; pixel centres are at integers."""
    return np.array([*(scale * matrix[:2]), *(scale * (matrix[2:] + 0.5) - 0.5)])


def other_images(stated: Camera, matrix: FloatArray) -> tuple[str, str]:
    """Explains a stated matrix that is for images of another size, or turned by 180 degrees.

    Args:
        stated: The stated lens, with the size of the images.
        matrix: (4,) estimated fx, fy, cx, cy of these images [px].

    Returns:
        What is wrong, and what to write; both empty where neither explains the difference.
    """
    half_turned = turned_lens(turned_lens(stated, clockwise=True), clockwise=True)
    shift_px = np.linalg.norm(half_turned.matrix[2:] - stated.matrix[2:])
    residual_px = np.linalg.norm(half_turned.matrix[2:] - matrix[2:])
    same_focus = np.abs(matrix[:2] / stated.matrix[:2] - 1.0).max() < _SAME_FOCUS
    if same_focus and shift_px > _LEAST_TURN_PX and residual_px < _SAME_TURN * shift_px:
        entries = _written("matrix", half_turned.matrix, ".2f")
        if np.any(stated.distortion != half_turned.distortion):
            entries += f" and {_written('distortion', half_turned.distortion, '.6g')}"
        return (
            "The images were turned by 180 degrees after the matrix was made: cx and cy are "
            f"{matrix[2]:.1f} and {matrix[3]:.1f} px by these images.",
            f"In session.toml, write {entries}; the camera's frame turns with the images.",
        )
    scale = float(np.sqrt(np.prod(matrix[:2] / stated.matrix[:2])))
    if max(scale, 1.0 / scale) < _LEAST_SCALE:
        return "", ""
    ratio = float(Fraction(scale).limit_denominator(_LARGEST_DENOMINATOR))
    if abs(ratio / scale - 1.0) < _SAME_SCALE:
        scale = ratio
    residuals = np.abs(scaled_matrix(stated.matrix, scale) - matrix)
    limits = [_SAME_SCALE * scale * stated.matrix[0]] * 2 + [_SAME_SHAPE * stated.resolution[0]] * 2
    if np.any(residuals > limits):
        return "", ""
    width, height = stated.resolution
    return (
        f"The stated matrix is for images of {width / scale:.0f} x {height / scale:.0f} px, and "
        f"these are {width} x {height} px: fx is {stated.matrix[0]:.1f} px there, and "
        f"{matrix[0]:.1f} px by these images ({scale:.3g} times as large).",
        f"In session.toml, write {_written('matrix', scaled_matrix(stated.matrix, scale), '.2f')}.",
    )


def turned_lens(camera: Camera, *, clockwise: bool) -> Camera:
    """Lens of images turned by 90 degrees; the camera's frame turns with them."""
    (width, height), (fx, fy, cx, cy) = camera.resolution, camera.matrix
    matrix = [fy, fx, height - 1 - cy, cx] if clockwise else [fy, fx, cy, width - 1 - cx]
    distortion = camera.distortion.copy()
    if camera.model == "brown":
        p1, p2 = distortion[2:4]
        distortion[2:4] = (p2, -p1) if clockwise else (-p2, p1)
    return Camera(camera.model, (height, width), np.array(matrix), distortion)


def _direction_of_turn(
    stated: Camera, corners: Mapping[int, Corners], target: Target
) -> tuple[str, Camera]:
    """Direction in which images were turned, and their lens; empty where the stated matrix fits."""
    upright = Camera(stated.model, stated.resolution[::-1], stated.matrix, stated.distortion)
    lenses = {
        "": upright,
        "clockwise": turned_lens(stated, clockwise=True),
        "counterclockwise": turned_lens(stated, clockwise=False),
    }

    def misfit(direction: tuple[str, Camera]) -> float:
        lens = direction[1]
        if not corners:
            # The principal point is near the centre.
            return float(np.linalg.norm(lens.matrix[2:] - np.array(lens.resolution) / 2))
        try:
            return estimate_poses(corners, [target], lens).sigma_px
        except DataError:
            return np.inf

    return min(lenses.items(), key=misfit)
