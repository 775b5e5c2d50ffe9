"""Fixture frame from images of markers whose positions a drawing states."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.detect import corners_in
from visioncal.core.errors import DataError
from visioncal.core.limits import FixtureLimits
from visioncal.core.number_format import counted, some_of
from visioncal.core.types import Corners, Target
from visioncal.core.verdict import remarks
from visioncal.estimation.points import FEWEST_POINTS
from visioncal.frames.camera_chain import CalibratedCamera
from visioncal.frames.fixture import FitSettings, Words, drawn_fixture
from visioncal.frames.frame_from_images import camera_details, view_findings
from visioncal.frames.session_observations import SessionImages, fit_views, session_images
from visioncal.frames.target_in_image import (
    check_image_size,
    target_pose_candidates,
)
from visioncal.frames.target_pose import (
    CandidateViews,
    Sight,
    all_places,
    check_labels,
    common_covariance,
    find_inliers,
    inlier_warnings,
    needs_robot,
)
from visioncal.frames.touches import MeasuredPoints, NominalPoints
from visioncal.results import Calibration, Frame
from visioncal.session import Session
from visioncal.vision.boards import NotFound, kind_of
from visioncal.vision.boards.marker import MarkerKind, marker_ids
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
class MarkerPoints(MeasuredPoints):
    """Markers' centres measured in the base, n of them, named by the markers' ids.

    Their common errors are the camera's transform, its lens, the markers' printed size, the arm's
    errors, and the robot's noise, which moves all markers of one image together.
    """

    seen_in: tuple[int, ...]  # (n,) number of inlier images of each.
    warnings: tuple[str, ...]  # Sentences.


def measure_markers(
    calibration: Calibration,
    sights: Sequence[Sight],
    ids: Sequence[int],
    dictionary: str,
    size_m: float,
    *,
    size_sigma_m: float | None = None,
    sigma_px: float | None = None,
    source: str = "images",
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
        source: What the images were read from, for the record.

    Raises:
        DataError: There is no camera, a marker is in no image, or a pose of the robot is missing.
    """
    check_labels(sights)
    eye = CalibratedCamera.of(calibration)
    if not ids:
        raise DataError("no markers to look for: give their ids.")
    document = {"kind": "marker", "size_m": size_m, "dictionary": dictionary}
    if size_sigma_m is not None:
        document["square_sigma_m"] = size_sigma_m
    targets = [target_from_document({**document, "id": at}, f"marker {at}") for at in ids]
    found = [
        [
            (at, corners)
            for at, sight in enumerate(sights)
            if (corners := _corners(eye, sight, target))
        ]
        for target in targets
    ]
    unseen = [str(number) for number, shown in zip(ids, found, strict=True) if not shown]
    if unseen:
        raise DataError(
            f"marker {some_of(unseen)} of {dictionary} is in none of the {len(sights)} images.",
            culprits=[f"marker {name}" for name in unseen],
            next_step="Take an image that shows it whole, with its white margin; or leave it out.",
        )
    common = common_covariance(eye, targets[0].square_sigma_m / targets[0].square_m)
    fits, independent, warnings = [], [], list(eye.warnings)
    # Jacobians of all centres by the common errors, and by the flange's at each image.
    by_common = np.zeros((len(ids), 3, len(common)))
    by_stop = np.zeros((len(sights), len(ids), 3, 6))
    for marker, (target, shown) in enumerate(zip(targets, found, strict=True)):
        own_sights = [sights[at] for at, _ in shown]
        looks = [
            target_pose_candidates(eye, corners, target, sights[at].label, sigma_px)
            for at, corners in shown
        ]
        views = all_places(eye, own_sights, looks, "base")
        fit = find_inliers(CandidateViews(views, eye.flange_noise, common, eye.noise_dof))
        by_centre = np.concatenate([np.zeros((3, 3)), fit.matrix[:3, :3]], axis=1)
        own = np.zeros((3, 3))
        for (at, _), view, pick, gain in zip(shown, views, fit.picks, fit.gains, strict=True):
            place, jacobian = view[pick], by_centre @ gain
            own += jacobian @ place.pixels @ jacobian.T
            by_common[marker] += jacobian @ place.by_common
            by_stop[at, marker] = np.sqrt(fit.variance) * jacobian @ place.flange_jacobian
        fits.append(fit)
        independent.append(fit.variance * own)
        warnings += [words for look in looks for words in look.warnings]
        # A single image needs no warning, since the other markers check it.
        if len(shown) > 1:
            keys = {sight.stop_key for sight in own_sights}
            stops = len(keys) if needs_robot(eye, "base") else None
            labels = [sight.label for sight in own_sights]
            warnings += inlier_warnings(fit, labels, looks, stops, f"marker {target.marker_id}")
    flat = by_common.reshape(3 * len(ids), -1)
    stops_flat = by_stop.reshape(len(sights), 3 * len(ids), 6)
    by_robot = np.einsum("sij,jk,slk->il", stops_flat, eye.flange_noise, stops_flat)
    names, seen_in = tuple(map(str, ids)), tuple(int(fit.inliers.sum()) for fit in fits)
    points = np.array([fit.matrix[:3, 3] for fit in fits])
    # Directions to the camera's mean position.
    positions = [eye.at(sight.base_from_flange).base_from_cam[:3, 3] for sight in sights]
    outward = np.mean(positions, axis=0) - points
    return MarkerPoints(
        source,
        names,
        tuple(counted(images, "image") for images in seen_in),
        names,
        points,
        np.array(independent),
        flat @ common @ flat.T + by_robot,
        outward / np.linalg.norm(outward, axis=1)[:, None],
        seen_in,
        tuple(warnings),
    )


