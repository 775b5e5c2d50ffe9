"""Pose of a target on a tool or fixture, estimated from images of a calibrated camera.

base_from_target = base_from_cam * cam_from_target                         eye-to-hand
base_from_target = base_from_flange * flange_from_cam * cam_from_target    eye-in-hand
flange_from_target = flange_from_base * base_from_cam * cam_from_target    eye-to-hand
flange_from_target = flange_from_cam * cam_from_target                     eye-in-hand

In the second and third case the robot is between parent and target: its noise counts, and images of
one stop share it. Outliers are whole images, by the 6-vector of a pose's difference from the mean.
The search starts from the image pose with the smallest distances to half of the images (least
median of squares, Rousseeuw 1984), over all candidate poses of each.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self, TypeAlias

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.arguments import check_fields, typed
from visioncal.core.errors import DataError
from visioncal.core.linalg import covariance_from, squared_lengths
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.quantiles import FALSE_ALARM, FALSE_REJECTION, chi2_limit, f_limit
from visioncal.core.robust import Distances, nearest, settled, trimmed_sum
from visioncal.core.transforms import adjoint, compose, exp, invert, log, pose_difference
from visioncal.core.types import Corners, FloatArray, Image, IntArray, Mask, Target
from visioncal.frames.camera_chain import CalibratedCamera, checked_pose
from visioncal.frames.target_in_image import PoseCandidates, target_pose_candidates
from visioncal.results import Calibration, Edge
from visioncal.vision.targets import load_target

Parent: TypeAlias = Literal["base", "flange"]
# Squared distance beyond which two poses differ significantly.
_DIFFERENT = float(chi2_limit(0.05, 6))
_FEWEST_FOR_SIZE = 3  # Images that agree on a board's size.


@dataclass(frozen=True, eq=False)
class Sight:
    """One image of a target."""

    label: str  # Its name in messages and results.
    seen: Corners | Image  # The target's corners, or the (h, w) grey image to find them in.
    # (4, 4) the flange's pose at the image as reported; None where no robot is between parent and
    # target.
    base_from_flange: FloatArray | None = None
    # Number of the robot's stop; where None, images with the same pose are of one stop.
    stop: int | None = None
    # (n,) joints [rad] where the pose is the calibrated arm's for these joints.
    joints_rad: FloatArray | None = None

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def stop_key(self) -> object:
        """Hashable identity of the robot's stop; the label for an image without a pose."""
        if self.stop is not None:
            return self.stop
        return self.label if self.base_from_flange is None else self.base_from_flange.tobytes()


@dataclass(frozen=True, eq=False)
class TargetPlace:
    """Candidate pose of a target in the parent's frame, from one image."""

    matrix: FloatArray  # (4, 4) `parent_from_target`.
    pixels: FloatArray  # (6, 6) covariance of its right perturbation by the pixel noise.
    # (6, 6) Jacobian by the flange's perturbation; zero where the robot is not between. With k
    # images of one stop it is multiplied by sqrt(k), so that their mean has the variance of the
    # error that they share.
    flange_jacobian: FloatArray
    # (6, c) Jacobian by the errors that all images share: camera's edge, lens, arm, target size.
    by_common: FloatArray


def needs_robot(eye: CalibratedCamera, parent: Parent) -> bool:
    """Whether the robot is between the parent and the target."""
    return (eye.mount == "eye-in-hand") == (parent == "base")


