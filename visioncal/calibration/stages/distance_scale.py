"""Whether the distances and turns of poses that another program measured can be the robot's."""

import numpy as np

from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import figure
from visioncal.core.transforms import cross, invert, log, mean_transform
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Remedy

# Errors of an arm's lengths are smaller, or leave as much unexplained; none are as large as the
# last share.
_LEAST, _SURE, _EXPLAINED, _NO_ARM = 2e-3, 5.0, 0.1, 0.02

# Of an arm's errors, and of its noise, the first is about one at most.
_BEYOND_ARM, _LEAST_VIEWS = 2.0, 8


def distance_scale(
    parent_from_flange: FloatArray, cam_from_target: FloatArray, flange_from_seer: FloatArray
) -> Finding | None:
    """Says by how much measured distances are too long or too short, where that is clear.

    parent_from_flange * flange_from_seer * cam_from_target is the same for all views; its position
    is linear in the scale of the measured distances, and in both unknown positions.

    Args:
        parent_from_flange: (m, 4, 4) the robot's poses; their inverses for a camera that stands
            still.
        cam_from_target: (m, 4, 4) as measured.
        flange_from_seer: (4, 4) the camera's transform, of which the rotation is taken.

    Returns:
        What to say; None where the scale is one, or a small departure from it leaves more than a
        tenth of the scatter.
    """
    count = len(cam_from_target)
    if 3 * count < 14:
        return None
    turned = parent_from_flange[:, :3, :3]
    seen = (turned @ flange_from_seer[:3, :3] @ cam_from_target[:, :3, 3:])[..., 0]
    same = np.broadcast_to(-np.eye(3), (count, 3, 3))
    a = np.concatenate([turned, same, seen[..., None]], axis=2).reshape(3 * count, 7)
    b = -parent_from_flange[:, :3, 3].reshape(-1)
    found, *_ = np.linalg.lstsq(a, b)
    left = float(np.sum((b - a @ found) ** 2))
    stated, *_ = np.linalg.lstsq(a[:, :6], b - a[:, 6])
    left_stated = float(np.sum((b - a[:, 6] - a[:, :6] @ stated) ** 2))
    share = float(found[6]) - 1.0
    variance = left / (3 * count - 7) * np.linalg.pinv(a.T @ a)[6, 6]
    if abs(share) < max(_LEAST, _SURE * variance**0.5):
        return None
    if abs(share) < _NO_ARM and left > _EXPLAINED * left_stated:
        return None
    short, size = ("short", "larger") if share > 0.0 else ("long", "smaller")
    percent = f"{figure(100 * abs(share))} % (sigma {figure(100 * variance**0.5)} %)"
    return Finding(
        "board_size",
        f"By the robot's motion the distances in the measured poses (cft_) are too {short} by "
        f"{percent}: the board is {size} by that than the program was told that measured them.",
        Remedy(
            "Measure the board with a caliper, and measure the poses again with its true size; or "
            f"multiply cft_x_m, cft_y_m and cft_z_m by {1.0 + share:.5g}."
        ),
        mahalanobis_sq=share**2 / variance if variance > 0.0 else np.inf,
    )


def measured_turns(
    parent_from_flange: FloatArray, flange_from_target: FloatArray
) -> Finding | None:
    """Says that measured rotations scatter, where that of positions rules the robot out.

    What turns the flange moves the target, unless it turns about an axis through it.

    Args:
        parent_from_flange: (m, 4, 4) the robot's poses; the (4, 4) identity where it carries the
            target.
        flange_from_target: (m, 4, 4) as measured.

    Returns:
        What to say; None where the robot can be the cause, or rotations agree well enough.
    """
    if len(flange_from_target) < _LEAST_VIEWS:
        return None
    placed = parent_from_flange @ flange_from_target
    off = log(invert(mean_transform(placed)) @ placed)
    turned = (flange_from_target[:, :3, :3] @ off[:, :3, None])[..., 0]
    moved = cross(turned, flange_from_target[:, :3, 3])
    rad, would_m, is_m = (
        float(np.median(np.linalg.norm(array, axis=1))) for array in (turned, moved, off[:, 3:])
    )
    deg = float(np.rad2deg(rad))
    if deg < CalibrationLimits.scatter_deg[0] or would_m < _BEYOND_ARM * is_m:
        return None
    return Finding(
        "measured_turns",
        f"A typical view has the target turned by {figure(deg)} deg and shifted by "
        f"{figure(1e3 * is_m)} mm against the others. A flange that is off by this turn would "
        f"shift it by {figure(1e3 * would_m)} mm: the measured rotations (cft_) are what scatters, "
        "as those of a single small marker do.",
        Remedy(
            "Give visioncal the images; or measure the poses again, of a board of many corners "
            "that fills much of the image, with a calibrated lens."
        ),
        until_mm=0.0,
    )