def _corners(eye: CalibratedCamera, sight: Sight, target: Target) -> Corners | None:
    """A marker's corners in an image; None where the image does not show it."""
    if isinstance(sight.seen, Corners):
        raise DataError(
            f"{sight.label}: markers are looked for in images, and corners were given.",
            next_step="Give the image; or place one target by its corners with place_seen.",
        )
    check_image_size(eye, sight.seen, sight.label)
    seen = corners_in(sight.seen, target)
    return None if isinstance(seen, NotFound) else seen


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
    for name in drawing.names:
        if not (name.isascii() and name.isdigit()):
            raise DataError(
                f"{drawing.source}: point {name!r} is no marker's id: a whole number is needed.",
                culprits=[name],
                next_step="Name each point by the id of the marker whose centre it is.",
            )
    ids = {int(name): name for name in drawing.names}
    shown = session_images(session, calibration, among=fit_views(session))
    if not isinstance(kind_of(shown.target), MarkerKind):
        raise DataError(
            f"session {session.name!r} has the target {shown.target.name}, a {shown.target.kind}; "
            "beside a drawing (--cad) it has to be one of the drawn markers.",
            culprits=["session.toml: target"],
            next_step="Name a marker there; or leave --cad away, and the board places the fixture.",
        )
    seen = _shown_markers(shown, tuple(ids))
    measured = measure_markers(
        calibration,
        shown.sights,
        seen,
        shown.target.dictionary,
        shown.target.square_m,
        size_sigma_m=shown.target.square_sigma_m,
        source=session.name,
    )
    eye = CalibratedCamera.of(calibration)
    findings = (
        *(
            replace(remark, is_fatal=remark.words in eye.warnings)
            for remark in remarks(measured.warnings)
        ),
        *view_findings(session, shown.lost),
        *remarks(shown.warnings),
    )
    setting = FitSettings(
        doubts=findings,
        details={
            "dictionary": shown.target.dictionary,
            "marker_mm": 1e3 * shown.target.square_m,
            "seen_in": dict(zip(measured.names, measured.seen_in, strict=True)),
            **camera_details(calibration),
        },
        options=options or FixtureLimits(),
        words=_WORDS,
        # Each point's own covariance already holds its noise.
        assumed_noise_m=0.0,
    )
    named = replace(measured, names=tuple(ids[number] for number in seen))
    return drawn_fixture(named, drawing, setting)


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