def candidate_places(
    eye: CalibratedCamera, sight: Sight, view: PoseCandidates, parent: Parent, of_stop: int = 1
) -> tuple[TargetPlace, ...]:
    """Candidate poses of one image in the parent's frame.

    `view` has those in the camera's frame; `of_stop` is the number of images of the same stop.

    Raises:
        DataError: The robot's pose is needed and missing or invalid.
    """
    parent_from_cam, arm = eye.edge, np.zeros((6, eye.arm_error_count))
    flange_jacobian = np.zeros((len(view.symmetries), 6, 6))
    if needs_robot(eye, parent):
        flange = sight.base_from_flange
        if flange is None:
            raise DataError(
                f"{sight.label}: the robot stands between the {parent} and what the camera "
                f"({eye.mount}) sees, and its pose is missing.",
                culprits=[sight.label],
                next_step="Give base_from_flange as the robot reported it at the image.",
            )
        checked_pose(flange, f"{sight.label}: base_from_flange")
        arm = eye.arm_basis(flange, sight.joints_rad)
        # In the hand the flange carries the camera, else the target.
        sign, parent_from_cam = 1.0, flange @ eye.edge
        flange_from_cam = eye.edge
        if parent == "flange":
            sign, parent_from_cam = -1.0, invert(flange) @ eye.edge
            flange_from_cam = parent_from_cam
        flange_jacobian = sign * adjoint(invert(flange_from_cam @ view.cam_from_target))
    by_edge = adjoint(invert(view.cam_from_target))
    return tuple(
        TargetPlace(
            parent_from_cam @ pose,
            view.covariance[at],
            np.sqrt(of_stop) * flange_jacobian[at],
            np.concatenate(
                [
                    by_edge[at],
                    view.by_lens[at],
                    flange_jacobian[at] @ arm,
                    view.by_scale[at][:, None],
                ],
                axis=1,
            ),
        )
        for at, pose in enumerate(view.cam_from_target)
    )


@dataclass(frozen=True, eq=False)
class _CandidateViews:
    """Candidate poses of a target from m images."""

    # Candidates of each image, the best by reprojection first.
    views: Sequence[Sequence[TargetPlace]]
    flange_noise: FloatArray  # (6, 6) covariance of the flange at one stop.
    common: FloatArray  # (c, c) covariance of the errors that all images share.
    freedom: float  # Degrees of freedom of the noise levels.

    def independent(self, place: TargetPlace) -> FloatArray:
        """(6, 6) covariance of a candidate by errors of its image alone: pixels and robot."""
        carried = place.flange_jacobian @ self.flange_noise @ place.flange_jacobian.T
        return np.asarray(place.pixels + carried)

    @property
    def limit(self) -> float:
        """Outlier limit of the squared distance, corrected for the number of images."""
        tail = FALSE_REJECTION / len(self.views)
        return 6.0 * float(f_limit(tail, 6, min(self.freedom, 1e6)))


@dataclass(frozen=True, eq=False)
class _ImageInliers:
    """Inlier images of a target, and their mean pose, weighted by all errors."""

    matrix: FloatArray  # (4, 4) `parent_from_target`, the mean of the inliers.
    independent: FloatArray  # (6, 6) covariance by the images' independent errors.
    by_common: FloatArray  # (6, c) Jacobian by the errors that all images share.
    inliers: Mask  # (m,) inlier mask.
    residuals: FloatArray  # (m, 6) residual of each image's pose from the mean [rad, m].
    mahalanobis_sq: FloatArray  # (m,) its squared Mahalanobis distance; six on average under noise.
    limit: float  # Its outlier limit.
    variance: float  # Variance factor of the images' independent errors; at least one.
    errors: FloatArray  # (c,) expected errors that all images share, by how they disagree.
    # Another pose that is a candidate of all inliers; None where there is none.
    rival: FloatArray | None


def _find_inliers(candidates: _CandidateViews) -> _ImageInliers:
    """Finds the inlier images of a target."""
    best: tuple[float, IntArray, FloatArray] | None = None
    half = len(candidates.views) // 2 + 1
    for seed in (place for view in candidates.views for place in view):
        distances, picks = _nearest(candidates, seed)
        score = trimmed_sum(distances, half)
        # Poses of a symmetric board fit equally, apart from rounding of their fits.
        if best is None or score < (1.0 - 1e-6) * best[0] - 1e-9:
            best = (score, picks, distances)
    if best is None:
        raise RuntimeError("there are no images to agree")
    _, picks, distances = best
    agrees = nearest(distances, half)
    search = _ImageSearch(candidates, picks)
    agrees, fit = settled(search, agrees, search.fit(agrees), fewest=2, suspect=0.0)
    return fit if 2 * int(agrees.sum()) > len(picks) else search.fit(np.ones_like(agrees))


