"""A tool or a fixture from a session's images: the frame, the words for it, whether to trust it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from visioncal.calibration.stages.observed import by_reason
from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.limits import ImageFrameLimits
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.types import FloatArray, Progress
from visioncal.core.verdict import AGREEMENT, Finding, Verdict, remarks
from visioncal.estimation.observability import Direction
from visioncal.estimation.placing import worst_of
from visioncal.frames.camera_chain import Eye, checked_point
from visioncal.frames.naming import PARENTS, FrameKind
from visioncal.frames.session_observations import (
    Sighting,
    for_fits,
    held_back,
    nothing_fits,
    session_looks,
    without_label,
)
from visioncal.frames.single_view import Sight, needs_robot
from visioncal.frames.target_in_image import SeenTarget, see
from visioncal.frames.target_pose import TargetPose, place_looks
from visioncal.frames.verdicts import weak_directions
from visioncal.results import HELD_BACK, Calibration, Frame, Observation, picked
from visioncal.session import Session, View
from visioncal.session.choosing import EYE, Choice

# The detail of a frame by which its camera's calibration is known.
SEEN_BY = "camera_calibrated"
_ORIGIN = (0.0, 0.0, 0.0)
# What is to be known of a frame that a camera has placed, whoever reads it.
_COUNTED_TWICE = (
    "the sigma holds the camera's own calibration: a pick by the same camera on a plane of this "
    "frame counts it twice"
)
# Images scatter wildly beyond this, in units of noise; they scatter under this share of it where
# the target really stands still.
_WILD, _STILL = 10.0, 0.1
# Beyond this share of views that could not be used it is a doubt; so many reasons are listed.
_LOST_SHARE, _LISTED = 0.25, 3
_COMMANDS: dict[FrameKind, str] = {"tool": "tcp", "fixture": "fixture"}


@dataclass(frozen=True, eq=False)
class _PlacedTarget:
    """A target's place, with what it was made from.

    Attributes:
        kind: What it is on.
        shown: The images.
        seen: The place of the frame's origin.
        worst: Its worst known directions.
        views: (m,) the views that it was made from.
        lost: Why others were not used, by their numbers.
    """

    kind: FrameKind
    shown: Sighting
    seen: TargetPose
    worst: tuple[Direction, Direction]
    views: tuple[View, ...]
    lost: Mapping[int, str]


@typed
def seen_frame(
    session: Session,
    calibration: Calibration,
    kind: FrameKind,
    point_target_m: FloatArray | Sequence[float] = _ORIGIN,
    *,
    options: ImageFrameLimits | None = None,
    camera: str | None = None,
    robot: str | None = None,
    target: str | None = None,
    progress: Progress | None = None,
) -> Frame:
    """Places a tool or a fixture by the target on it, as the calibrated camera sees it.

    The camera's calibration is a part of the frame's covariance. What a later pick by the same
    camera has in common with that is counted twice there, on the safe side.

    Args:
        session: The images, of the same camera; its target is the one on the tool or the fixture.
        calibration: The camera's.
        kind: What the target is on.
        point_target_m: (3,) the frame's origin in the target's frame [m], such as the tool's tip;
            its axes are the target's.
        options: Where doubt begins.
        camera: Which camera is meant, where session or calibration is of a whole cell.
        robot: Which robot, in whose base or on whose flange it is placed; likewise.
        target: Which target of the session; likewise.
        progress: Told of long work.

    Returns:
        `flange_from_tool` or `base_from_fixture`.

    Raises:
        DataError: No image serves, the target is elsewhere, or the session is of another camera.
    """
    choice = Choice(camera, robot, target)
    session, calibration = picked(session, calibration, choice, EYE, parted=False)
    options = options or ImageFrameLimits()
    point = checked_point(point_target_m, "point_target_m")
    eye, parent = Eye.of(calibration), PARENTS[kind]
    shown = session_looks(session, calibration, parent, among=for_fits(session), progress=progress)
    views, looks, lost = _looks(eye, shown)
    lost |= held_back(session)
    sights = [sight for sight, view in zip(shown.sights, shown.views, strict=True) if view in views]
    seen = place_looks(eye, sights, looks, parent).at(point)
    worst = worst_of(seen.matrix, seen.covariance, kind, parent)
    placed = _PlacedTarget(kind, shown, seen, worst, views, lost)
    _check_still(eye, placed, sights, looks)
    doubts = [
        *(
            replace(remark, is_fatal=remark.words in eye.warnings)
            for remark in remarks(seen.warnings)
        ),
        *weak_directions(worst, options.sigma_mm, options.sigma_deg, _advice(seen)),
        *view_doubts(session, lost),
        *remarks(shown.warnings),
    ]
    return Frame(
        seen.edge,
        True,
        _method(placed, point),
        session.name,
        datetime.now(UTC).isoformat(timespec="seconds"),
        seen.rms_mm,
        _noise_mm(seen),
        tuple(_observations(session, placed)),
        Verdict.by(doubts, Finding(AGREEMENT, _praise(placed))),
        _details(placed, point, calibration),
    )


def _looks(eye: Eye, shown: Sighting) -> tuple[tuple[View, ...], list[SeenTarget], dict[int, str]]:
    """What was seen in each image, and why some show nothing that fits."""
    views, looks, lost = [], [], dict(shown.lost)
    for sight, view in zip(shown.sights, shown.views, strict=True):
        try:
            looks.append(see(eye, sight.seen, shown.target, sight.label))
            views.append(view)
        except DataError as error:
            lost[view.number] = without_label(error, sight)
    if not views:
        raise nothing_fits(shown, lost)
    return tuple(views), looks, lost


def _check_still(
    eye: Eye, placed: _PlacedTarget, sights: Sequence[Sight], looks: Sequence[SeenTarget]
) -> None:
    """Refuses a target that moves where it should stand still, and stands still elsewhere."""
    other: FrameKind = "fixture" if placed.kind == "tool" else "tool"
    parent, seen = PARENTS[other], placed.seen
    has_poses = all(sight.base_from_flange is not None for sight in sights)
    if seen.scatter < _WILD or (needs_robot(eye, parent) and not has_poses):
        return
    found = place_looks(eye, sights, looks, parent)
    if found.rms_mm < _STILL * seen.rms_mm:
        raise DataError(
            f"session {placed.shown.source!r}: target {placed.shown.target.name} moves by "
            f"{figure(seen.rms_mm)} mm against the {PARENTS[placed.kind]}, and stands still to "
            f"{figure(found.rms_mm)} mm against the {parent}: it is on a {other}, not on a "
            f"{placed.kind}.",
            culprits=[placed.shown.source],
            next_step=f"Say visioncal {_COMMANDS[other]} for it.",
        )


def _advice(seen: TargetPose) -> str:
    own, common = (float(np.trace(array[3:, 3:])) for array in (seen.independent, seen.common))
    if own > common:
        return "Take more images, from nearer and from other sides."
    return (
        "Most of it is the same in all images (the camera's calibration, the target's size, the "
        "arm's errors): a better calibration helps, more images do not."
    )


def view_doubts(session: Session, lost: Mapping[int, str]) -> Iterator[Finding]:
    """Doubts a session many of whose views were not used."""
    missing = {view: why for view, why in lost.items() if why != HELD_BACK}
    if len(missing) > _LOST_SHARE * len(session.views):
        yield Finding(
            "lost_views",
            f"{len(missing)} of {len(session.views)} views were not used: "
            f"{'; '.join(by_reason(missing)[:_LISTED])}.",
            views=tuple(missing),
        )


def camera_details(calibration: Calibration) -> dict[str, Any]:
    """What the record says of a frame that a camera has placed, whatever it was placed by."""
    return {SEEN_BY: calibration.created, "note": _COUNTED_TWICE}


def _method(placed: _PlacedTarget, point: FloatArray) -> str:
    count, target = int(placed.seen.agrees.sum()), placed.shown.target
    words = {
        "charuco": "ChArUco board",
        "aprilgrid": "AprilGrid",
        "circles": "grid of circles",
        "points": "rig",
    }
    images = "one image" if count == 1 else f"{count} images"
    note = f"{words.get(target.kind, target.kind)} {target.name} seen in {images}"
    if not point.any():
        return note
    return f"{note}; its point ({', '.join(f'{value:.6g}' for value in 1e3 * point)}) mm"


def _noise_mm(seen: TargetPose) -> float:
    """Of one image, per axis: by how they scatter, or as predicted where there is only one."""
    count = int(seen.agrees.sum())
    if count > 1:
        return float(np.sqrt(np.sum(seen.away_mm[seen.agrees] ** 2) / (3 * (count - 1))))
    return float(1e3 * np.sqrt(np.trace(seen.independent[3:, 3:]) / 3))


def _observations(session: Session, placed: _PlacedTarget) -> Iterator[Observation]:
    places = {view.number: at for at, view in enumerate(placed.views)}
    for number in (view.number for view in session.views):
        if number not in places:
            yield Observation(str(number), used=False, reason=placed.lost[number])
            continue
        at = places[number]
        away_mm, agrees = float(placed.seen.away_mm[at]), bool(placed.seen.agrees[at])
        away = mm_and_deg(away_mm, float(placed.seen.away_deg[at]))
        reason = "" if agrees else f"it puts the target {away} from where the others do"
        yield Observation(str(number), agrees, reason, residual_mm=away_mm)


def _praise(placed: _PlacedTarget) -> str:
    seen, worst = placed.seen, placed.worst[0]
    return (
        f"{int(seen.agrees.sum())} images agree to {mm_and_deg(seen.rms_mm, seen.rms_deg)} (rms), "
        f"and {worst.words}, the worst direction, is known to "
        f"{figure(1e3 * worst.sigma)} mm."
    )


def _details(placed: _PlacedTarget, point: FloatArray, calibration: Calibration) -> dict[str, Any]:
    seen = placed.seen
    own = {"point_target_mm": (1e3 * point).tolist()} if point.any() else {}
    return {
        "target": placed.shown.target.name,
        **own,
        "rms_deg": seen.rms_deg,
        "scatter_over_expected": seen.scatter,
        "sigma_by_images_mm": _length_mm(seen.independent),
        "sigma_in_common_mm": _length_mm(seen.common),
        **camera_details(calibration),
    }


def _length_mm(covariance: FloatArray) -> float:
    return float(1e3 * np.sqrt(np.trace(covariance[3:, 3:])))


def rests_on_camera(frame: Frame) -> bool:
    """Whether a frame was placed by a calibrated camera, and stands or falls with it."""
    return SEEN_BY in frame.details
