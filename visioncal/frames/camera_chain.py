"""The calibrated chain from the base to the camera, and its uncertainty at one stop.

Eye-in-hand, `base_from_cam = base_from_flange * flange_from_cam`: the robot's noise at the stop
where the image was taken is new, and adds to the camera's transform. Eye-to-hand,
`base_from_cam` is the camera's transform itself, and no robot stands between.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.errors import DataError
from visioncal.core.transforms import adjoint, invert, rigid_fault, skew
from visioncal.core.types import Camera, FloatArray, Mount
from visioncal.estimation.arm import pose_basis
from visioncal.estimation.chain import edge_names
from visioncal.results import Calibration, CameraResult

# A transform, or its (4, 4) matrix.
Pose: TypeAlias = FloatArray | RigidTransform

# No arm reaches this far [m]: such numbers are in millimetres.
FAR_M = 20.0


@dataclass(frozen=True, eq=False)
class Eye:
    """A calibrated camera as it is used: its lens, its place, and the covariance of both.

    Attributes:
        mount: Where it is mounted.
        lens: The intrinsics, k values, and m coefficients of what the lens does beyond its model.
        edge: (4, 4) `flange_from_cam` or `base_from_cam`.
        covariance: (6 + k + m,) squared, of the edge's right perturbation and the lens together.
        flange_sigmas: (6,) noise of the flange at one stop, per axis [rad, m].
        arm_sigma: Size of errors that follow the arm's posture [rad], 0.5 m of length for each
            radian; zero where there are none.
        pixel_px: Noise of a corner's coordinate [px]; None where the calibration does not say.
        freedom: Degrees of freedom that the noise was estimated with, infinite where not said.
        warnings: Why not to trust it, in sentences.
    """

    mount: Mount
    lens: CameraResult
    edge: FloatArray
    covariance: FloatArray
    flange_sigmas: FloatArray
    arm_sigma: float
    pixel_px: float | None
    freedom: float
    warnings: tuple[str, ...]

    @classmethod
    def of(cls, calibration: Calibration) -> Self:
        """Takes from a calibration what a look through its camera needs.

        Raises:
            DataError: The calibration has no camera: it was made from measured poses.
        """
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
        return cls(
            calibration.mount,
            result,
            edge.matrix,
            result.covariance_with(edge.covariance),
            _flange_sigmas(calibration),
            _arm_sigma(calibration),
            calibration.noise.get("pixel_px"),
            calibration.noise_dof,
            (bad,) if verdict.status == "bad" else (),
        )

    @property
    def camera(self) -> Camera:
        """The intrinsics."""
        return self.lens.camera

    @property
    def breathes(self) -> bool:
        """Whether the focal length follows the distance."""
        return self.lens.field is not None and self.lens.field.breathing > 0.0

    @property
    def jitter(self) -> float:
        """Standard deviation of the focal length from view to view, as a share of it."""
        return 0.0 if self.lens.field is None else self.lens.field.jitter

    def noise_px(self, stated: float | None) -> float:
        """The noise of a coordinate in the image: the stated one, or the calibration's [px].

        Raises:
            DataError: It is not positive, or neither is known.
        """
        sigma = self.pixel_px if stated is None else stated
        if sigma is None:
            raise DataError(
                "locate: the calibration does not say how noisy a pixel is.",
                next_step="State the feature's standard deviation in pixels (sigma_px).",
            )
        if not np.isfinite(sigma) or sigma < 0.0:
            raise DataError(f"locate: sigma_px is {sigma!r}; a standard deviation is needed.")
        return float(sigma)

    def at(self, base_from_flange: Pose | None) -> "ChainStop":
        """The chain while the flange stands somewhere.

        Args:
            base_from_flange: As the robot reported it when the image was taken. A camera that
                stands still needs none, and takes no notice of one.

        Raises:
            DataError: A camera on the flange needs the pose and there is none, or it is no rigid
                transform in metres.
        """
        if self.mount == "eye-to-hand":
            return ChainStop(self.edge, np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 0)))
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
        return ChainStop(
            base_from_flange @ self.edge,
            adjoint(invert(self.edge)),
            self.flange_noise,
            self.arm_basis(base_from_flange),
        )

    @property
    def flange_noise(self) -> FloatArray:
        """(6, 6) covariance of the flange's right perturbation at one stop."""
        return np.asarray(np.diag(self.flange_sigmas**2))

    def arm_basis(self, base_from_flange: FloatArray) -> FloatArray:
        """(6, p) how the flange errs with the arm's posture, by p independent errors of size one.

        By the shape of any arm's errors (`estimation.arm.pose_basis`), as independent of those that
        the calibration met: the camera's transform has taken a part of them up, and nothing says
        which. Without such errors p is zero.
        """
        basis = pose_basis(base_from_flange[None])[0]
        return np.asarray(self.arm_sigma * basis[:, : basis.shape[1] * (self.arm_sigma > 0.0)])


