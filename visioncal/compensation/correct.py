"""Targets that make a real arm stand where it is wanted, through its nominal controller."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.calibration import Calibration
from visioncal.compensation.arms import CalibratedArm
from visioncal.errors import DataError
from visioncal.robot import Robot
from visioncal.robot.inverse import Inverse, Posture
from visioncal.transforms import invert, rotation_angle
from visioncal.types import FloatArray, Mask

# Transforms, or their (4, 4) or (m, 4, 4) matrices.
Poses: TypeAlias = FloatArray | RigidTransform

# Joints that turn farther than this from one target to the next have taken another branch, or the
# targets are no path [rad].
WIDEST_RAD = float(np.pi / 2)
# No arm reaches this far [m], and no joint of one turns this far [rad].
FAR_M, WIDE_RAD = 20.0, 4 * np.pi
# Poses come with five digits or more; a matrix that is off by more is no rotation.
_RIGID = 1e-4


@dataclass(frozen=True, eq=False)
class Corrected:
    """What to send, for m targets.

    Attributes:
        q: (m, n) joint targets [rad or m]; where `reached` is false, those that come nearest.
        base_from_flange: (m, 4, 4) Cartesian targets [m]: where the nominal controller has the
            flange at `q`.
        reached: (m,) whether the calibrated arm is at its target there, within its limits.
        off_m: (m,) distance that is left [m].
        off_rad: (m,) angle that is left [rad]. An arm of fewer than six joints reaches the
            position, and the rotation as nearly as it can.
        moved_m: (m,) distance of the Cartesian target to send from the one that is wanted [m].
        moved_rad: (m,) angle between both [rad].
        turned_rad: (m, n) how far each joint turns from where it was looked for: the row's seed, or
            the target before; zero for a prismatic joint, and for a first target without a seed.
        beyond: (m,) where a target is not reached, the joints whose limits alone are in the way.
    """

    q: FloatArray
    base_from_flange: FloatArray
    reached: Mask
    off_m: FloatArray
    off_rad: FloatArray
    moved_m: FloatArray
    moved_rad: FloatArray
    turned_rad: FloatArray
    beyond: tuple[tuple[str, ...], ...]

    def __len__(self) -> int:
        return len(self.q)


def correct(
    calibration: Calibration,
    base_from_flange: Poses,
    q_seed: FloatArray | Sequence[float] | None = None,
    *,
    widest_rad: float = WIDEST_RAD,
) -> Corrected:
    """Computes what to send to the nominal controller so that the real arm reaches targets.

    The calibrated model is inverted: its `base_from_flange(q)` is the target. Sent as joints, `q`
    is right whatever the controller believes; as a pose, it is where the nominal model has the
    flange at `q`, from which the controller finds `q` again.

    Args:
        calibration: Of a calibrated arm.
        base_from_flange: The targets, in the calibration's base [m]: (4, 4), (m, 4, 4) or
            transforms.
        q_seed: (n,) where the first is looked for, and each further one from the target before it;
            or (m, n) one a target, where a row of NaN follows the target before it [rad or m].
            Without it, the first is the posture nearest to the middle of the joints' limits.
        widest_rad: Where a joint turns farther from its seed, other branches are looked at and the
            nearest is taken [rad].

    Raises:
        DataError: The calibration has no calibrated arm, or a target or a seed is none.
    """
    arm = CalibratedArm.of(calibration)
    targets = _matrices(base_from_flange)
    first, own = _seeds(q_seed, arm.real, len(targets))
    inverse = Inverse(arm.real)
    found: list[Posture] = []
    starts = np.empty((len(targets), arm.real.joint_count))
    last = first
    for at, target in enumerate(targets):
        start = own[at] if own is not None and not np.isnan(own[at, 0]) else last
        # Without a seed any branch is as good: the one nearest to the middle is taken.
        anywhere = start is None
        starts[at] = _middle(arm.real) if start is None else start
        found.append(inverse.solve(target, starts[at], widest_rad=0.0 if anywhere else widest_rad))
        if anywhere:
            starts[at] = found[-1].q
        last = found[-1].q if found[-1].reached else start
    return _corrected(arm, targets, found, starts)


def _corrected(
    arm: CalibratedArm, targets: FloatArray, found: Sequence[Posture], starts: FloatArray
) -> Corrected:
    q = np.array([it.q for it in found]).reshape(starts.shape)
    sent = arm.nominal.base_from_flange(q)
    between = invert(targets) @ sent
    return Corrected(
        q=q,
        base_from_flange=sent,
        reached=np.array([it.reached for it in found], dtype=bool),
        off_m=np.array([it.off_m for it in found]),
        off_rad=np.array([it.off_rad for it in found]),
        moved_m=np.linalg.norm(between[:, :3, 3], axis=1),
        moved_rad=rotation_angle(between),
        turned_rad=np.where(arm.real.chain.prismatic, 0.0, np.abs(q - starts)),
        beyond=tuple(it.beyond for it in found),
    )


def _middle(robot: Robot) -> FloatArray:
    """(n,) the middle of the joints' limits; zero where there are none [rad or m]."""
    known = np.isfinite(robot.lower_rad) & np.isfinite(robot.upper_rad)
    ends = [np.where(known, it, 0.0) for it in (robot.lower_rad, robot.upper_rad)]
    return np.asarray(0.5 * (ends[0] + ends[1]))


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
    wrong = np.flatnonzero(~((off < _RIGID) & (np.linalg.det(rotations) > 0.0)))
    if len(wrong):
        raise DataError(
            f"correct: target {wrong[0]} is no rigid transform: its rotation is off by "
            f"{off[wrong[0]]:.2g}.",
            culprits=[f"target {it}" for it in wrong],
        )
    away = np.abs(matrices[:, :3, 3]).max(axis=1, initial=0.0)
    far = np.flatnonzero(~(away < FAR_M))
    if len(far):
        raise DataError(
            f"correct: target {far[0]} is {away[far[0]]:.4g} m from the base, and no arm reaches "
            f"{FAR_M:g} m.",
            culprits=[f"target {it}" for it in far],
            next_step="Positions are in metres.",
        )
    return matrices


def _seeds(
    q_seed: FloatArray | Sequence[float] | None, robot: Robot, count: int
) -> tuple[FloatArray | None, FloatArray | None]:
    """The seed (n,) of the first target, and the seeds (m, n) of all; None for none."""
    if q_seed is None:
        return None, None
    seeds = np.asarray(q_seed, dtype=float)
    size = robot.joint_count
    if seeds.shape not in ((size,), (count, size)):
        raise DataError(
            f"correct: seeds of shape ({size},) or ({count}, {size}) are needed, for the joints of "
            f"{robot.name}, not {seeds.shape}.",
        )
    turns = np.abs(seeds[..., ~robot.chain.prismatic])
    largest = float(np.nanmax(turns, initial=0.0))
    if largest > WIDE_RAD:
        raise DataError(
            f"correct: a seed has a joint at {largest:.4g} rad, more than two turns: these look "
            "like degrees.",
            next_step="Write radians.",
        )
    if seeds.ndim == 1:
        if np.isnan(seeds).any():
            raise DataError("correct: the seed has a joint that is no number.")
        return seeds, None
    return None, seeds
