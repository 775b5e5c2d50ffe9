"""A tool or a fixture placed by a target on it, as the calibrated camera sees it."""

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
from visioncal.frames.camera_chain import Eye
from visioncal.frames.image_outliers import CandidateViews, ImageInliers, agreeing
from visioncal.frames.single_view import (
    Parent,
    Sight,
    all_places,
    check_labels,
    common_covariance,
    needs_robot,
)
from visioncal.frames.target_in_image import SeenTarget, see
from visioncal.results import Calibration, Edge
from visioncal.vision.targets import load_target

# Images scatter more than this by chance in one set of ten thousand.
_FALSE_ALARM = 1e-4


@dataclass(frozen=True, eq=False)
class TargetPose:
    """Where images put a target on a tool or a fixture.

    Attributes:
        matrix: (4, 4) `parent_from_target`.
        independent: (6, 6) covariance of its right perturbation by what is each image's own: the
            pixels and, where it stands between, the robot. More images make it smaller.
        common: (6, 6) covariance by what all images share: the camera's transform, its lens, the
            target's size, the arm's errors. No number of images makes it smaller.
        labels: (m,) the images.
        agrees: (m,) which of them agree; the others have no part.
        away_mm: (m,) how far each puts the target from the mean [mm].
        away_deg: (m,) the same in rotation [deg].
        scatter: By how much the images differ, in units of what the calibration's noise lets them;
            one where it explains them. `independent` is that much larger, squared.
        warnings: What to know, in sentences.
    """

    matrix: FloatArray
    independent: FloatArray
    common: FloatArray
    labels: tuple[str, ...]
    agrees: Mask
    away_mm: FloatArray
    away_deg: FloatArray
    scatter: float
    warnings: tuple[str, ...]

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) of the right perturbation (rotation [rad], translation [m])."""
        return self.independent + self.common

    @property
    def edge(self) -> Edge:
        """The transform with its covariance."""
        return Edge(self.matrix, self.covariance)

    def at(self, point_m: FloatArray) -> Self:
        """The same of a frame with the target's axes whose origin is a point of the target.

        Args:
            point_m: (3,) in the target's frame [m].
        """
        target_from_point = compose(np.eye(3), point_m)
        carry = adjoint(invert(target_from_point))
        return replace(
            self,
            matrix=self.matrix @ target_from_point,
            independent=carry @ self.independent @ carry.T,
            common=carry @ self.common @ carry.T,
        )

    @property
    def rms_mm(self) -> float:
        """Root mean square distance of the images that agree from their mean [mm]."""
        return float(np.sqrt(np.mean(self.away_mm[self.agrees] ** 2)))

    @property
    def rms_deg(self) -> float:
        """The same in rotation [deg]."""
        return float(np.sqrt(np.mean(self.away_deg[self.agrees] ** 2)))


@typed
def place_seen(
    calibration: Calibration,
    sights: Sequence[Sight],
    target: Target | Path | str,
    parent: Parent,
    *,
    sigma_px: float | None = None,
) -> TargetPose:
    """Places a target on a fixture in the base, or on a tool on the flange.

    The images are averaged with the weights of what is each one's own, and those that disagree are
    left out and named. What all of them share is carried to the answer as it is.

    Args:
        calibration: The camera's.
        sights: The images; one is enough, and then nothing checks it.
        target: What they show, or its name or file as `load_target` takes it.
        parent: `base` for a fixture, `flange` for a tool.
        sigma_px: Noise of a corner's coordinate [px]; the calibration's where None.

    Raises:
        DataError: There is no camera, an image does not show the target, or a pose of the robot is
            needed and missing.
    """
    check_labels(sights)
    eye = Eye.of(calibration)
    board = target if isinstance(target, Target) else load_target(target)
    looks = [see(eye, sight.seen, board, sight.label, sigma_px) for sight in sights]
    return place_looks(eye, sights, looks, parent)


def place_looks(
    eye: Eye, sights: Sequence[Sight], looks: Sequence[SeenTarget], parent: Parent
) -> TargetPose:
    """Places a target by what was seen of it in each of the images; see `place_seen`."""
    views = all_places(eye, sights, looks, parent)
    common = common_covariance(eye, looks[0].scale_sigma)
    stops = len({sight.stop_key for sight in sights}) if needs_robot(eye, parent) else None
    found = agreeing(CandidateViews(views, eye.flange_noise, common, eye.freedom))
    labels = tuple(sight.label for sight in sights)
    return TargetPose(
        found.mean.matrix,
        found.variance * found.mean.own,
        found.mean.by_common @ common @ found.mean.by_common.T,
        labels,
        found.agrees,
        1e3 * np.linalg.norm(found.away[:, 3:], axis=1),
        np.rad2deg(np.linalg.norm(found.away[:, :3], axis=1)),
        float(np.sqrt(found.variance)),
        (
            *eye.warnings,
            *(words for look in looks for words in look.warnings),
            *doubts(found, labels, looks, stops),
        ),
    )


def doubts(
    found: ImageInliers,
    labels: Sequence[str],
    looks: Sequence[SeenTarget],
    stops: int | None,
    thing: str = "target",
) -> Iterator[str]:
    """Says what of an agreement of images is not as it should be.

    Args:
        found: The agreement.
        labels: The images' names.
        looks: What was seen in them.
        stops: At how many stops of the robot they were taken; None where it has no part.
        thing: What was seen, in words.
    """
    count = len(labels)
    for at in np.flatnonzero(~found.agrees).tolist():
        yield (
            f"{labels[at]} puts the {thing} {_distance(found, at)} from where the others do, "
            "and was left out: was it moved, or is the robot's pose that of another image?"
        )
    inside = int(found.agrees.sum())
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
    elif found.agrees.all() and np.any(found.mahalanobis_sq > found.limit):
        # Images stayed in although they contradict each other.
        worst = int(np.where(found.agrees, found.mahalanobis_sq, -1.0).argmax())
        yield (
            f"The images disagree, by up to {_distance(found, worst)}, and with {count} of them "
            "it is not known which are right: take more."
        )
    elif found.variance * 6 * (inside - 1) > chi2_limit(_FALSE_ALARM, 6 * (inside - 1)):
        yield (
            f"The images scatter {figure(np.sqrt(found.variance))} times as much as the "
            "calibration's noise lets them; the sigmas are that much larger."
        )
    if found.rival is not None:
        yield _rival_words(found, looks, thing)


def _distance(found: ImageInliers, at: int) -> str:
    away = found.away[at]
    millimetres = 1e3 * float(np.linalg.norm(away[3:]))
    degrees = float(np.rad2deg(np.linalg.norm(away[:3])))
    return mm_and_deg(millimetres, degrees)


def _rival_words(found: ImageInliers, looks: Sequence[SeenTarget], thing: str) -> str:
    rival = np.eye(4) if found.rival is None else found.rival
    millimetres, degrees = pose_difference(found.mean.matrix, rival)
    away = f"{mm_and_deg(millimetres, degrees)} away"
    if any(len(set(look.turns)) > 1 for look in looks):
        return (
            f"The {thing} looks the same when it is turned: it may as well be {away}. Use a board "
            "without symmetry, or see to it that it is not turned."
        )
    return (
        f"Seen so flat, the {thing} may as well be tilted the other way, {away}. Look from another "
        "side, or from nearer."
    )
