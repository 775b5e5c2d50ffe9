"""Alternative conventions for poses under which the touches of a tool close."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.touching import Touches, linear_tip

# Least improvement of a correct convention over a wrong one, and largest rms with it [m].
_MUCH_BETTER, _CLOSED_M = 20.0, 2e-3


@dataclass(frozen=True)
class PoseReading:
    """Alternative convention for the poses, under which the touches close."""

    words: str  # Its name: `with quaternions as w, x, y, z`.
    rms_m: float  # Root mean square distance of the touches with it [m].
    as_read_m: float  # The same as they were read [m].
    # Command options that read columns of the usual names so; empty where none are known.
    options: str = ""


def readings_that_close(touches: Touches) -> tuple[PoseReading, ...]:
    """Finds pose conventions under which the touches close, where as read they do not.

    Touches of one point close in both directions alike, with the tip and the point exchanged; of
    several points, in one only. Those along the tool's axes, all of one point, do in one only, too.

    Returns:
        The conventions under which they close to within 2 mm and twenty times better, best first.
    """
    tips = touches.subset(touches.are("point"))
    poses = tips.base_from_flange
    inverse = "the other way round, as flange_from_base"
    as_read = _linear_rms(tips)
    first = "with quaternions as w, x, y, z"
    others = {
        first: _reordered(poses, -1),
        "with quaternions as x, y, z, w": _reordered(poses, 1),
    }
    options = {first: "--robot-columns x_m,y_m,z_m,qy,qz,qw,qx"}
    if len(np.unique(tips.points)) > 1:
        others |= {f"{words} and {inverse}": invert(other) for words, other in others.items()}
        others[inverse] = invert(poses)
        options |= {inverse: "--robot-inverse"}
        options |= {f"{first} and {inverse}": f"{options[first]} --robot-inverse"}
    candidates = [
        PoseReading(
            words,
            _linear_rms(replace(tips, base_from_flange=other)),
            as_read,
            options.get(words, ""),
        )
        for words, other in others.items()
    ]
    if len(np.unique(touches.points)) == 1:
        inverted = replace(touches, base_from_flange=invert(touches.base_from_flange))
        sizes = (_axes_rms(inverted), _axes_rms(touches))
        candidates.append(PoseReading(inverse, *sizes, "--robot-inverse"))
    closing = [
        reading
        for reading in candidates
        if reading.rms_m < min(reading.as_read_m / _MUCH_BETTER, _CLOSED_M)
    ]
    return tuple(sorted(closing, key=lambda value: value.rms_m))


def _reordered(poses: FloatArray, shift: int) -> FloatArray:
    """The poses if the quaternion's numbers had been read in an order shifted by some places."""
    numbers = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return compose(Rotation.from_quat(np.roll(numbers, shift, axis=1)).as_matrix(), poses[:, :3, 3])


def _linear_rms(touches: Touches) -> float:
    poses = touches.base_from_flange
    positions = poses[:, :3, :3] @ linear_tip(poses, touches.points) + poses[:, :3, 3]
    deviations = [
        positions[touches.points == value] - positions[touches.points == value].mean(axis=0)
        for value in np.unique(touches.points)
    ]
    return float(np.sqrt(np.sum(np.concatenate(deviations) ** 2) / len(touches)))


def _axes_rms(touches: Touches) -> float:
    """Rms distance of touches of one point from it, and from the tool's z axis and xz plane."""
    tips = touches.subset(touches.are("point"))
    poses = tips.base_from_flange
    tip = linear_tip(poses, tips.points)
    point = (poses[:, :3, :3] @ tip + poses[:, :3, 3]).mean(axis=0)
    flange_from_base = invert(touches.base_from_flange)
    local = flange_from_base[:, :3, :3] @ point + flange_from_base[:, :3, 3] - tip
    along, beside = local[touches.are("z")], local[touches.are("xz")]
    if not len(along):
        return 0.0  # Without touches along z.
    z = np.linalg.svd(along)[2][0]
    deviations, beside = [along - np.outer(along @ z, z)], beside - np.outer(beside @ z, z)
    if len(beside):
        x = np.linalg.svd(beside)[2][0]
        deviations.append(beside - np.outer(beside @ x, x))
    squares = np.sum(np.concatenate(deviations) ** 2, axis=1)
    return float(np.hypot(np.sqrt(squares.mean()), _linear_rms(tips)))
