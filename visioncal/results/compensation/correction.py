"""Nominal and calibrated model of an arm, and correction of its targets."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self, TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.arguments import typed
from visioncal.core.choices import WIDEST_RAD as WIDEST_RAD
from visioncal.core.errors import DataError
from visioncal.core.limits import FAR_M, WIDE_RAD
from visioncal.core.number_format import figure
from visioncal.core.transforms import compose, invert, nearest_rotation, rigid_fault, rotation_angle
from visioncal.core.types import FloatArray, Mask
from visioncal.results import Calibration
from visioncal.results.arm import ArmResult, WorkspacePlace
from visioncal.robot import Loads, Robot
from visioncal.robot.elasticity import joint_deflections
from visioncal.robot.inverse import Inverse, Posture
from visioncal.session.selecting import ARM, Choice

# Transforms, or their (4, 4) or (m, 4, 4) matrices.
Poses: TypeAlias = FloatArray | RigidTransform

# Smallest number of joints that reach any position.
_LEAST_JOINTS = 3
# Beyond half as much again as was seen, loads and rises of temperature are extrapolated: postures
# of targets differ from those of stops by less.
_BEYOND = 1.5


@dataclass(frozen=True, eq=False)
class CalibratedArm:
    """Nominal and calibrated model of an arm, prepared for `correct`.

    In a loop, prepare it once for each thread.
    """

    nominal: Robot  # The controller's model.
    real: Robot  # The calibrated model.
    inverse: Inverse  # Inverse kinematics of the calibrated arm without a load.
    compliance: FloatArray  # (n,) compliance of its joints [rad/(N m)].
    # (n, 4 n) compliance times unknown masses and first moments of the links; None where the masses
    # are known (see `deflected_joints`).
    weight_moments: FloatArray | None

    @classmethod
    @typed
    def of(cls, calibration: Calibration, *, or_nominal: bool = False) -> Self:
        """Reads both models from a calibration; raises DataError.

        With `or_nominal`, the arm may be the controller's own.
        """
        nominal, real = calibration.robot, calibration.calibrated_robot
        is_known = or_nominal or calibration.arm_is_calibrated
        if nominal is None or real is None or not is_known:
            name = calibration.session_name
            if calibration.arm is None:
                raise DataError(
                    f"calibration {name!r} has no calibrated arm: its session had no joint angles "
                    "of every view or no known robot model, or it was made with --level hand-eye.",
                    next_step="Record q1_rad ... with every view, name the arm in [robot] model, "
                    "and calibrate with --level auto or kinematics.",
                )
            raise DataError(
                f"calibration {name!r} has no calibrated arm (level {calibration.arm.level}): its "
                "views do not distinguish the arm from its nominal model, so there is nothing to "
                "correct.",
                next_step="Send the targets as they are; or calibrate with more views, all over "
                "the workspace.",
            )
        if real.joint_count < _LEAST_JOINTS:
            raise DataError(
                f"robot {real.name} has {real.joint_count} joints, but must have {_LEAST_JOINTS} "
                "to reach a position.",
                culprits=[real.name],
            )
        return cls(nominal, real, Inverse(real), calibration.compliance, calibration.weight_moments)

    @typed
    def unbent(self, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """Encoder angles that compensate the joints' deflection under load.

        Args:
            q: (m, n) angles of the arm without deflection [rad].
            loads: Loads on the flange; the arm's own weight alone where None.

        Returns:
            (m, n) encoder angles [rad].
        """
        if not self.compliance.any() and self.weight_moments is None:
            return q
        return np.asarray(
            q - joint_deflections(self.real, q, self.compliance, loads, self.weight_moments)
        )


def predicted_sigma_mm(
    calibration: Calibration,
    p_base: FloatArray,
    q: FloatArray | None = None,
    *,
    loads: Loads | None = None,
    links_c: FloatArray | None = None,
) -> FloatArray:
    """Predicted sigma of the calibrated arm at positions of the flange.

    Args:
        calibration: Of a calibrated arm.
        p_base: (m, 3) positions of the flange [m].
        q: (m, n) joints [rad or m]; None where unknown.
        loads: Loads there: by their torques, uncertain compliances add to the sigma.
        links_c: (n,) temperatures of the links [deg C], by whose rise uncertain drift adds.

    Returns:
        (m,) root of the trace of a position's covariance [mm], interpolated from the map of
        measured postures where `q` is within their joint ranges, else from the workspace's map;
        without maps the workspace's median, or NaN.
    """
    squares = _of_map_mm(calibration.arm, p_base, q) ** 2
    real = calibration.calibrated_robot
    if q is not None and real is not None and loads is not None and calibration.elastic is not None:
        tool_m = next(
            (
                edge.matrix[:3, 3]
                for name, edge in calibration.edges.items()
                if name.startswith("flange_from_")
            ),
            np.zeros(3),
        )
        turning, shifting = np.split(np.swapaxes(real.axis_jacobian(q), 1, 2), 2, axis=2)
        moves = shifting + np.cross(turning, tool_m)
        added = real.load_torques(q, loads) - real.load_torques(q)
        turns = 1e3 * added * calibration.elastic.sigmas
        squares += np.sum((moves * turns[:, :, None]) ** 2, axis=(1, 2))
    if q is not None and links_c is not None:
        squares += (1e3 * calibration.drift.sigma_m(q, links_c)) ** 2
    return np.asarray(np.sqrt(squares))


def unseen(
    calibration: Calibration, q: FloatArray, loads: Loads, links_c: FloatArray | None
) -> Iterator[str]:
    """Loads and temperatures at (m, n) joints that are far from all of the calibration, in words.

    See `predicted_sigma_mm`.
    """
    elastic, real = calibration.elastic, calibration.calibrated_robot
    if elastic is not None and real is not None and loads.any:
        borne = np.abs(real.load_torques(q, loads)).max(axis=0)
        seen = np.array([max(map(abs, joint.torque_nm)) for joint in elastic.joints])
        over = (borne - _BEYOND * seen) * (elastic.compliance + elastic.sigmas)
        at = int(np.argmax(over))
        if over[at] > 0.0:
            # Ten times as much as was seen is no load of the same arm.
            unit = "kilograms, and the centre in metres? " * bool(
                borne.max() > 10.0 * elastic.most_nm
            )
            yield (
                f"The payload is beyond what the calibration has seen: {elastic.joints[at].joint} "
                f"bears up to {figure(borne[at])} N m at the targets, and bore up to "
                f"{figure(seen[at])} N m at the stops. {unit[:1].upper()}{unit[1:]}How it yields "
                "there is extrapolated: calibrate under the load of the work."
            )
    if links_c is not None and calibration.thermal is not None:
        least, most = calibration.thermal.seen_c
        margin = (_BEYOND - 1.0) * (most - least)
        far = max(links_c.tolist(), key=lambda at: abs(at - 0.5 * (least + most)))
        if not least - margin <= far <= most + margin:
            celsius = (far - 32.0) / 1.8
            unit = f"Fahrenheit ({figure(celsius)} deg C)? " * bool(
                least - margin <= celsius <= most + margin
            )
            yield (
                f"{figure(far)} deg C is beyond what the calibration has seen: links at "
                f"{figure(least)} to {figure(most)} deg C. {unit}Their drift there is "
                "extrapolated: calibrate up to the temperatures of the work."
            )


def _of_map_mm(arm: ArmResult | None, p_base: FloatArray, q: FloatArray | None) -> FloatArray:
    """(m,) sigmas [mm] without loads, at the temperatures of the calibration."""
    if arm is None or not arm.workspace_map:
        sigma = None if arm is None else arm.workspace_sigma_mm
        return np.full(len(p_base), np.nan if sigma is None else sigma.median)
    sigma_mm = _interpolated(p_base, arm.workspace_map)
    if q is None or not arm.measured_map:
        return sigma_mm
    lower, upper = np.array([(joint.lower, joint.upper) for joint in arm.measured]).T
    # Random stops seldom reach the ends.
    margin = 0.05 * (upper - lower)
    measured = np.all((lower - margin <= q) & (q <= upper + margin), axis=1)
    return np.where(measured, _interpolated(p_base, arm.measured_map), sigma_mm)


def _interpolated(p_base: FloatArray, rows: Sequence[WorkspacePlace]) -> FloatArray:
    """(m,) sigmas [mm] at (m, 3) positions [m], by inverse squared distance to a map's nearest."""
    positions = np.array([(row.x_m, row.y_m, row.z_m) for row in rows])
    distances = np.linalg.norm(p_base[:, None] - positions, axis=2)
    near = np.argsort(distances, axis=1)[:, :4]
    # Limits the weight at a position of the map itself.
    weights = 1.0 / np.maximum(np.take_along_axis(distances, near, axis=1), 1e-6) ** 2
    sigmas = np.array([row.sigma_mm for row in rows])[near]
    return np.asarray((weights * sigmas).sum(axis=1) / weights.sum(axis=1))