@dataclass(frozen=True, eq=False)
class _ImageSearch:
    """Inlier search over images, each with its selected candidate."""

    candidates: _CandidateViews
    picks: IntArray

    def fit(self, agrees: Mask, _: _ImageInliers | None = None) -> _ImageInliers:
        """Mean pose over the inliers, and the distances of all images from it."""
        candidates = self.candidates
        chosen = [view[at] for view, at in zip(candidates.views, self.picks, strict=True)]
        matrices = np.array([place.matrix for place in chosen])
        of_images = np.array([candidates.independent(place) for place in chosen])
        by_common = np.array([place.by_common for place in chosen])
        # Least variance by all errors (Aitken 1936): views from several sides tell how large the
        # target is, and where the camera is.
        weights = np.where(agrees[:, None, None], np.linalg.inv(of_images), 0.0)
        values, vectors = np.linalg.eigh(candidates.common)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        rooted = by_common @ root
        against = weights @ rooted
        inner = np.einsum("mij,mik->jk", rooted, against) + np.eye(len(values))
        net_weights = weights - against.sum(axis=0) @ np.linalg.solve(
            inner, np.swapaxes(against, 1, 2)
        )
        gains = covariance_from(net_weights.sum(axis=0)) @ net_weights
        matrix = matrices[int(np.flatnonzero(agrees)[0])]
        # The mean converges in a few steps, since the poses are near each other.
        for _round in range(10):
            step = np.einsum("mij,mj->i", gains, log(invert(matrix) @ matrices))
            matrix = matrix @ exp(step)
            if np.abs(step).max() < 1e-12:
                break
        errors = log(invert(matrix) @ matrices)
        mean_by_common = np.einsum("mij,mjk->ik", gains, by_common)
        difference = by_common - mean_by_common
        shared = difference @ candidates.common @ np.swapaxes(difference, 1, 2)
        carried, others = gains @ of_images, int(agrees.sum()) - 1
        of_mean = (carried @ np.swapaxes(gains, 1, 2)).sum(axis=0)
        squared = np.einsum(
            "mi,mi->m", errors, np.linalg.solve(of_images + shared, errors[..., None])[..., 0]
        )
        # Six degrees of freedom for each image beyond the first, less what they share.
        seen = np.einsum("mij,mi->j", against, errors)
        expected = np.linalg.solve(inner, seen)
        total = np.einsum("mi,mij,mj", errors, weights, errors) - seen @ expected
        variance = max(float(total) / (6.0 * others), 1.0) if others else 1.0
        # An image's own errors are in the mean, too, where it is a part of that.
        covariance = of_images + shared + of_mean - carried - np.swapaxes(carried, 1, 2)
        mahalanobis_sq = (
            squared_lengths(errors, covariance, of_images)[0]
            if others
            else np.where(agrees, 0.0, squared)
        )
        return _ImageInliers(
            matrix,
            of_mean,
            mean_by_common,
            agrees,
            errors,
            mahalanobis_sq,
            candidates.limit,
            variance,
            root @ expected,
            _rival(candidates, matrix, agrees, variance),
        )

    def distances(self, _: Mask, fit: _ImageInliers) -> Distances:
        six = np.full(len(self.picks), 6.0)
        return Distances(fit.mahalanobis_sq, six, fit.variance * fit.limit * np.ones_like(six))


def _nearest(candidates: _CandidateViews, seed: TargetPlace) -> tuple[FloatArray, IntArray]:
    """Squared distance (m,) of each image's nearest candidate from a pose, and its index."""
    independent, found = candidates.independent(seed), []
    for view in candidates.views:
        differences = [log(invert(seed.matrix) @ place.matrix) for place in view]
        squared = [
            float(d @ np.linalg.solve(independent + candidates.independent(place), d))
            for d, place in zip(differences, view, strict=True)
        ]
        found.append((min(squared), int(np.argmin(squared))))
    distances, picks = zip(*found, strict=True)
    return np.array(distances), np.array(picks, dtype=np.int64)


