"""The two models of an arm, and targets that make the real one stand where it is wanted."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.arguments import typed
from visioncal.core.choices import WIDEST_RAD as WIDEST_RAD
from visioncal.core.errors import DataError
from visioncal.core.transforms import (
    LAST_ROW,
    RIGID,
    compose,
    invert,
    nearest_rotation,
    rigid_fault,
    rotation_angle,
)
from visioncal.core.types import FloatArray, Mask
from visioncal.results import Calibration
from visioncal.results.arm import WorkspacePlace
from visioncal.robot import Loads, Robot, bends
from visioncal.robot.inverse import Inverse, Posture
from visioncal.session.choosing import ARM, Choice

# Transforms, or their (4, 4) or (m, 4, 4) matrices.
Poses: TypeAlias = FloatArray | RigidTransform

# No arm reaches this far [m], and no joint of one turns this far [rad].
FAR_M, WIDE_RAD = 20.0, 4 * np.pi
# No rotation is at a matrix that is off by more: it is written with fewer digits than count here.
_ROUNDED = 1e-12

# A place's sigma is that of so many places of the map around it.
_AROUND = 4
# Postures count as measured beyond the ranges of the stops by such a share of these: ends of a
# range are seldom among random stops.
_MARGIN = 0.05
# Fewer joints reach no position at will.
_LEAST_JOINTS = 3


@dataclass(frozen=True, eq=False)
class CalibratedArm:
    """An arm as its controller believes it to be, and as it was found.

    What `correct` needs besides the targets is prepared here: for a loop, once and for each thread.

    Attributes:
        nominal: What the controller computes with.
        real: What the calibration found.
        inverse: The inverse kinematics of the real arm without a load.
        compliance: (n,) what its joints yield to a torque [rad/(N m)].
        weight_moments: (n, 4 n) how they yield to the weight of links of unknown masses; None
            where these are known (see `bent_joints`).
    """

    nominal: Robot
    real: Robot
    inverse: Inverse
    compliance: FloatArray
    weight_moments: FloatArray | None

    @classmethod
    @typed
    def of(cls, calibration: Calibration) -> Self:
        """Takes both models out of a calibration.

        Raises:
            DataError: It has no calibrated arm, or one that reaches no position at will.
        """
        nominal, real = calibration.robot, calibration.calibrated_robot
        if nominal is None or real is None or not calibration.arm_is_calibrated:
            raise _without_arm(calibration)
        if real.joint_count < _LEAST_JOINTS:
            raise DataError(
                f"robot {real.name} has {real.joint_count} joints, and {_LEAST_JOINTS} are needed "
                "to reach a position.",
                culprits=[real.name],
            )
        return cls(nominal, real, Inverse(real), calibration.compliance, calibration.weight_moments)

    @typed
    def unbent(self, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """Where to send the joints so that under their loads they stand elsewhere.

        Args:
            q: (m, n) where they are to stand, as angles of the arm without a load [rad].
            loads: What the flange carries; the arm's own weight alone where None.

        Returns:
            (m, n) what their encoders have to report [rad].
        """
        if not self.compliance.any() and self.weight_moments is None:
            return q
        return np.asarray(q - bends(self.real, q, self.compliance, loads, self.weight_moments))

    def turns_deg_per_mm(self, q: FloatArray) -> FloatArray:
        """How far joints turn at the most for a millimetre of the flange, its rotation kept.

        Args:
            q: (m, n) joint positions [rad or m].

        Returns:
            (m, n) degrees a millimetre, large near singular postures; zero for a prismatic joint.
        """
        joints_flange_jacobian = np.linalg.pinv(self.real.joint_jacobian(q))
        turns = np.linalg.norm(joints_flange_jacobian[:, :, 3:], axis=2)
        return np.where(self.real.chain.prismatic, 0.0, 1e-3 * np.rad2deg(turns))


def _without_arm(calibration: Calibration) -> DataError:
    name = calibration.session_name
    if calibration.arm is None:
        return DataError(
            f"calibration {name!r} has no calibrated arm: its session had no joint angles of every "
            "view or no known robot model, or it was made with --level hand-eye.",
            next_step="Record q1_rad ... with every view, name the arm in [robot] model, and "
            "calibrate with --level auto or kinematics.",
        )
    return DataError(
        f"calibration {name!r} has no calibrated arm (level {calibration.arm.level}): its "
        "views do not distinguish the arm from its nominal model, so there is nothing to correct.",
        next_step="Send the targets as they are; or calibrate with more views, all over the "
        "workspace.",
    )


def predicted_sigma_mm(
    calibration: Calibration, p_base: FloatArray, q: FloatArray | None = None
) -> FloatArray:
    """How surely the calibrated arm reaches places, as its calibration predicts.

    Args:
        calibration: Of a calibrated arm.
        p_base: (m, 3) places of the flange [m].
        q: (m, n) with which joints it reaches them [rad or m]; None where that is open.

    Returns:
        (m,) root of the trace of a place's covariance [mm]: of the map around each place, that of
        postures as they were measured or of all the workspace; or else the median over the
        workspace; NaN where the calibration says none of them.
    """
    arm = calibration.arm
    if arm is None or not arm.workspace_map:
        known = None if arm is None else arm.workspace_sigma_mm
        return np.full(len(p_base), np.nan if known is None else known.median)
    found = _around(p_base, arm.workspace_map)
    if q is None or not arm.measured_map:
        return found
    lower, upper = np.array([(joint.lower, joint.upper) for joint in arm.measured]).T
    margin = _MARGIN * (upper - lower)
    measured = np.all((lower - margin <= q) & (q <= upper + margin), axis=1)
    return np.where(measured, _around(p_base, arm.measured_map), found)


def _around(p_base: FloatArray, rows: Sequence[WorkspacePlace]) -> FloatArray:
    """(m,) sigmas [mm] of a map at (m, 3) places [m], by the places of the map around each."""
    places = np.array([(row.x_m, row.y_m, row.z_m) for row in rows])
    away = np.linalg.norm(p_base[:, None] - places, axis=2)
    near = np.argsort(away, axis=1)[:, :_AROUND]
    # A place of the map itself would have all the weight there is.
    weights = 1.0 / np.maximum(np.take_along_axis(away, near, axis=1), 1e-6) ** 2
    sigmas = np.array([row.sigma_mm for row in rows])[near]
    return np.asarray((weights * sigmas).sum(axis=1) / weights.sum(axis=1))


@dataclass(frozen=True, eq=False)
class Corrected:
    """What to send, for m targets.

    Attributes:
        wanted: (m, 4, 4) the targets: where the flange is to be [m].
        q: (m, n) joint targets [rad or m]; where `reached` is false, those that come nearest.
        base_from_flange: (m, 4, 4) Cartesian targets [m]: where the nominal controller has the
            flange at `q`.
        reached: (m,) whether the calibrated arm is at its target there, within its limits.
        off_m: (m,) distance that is left [m].
        off_rad: (m,) angle that is left [rad]. An arm of fewer than six joints reaches the
            position, and the rotation as nearly as it can.
        turned_rad: (m, n) how far each joint turns from where it was looked for: the row's seed, or
            the target before; zero for a prismatic joint, and for a first target without a seed.
        beyond: (m,) where a target is not reached, the joints whose limits alone are in the way.
    """

    wanted: FloatArray
    q: FloatArray
    base_from_flange: FloatArray
    reached: Mask
    off_m: FloatArray
    off_rad: FloatArray
    turned_rad: FloatArray
    beyond: tuple[tuple[str, ...], ...]

    def __len__(self) -> int:
        return len(self.q)

    @property
    def moved_m(self) -> FloatArray:
        """(m,) distance of the flange as it is sent from where it is wanted [m]."""
        away = self.base_from_flange[:, :3, 3] - self.wanted[:, :3, 3]
        return np.asarray(np.linalg.norm(away, axis=1))

    @property
    def moved_rad(self) -> FloatArray:
        """(m,) angle between both [rad]."""
        return rotation_angle(invert(self.wanted) @ self.base_from_flange)


@typed
def correct(
    calibration: Calibration | CalibratedArm,
    base_from_flange: Poses,
    q_seed: FloatArray | Sequence[float] | None = None,
    *,
    widest_rad: float = WIDEST_RAD,
    loads: Loads | None = None,
    robot: str | None = None,
) -> Corrected:
    """Computes what to send to the nominal controller so that the real arm reaches targets.

    The calibrated model is inverted: its `base_from_flange(q)` is the target. Sent as joints, `q`
    is right whatever the controller believes; as a pose, it is where the nominal model has the
    flange at `q`, from which the controller finds `q` again.

    Args:
        calibration: Of a calibrated arm; or that arm, prepared once by `CalibratedArm.of`.
        base_from_flange: The targets, in the calibration's base [m]: (4, 4), (m, 4, 4) or
            transforms.
        q_seed: (n,) where the first is looked for, and each further one from the target before it;
            or (m, n) one a target, where a row of NaN follows the target before it [rad or m].
            Without it, the first is the posture nearest to the middle of the joints' limits.
        widest_rad: Where a joint turns farther from its seed, other branches are looked at and the
            nearest is taken [rad].
        loads: What the flange carries at each target, for an arm whose joints bend
            (`Loads.alike`); its own weight alone where None.
        robot: Which robot of a whole cell's calibration is meant.

    Raises:
        DataError: The calibration has no calibrated arm, or a target or a seed is none.
    """
    arm = calibration
    if isinstance(arm, Calibration):
        arm = CalibratedArm.of(arm.chosen(Choice(robot=robot), ARM))
    wanted = _matrices(base_from_flange)
    own = _seeds(q_seed, arm.real, len(wanted))
    chain, inverse = arm.real.chain, arm.inverse
    seeds = chain.effective(own)
    seeded = np.asarray(np.isfinite(own).all(axis=1))
    last: FloatArray | None = None
    found: list[Posture] = []
    starts = np.empty_like(seeds)
    for at, target in enumerate(wanted):
        start = seeds[at] if seeded[at] else last
        if start is None:
            # Any branch is as good: the one nearest to the middle is taken.
            found.append(inverse.solve(target, _middle(arm.real), widest_rad=0.0))
            starts[at] = found[-1].positions
        else:
            found.append(inverse.solve(target, start, widest_rad=widest_rad))
            starts[at] = start
        last = found[-1].positions if found[-1].reached else start
    positions = np.array([posture.positions for posture in found]).reshape(seeds.shape)
    q = arm.unbent(chain.encoded(positions), loads)
    return Corrected(
        wanted=wanted,
        q=q,
        base_from_flange=arm.nominal.base_from_flange(q),
        reached=np.array([posture.reached for posture in found], dtype=bool),
        off_m=np.array([posture.off_m for posture in found]),
        off_rad=np.array([posture.off_rad for posture in found]),
        turned_rad=np.where(chain.prismatic, 0.0, np.abs(positions - starts)),
        beyond=tuple(posture.beyond for posture in found),
    )


def _middle(robot: Robot) -> FloatArray:
    """(n,) effective positions in the middle of the limits, zero without limits [rad or m]."""
    known = np.isfinite(robot.lower_rad) & np.isfinite(robot.upper_rad)
    ends = [np.where(known, array, 0.0) for array in (robot.lower_rad, robot.upper_rad)]
    return np.asarray(robot.chain.effective((0.5 * (ends[0] + ends[1]))[None])[0])


def _matrices(poses: Poses) -> FloatArray:
    """The targets as (m, 4, 4), checked."""
    given = poses.as_matrix() if isinstance(poses, RigidTransform) else poses
    matrices = np.asarray(given, dtype=float)
    matrices = matrices[None] if matrices.ndim == 2 else matrices
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
        raise DataError(
            f"correct: targets of shape (m, 4, 4) are needed, not {np.shape(given)}.",
        )
    rotations = matrices[:, :3, :3]
    off = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    rigid = (off < RIGID) & (np.abs(matrices[:, 3] - LAST_ROW).max(axis=1, initial=0.0) < RIGID)
    if rigid.all():
        rigid = np.linalg.det(rotations) > 0.0
    if not rigid.all():
        at = int(np.argmin(rigid))
        fault, step = rigid_fault(matrices[at])
        raise DataError(
            f"correct: target {at} is no rigid transform: {fault}.",
            culprits=[f"target {at}"],
            next_step=step,
        )
    away = np.abs(matrices[:, :3, 3]).max(axis=1, initial=0.0)
    near = away < FAR_M
    if not near.all():
        at = int(np.argmin(near))
        raise DataError(
            f"correct: target {at} is {away[at]:.4g} m from the base, and no arm reaches "
            f"{FAR_M:g} m.",
            culprits=[f"target {at}"],
            next_step="Positions are in metres.",
        )
    if off.max(initial=0.0) > _ROUNDED:
        return compose(nearest_rotation(rotations), matrices[:, :3, 3])
    return matrices


def _seeds(q_seed: FloatArray | Sequence[float] | None, robot: Robot, count: int) -> FloatArray:
    """The seeds (m, n) of all targets; NaN in a row that follows the target before it."""
    size = robot.joint_count
    if q_seed is None:
        return np.full((count, size), np.nan)
    seeds = np.asarray(q_seed, dtype=float)
    if seeds.shape not in ((size,), (count, size)):
        raise DataError(
            f"correct: seeds of shape ({size},) or ({count}, {size}) are needed, for the joints of "
            f"{robot.name}, not {seeds.shape}.",
        )
    if seeds.ndim == 1:
        if not np.isfinite(seeds).all():
            raise DataError("correct: the seed has a joint that is no finite number.")
        seeds = np.concatenate([seeds[None], np.full((max(count - 1, 0), size), np.nan)])[:count]
    turns = np.abs(seeds[:, ~robot.chain.prismatic])
    if (turns > WIDE_RAD).any():
        raise DataError(
            f"correct: a seed has a joint at {np.nanmax(turns):.4g} rad, more than two turns: "
            "these look like degrees.",
            next_step="Write radians.",
        )
    return seeds
