"""Calibrated camera, its pose in the base with uncertainty at one stop, and planes.

Eye-in-hand, `base_from_cam = base_from_flange * flange_from_cam`: the robot's noise at the image's
stop is independent of the calibration and adds to the covariance of the camera's transform.
Eye-to-hand, `base_from_cam` is the camera's transform itself, and the robot has no part.

Where the arm was calibrated with the camera and an image's joints are known, the arm's remaining
error has the calibration's covariance, correlated with the camera's transform: the last joint's
zero, say, is in both and moves no point. Otherwise the size of the arm's errors is that which the
calibration's own stops showed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.limits import FAR_M
from visioncal.core.prediction import point_jacobian
from visioncal.core.transforms import adjoint, invert, rigid_fault, skew
from visioncal.core.types import Camera, FloatArray, Mount
from visioncal.results.arm import FUNCTIONS
from visioncal.results.content import CalibrationContent
from visioncal.results.edge import Edge
from visioncal.results.lens import CameraResult
from visioncal.robot.arm_model import ArmModel
from visioncal.robot.errors import pose_basis
from visioncal.session.frames import edge_names
from visioncal.vision.camera import intrinsics

# A transform, or its (4, 4) matrix.
Pose: TypeAlias = FloatArray | RigidTransform


@dataclass(frozen=True, eq=False)
class ArmErrors:
    """Posterior of the errors of an arm that was calibrated with the camera."""

    model: ArmModel  # The arm's model with its p error parameters.
    covariance: FloatArray  # (p, p) of the parameters.
    # (6 + k + m, p) cross-covariance with the camera's edge and lens, as in `CalibratedCamera`.
    with_camera: FloatArray

    @classmethod
    def of(cls, calibration: CalibrationContent, camera: FloatArray) -> Self | None:
        """Reads the posterior from a calibration; None where its arm was not calibrated.

        `camera` is the (6 + k + m, 6 + k + m) covariance of the camera's edge and lens.
        """
        result, fit = calibration.arm, calibration.joint_fit
        # The joint fit's covariance does not contain functions of the joints.
        if result is None or result.level == FUNCTIONS:
            return None
        if fit is None or not calibration.arm_is_calibrated:
            return None
        model = None if fit.arm is None else fit.arm.model(calibration.calibrated_robot)
        if fit.arm is None or model is None or calibration.camera is None:
            return None
        lens_size = len(intrinsics(calibration.camera.camera))
        free = [at for at in fit.looks if at < lens_size]
        # Between the camera's edge and the lens are the boards' edges.
        lens_start = 6 + 6 * len(fit.boards)
        fitted = [*range(6), *(lens_start + fit.looks.index(at) for at in free)]
        kept = [*range(6), *(6 + at for at in free)]
        arm = slice(len(fit.covariance) - len(fit.arm.values), None)
        # Parameters that were not fitted correlate with the arm only through those that were.
        gain = camera[:, kept] @ np.linalg.pinv(camera[np.ix_(kept, kept)], hermitian=True)
        return cls(model, fit.covariance[arm, arm], gain @ fit.covariance[fitted, arm])


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """Calibrated camera: lens, extrinsics, their joint covariance, and the noise levels."""

    mount: Mount  # Where it is mounted.
    # The intrinsics (k values) and the field beyond the lens model (m coefficients).
    lens: CameraResult
    edge: FloatArray  # (4, 4) `flange_from_cam` or `base_from_cam`.
    # (6 + k + m, 6 + k + m) of the edge's right perturbation and the lens together.
    covariance: FloatArray
    flange_sigmas: FloatArray  # (6,) noise of the flange at one stop, per axis [rad, m].
    # Size of posture-dependent arm errors [rad], 0.5 m of length for each radian; zero where there
    # are none.
    arm_sigma: float
    arm: ArmErrors | None  # The arm's errors, where it was calibrated with the camera.
    pixel_px: float | None  # Noise of a corner's coordinate [px]; None where unknown.
    noise_dof: float  # Degrees of freedom of the noise estimate; infinite where unknown.
    warnings: tuple[str, ...]  # Reasons not to trust the camera, in sentences.
    # (2,) least and greatest distance at which its views looked; None where unknown.
    distances_m: FloatArray | None
    calibration: CalibrationContent  # All of it.

    @classmethod
    def of(cls, calibration: CalibrationContent) -> Self:
        """Reads the camera from a calibration; raises DataError."""
        result = calibration.camera
        if result is None:
            raise DataError(
                f"calibration {calibration.session_name!r}: it holds no camera, because its "
                "session gave measured poses and no images.",
                next_step="Calibrate from images, or declare the camera in the session.",
            )
        edge = calibration.edges[edge_names(calibration.mount)[0]]
        verdict = calibration.verdict
        bad = f"The calibration's verdict is bad: {' '.join(verdict.reasons[:1])}"
        covariance = result.covariance_with(edge.covariance)
        noise, errors = calibration.noise, calibration.arm_errors
        # Robot and camera combined where they were not separable.
        source = "robot" if "robot_translation_mm" in noise else "combined"
        rotation = np.deg2rad(noise.get(f"{source}_rotation_deg", 0.0))
        translation = 1e-3 * noise.get(f"{source}_translation_mm", 0.0)
        # Without known joints, the estimated noise of the flange already contains the arm's errors.
        arm_sigma = float(np.deg2rad(errors.sigma_deg)) if errors and errors.of is None else 0.0
        return cls(
            calibration.mount,
            result,
            edge.matrix,
            covariance,
            np.repeat([rotation, translation], 3),
            arm_sigma,
            ArmErrors.of(calibration, covariance),
            noise.get("pixel_px"),
            calibration.noise_dof,
            (bad,) if verdict.status == "bad" else (),
            None if calibration.budget is None else calibration.budget.distances_m,
            calibration,
        )

    @property
    def camera(self) -> Camera:
        """The intrinsics."""
        return self.lens.camera

    @property
    def jitter(self) -> float:
        """Standard deviation of the focal length from view to view, as a share of it."""
        return 0.0 if self.lens.field is None else self.lens.field.jitter

    def noise_px(self, stated: float | None) -> float:
        """Noise of an image coordinate: the stated one, else the calibration's [px].

        Raises:
            DataError: It is negative or not finite, or neither is known.
        """
        sigma = self.pixel_px if stated is None else stated
        if sigma is None:
            raise DataError(
                "locate: the calibration does not say how noisy a pixel is.",
                next_step="State the feature's standard deviation in pixels (sigma_px).",
            )
        if not np.isfinite(sigma) or sigma < 0.0:
            raise DataError(f"locate: sigma_px is {sigma!r}, but must be a standard deviation.")
        return float(sigma)

    def at(
        self, base_from_flange: Pose | None, joints_rad: FloatArray | None = None
    ) -> "CameraPose":
        """Camera pose in the base at one pose of the flange.

        Args:
            base_from_flange: As the robot reported it when the image was taken. Ignored for a fixed
                camera.
            joints_rad: (n,) joints [rad] where the pose is the calibrated arm's for these joints.

        Raises:
            DataError: A camera on the flange needs the pose and there is none, or it is no rigid
                transform in metres.
        """
        if self.mount == "eye-to-hand":
            zero = np.zeros((6, 6))
            return CameraPose(self.edge, zero, zero, np.zeros((6, self.arm_error_count)))
        if base_from_flange is None:
            raise DataError(
                "locate: the camera is on the flange (eye-in-hand), and the robot's pose at the "
                "image is missing.",
                next_step="Give base_from_flange as the robot reported it when the image was "
                "taken: on the command line with --pose, or by a session and its --view.",
            )
        if isinstance(base_from_flange, RigidTransform):
            base_from_flange = base_from_flange.as_matrix()
        base_from_flange = np.asarray(base_from_flange, dtype=float)
        checked_pose(base_from_flange, "base_from_flange")
        return CameraPose(
            base_from_flange @ self.edge,
            adjoint(invert(self.edge)),
            self.flange_noise,
            self.arm_basis(base_from_flange, joints_rad),
        )

    @property
    def flange_noise(self) -> FloatArray:
        """(6, 6) covariance of the flange's right perturbation at one stop."""
        return np.asarray(np.diag(self.flange_sigmas**2))

    @property
    def arm_error_count(self) -> int:
        """Number of columns of `arm_basis`."""
        return self.posture_error_count + (0 if self.arm is None else len(self.arm.covariance))

    @property
    def posture_error_count(self) -> int:
        """Number of these for an arm that is not calibrated or whose joints are unknown."""
        return pose_basis(np.eye(4)[None]).shape[2] if self.arm_sigma > 0.0 else 0

    def arm_basis(
        self, base_from_flange: FloatArray, joints_rad: FloatArray | None = None
    ) -> FloatArray:
        """(6, a) Jacobian of the flange's pose by the arm's errors in `shared_covariance`.

        With known joints of a calibrated arm, by its error parameters. Otherwise by generic
        posture-dependent errors (`estimation.arm.pose_basis`), taken as independent of those in the
        calibration: the camera's transform has absorbed an unknown part of them.
        """
        basis, postures = np.zeros((6, self.arm_error_count)), self.posture_error_count
        if self.arm is not None and joints_rad is not None:
            basis[:, postures:] = self.arm.model.basis_without_harmonics(joints_rad[None])[0]
        elif postures:
            basis[:, :postures] = self.arm_sigma * pose_basis(base_from_flange[None])[0]
        return basis

    @property
    def shared_covariance(self) -> FloatArray:
        """Covariance of the common errors of all images: camera, lens, arm; (6 + k + m + a,)^2."""
        camera, size = len(self.covariance), len(self.covariance) + self.arm_error_count
        covariance = np.eye(size)
        covariance[:camera, :camera] = self.covariance
        if self.arm is not None:
            arm = slice(camera + self.posture_error_count, size)
            covariance[arm, arm] = self.arm.covariance
            covariance[:camera, arm] = self.arm.with_camera
            covariance[arm, :camera] = self.arm.with_camera.T
        return covariance


