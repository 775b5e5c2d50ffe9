"""Whether touches close when their poses are read in another way."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.touching import Touches, linear_tip

# Touches that were read wrongly close so much better when they are read right, and this well [m].
_MUCH_BETTER, _CLOSED_M = 20.0, 2e-3


@dataclass(frozen=True)
class PoseReading:
    """Another way to read the poses, by which the touches close.

    Attributes:
        words: What it is: `with quaternions as w, x, y, z`.
        rms_m: Root mean square distance of the touches then [m].
        as_read_m: The same as they were read [m].
        options: Those of commands by which columns of their usual names are read so; empty where
            none are known.
    """

    words: str
    rms_m: float
    as_read_m: float
    options: str = ""


def readings_that_close(touches: Touches) -> tuple[PoseReading, ...]:
    """Finds other ways to read the poses by which the touches close, where as read they do not.

    Touches of one point close in both directions alike, with the tip and the point exchanged; of
    several, in one only. Those along the tool's axes, all of one point, do in one only, too.

    Args:
        touches: As they were read; those of kind `point` count, and others where they are of one.

    Returns:
        The readings under which they close to within 2 mm and twenty times better, best first.
    """
    there = touches.subset(touches.are("point"))
    poses = there.base_from_flange
    inverse = "the other way round, as flange_from_base"
    as_read = _linear_rms(there)
    first = "with quaternions as w, x, y, z"
    others = {
        first: _reordered(poses, -1),
        "with quaternions as x, y, z, w": _reordered(poses, 1),
    }
    options = {first: "--robot-columns x_m,y_m,z_m,qy,qz,qw,qx"}
    if len(np.unique(there.points)) > 1:
        others |= {f"{words} and {inverse}": invert(other) for words, other in others.items()}
        others[inverse] = invert(poses)
        options |= {inverse: "--robot-inverse"}
        options |= {f"{first} and {inverse}": f"{options[first]} --robot-inverse"}
    found = [
        PoseReading(
            words,
            _linear_rms(replace(there, base_from_flange=other)),
            as_read,
            options.get(words, ""),
        )
        for words, other in others.items()
    ]
    if len(np.unique(touches.points)) == 1:
        back = replace(touches, base_from_flange=invert(touches.base_from_flange))
        sizes = (_axes_rms(back), _axes_rms(touches))
        found.append(PoseReading(inverse, *sizes, "--robot-inverse"))
    closing = [
        reading
        for reading in found
        if reading.rms_m < min(reading.as_read_m / _MUCH_BETTER, _CLOSED_M)
    ]
    return tuple(sorted(closing, key=lambda value: value.rms_m))


def _reordered(poses: FloatArray, shift: int) -> FloatArray:
    """The poses had the numbers that were read as x, y, z, w stood so many places further on."""
    numbers = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return compose(Rotation.from_quat(np.roll(numbers, shift, axis=1)).as_matrix(), poses[:, :3, 3])


def _linear_rms(touches: Touches) -> float:
    poses = touches.base_from_flange
    met = poses[:, :3, :3] @ linear_tip(poses, touches.points) + poses[:, :3, 3]
    away = [
        met[touches.points == value] - met[touches.points == value].mean(axis=0)
        for value in np.unique(touches.points)
    ]
    return float(np.sqrt(np.sum(np.concatenate(away) ** 2) / len(touches)))


def _axes_rms(touches: Touches) -> float:
    """How far touches of one point are off: of its place, and of the tool's z axis and xz plane."""
    # Zero without touches along z.
    there = touches.subset(touches.are("point"))
    poses = there.base_from_flange
    tip = linear_tip(poses, there.points)
    point = (poses[:, :3, :3] @ tip + poses[:, :3, 3]).mean(axis=0)
    back = invert(touches.base_from_flange)
    seen = back[:, :3, :3] @ point + back[:, :3, 3] - tip
    along, beside = seen[touches.are("z")], seen[touches.are("xz")]
    if not len(along):
        return 0.0
    z = np.linalg.svd(along)[2][0]
    away, beside = [along - np.outer(along @ z, z)], beside - np.outer(beside @ z, z)
    if len(beside):
        x = np.linalg.svd(beside)[2][0]
        away.append(beside - np.outer(beside @ x, x))
    squares = np.sum(np.concatenate(away) ** 2, axis=1)
    return float(np.hypot(np.sqrt(squares.mean()), _linear_rms(there)))
