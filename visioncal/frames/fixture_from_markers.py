"""Fixture frame from images of markers whose positions a drawing states."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.errors import DataError
from visioncal.core.limits import FixtureLimits
from visioncal.core.number_format import counted, some_of
from visioncal.core.types import Corners, FloatArray, Image, Target
from visioncal.core.verdict import remarks
from visioncal.estimation.pointfit import FEWEST_POINTS
from visioncal.frames.camera_chain import CalibratedCamera
from visioncal.frames.drawing_points import NominalPoints
from visioncal.frames.fixture import drawn_fixture
from visioncal.frames.fixture_fit import FitSettings, Words
from visioncal.frames.frame_from_images import camera_details, view_findings
from visioncal.frames.image_outliers import CandidateViews, ImageInliers, find_inliers
from visioncal.frames.measured_points import MeasuredPoints
from visioncal.frames.session_observations import SessionImages, fit_views, session_images
from visioncal.frames.single_view import (
    Sight,
    TargetPlace,
    all_places,
    check_labels,
    common_covariance,
    needs_robot,
)
from visioncal.frames.target_in_image import (
    PoseCandidates,
    check_image_size,
    target_pose_candidates,
)
from visioncal.frames.target_pose import inlier_warnings
from visioncal.results import Calibration, Frame
from visioncal.session import Session
from visioncal.vision.finders import NotFound, find_target
from visioncal.vision.finders.imaging import blur_at_corners
from visioncal.vision.finders.marker import marker_ids
from visioncal.vision.targets import target_from_document

_WORDS = Words(
    "markers",
    "Take more images, and check the markers' ids and places in the drawing.",
    "Look whether the markers lie as drawn, and are of the size that is stated; take more images, "
    "from nearer.",
    "Put the markers farther apart, or more of them; a better calibration of the camera helps "
    "where all share its error.",
    "the camera looked from",
)


@dataclass(frozen=True, eq=False)
class MarkerPoints:
    """Markers' centres measured in the base, n of them.

    A fit to the points weights them with `independent`; `common` adds J common J^T to the result's
    covariance, where J (6, 3 n) is the result's Jacobian by the points.
    """

    names: tuple[str, ...]  # (n,) the markers' ids as text.
    points: FloatArray  # (n, 3) [m].
    independent: FloatArray  # (n, 3, 3) covariance of each by its pixel noise [m^2].
    # (3 n, 3 n) covariance by shared errors: the camera's transform, its lens, the markers' printed
    # size, the arm's errors, and the robot's noise, which moves all markers of one image together
    # [m^2].
    common: FloatArray
    seen_in: tuple[int, ...]  # (n,) number of inlier images of each.
    warnings: tuple[str, ...]  # Sentences.

    @property
    def covariance(self) -> FloatArray:
        """(3 n, 3 n) joint covariance of all points [m^2]."""
        return np.asarray(block_diag(*self.independent) + self.common)


@dataclass(frozen=True, eq=False)
class _Marker:
    """One marker in the i images that show it: their indices, its places and its poses in each."""

    name: str
    images: tuple[int, ...]
    views: tuple[tuple[TargetPlace, ...], ...]
    looks: tuple[PoseCandidates, ...]


def measure_markers(
    calibration: Calibration,
    sights: Sequence[Sight],
    ids: Sequence[int],
    dictionary: str,
    size_m: float,
    *,
    size_sigma_m: float | None = None,
    sigma_px: float | None = None,
) -> MarkerPoints:
    """Measures the centres of markers in the base.

    Args:
        calibration: The camera's.
        sights: The images, each of some of the markers.
        ids: The markers to look for.
        dictionary: Their ArUco dictionary by OpenCV's name.
        size_m: Side of each [m].
        size_sigma_m: Its standard deviation, common to all markers [m]; 0.1 % of it where None.
        sigma_px: Noise of a corner's coordinate [px]; the calibration's where None.

    Raises:
        DataError: There is no camera, a marker is in no image, or a pose of the robot is missing.
    """
    check_labels(sights)
    eye = CalibratedCamera.of(calibration)
    targets = [_target(number, dictionary, size_m, size_sigma_m) for number in ids]
    if not targets:
        raise DataError("no markers to look for: give their ids.")
    markers = [_detect(eye, sights, target, sigma_px) for target in targets]
    unseen = [marker.name for marker in markers if not marker.images]
    if unseen:
        raise DataError(
            f"marker {some_of(unseen)} of {dictionary} is in none of the {len(sights)} images.",
            culprits=[f"marker {name}" for name in unseen],
            next_step="Take an image that shows it whole, with its white margin; or leave it out.",
        )
    common = common_covariance(eye, markers[0].looks[0].scale_sigma)
    fits = [
        find_inliers(CandidateViews(marker.views, eye.flange_noise, common, eye.noise_dof))
        for marker in markers
    ]
    warnings = [
        warning
        for marker, fit in zip(markers, fits, strict=True)
        for warning in _warnings(eye, marker, fit, sights)
    ]
    return MarkerPoints(
        tuple(marker.name for marker in markers),
        np.array([fit.mean.matrix[:3, 3] for fit in fits]),
        np.array([_own_covariance(*pair) for pair in zip(markers, fits, strict=True)]),
        _common_covariance(eye, markers, fits, common, len(sights)),
        tuple(int(fit.inliers.sum()) for fit in fits),
        (*eye.warnings, *warnings),
    )


def _target(marker: int, dictionary: str, size_m: float, sigma_m: float | None) -> Target:
    document = {"kind": "marker", "id": marker, "size_m": size_m, "dictionary": dictionary}
    if sigma_m is not None:
        document["square_sigma_m"] = sigma_m
    return target_from_document(document, f"marker {marker}")


def _detect(
    eye: CalibratedCamera, sights: Sequence[Sight], target: Target, sigma_px: float | None
) -> _Marker:
    """Detects one marker in all images; images without it are skipped."""
    seen = [(at, _corners(eye, sight, target)) for at, sight in enumerate(sights)]
    shown = [(at, corners) for at, corners in seen if corners is not None]
    own_sights = [sights[at] for at, _ in shown]
    looks = [
        target_pose_candidates(eye, corners, target, sight.label, sigma_px)
        for (_, corners), sight in zip(shown, own_sights, strict=True)
    ]
    views = all_places(eye, own_sights, looks, "base")
    images = tuple(at for at, _ in shown)
    return _Marker(str(target.marker_id), images, tuple(views), tuple(looks))


def _corners(eye: CalibratedCamera, sight: Sight, target: Target) -> Corners | None:
    """A marker's corners in an image; None where the image does not show it."""
    if isinstance(sight.seen, Corners):
        raise DataError(
            f"{sight.label}: markers are looked for in images, and corners were given.",
            next_step="Give the image; or place one target by its corners with place_seen.",
        )
    image: Image = sight.seen
    check_image_size(eye, image, sight.label)
    detected = find_target(image, target)
    if isinstance(detected, NotFound):
        return None
    return Corners(0, detected.ids, detected.px, blur_at_corners(image, detected.px))


