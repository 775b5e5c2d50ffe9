"""Arms, and the moments of a cell."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from visioncal.core.types import FloatArray, IntArray
from visioncal.robot import Loads, Robot
from visioncal.robot.thermal import Inputs


@dataclass(frozen=True, eq=False)
class Arm:
    """One robot of a cell, at the cell's s stops."""

    flange: str  # Frame of its flange, by which it is known.
    # (s, 4, 4) `base_from_flange` as reported; NaN where it stood elsewhere or is not known.
    poses: FloatArray
    joints: FloatArray | None = None  # (s, n) joint angles [rad]; None unless known at all stops.
    model: Robot | None = None  # Its geometry, if known.
    # Its loads at the stops, and the side from which it approached them; None where unknown.
    loads: Loads | None = None
    heat: Inputs | None = None  # Its heat sources; None where they are not recorded.

    @property
    def has_joints(self) -> bool:
        """Whether errors of its links can be determined from its postures."""
        return self.joints is not None and self.model is not None

    @property
    def sides(self) -> FloatArray | None:
        """(s, n) side from which each joint came to the stops: 1 from above, -1 from below.

        Where none is stated, that of its last motion; 0 before the first. None without joints.
        """
        if self.joints is None:
            return None
        if self.loads is not None and self.loads.side.any():
            return self.loads.sides + np.zeros_like(self.joints)
        stood = np.flatnonzero(np.isfinite(self.poses[:, 0, 0]))
        sides = np.zeros_like(self.joints)
        sides[stood] = sides_of_motion(self.joints[stood])
        return sides


def sides_of_motion(joints: FloatArray) -> FloatArray:
    """(m, n) sides from which joints came to (m, n) angles [rad], one stop after the other.

    1 from above, -1 from below; 0 before the first motion.
    """
    moved = np.diff(joints, axis=0, prepend=joints[:1])
    # Encoders of a joint that stands still are noisy: it came from where it did before.
    signs = -np.sign(np.where(np.abs(moved) > 1e-4, moved, 0.0))
    last = np.maximum.accumulate(np.where(signs, np.arange(len(signs))[:, None], 0), axis=0)
    return np.take_along_axis(signs, last, axis=0)


@dataclass(frozen=True, eq=False)
class Reported:
    """The reports of a robot's rows, by view."""

    poses: Mapping[int, FloatArray]  # (4, 4) `base_from_flange`.
    joints: Mapping[int, FloatArray]  # (n,) joint angles that belong to the model [rad].
    model: Robot | None  # None where no joints belong to one.


@dataclass(frozen=True, eq=False)
class Swept:
    """Sightings by one camera while one robot moved, at poses of that robot by another clock."""

    camera: str
    flange: str
    # (6,) twist per second of the flange by view, in its own frame [rad/s, m/s].
    rates: Mapping[int, FloatArray]
    sigma_s: float  # Standard deviation of the time between both clocks that was taken [s].


@dataclass(frozen=True, eq=False)
class Moments:
    """k moments: where the arms stand, and when it is. Effects are functions of these."""

    poses: Mapping[str, FloatArray]  # (k, 4, 4) `base_from_flange` as reported, by flange.
    joints: Mapping[str, FloatArray]  # (k, n) joint angles [rad] of arms whose links are known.
    # (k,) share of the session: -1 at its first stop, 0 at its last. Picks come after it.
    progress: FloatArray
    stops: IntArray  # (k,) indices of the cell's stops; -1 of other moments.
    # (k, n) sides from which joints came, as of `Arm.sides`; in the middle of their play elsewhere.
    sides: Mapping[str, FloatArray] = field(default_factory=dict)
    # Loads of arms beside their own weight; those without carry nothing.
    loads: Mapping[str, Loads] = field(default_factory=dict)
    # (k, 6) twist per second of a flange, in its own frame [rad/s, m/s], while a camera looked: by
    # the camera and the flange. At rest elsewhere.
    rates: Mapping[tuple[str, str], FloatArray] = field(default_factory=dict)
    # (k,) [s]; NaN, or None of all, where unknown: as at the end of the session.
    stamps_s: FloatArray | None = None

    @classmethod
    def of(
        cls,
        arms: Mapping[str, Arm],
        progress: FloatArray,
        rates: Mapping[tuple[str, str], FloatArray] | None = None,
        stamps_s: FloatArray | None = None,
    ) -> Self:
        """The moments of all stops."""
        return cls(
            {name: arm.poses for name, arm in arms.items()},
            {name: arm.joints for name, arm in arms.items() if arm.joints is not None},
            progress,
            np.arange(len(progress)),
            {name: arm.sides for name, arm in arms.items() if arm.sides is not None},
            {name: arm.loads for name, arm in arms.items() if arm.loads is not None},
            rates or {},
            stamps_s,
        )

    def take(self, stops: IntArray) -> Self:
        """The moments at the given indices, in their order."""
        return type(self)(
            {name: poses[stops] for name, poses in self.poses.items()},
            {name: joints[stops] for name, joints in self.joints.items()},
            self.progress[stops],
            self.stops[stops],
            {name: sides[stops] for name, sides in self.sides.items()},
            {name: loads.chosen(stops) for name, loads in self.loads.items()},
            {names: rates[stops] for names, rates in self.rates.items()},
            None if self.stamps_s is None else self.stamps_s[stops],
        )

    def __len__(self) -> int:
        return len(self.progress)


def even_progress(count: int) -> FloatArray:
    """(s,) shares of a session whose stops follow one another evenly."""
    return np.linspace(-1.0, 0.0, count) if count > 1 else np.zeros(count)