@dataclass(frozen=True, eq=False)
class CameraPose:
    """Camera pose in the base at one stop, and its dependence on the flange."""

    base_from_cam: FloatArray  # (4, 4).
    # (6, 6) its right perturbation by the flange's; zero for a fixed camera.
    flange_jacobian: FloatArray
    flange_noise: FloatArray  # (6, 6) covariance of the flange's noise.
    arm_basis: FloatArray  # (6, a) see `CalibratedCamera.arm_basis`.

    def point(self, point_cam: FloatArray) -> FloatArray:
        """(3,) position in the base of a point in the camera's frame [m]."""
        return np.asarray(self.base_from_cam[:3, :3] @ point_cam + self.base_from_cam[:3, 3])

    def camera_jacobian(self, point_cam: FloatArray) -> FloatArray:
        """(3, 6) Jacobian of a camera-fixed point in the base by the camera's perturbation."""
        return point_jacobian(self.base_from_cam, point_cam)


def checked_pose(pose: FloatArray, name: str) -> None:
    """Checks that a matrix is a (4, 4) pose in metres; raises DataError."""
    if fault := rigid_fault(pose):
        raise DataError(f"{name}: not a (4, 4) rigid transform: {fault}.", culprits=[name])
    length = float(np.linalg.norm(pose[:3, 3]))
    if length > FAR_M:
        raise DataError(
            f"{name}: its offset is {length:.4g} m long, more than any arm reaches ({FAR_M:g} m).",
            culprits=[name],
            next_step="It looks like millimetres: multiply it by 0.001.",
        )


