"""Markers on a fixture as measured points: their centres in the base, with names and covariance."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.core.types import Corners, FloatArray, Image, Target
from visioncal.frames.camera_chain import Eye
from visioncal.frames.image_outliers import CandidateViews, ImageInliers, agreeing
from visioncal.frames.single_view import (
    Sight,
    TargetPlace,
    all_places,
    check_labels,
    common_covariance,
    needs_robot,
)
from visioncal.frames.target_in_image import SeenTarget, check_size, see
from visioncal.frames.target_pose import doubts
from visioncal.results import Calibration
from visioncal.vision.finders import NotFound, find_target
from visioncal.vision.finders.imaging import blur_at_corners
from visioncal.vision.targets import target_from_document


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Markers' centres in the base, n of them.

    A fit to points weighs them with `independent`, and carries `common` to its answer: where that
    moves with the points by a slope J (6, 3 n), J common J^T adds to its covariance.

    Attributes:
        names: (n,) the markers' ids as text.
        points: (n, 3) [m].
        independent: (n, 3, 3) covariance of each by its own pixels [m^2].
        common: (3 n, 3 n) covariance of all by what they share: the camera's transform, its lens,
            the markers' printed size, the arm's errors, and the robot's noise, which moves all
            markers of one image together [m^2].
        seen_in: (n,) how many images place each.
        warnings: What to know, in sentences.
    """

    names: tuple[str, ...]
    points: FloatArray
    independent: FloatArray
    common: FloatArray
    seen_in: tuple[int, ...]
    warnings: tuple[str, ...]

    @property
    def covariance(self) -> FloatArray:
        """(3 n, 3 n) of all points together [m^2]."""
        return np.asarray(block_diag(*self.independent) + self.common)


@dataclass(frozen=True, eq=False)
class _Marker:
    """One marker as the images show it: the (i,) images' places in the list, and what they say."""

    name: str
    images: tuple[int, ...]
    views: tuple[tuple[TargetPlace, ...], ...]
    looks: tuple[SeenTarget, ...]


def seen_markers(
    calibration: Calibration,
    sights: Sequence[Sight],
    ids: Sequence[int],
    dictionary: str,
    size_m: float,
    *,
    size_sigma_m: float | None = None,
    sigma_px: float | None = None,
) -> SeenPoints:
    """Measures the centres of single markers in the base.

    Args:
        calibration: The camera's.
        sights: The images, each of some of the markers.
        ids: The markers to look for.
        dictionary: Their ArUco dictionary by OpenCV's name.
        size_m: Side of each [m].
        size_sigma_m: How well that is known, for all of them alike [m]; 0.1 % of it where None.
        sigma_px: Noise of a corner's coordinate [px]; the calibration's where None.

    Raises:
        DataError: There is no camera, a marker is in no image, or a pose of the robot is missing.
    """
    check_labels(sights)
    eye = Eye.of(calibration)
    targets = [_target(number, dictionary, size_m, size_sigma_m) for number in ids]
    if not targets:
        raise DataError("no markers to look for: give their ids.")
    markers = [_look(eye, sights, target, sigma_px) for target in targets]
    unseen = [marker.name for marker in markers if not marker.images]
    if unseen:
        raise DataError(
            f"marker {some_of(unseen)} of {dictionary} is in none of the {len(sights)} images.",
            culprits=[f"marker {name}" for name in unseen],
            next_step="Take an image that shows it whole, with its white margin; or leave it out.",
        )
    common = common_covariance(eye, markers[0].looks[0].scale_sigma)
    found = [
        agreeing(CandidateViews(marker.views, eye.flange_noise, common, eye.freedom))
        for marker in markers
    ]
    warnings = [
        warning
        for marker, agreement in zip(markers, found, strict=True)
        for warning in _warnings(eye, marker, agreement, sights)
    ]
    return SeenPoints(
        tuple(marker.name for marker in markers),
        np.array([inliers.mean.matrix[:3, 3] for inliers in found]),
        np.array([_own(*pair) for pair in zip(markers, found, strict=True)]),
        _shared(eye, markers, found, common, len(sights)),
        tuple(int(inliers.agrees.sum()) for inliers in found),
        (*eye.warnings, *warnings),
    )