def _rival(
    candidates: _CandidateViews, matrix: FloatArray, agrees: Mask, variance: float
) -> FloatArray | None:
    """Another pose among the candidates of all inliers: of a mirrored or rotated target."""
    limit = variance * candidates.limit
    first = candidates.views[int(np.flatnonzero(agrees)[0])]
    for seed in first:
        delta = log(invert(matrix) @ seed.matrix)
        is_other = (
            float(delta @ np.linalg.solve(2.0 * candidates.independent(seed), delta)) > _DIFFERENT
        )
        if is_other and bool(np.all(_nearest(candidates, seed)[0][agrees] < limit)):
            return seed.matrix
    return None


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
        """Root mean square of the residuals in rotation [deg]."""
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

    The images are averaged with least variance, those that share errors by these, and outliers are
    left out and named.

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
    if not sights:
        raise DataError("No image shows the target, but at least one must.")
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
    keys = [sight.stop_key for sight in sights]
    views = [
        candidate_places(eye, sight, look, parent, keys.count(key))
        for sight, look, key in zip(sights, looks, keys, strict=True)
    ]
    common = np.asarray(block_diag(eye.shared_covariance, [[looks[0].scale_sigma ** 2]]))
    stops = len({*keys}) if needs_robot(eye, parent) else None
    candidates = _CandidateViews(views, eye.flange_noise, common, eye.noise_dof)
    fit = _find_inliers(candidates)
    labels = tuple(sight.label for sight in sights)
    return TargetPose(
        fit.matrix,
        fit.variance * fit.independent,
        fit.by_common @ common @ fit.by_common.T,
        fit.inliers,
        1e3 * np.linalg.norm(fit.residuals[:, 3:], axis=1),
        np.rad2deg(np.linalg.norm(fit.residuals[:, :3], axis=1)),
        float(np.sqrt(fit.variance)),
        (
            *eye.warnings,
            *(words for look in looks for words in look.warnings),
            *_size_warning(fit, candidates),
            *_inlier_warnings(fit, labels, looks, stops),
        ),
    )


def _size_warning(fit: _ImageInliers, candidates: _CandidateViews) -> Iterator[str]:
    """Warning on a board of another size, where that makes images from several sides agree."""
    scatter = 6.0 * (int(fit.inliers.sum()) - 1) * (fit.variance - 1.0)
    # Two images agree by a size whatever else moved.
    if scatter < chi2_limit(FALSE_ALARM, 1) or fit.inliers.sum() < _FEWEST_FOR_SIZE:
        return
    common = candidates.common.copy()
    # Sigma of a board's size where another one is tried, the least error that is named, and the
    # share of the scatter that it explains.
    common[-1, -1] = 0.1**2
    sized = _find_inliers(replace(candidates, common=common))
    share = float(sized.errors[-1])
    is_explained = sized.variance - 1.0 < (1.0 - 0.75) * (fit.variance - 1.0)
    if is_explained and abs(share) > 2e-3 and sized.inliers.sum() >= fit.inliers.sum():
        # A board that is larger is seen as if the stated one were nearer.
        than = "larger" if share < 0.0 else "smaller"
        yield (
            f"The images agree if the board is {figure(100.0 * abs(share))} % {than} than stated "
            f"(scatter {figure(np.sqrt(sized.variance))} times the calibration's noise, "
            f"{figure(np.sqrt(fit.variance))} as stated), or the lens was focused anew: measure "
            "the board, and state its size (square_m, or diameter_m, in its .toml)."
        )


def _inlier_warnings(
    fit: _ImageInliers, labels: Sequence[str], looks: Sequence[PoseCandidates], stops: int | None
) -> Iterator[str]:
    """Warnings on the inliers of a target's images."""
    count, sizes = len(labels), np.linalg.norm(fit.residuals.reshape(-1, 2, 3), axis=2)
    away = [mm_and_deg(1e3 * shift_m, np.rad2deg(turn_rad)) for turn_rad, shift_m in sizes.tolist()]
    for at in np.flatnonzero(~fit.inliers).tolist():
        yield (
            f"{labels[at]} puts the target {away[at]} from where the others do, "
            "and was left out: was it moved, or is the robot's pose that of another image?"
        )
    inliers = int(fit.inliers.sum())
    if count == 1:
        yield (
            f"One image places the target: nothing checks it. Take another"
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
            f"The images disagree, by up to {away[worst]}, and with {count} of "
            "them it is not known which are right: take more."
        )
    elif fit.variance * 6 * (inliers - 1) > chi2_limit(1e-4, 6 * (inliers - 1)):
        yield (
            f"The images scatter {figure(np.sqrt(fit.variance))} times as much as the "
            "calibration's noise lets them; the sigmas are that much larger."
        )
    if fit.rival is None:
        return
    shift = f"{mm_and_deg(*pose_difference(fit.matrix, fit.rival))} away"
    if any(len(set(look.symmetries)) > 1 for look in looks):
        yield (
            f"The target looks the same when it is turned: it may as well be {shift}. Use a board "
            "without symmetry, or see to it that it is not turned."
        )
    else:
        yield (
            f"Seen so flat, the target may as well be tilted the other way, {shift}. Look from "
            "another side, or from nearer."
        )