def _warnings(
    eye: CalibratedCamera, marker: _Marker, fit: ImageInliers, sights: Sequence[Sight]
) -> Iterator[str]:
    """Warnings on a marker; a single image needs none, since the other markers check it."""
    for look in marker.looks:
        yield from look.warnings
    if len(marker.images) > 1:
        shown = [sights[at] for at in marker.images]
        stops = len({sight.stop_key for sight in shown}) if needs_robot(eye, "base") else None
        labels = [sight.label for sight in shown]
        yield from inlier_warnings(fit, labels, marker.looks, stops, f"marker {marker.name}")


def _place_jacobians(
    fit: ImageInliers, views: Sequence[Sequence[TargetPlace]]
) -> list[tuple[TargetPlace, FloatArray]]:
    """Each image's place, and the (3, 6) Jacobian of the mean's centre by its perturbation."""
    mean = np.concatenate([np.zeros((3, 3)), fit.mean.matrix[:3, :3]], axis=1)
    return [
        (view[pick], mean @ gain)
        for view, pick, gain in zip(views, fit.picks, fit.mean.gains, strict=True)
    ]


def _own_covariance(marker: _Marker, fit: ImageInliers) -> FloatArray:
    """(3, 3) covariance of a centre by the pixel noise of its images."""
    covariance = np.sum(
        [
            jacobian @ place.pixels @ jacobian.T
            for place, jacobian in _place_jacobians(fit, marker.views)
        ],
        axis=0,
    )
    return np.asarray(fit.variance * covariance)


def _common_covariance(
    eye: CalibratedCamera,
    markers: Sequence[_Marker],
    fits: Sequence[ImageInliers],
    common: FloatArray,
    images: int,
) -> FloatArray:
    """(3 n, 3 n) covariance of all centres by their common errors."""
    by_common = np.zeros((len(markers), 3, len(common)))
    by_stop = np.zeros((images, len(markers), 3, 6))
    for at, (marker, fit) in enumerate(zip(markers, fits, strict=True)):
        for image, (place, jacobian) in zip(
            marker.images, _place_jacobians(fit, marker.views), strict=True
        ):
            by_common[at] += jacobian @ place.by_common
            by_stop[image, at] = np.sqrt(fit.variance) * jacobian @ place.flange_jacobian
    flat = by_common.reshape(3 * len(markers), -1)
    stops = by_stop.reshape(images, 3 * len(markers), 6)
    return np.asarray(
        flat @ common @ flat.T + np.einsum("sij,jk,slk->il", stops, eye.flange_noise, stops)
    )


