"""Arms, and the moments of a cell."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from visioncal.core.types import FloatArray, IntArray
from visioncal.robot import Robot


@dataclass(frozen=True, eq=False)
class Arm:
    """One robot of a cell, at the cell's s stops."""

    flange: str  # Frame of its flange, by which it is known.
    # (s, 4, 4) `base_from_flange` as reported; NaN where it stood elsewhere or is not known.
    poses: FloatArray
    joints: FloatArray | None = None  # (s, n) joint angles [rad]; None unless known at all stops.
    model: Robot | None = None  # Its geometry, if known.

    @property
    def has_joints(self) -> bool:
        """Whether errors of its links can be determined from its postures."""
        return self.joints is not None and self.model is not None


@dataclass(frozen=True, eq=False)
class Moments:
    """k moments: where the arms stand, and when it is. Effects are functions of these."""

    poses: Mapping[str, FloatArray]  # (k, 4, 4) `base_from_flange` as reported, by flange.
    joints: Mapping[str, FloatArray]  # (k, n) joint angles [rad] of arms whose links are known.
    # (k,) share of the session: -1 at its first stop, 0 at its last. Picks come after it.
    progress: FloatArray
    stops: IntArray  # (k,) indices of the cell's stops; -1 of other moments.

    @classmethod
    def of(cls, arms: Mapping[str, Arm], progress: FloatArray) -> Self:
        """The moments of all stops."""
        known = {name: arm.joints for name, arm in arms.items() if arm.joints is not None}
        poses = {name: arm.poses for name, arm in arms.items()}
        return cls(poses, known, progress, np.arange(len(progress)))

    def take(self, stops: IntArray) -> Self:
        """Some of them, in an order."""
        return type(self)(
            {name: poses[stops] for name, poses in self.poses.items()},
            {name: joints[stops] for name, joints in self.joints.items()},
            self.progress[stops],
            self.stops[stops],
        )

    def __len__(self) -> int:
        return len(self.progress)


def even_progress(count: int) -> FloatArray:
    """(s,) shares of a session whose stops follow one another evenly."""
    return np.linspace(-1.0, 0.0, count) if count > 1 else np.zeros(count)
