"""Targets that make a real arm stand where it is wanted, through its nominal controller."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

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
from visioncal.results.compensation.arms import CalibratedArm
from visioncal.robot import Loads, Robot
from visioncal.robot.inverse import Posture
from visioncal.session.choosing import ARM, Choice

# Transforms, or their (4, 4) or (m, 4, 4) matrices.
Poses: TypeAlias = FloatArray | RigidTransform

# No arm reaches this far [m], and no joint of one turns this far [rad].
FAR_M, WIDE_RAD = 20.0, 4 * np.pi
# No rotation is at a matrix that is off by more: it is written with fewer digits than count here.
_ROUNDED = 1e-12


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
