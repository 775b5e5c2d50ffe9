"""Limits of a motion (joints, drives, distances), and the check that a motion keeps them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np

from visioncal.core.arguments import check_fields
from visioncal.core.codec import within
from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray
from visioncal.dynamics.model import JointMotion
from visioncal.robot import Robot
from visioncal.robot.collision import Body, Collisions, arm_bodies
from visioncal.robot.inertia import Inertias, parameter_transform
from visioncal.robot.torques import joint_torques

CHECK_HZ = 1000.0  # Samples a second at which motions are checked against limits.


@dataclass(frozen=True)
class MotionMargins:
    """Margins of a planned motion."""

    # Distance of the joints from the ends of their ranges [rad].
    margin_rad: Annotated[float, within(0.0, np.pi)] = 0.05
    speed: Annotated[float, within(0.01, 1.0)] = 0.9  # Usable share of the greatest speeds.
    # Usable share of the greatest accelerations.
    acceleration: Annotated[float, within(0.01, 1.0)] = 0.9
    # Safety factor of the torques predicted by the nominal inertias.
    torque: Annotated[float, within(1.0, 10.0)] = 1.2
    # Distance of the arm from itself, the floor and all bodies [m].
    clearance_m: Annotated[float, within(0.0, 10.0)] = 0.03
    floor_m: float | None = 0.0  # Height of the floor in the base frame [m]; None for none.

    def __post_init__(self) -> None:
        check_fields(self, "limits")


@dataclass(frozen=True)
class DefaultLimits:
    """Defaults of limits that the robot's description does not state; None for no default."""

    range_rad: float | None = None  # Farthest position to either side [rad].
    speed_rad_s: float | None = None  # Greatest speed [rad/s].
    acceleration_rad_s2: float | None = None  # Greatest acceleration [rad/s^2].


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Limits of a motion, margins included."""

    robot: Robot  # The arm.
    lower: FloatArray  # (n,) least positions [rad].
    upper: FloatArray  # (n,) greatest positions [rad].
    speed: FloatArray  # (n,) greatest speeds [rad/s].
    acceleration: FloatArray  # (n,) greatest accelerations [rad/s^2].
    # (n,) greatest torques predicted by the nominal inertias [N m]; inf where unknown.
    torque: FloatArray
    inertias: Inertias | None  # Nominal ones, with the payload; None where unknown.
    bodies: tuple[Body, ...]  # Collision bodies of the arm and of the cell.
    share: MotionMargins  # The margins.

    @cached_property
    def collisions(self) -> Collisions:
        """Distance computation of the cell; to be used by one thread."""
        share = self.share
        return Collisions(self.robot, self.bodies, share.clearance_m, share.floor_m)

    @property
    def middle(self) -> FloatArray:
        """(n,) centres of the ranges [rad]."""
        return 0.5 * (self.lower + self.upper)

    @property
    def half(self) -> FloatArray:
        """(n,) half widths of the ranges [rad]."""
        return 0.5 * (self.upper - self.lower)

    @property
    def unchecked(self) -> tuple[str, ...]:
        """Messages on limits that cannot be checked for lack of data."""
        if self.inertias is None:
            return (
                f"torques: the description of {self.robot.name} states no inertias of its links",
            )
        unknown = [
            name
            for name, limit in zip(self.robot.joint_names, self.torque, strict=True)
            if not np.isfinite(limit)
        ]
        if unknown:
            return (f"torques: no greatest torque is stated of {some_of(unknown)}",)
        return ()

    def torques(self, motion: JointMotion) -> FloatArray | None:
        """Torques (m, n) predicted by the nominal inertias [N m]; None where unknown."""
        if self.inertias is None:
            return None
        return joint_torques(self.robot, self.inertias, motion.q, motion.dq, motion.ddq)


def motion_limits(
    robot: Robot,
    share: MotionMargins,
    *,
    missing: DefaultLimits | None = None,
    bodies: Sequence[Body] = (),
    payload: FloatArray | None = None,
) -> MotionLimits:
    """Collects the limits of a motion.

    Args:
        robot: The arm.
        share: The margins.
        missing: Defaults of limits that the robot's description does not state.
        bodies: Collision bodies of tool and cell.
        payload: (10,) inertial parameters of the payload in the flange frame; None for none.

    Raises:
        DataError: A limit is not stated, or the margins leave no range.
    """
    missing = missing or DefaultLimits()
    given = np.full(robot.joint_count, np.inf if missing.range_rad is None else missing.range_rad)
    lower = np.where(np.isfinite(robot.lower_rad), robot.lower_rad, -given)
    upper = np.where(np.isfinite(robot.upper_rad), robot.upper_rad, given)
    rates = [
        np.where(np.isfinite(stated), stated, np.inf if instead is None else instead)
        for stated, instead in (
            (robot.rates.velocity, missing.speed_rad_s),
            (robot.rates.acceleration, missing.acceleration_rad_s2),
        )
    ]
    for values, what, keys, option in (
        (np.minimum(-lower, upper), "positions", "lower_deg and upper_deg", "--range-deg"),
        (rates[0], "speed", "velocity_rad_s", "--speed-deg"),
        (rates[1], "acceleration", "acceleration_rad_s2", "--acceleration-deg"),
    ):
        unlimited = [
            name
            for name, value in zip(robot.joint_names, values, strict=True)
            if not np.isfinite(value)
        ]
        if unlimited:
            raise DataError(
                f"robot {robot.name}: its description states no limits of {what} for "
                f"{some_of(unlimited)}; a motion is planned within limits only.",
                culprits=unlimited,
                next_step=f"Write {keys} into its description (a <limit> into a URDF), or give "
                f"{option}.",
            )
    allowed = MotionLimits(
        robot,
        lower + share.margin_rad,
        upper - share.margin_rad,
        share.speed * rates[0],
        share.acceleration * rates[1],
        robot.rates.torque / share.torque,
        robot.inertias,
        (*arm_bodies(robot), *bodies),
        share,
    )
    for place, name in enumerate(allowed.robot.joint_names):
        left = float(allowed.upper[place] - allowed.lower[place])
        if left <= 0.0:
            margin_deg = np.rad2deg(allowed.share.margin_rad)
            raise DataError(
                f"robot {allowed.robot.name}: of the range of {name} "
                f"{np.rad2deg(left) + 2.0 * margin_deg:.1f} deg are left, but must hold a margin "
                f"of {margin_deg:.1f} deg on both sides.",
                culprits=[name],
                next_step="Make the margin smaller (--margin-deg), or mend the limits.",
            )
    if payload is None or allowed.inertias is None:
        return allowed
    values = allowed.inertias.values.copy()
    values[-1] += parameter_transform(robot.chain.placements[-1]) @ payload
    return replace(allowed, inertias=Inertias(values))


@dataclass(frozen=True, eq=False)
class MotionExtremes:
    """Extremes of a motion, against its limits."""

    allowed: MotionLimits  # The limits.
    lowest: FloatArray  # (n,) least positions [rad].
    highest: FloatArray  # (n,) greatest positions [rad].
    speed: FloatArray  # (n,) greatest speeds [rad/s].
    acceleration: FloatArray  # (n,) greatest accelerations [rad/s^2].
    # (n,) greatest torques predicted by the nominal inertias [N m]; None where unknown.
    torque: FloatArray | None
    # Least distance of collision pairs less the required one [m]; inf without pairs.
    apart_m: float
    nearest: tuple[str, ...]  # The nearest pair; empty without pairs.
    nearest_s: float  # Time at which it is nearest [s].

    @property
    def clearance_m(self) -> float:
        """Least distance of collision pairs [m]."""
        return self.apart_m + self.allowed.share.clearance_m

    @property
    def shares(self) -> dict[str, list[float]]:
        """Used share of each limit, joint by joint; torque only where known."""
        allowed = self.allowed
        reach = np.maximum(self.highest - allowed.middle, allowed.middle - self.lowest)
        shares = {
            "range": reach / allowed.half,
            "speed": self.speed / allowed.speed,
            "acceleration": self.acceleration / allowed.acceleration,
        }
        if self.torque is not None and not allowed.unchecked:
            shares["torque"] = self.torque / allowed.torque
        return {
            name: [float(value) for value in np.round(used, 6)] for name, used in shares.items()
        }

    @property
    def breaches(self) -> tuple[str, ...]:
        """Messages on exceeded limits; empty for a motion that may be driven."""
        allowed, names = self.allowed, self.allowed.robot.joint_names
        messages = []
        for what, used, limit, unit in (
            ("position", -self.lowest, -allowed.lower, "rad"),
            ("position", self.highest, allowed.upper, "rad"),
            ("speed", self.speed, allowed.speed, "rad/s"),
            ("acceleration", self.acceleration, allowed.acceleration, "rad/s^2"),
            *([("torque", self.torque, allowed.torque, "N m")] if self.torque is not None else []),
        ):
            # Motions are scaled to reach their limits exactly, but for rounding.
            beyond = np.flatnonzero(used > limit + 1e-9 * np.maximum(1.0, np.abs(limit)))
            messages += [
                f"{what} of {names[joint]} reaches {abs(used[joint]):.3g} {unit}, "
                f"{abs(limit[joint]):.3g} is allowed"
                for joint in beyond
            ]
        if self.apart_m < 0.0:
            messages.append(
                f"{' and '.join(self.nearest)} come to {1e3 * self.clearance_m:.0f} mm of one "
                f"another, {1e3 * allowed.share.clearance_m:.0f} mm is allowed"
            )
        return tuple(messages)


def motion_extremes(allowed: MotionLimits, motion: JointMotion) -> MotionExtremes:
    """Computes the extremes of a densely sampled motion."""
    torques = allowed.torques(motion)
    collisions, apart_m, row = allowed.collisions, np.inf, 0
    nearest: tuple[str, ...] = ()
    if collisions.names:
        excess = np.array([collisions.distances(q) for q in motion.q]) - collisions.needed_m()
        row, pair = divmod(int(excess.argmin()), excess.shape[1])
        apart_m, nearest = float(excess[row, pair]), collisions.names[pair]
    return MotionExtremes(
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