@dataclass(frozen=True, eq=False)
class Corrected:
    """Corrected commands for m targets."""

    wanted: FloatArray  # (m, 4, 4) the targets of the flange [m].
    q: FloatArray  # (m, n) joint targets [rad or m]; where `reached` is false, the nearest ones.
    base_from_flange: FloatArray  # (m, 4, 4) Cartesian targets [m]: the nominal flange pose at `q`.
    reached: Mask  # (m,) whether the calibrated arm reaches its target within its limits.
    off_m: FloatArray  # (m,) remaining distance [m].
    # (m,) remaining angle [rad]. An arm of fewer than six joints reaches the position, and the
    # rotation as nearly as it can.
    off_rad: FloatArray
    # (m, n) rotation of each joint from its seed, or else from the target before; zero for a
    # prismatic joint, and for a first target without a seed.
    turned_rad: FloatArray

    def __len__(self) -> int:
        return len(self.q)

    @property
    def moved_m(self) -> FloatArray:
        """(m,) distance between commanded and wanted flange position [m]."""
        shift = self.base_from_flange[:, :3, 3] - self.wanted[:, :3, 3]
        return np.asarray(np.linalg.norm(shift, axis=1))

    @property
    def moved_rad(self) -> FloatArray:
        """(m,) angle between commanded and wanted orientation [rad]."""
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
    """Computes the commands for the nominal controller with which the real arm reaches targets.

    The calibrated model is inverted: its `base_from_flange(q)` is the target. Joint commands `q`
    are right for any controller model; Cartesian commands are the nominal flange pose at `q`, from
    which the controller computes `q` again.

    Args:
        calibration: Of a calibrated arm; or that arm, prepared once by `CalibratedArm.of`.
        base_from_flange: The targets, in the calibration's base [m]: (4, 4), (m, 4, 4) or
            transforms.
        q_seed: (n,) start of the search for the first target, further ones start from the target
            before; or (m, n) a start for each target, where a row of NaN starts from the target
            before [rad or m]. Without it, the first posture is that nearest to the middle of the
            joints' limits.
        widest_rad: Rotation of a joint from its seed beyond which the nearest of all branches of
            the inverse kinematics is taken [rad].
        loads: Loads on the flange at each target, for an arm with joint compliance (`Loads.alike`);
            its own weight alone where None.
        robot: Name of the robot in a whole cell's calibration.

    Raises:
        DataError: The calibration has no calibrated arm, or a target or a seed is invalid.
    """
    arm = calibration
    if isinstance(arm, Calibration):
        arm = CalibratedArm.of(arm.chosen(Choice(robot=robot), ARM))
    wanted = _matrices(base_from_flange)
    given_seeds = _seeds(q_seed, arm.real, len(wanted))
    chain, inverse = arm.real.chain, arm.inverse
    seeds = chain.effective(given_seeds)
    seeded = np.asarray(np.isfinite(given_seeds).all(axis=1))
    # Without a seed, the branch nearest to the middle of the limits is taken.
    limited = np.isfinite(arm.real.lower_rad) & np.isfinite(arm.real.upper_rad)
    ends = [np.where(limited, each, 0.0) for each in (arm.real.lower_rad, arm.real.upper_rad)]
    middle = chain.effective((0.5 * (ends[0] + ends[1]))[None])[0]
    previous: FloatArray | None = None
    postures: list[Posture] = []
    starts = np.empty_like(seeds)
    for at, target in enumerate(wanted):
        start = seeds[at] if seeded[at] else previous
        begin, widest = (middle, 0.0) if start is None else (start, widest_rad)
        posture = inverse.solve(target, begin, widest_rad=widest)
        postures.append(posture)
        starts[at] = posture.positions if start is None else start
        previous = posture.positions if posture.reached else start
    positions = np.array([posture.positions for posture in postures]).reshape(seeds.shape)
    q = arm.unbent(chain.encoded(positions), loads)
    return Corrected(
        wanted=wanted,
        q=q,
        base_from_flange=arm.nominal.base_from_flange(q),
        reached=np.array([posture.reached for posture in postures], dtype=bool),
        off_m=np.array([posture.off_m for posture in postures]),
        off_rad=np.array([posture.off_rad for posture in postures]),
        turned_rad=np.where(chain.prismatic, 0.0, np.abs(positions - starts)),
    )


