"""Pose of a target on a tool or fixture, estimated from images of a calibrated camera."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import adjoint, compose, invert, pose_difference
from visioncal.core.types import FloatArray, Mask, Target
from visioncal.frames.camera_chain import CalibratedCamera
from visioncal.frames.image_outliers import CandidateViews, ImageInliers, find_inliers
from visioncal.frames.single_view import (
    Parent,
    Sight,
    all_places,
    check_labels,
    common_covariance,
    needs_robot,
)
from visioncal.frames.target_in_image import PoseCandidates, target_pose_candidates
from visioncal.results import Calibration, Edge
from visioncal.vision.targets import load_target

# Significance of images that scatter more than the noise.
_FALSE_ALARM = 1e-4


@dataclass(frozen=True, eq=False)
class TargetPose:
    """Pose of a target on a tool or fixture, estimated from images."""

    matrix: FloatArray  # (4, 4) `parent_from_target`.
    # (6, 6) covariance of its right perturbation by errors that average out over images: the pixels
    # and, where it is between, the robot.
    independent: FloatArray
    # (6, 6) covariance by errors that all images share: the camera's transform, its lens, the
    # target's size, the arm's errors.
    common: FloatArray
    labels: tuple[str, ...]  # (m,) the images.
    inliers: Mask  # (m,) inlier mask; outliers are not used.
    away_mm: FloatArray  # (m,) distance of each image's pose from the mean [mm].
    away_deg: FloatArray  # (m,) the same in rotation [deg].
    # Ratio of the images' scatter to the calibration's noise, at least one; its square scales
    # `independent`.
    scatter: float
    warnings: tuple[str, ...]  # Sentences.

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) of the right perturbation (rotation [rad], translation [m])."""
        return self.independent + self.common

    @property
    def edge(self) -> Edge:
        """The transform with its covariance."""
        return Edge(self.matrix, self.covariance)

    def at(self, point_m: FloatArray) -> Self:
        """Pose of the frame with the target's axes and its origin at a point (3,) of it [m]."""
        target_from_point = compose(np.eye(3), point_m)
        transport = adjoint(invert(target_from_point))
        return replace(
            self,
            matrix=self.matrix @ target_from_point,
            independent=transport @ self.independent @ transport.T,
            common=transport @ self.common @ transport.T,
        )

    @property
    def rms_mm(self) -> float:
        """Root mean square distance of the inlier images from their mean [mm]."""
        return float(np.sqrt(np.mean(self.away_mm[self.inliers] ** 2)))

    @property
    def rms_deg(self) -> float:
        """The same in rotation [deg]."""
        return float(np.sqrt(np.mean(self.away_deg[self.inliers] ** 2)))


@typed
def place_seen(
    calibration: Calibration,
    sights: Sequence[Sight],
    target: Target | Path | str,
    parent: Parent,
    *,
    sigma_px: float | None = None,
) -> TargetPose:
    """Estimates the pose of a target on a fixture in the base, or on a tool on the flange.

    The images are averaged, weighted by their independent errors, and outliers are left out and
    named. Common errors add to the covariance in full.

    Args:
        calibration: The camera's.
        sights: The images; a single one is not checked by anything.
        target: The target, or its name or file as `load_target` takes it.
        parent: `base` for a fixture, `flange` for a tool.
        sigma_px: Noise of a corner's coordinate [px]; the calibration's where None.

    Raises:
        DataError: There is no camera, an image does not show the target, or a pose of the robot is
            needed and missing.
    """
    check_labels(sights)
    eye = CalibratedCamera.of(calibration)
    board = target if isinstance(target, Target) else load_target(target)
    looks = [
        target_pose_candidates(eye, sight.seen, board, sight.label, sigma_px) for sight in sights
    ]
    return place_target(eye, sights, looks, parent)


def place_target(
    eye: CalibratedCamera, sights: Sequence[Sight], looks: Sequence[PoseCandidates], parent: Parent
) -> TargetPose:
    """Estimates a target's pose from its candidate poses in the images; see `place_seen`."""
    views = all_places(eye, sights, looks, parent)
    common = common_covariance(eye, looks[0].scale_sigma)
    stops = len({sight.stop_key for sight in sights}) if needs_robot(eye, parent) else None
    fit = find_inliers(CandidateViews(views, eye.flange_noise, common, eye.noise_dof))
    labels = tuple(sight.label for sight in sights)
    return TargetPose(
        fit.mean.matrix,
        fit.variance * fit.mean.independent,
        fit.mean.by_common @ common @ fit.mean.by_common.T,
        labels,
        fit.inliers,
        1e3 * np.linalg.norm(fit.residuals[:, 3:], axis=1),
        np.rad2deg(np.linalg.norm(fit.residuals[:, :3], axis=1)),
        float(np.sqrt(fit.variance)),
        (
            *eye.warnings,
            *(words for look in looks for words in look.warnings),
            *inlier_warnings(fit, labels, looks, stops),
        ),
    )


def inlier_warnings(
    fit: ImageInliers,
    labels: Sequence[str],
    looks: Sequence[PoseCandidates],
    stops: int | None,
    thing: str = "target",
) -> Iterator[str]:
    """Warnings on the inliers of a target's images.

    `stops` is the number of the robot's stops, None where the robot is not between.
    """
    count = len(labels)
    for at in np.flatnonzero(~fit.inliers).tolist():
        yield (
            f"{labels[at]} puts the {thing} {_distance_words(fit, at)} from where the others do, "
            "and was left out: was it moved, or is the robot's pose that of another image?"
        )
    inliers = int(fit.inliers.sum())
    if count == 1:
        yield (
            f"One image places the {thing}: nothing checks it. Take another"
            f"{', from another side' if stops else ''}."
        )
    elif stops == 1:
        yield (
            f"All {count} images are of one stop of the robot, whose error they share: nothing "
            "checks it. Take others, from other sides."
        )
    elif fit.inliers.all() and np.any(fit.mahalanobis_sq > fit.limit):
        # Images were kept although they contradict each other.
        worst = int(np.where(fit.inliers, fit.mahalanobis_sq, -1.0).argmax())
        yield (
            f"The images disagree, by up to {_distance_words(fit, worst)}, and with {count} of "
            "them it is not known which are right: take more."
        )
    elif fit.variance * 6 * (inliers - 1) > chi2_limit(_FALSE_ALARM, 6 * (inliers - 1)):
        yield (
            f"The images scatter {figure(np.sqrt(fit.variance))} times as much as the "
            "calibration's noise lets them; the sigmas are that much larger."
        )
    if fit.rival is not None:
        yield _ambiguity_warning(fit, looks, thing)


def _distance_words(fit: ImageInliers, at: int) -> str:
    residual = fit.residuals[at]
    millimetres = 1e3 * float(np.linalg.norm(residual[3:]))
    degrees = float(np.rad2deg(np.linalg.norm(residual[:3])))
    return mm_and_deg(millimetres, degrees)


def _ambiguity_warning(fit: ImageInliers, looks: Sequence[PoseCandidates], thing: str) -> str:
    rival = np.eye(4) if fit.rival is None else fit.rival
    millimetres, degrees = pose_difference(fit.mean.matrix, rival)
    shift = f"{mm_and_deg(millimetres, degrees)} away"
    if any(len(set(look.symmetries)) > 1 for look in looks):
        return (
            f"The {thing} looks the same when it is turned: it may as well be {shift}. Use a board "
            "without symmetry, or see to it that it is not turned."
        )
    return (
        f"Seen so flat, the {thing} may as well be tilted the other way, {shift}. Look from "
        "another side, or from nearer."
    )