def _target(marker: int, dictionary: str, size_m: float, sigma_m: float | None) -> Target:
    document = {"kind": "marker", "id": marker, "size_m": size_m, "dictionary": dictionary}
    if sigma_m is not None:
        document["square_sigma_m"] = sigma_m
    return target_from_document(document, f"marker {marker}")


def _look(eye: Eye, sights: Sequence[Sight], target: Target, sigma_px: float | None) -> _Marker:
    """Looks for one marker in all images; those without it are passed over."""
    seen = [(at, _corners(eye, sight, target)) for at, sight in enumerate(sights)]
    shown = [(at, corners) for at, corners in seen if corners is not None]
    own = [sights[at] for at, _ in shown]
    looks = [
        see(eye, corners, target, sight.label, sigma_px)
        for (_, corners), sight in zip(shown, own, strict=True)
    ]
    views = all_places(eye, own, looks, "base")
    images = tuple(at for at, _ in shown)
    return _Marker(str(target.marker_id), images, tuple(views), tuple(looks))


def _corners(eye: Eye, sight: Sight, target: Target) -> Corners | None:
    """A marker's corners in an image; None where it is not in it, which is no failure."""
    if isinstance(sight.seen, Corners):
        raise DataError(
            f"{sight.label}: markers are looked for in images, and corners were given.",
            next_step="Give the image; or place one target by its corners with place_seen.",
        )
    image: Image = sight.seen
    check_size(eye, image, sight.label)
    found = find_target(image, target)
    if isinstance(found, NotFound):
        return None
    return Corners(0, found.ids, found.px, blur_at_corners(image, found.px))


def _warnings(
    eye: Eye, marker: _Marker, found: ImageInliers, sights: Sequence[Sight]
) -> Iterator[str]:
    """What is odd. One image is not: the other markers check it."""
    for look in marker.looks:
        yield from look.warnings
    if len(marker.images) > 1:
        own = [sights[at] for at in marker.images]
        stops = len({sight.stop_key for sight in own}) if needs_robot(eye, "base") else None
        labels = [sight.label for sight in own]
        yield from doubts(found, labels, marker.looks, stops, f"marker {marker.name}")


def _shares(
    found: ImageInliers, views: Sequence[Sequence[TargetPlace]]
) -> list[tuple[TargetPlace, FloatArray]]:
    """Each image's place, and the (3, 6) slope by which it moves the mean's centre."""
    mean = np.concatenate([np.zeros((3, 3)), found.mean.matrix[:3, :3]], axis=1)
    return [
        (view[pick], mean @ gain)
        for view, pick, gain in zip(views, found.picks, found.mean.gains, strict=True)
    ]


def _own(marker: _Marker, found: ImageInliers) -> FloatArray:
    """(3, 3) covariance of a centre by the pixels of its images."""
    covariance = np.sum(
        [slope @ place.pixels @ slope.T for place, slope in _shares(found, marker.views)], axis=0
    )
    return np.asarray(found.variance * covariance)


def _shared(
    eye: Eye,
    markers: Sequence[_Marker],
    found: Sequence[ImageInliers],
    common: FloatArray,
    images: int,
) -> FloatArray:
    """(3 n, 3 n) covariance of all centres by what they share."""
    by_common = np.zeros((len(markers), 3, len(common)))
    by_stop = np.zeros((images, len(markers), 3, 6))
    for at, (marker, agreement) in enumerate(zip(markers, found, strict=True)):
        for image, (place, slope) in zip(
            marker.images, _shares(agreement, marker.views), strict=True
        ):
            by_common[at] += slope @ place.by_common
            by_stop[image, at] = np.sqrt(agreement.variance) * slope @ place.flange_jacobian
    flat = by_common.reshape(3 * len(markers), -1)
    stops = by_stop.reshape(images, 3 * len(markers), 6)
    return np.asarray(
        flat @ common @ flat.T + np.einsum("sij,jk,slk->il", stops, eye.flange_noise, stops)
    )