def _matrices(poses: Poses) -> FloatArray:
    """(m, 4, 4) the checked targets."""
    given = poses.as_matrix() if isinstance(poses, RigidTransform) else poses
    matrices = np.asarray(given, dtype=float)
    matrices = matrices[None] if matrices.ndim == 2 else matrices
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
        raise DataError(
            f"correct: targets have the shape {np.shape(given)}, but must have (m, 4, 4)."
        )
    for at, matrix in enumerate(matrices):
        if fault := rigid_fault(matrix):
            raise DataError(
                f"correct: target {at} must be a rigid transform, but {fault}.",
                culprits=[f"target {at}"],
            )
        extent_m = np.abs(matrix[:3, 3]).max()
        if extent_m >= FAR_M:
            raise DataError(
                f"correct: target {at} is {extent_m:.4g} m from the base, and no arm reaches "
                f"{FAR_M:g} m.",
                culprits=[f"target {at}"],
                next_step="Positions are in metres.",
            )
    # Matrices written with few digits are made orthonormal.
    rotations = matrices[:, :3, :3]
    off = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3))
    if off.max(initial=0.0) > 1e-12:
        return compose(nearest_rotation(rotations), matrices[:, :3, 3])
    return matrices


def _seeds(q_seed: FloatArray | Sequence[float] | None, robot: Robot, count: int) -> FloatArray:
    """(m, n) seeds of all targets; NaN where the search starts from the target before."""
    size = robot.joint_count
    if q_seed is None:
        return np.full((count, size), np.nan)
    seeds = np.asarray(q_seed, dtype=float)
    if seeds.shape not in ((size,), (count, size)):
        raise DataError(
            f"correct: seeds must have the shape ({size},) or ({count}, {size}), for the joints of "
            f"{robot.name}, not {seeds.shape}."
        )
    if seeds.ndim == 1:
        if not np.isfinite(seeds).all():
            raise DataError("correct: each joint of the seed must be a finite number.")
        seeds = np.concatenate([seeds[None], np.full((max(count - 1, 0), size), np.nan)])[:count]
    turns = np.abs(seeds[:, ~robot.chain.prismatic])
    if (turns > WIDE_RAD).any():
        raise DataError(
            f"correct: a seed has a joint at {np.nanmax(turns):.4g} rad, more than two turns: "
            "these look like degrees.",
            next_step="Write radians.",
        )
    return seeds