def fixture_from_marker_images(
    session: Session,
    calibration: Calibration,
    drawing: NominalPoints,
    *,
    options: FixtureLimits | None = None,
) -> Frame:
    """Estimates a fixture's frame from images of the markers on it.

    Each marker's centre is a point of the drawing, named by the marker's id. The markers' common
    errors, mainly the camera's calibration, are part of the frame's covariance.

    Args:
        session: The images, of the same camera. Its target is one of the markers: the others are of
            the same dictionary and size.
        calibration: The camera's.
        drawing: The markers' centres, named by their ids.
        options: Limits of the verdict.

    Returns:
        `base_from_fixture`.

    Raises:
        DataError: Fewer than three drawn markers are seen, or they do not fit the drawing.
        DegenerateError: They do not determine the fixture in every direction.
    """
    ids = {_id(name, drawing): name for name in drawing.names}
    shown = session_images(session, calibration, among=fit_views(session))
    if shown.target.kind != "marker":
        raise DataError(
            f"session {session.name!r} has the target {shown.target.name}, a {shown.target.kind}; "
            "beside a drawing (--cad) it has to be one of the drawn markers.",
            culprits=["session.toml: target"],
            next_step="Name a marker there; or leave --cad away, and the board places the fixture.",
        )
    seen = _shown_markers(shown, tuple(ids))
    points = measure_markers(
        calibration,
        shown.sights,
        seen,
        shown.target.dictionary,
        shown.target.square_m,
        size_sigma_m=shown.target.square_sigma_m,
    )
    measured = MeasuredPoints(
        session.name,
        points.names,
        tuple(counted(images, "image") for images in points.seen_in),
        tuple(ids[number] for number in seen),
        points.points,
        points.independent,
        points.common,
        _outward(calibration, shown.sights, points),
    )
    fatal = CalibratedCamera.of(calibration).warnings
    findings = (
        *(replace(remark, is_fatal=remark.words in fatal) for remark in remarks(points.warnings)),
        *view_findings(session, shown.lost),
        *remarks(shown.warnings),
    )
    setting = FitSettings(
        doubts=findings,
        details=_details(shown.target, points, calibration),
        options=options or FixtureLimits(),
        words=_WORDS,
        # Each point's own covariance already holds its noise.
        assumed_noise_m=0.0,
    )
    return drawn_fixture(measured, drawing, setting)


def _id(name: str, drawing: NominalPoints) -> int:
    if not (name.isascii() and name.isdigit()):
        raise DataError(
            f"{drawing.source}: point {name!r} is no marker's id: a whole number is needed.",
            culprits=[name],
            next_step="Name each point by the id of the marker whose centre it is.",
        )
    return int(name)


def _shown_markers(shown: SessionImages, ids: Sequence[int]) -> tuple[int, ...]:
    """Ids of the drawn markers that are in any of the images."""
    images = [sight.seen for sight in shown.sights if not isinstance(sight.seen, Corners)]
    detected = {id_ for image in images for id_ in marker_ids(image, shown.target.dictionary)}
    seen = tuple(number for number in ids if number in detected)
    if len(seen) >= FEWEST_POINTS:
        return seen
    others = sorted(detected - set(ids))
    raise DataError(
        f"session {shown.source!r}: its {counted(len(images), 'image')} show "
        f"{counted(len(seen), 'drawn marker')} of {shown.target.dictionary}"
        f"{_listed(seen)}, at least {FEWEST_POINTS} are needed"
        f"{'; markers that are not drawn' if others else ''}{_listed(others)}.",
        culprits=[f"marker {number}" for number in ids if number not in detected],
        next_step="Take images that show them whole, with their white margins; or correct the ids "
        "in the drawing.",
    )


def _listed(ids: Sequence[int]) -> str:
    return f" ({some_of([str(number) for number in ids])})" if ids else ""


def _outward(calibration: Calibration, sights: Sequence[Sight], points: MarkerPoints) -> FloatArray:
    """(n, 3) unit directions in the base from the markers to the camera's mean position."""
    eye = CalibratedCamera.of(calibration)
    positions = np.array([eye.at(sight.base_from_flange).base_from_cam[:3, 3] for sight in sights])
    directions = positions.mean(axis=0) - points.points
    return np.asarray(directions / np.linalg.norm(directions, axis=1)[:, None])


def _details(target: Target, points: MarkerPoints, calibration: Calibration) -> dict[str, Any]:
    return {
        "dictionary": target.dictionary,
        "marker_mm": 1e3 * target.square_m,
        "seen_in": dict(zip(points.names, points.seen_in, strict=True)),
        **camera_details(calibration),
    }
