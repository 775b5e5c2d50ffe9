"""A fixture from markers on it, measured in the base, whose places a drawing has."""

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
from visioncal.frames.camera_chain import Eye
from visioncal.frames.drawing_points import NominalPoints
from visioncal.frames.fixture import drawn_fixture
from visioncal.frames.fixture_fit import Setting, Words
from visioncal.frames.frame_from_images import camera_details, view_doubts
from visioncal.frames.image_outliers import CandidateViews, ImageInliers, agreeing
from visioncal.frames.measured import MeasuredPoints
from visioncal.frames.session_observations import Sighting, for_fits, pictured
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


def marked_fixture(
    session: Session,
    calibration: Calibration,
    drawing: NominalPoints,
    *,
    options: FixtureLimits | None = None,
) -> Frame:
    """Finds a fixture by the markers on it.

    Each marker's centre is a point of the drawing, by its id. What the markers share, the camera's
    calibration above all, is carried to the frame's covariance as it is.

    Args:
        session: The images, of the same camera. Its target is one of the markers: the others are of
            the same dictionary and size.
        calibration: The camera's.
        drawing: Where the markers' centres are; their names are the ids.
        options: Where doubt begins.

    Returns:
        `base_from_fixture`.

    Raises:
        DataError: Fewer than three drawn markers are seen, or they do not fit the drawing.
        DegenerateError: They leave a direction open.
    """
    ids = {_id(name, drawing): name for name in drawing.names}
    shown = pictured(session, calibration, among=for_fits(session))
    if shown.target.kind != "marker":
        raise DataError(
            f"session {session.name!r} has the target {shown.target.name}, a {shown.target.kind}; "
            "beside a drawing (--cad) it has to be one of the drawn markers.",
            culprits=["session.toml: target"],
            next_step="Name a marker there; or leave --cad away, and the board places the fixture.",
        )
    seen = _seen(shown, tuple(ids))
    found = seen_markers(
        calibration,
        shown.sights,
        seen,
        shown.target.dictionary,
        shown.target.square_m,
        size_sigma_m=shown.target.square_sigma_m,
    )
    measured = MeasuredPoints(
        session.name,
        found.names,
        tuple(counted(index, "image") for index in found.seen_in),
        tuple(ids[index] for index in seen),
        found.points,
        found.independent,
        found.common,
        _outward(calibration, shown.sights, found),
    )
    trusted = Eye.of(calibration).warnings
    doubts = (
        *(replace(remark, is_fatal=remark.words in trusted) for remark in remarks(found.warnings)),
        *view_doubts(session, shown.lost),
        *remarks(shown.warnings),
    )
    setting = Setting(
        doubts=doubts,
        details=_details(shown.target, found, calibration),
        options=options or FixtureLimits(),
        words=_WORDS,
        # Images tell the noise of each point by themselves.
        careful_m=0.0,
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


def _seen(shown: Sighting, ids: Sequence[int]) -> tuple[int, ...]:
    """The drawn markers that an image shows."""
    pictures = [sight.seen for sight in shown.sights if not isinstance(sight.seen, Corners)]
    there = {id_ for image in pictures for id_ in marker_ids(image, shown.target.dictionary)}
    seen = tuple(number for number in ids if number in there)
    if len(seen) >= FEWEST_POINTS:
        return seen
    others = sorted(there - set(ids))
    raise DataError(
        f"session {shown.source!r}: its {counted(len(pictures), 'image')} show "
        f"{counted(len(seen), 'drawn marker')} of {shown.target.dictionary}"
        f"{_listed(seen)}, at least {FEWEST_POINTS} are needed"
        f"{'; markers that are not drawn' if others else ''}{_listed(others)}.",
        culprits=[f"marker {number}" for number in ids if number not in there],
        next_step="Take images that show them whole, with their white margins; or correct the ids "
        "in the drawing.",
    )


def _listed(ids: Sequence[int]) -> str:
    return f" ({some_of([str(number) for number in ids])})" if ids else ""


def _outward(calibration: Calibration, sights: Sequence[Sight], found: SeenPoints) -> FloatArray:
    """(n, 3) directions from the markers to the camera, on the mean over the images."""
    eye = Eye.of(calibration)
    eyes = np.array([eye.at(sight.base_from_flange).base_from_cam[:3, 3] for sight in sights])
    away = eyes.mean(axis=0) - found.points
    return np.asarray(away / np.linalg.norm(away, axis=1)[:, None])


def _details(target: Target, found: SeenPoints, calibration: Calibration) -> dict[str, Any]:
    return {
        "dictionary": target.dictionary,
        "marker_mm": 1e3 * target.square_m,
        "seen_in": dict(zip(found.names, found.seen_in, strict=True)),
        **camera_details(calibration),
    }