@dataclass(frozen=True, eq=False)
class ChainStop:
    """The chain while the flange stands at one place.

    Attributes:
        base_from_cam: (4, 4).
        flange_jacobian: (6, 6) how it moves, on its right, with the flange; zero for a camera that
            stands still.
        flange_noise: (6, 6) covariance of the flange by its noise.
        arm_basis: (6, p) how the flange errs with the arm's posture; see `Eye.arm_basis`.
    """

    base_from_cam: FloatArray
    flange_jacobian: FloatArray
    flange_noise: FloatArray
    arm_basis: FloatArray

    def point(self, point_cam: FloatArray) -> FloatArray:
        """(3,) a point of the camera's frame in the base [m]."""
        return np.asarray(self.base_from_cam[:3, :3] @ point_cam + self.base_from_cam[:3, 3])

    def by_camera(self, point_cam: FloatArray) -> FloatArray:
        """(3, 6) how a point that is fixed to the camera moves with the camera's perturbation."""
        return point_slope(self.base_from_cam, point_cam)


def point_slope(a_from_b: FloatArray, point_b: FloatArray) -> FloatArray:
    """(3, 6) how a point fixed in b moves in a with the right perturbation of `a_from_b`."""
    return np.asarray(a_from_b[:3, :3] @ np.concatenate([-skew(point_b), np.eye(3)], axis=1))


def checked_pose(pose: FloatArray, name: str) -> None:
    """Refuses what is no pose in metres.

    Raises:
        DataError: It is no (4, 4) rigid transform, or it lies farther off than any arm reaches.
    """
    fault, step = (f"its shape is {pose.shape}", "") if pose.shape != (4, 4) else rigid_fault(pose)
    if fault:
        raise DataError(
            f"{name}: not a (4, 4) rigid transform: {fault}.", culprits=[name], next_step=step
        )
    length = float(np.linalg.norm(pose[:3, 3]))
    if length > FAR_M:
        raise DataError(
            f"{name}: its offset is {length:.4g} m long, more than any arm reaches ({FAR_M:g} m).",
            culprits=[name],
            next_step="It looks like millimetres: multiply it by 0.001.",
        )


def checked_point(point_m: FloatArray | Sequence[float], name: str) -> FloatArray:
    """Refuses what is no point in metres.

    Returns:
        (3,) the point [m].

    Raises:
        DataError: It is no three finite numbers, or farther off than any arm reaches.
    """
    point = np.asarray(point_m, dtype=float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise DataError(f"{name} is {point.tolist()}; three metres are needed.", culprits=[name])
    if np.abs(point).max() > FAR_M:
        raise DataError(
            f"{name} is {point.tolist()}, and no arm reaches farther than {FAR_M:g} m.",
            culprits=[name],
            next_step="It looks like millimetres: multiply it by 0.001.",
        )
    return point


def _flange_sigmas(calibration: Calibration) -> FloatArray:
    """The flange's noise; of both together where it could not be separated from the camera's."""
    noise = calibration.noise
    of = "robot" if "robot_translation_mm" in noise else "combined"
    rotation = np.deg2rad(noise.get(f"{of}_rotation_deg", 0.0))
    translation = 1e-3 * noise.get(f"{of}_translation_mm", 0.0)
    return np.repeat([rotation, translation], 3)


def _arm_sigma(calibration: Calibration) -> float:
    found = calibration.arm_errors
    # Where joints are not known, the flange's noise is that of single looks, all of them in it.
    return float(np.deg2rad(found.sigma_deg)) if found and found.of is None else 0.0
