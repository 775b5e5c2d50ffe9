"""Whether what poses turn by, that another program measured, can be the robot's doing."""

import numpy as np

from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import figure
from visioncal.core.transforms import cross, invert, log, mean_transform
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Remedy

# Of an arm's errors, and of its noise, the first is about one at most.
_BEYOND_ARM, _LEAST_VIEWS = 2.0, 8


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