def checked_point(point_target_m: FloatArray | Sequence[float]) -> FloatArray:
    """Checks that an array is a point of a target in metres.

    Returns:
        (3,) the point [m].

    Raises:
        DataError: It is not three finite numbers, or is farther off than any arm reaches.
    """
    point, name = np.asarray(point_target_m, dtype=float), "point_target_m"
    if point.shape != (3,) or not np.isfinite(point).all():
        seen = f"is {point.tolist()}" if point.shape == (3,) else f"has the shape {point.shape}"
        raise DataError(f"{name} {seen}, but must be three numbers [m].", culprits=[name])
    if np.abs(point).max() > FAR_M:
        raise DataError(
            f"{name} is {point.tolist()}, and no arm reaches farther than {FAR_M:g} m.",
            culprits=[name],
            next_step="It looks like millimetres: multiply it by 0.001.",
        )
    return point


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane in the base: `normal . p = offset`."""

    normal: FloatArray  # (3,) of unit length.
    offset_m: float  # Its distance from the base's origin along the normal [m].
    covariance: FloatArray  # (4, 4) of normal and offset.

    @classmethod
    @typed
    def horizontal(cls, z_m: float, sigma_m: float = 0.0) -> Self:
        """The plane `z = z_m` of the base, with the height's standard deviation `sigma_m` [m]."""
        return cls.through(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, z_m]), sigma_m)

    @classmethod
    @typed
    def through(cls, normal: FloatArray, point: FloatArray, sigma_m: float = 0.0) -> Self:
        """The plane with a given normal through a point.

        Args:
            normal: (3,) of any length but zero.
            point: (3,) in the base [m].
            sigma_m: Standard deviation of its offset along the normal [m].

        Raises:
            DataError: The normal has no direction, or a number is not finite or farther than any
                arm reaches.
        """
        for name, array in (("normal", normal), ("point", point)):
            if np.shape(array) != (3,):
                raise DataError(f"plane: the {name} is {array!r}, but must be three numbers.")
        length = float(np.linalg.norm(normal))
        if not np.isfinite(length) or length < 1e-9:
            raise DataError(
                f"plane: the normal {np.asarray(normal).tolist()} has no direction.",
                next_step="Give one of any length but zero; 0,0,1 is upward in the base.",
            )
        unit = np.asarray(normal, dtype=float) / length
        return cls(unit, _length(float(unit @ point)), _offset_covariance(sigma_m))

    @classmethod
    @typed
    def of_frame(cls, edge: Edge, z_m: float = 0.0, sigma_m: float = 0.0) -> Self:
        """The plane `z = z_m` of a frame in the base, such as a fixture.

        The frame is taken as independent of the calibration. Where this same camera has placed it,
        the shared errors are counted twice.

        Args:
            edge: `base_from_fixture`, with its covariance.
            z_m: Height of the plane in the frame [m].
            sigma_m: Standard deviation of that height [m].
        """
        rotation, origin = edge.matrix[:3, :3], edge.matrix[:3, 3]
        normal = rotation[:, 2]
        # A perturbation (w, v) of the frame turns its normal by w x z and shifts its origin by v.
        by_rotation = -rotation @ skew(np.array([0.0, 0.0, 1.0]))
        jacobian = np.zeros((4, 6))
        jacobian[:3, :3] = by_rotation
        jacobian[3, :3] = origin @ by_rotation
        jacobian[3, 3:] = normal @ rotation
        offset = float(normal @ origin) + _length(z_m)
        covariance = jacobian @ edge.covariance @ jacobian.T + _offset_covariance(sigma_m)
        return cls(normal, _length(offset), covariance)


def _length(value_m: float) -> float:
    if not np.isfinite(value_m) or abs(value_m) > FAR_M:
        raise DataError(
            f"plane: it lies {value_m:.4g} m from the base's origin, and no arm reaches farther "
            f"than {FAR_M:g} m.",
            next_step="Give the plane in metres.",
        )
    return value_m


def _offset_covariance(sigma_m: float) -> FloatArray:
    if not np.isfinite(sigma_m) or sigma_m < 0.0:
        raise DataError(
            f"plane: sigma_m is {sigma_m!r}, but must be a standard deviation.",
            culprits=["sigma_m"],
            next_step="Give how well its height is known, 0 or more.",
        )
    return np.diag([0.0, 0.0, 0.0, sigma_m**2])
