"""Whether a motion keeps its limits, by looking at many of its samples."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.dynamics.limits import Allowed
from visioncal.dynamics.motion import Motion

CHECK_HZ = 1000.0
# Rounding alone is no breach: a motion is scaled to end at its limits.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Kept:
    """The extremes of a motion.

    Attributes:
        allowed: What it must keep.
        lowest: (n,) least positions [rad].
        highest: (n,) greatest positions [rad].
        speed: (n,) greatest speeds [rad/s].
        acceleration: (n,) greatest accelerations [rad/s^2].
        torque: (n,) greatest torques of the nominal arm [N m]; None where they are not known.
        apart_m: Least distance of what must stay apart, beyond what it must be [m]; inf where
            nothing must.
        nearest: The two that come nearest; empty where nothing must stay apart.
        nearest_s: When they do [s].
    """

    allowed: Allowed
    lowest: FloatArray
    highest: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    torque: FloatArray | None
    apart_m: float
    nearest: tuple[str, ...]
    nearest_s: float

    @property
    def clearance_m(self) -> float:
        """Least distance of what must stay apart [m]."""
        return self.apart_m + self.allowed.share.clearance_m

    @property
    def shares(self) -> dict[str, list[float]]:
        """By limit, what share of it each joint uses; torque only where it is known."""
        allowed = self.allowed
        reach = np.maximum(self.highest - allowed.middle, allowed.middle - self.lowest)
        found = {
            "range": reach / allowed.half,
            "speed": self.speed / allowed.speed,
            "acceleration": self.acceleration / allowed.acceleration,
        }
        if self.torque is not None and not allowed.unchecked:
            found["torque"] = self.torque / allowed.torque
        return {name: [float(it) for it in np.round(used, 6)] for name, used in found.items()}

    @property
    def breaches(self) -> tuple[str, ...]:
        """What is not kept, in words; empty for a motion that may be driven."""
        allowed, names = self.allowed, self.allowed.robot.joint_names
        found = []
        for what, used, limit, unit in (
            ("position", -self.lowest, -allowed.lower, "rad"),
            ("position", self.highest, allowed.upper, "rad"),
            ("speed", self.speed, allowed.speed, "rad/s"),
            ("acceleration", self.acceleration, allowed.acceleration, "rad/s^2"),
            *([("torque", self.torque, allowed.torque, "N m")] if self.torque is not None else []),
        ):
            beyond = np.flatnonzero(used > limit + _ROUNDING * np.maximum(1.0, np.abs(limit)))
            found += [
                f"{what} of {names[joint]} reaches {abs(used[joint]):.3g} {unit}, "
                f"{abs(limit[joint]):.3g} is allowed"
                for joint in beyond
            ]
        if self.apart_m < 0.0:
            found.append(
                f"{' and '.join(self.nearest)} come to {1e3 * self.clearance_m:.0f} mm of one "
                f"another, {1e3 * allowed.share.clearance_m:.0f} mm is allowed"
            )
        return tuple(found)


def kept_limits(allowed: Allowed, motion: Motion) -> Kept:
    """Looks for the extremes of a motion at all its samples.

    Args:
        allowed: What it must keep.
        motion: Densely sampled.
    """
    torques = allowed.torques(motion)
    apart_m, nearest, row = _nearest(allowed, motion.q)
    return Kept(
        allowed,
        motion.q.min(axis=0),
        motion.q.max(axis=0),
        np.abs(motion.dq).max(axis=0),
        np.abs(motion.ddq).max(axis=0),
        None if torques is None else np.abs(torques).max(axis=0),
        apart_m,
        nearest,
        float(motion.times_s[row]),
    )


def _nearest(allowed: Allowed, q: FloatArray) -> tuple[float, tuple[str, ...], int]:
    """What is left of the distances at (m, n) postures: the least [m], whose it is, and where."""
    collisions = allowed.collisions
    if not collisions.names:
        return np.inf, (), 0
    left = np.array([collisions.distances(it) for it in q]) - collisions.needed_m()
    row, pair = np.unravel_index(int(left.argmin()), left.shape)
    return float(left[row, pair]), collisions.names[pair], int(row)
