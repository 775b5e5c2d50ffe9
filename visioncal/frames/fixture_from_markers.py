"""A fixture from markers on it, whose places a drawing has."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.core.limits import FixtureLimits
from visioncal.core.types import Corners, FloatArray, Target
from visioncal.core.verdict import remarks
from visioncal.estimation.pointpairs import FEWEST_POINTS
from visioncal.frames.camera_chain import Eye
from visioncal.frames.drawing_points import NominalPoints
from visioncal.frames.fixture_fit import Setting, Words
from visioncal.frames.fixture_from_drawing import drawn_fixture
from visioncal.frames.frame_from_images import camera_details, view_doubts
from visioncal.frames.marker_points import SeenPoints, seen_markers
from visioncal.frames.measured import MeasuredPoints
from visioncal.frames.session_observations import Sighting, for_fits, pictured
from visioncal.frames.single_view import Sight
from visioncal.results import Calibration, Frame
from visioncal.session import Session
from visioncal.vision.finders.marker import marker_ids

_WORDS = Words(
    "markers",
    "Take more images, and check the markers' ids and places in the drawing.",
    "Look whether the markers lie as drawn, and are of the size that is stated; take more images, "
    "from nearer.",
    "Put the markers farther apart, or more of them; a better calibration of the camera helps "
    "where all share its error.",
    "the camera looked from",
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
        tuple(_count(index, "image") for index in found.seen_in),
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
        f"session {shown.source!r}: its {_count(len(pictures), 'image')} show "
        f"{_count(len(seen), 'drawn marker')} of {shown.target.dictionary}"
        f"{_listed(seen)}, at least {FEWEST_POINTS} are needed"
        f"{'; markers that are not drawn' if others else ''}{_listed(others)}.",
        culprits=[f"marker {number}" for number in ids if number not in there],
        next_step="Take images that show them whole, with their white margins; or correct the ids "
        "in the drawing.",
    )


def _listed(ids: Sequence[int]) -> str:
    return f" ({some_of([str(number) for number in ids])})" if ids else ""


def _count(count: int, thing: str) -> str:
    return f"{count} {thing}{'' if count == 1 else 's'}"


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
