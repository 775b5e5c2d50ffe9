"""The two models of one arm that a calibration holds, and what it says of their use."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.results import Calibration
from visioncal.results.arm import WorkspacePlace
from visioncal.robot import Loads, Robot, bends
from visioncal.robot.inverse import Inverse

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
