"""Picks from a session: position in the base of a point of the target, by each view."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, Progress
from visioncal.frames.camera_chain import checked_point
from visioncal.frames.locate import locate_target
from visioncal.frames.located import Located
from visioncal.frames.session_observations import (
    detect_session_target,
    no_usable_image,
    without_label,
)
from visioncal.results import Calibration, select_matching
from visioncal.session import Session, View
from visioncal.session.selecting import EYE, Choice

_ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Picks:
    """Positions of a point by each view."""

    found: Mapping[int, Located]  # The positions, by view number.
    lost: Mapping[int, str]  # Why other views give none, by view number.
    warnings: tuple[str, ...] = ()  # Warnings on the session, in sentences.


@typed
def locate_views(
    session: Session,
    calibration: Calibration,
    point_target_m: FloatArray | Sequence[float] = _ORIGIN,
    *,
    among: Sequence[View] | None = None,
    sigma_px: float | None = None,
    camera: str | None = None,
    robot: str | None = None,
    target: str | None = None,
    progress: Progress | None = None,
) -> Picks:
    """Positions in the base of a point of the target, by each view of a session alone.

    Errors that the views share, mainly the camera's transform, are in every position and do not
    average out.

    Args:
        session: Of the same camera as the calibration; it names the target.
        calibration: The camera's.
        point_target_m: (3,) the point in the target's frame [m].
        among: The views to use; all where None.
        sigma_px: Noise of a corner's coordinate [px]; the calibration's where None.
        camera: Name of the camera, where session or calibration is of a whole cell.
        robot: Name of the robot in whose base, likewise.
        target: Name of the session's target, likewise.
        progress: Called after each image.

    Raises:
        DataError: No view is usable, or the point is invalid.
    """
    point = checked_point(point_target_m, "point_target_m")
    choice = Choice(camera, robot, target)
    session, calibration = select_matching(session, calibration, choice, EYE, parted=False)
    shown = detect_session_target(session, calibration, "base", among=among, progress=progress)
    located: dict[int, Located] = {}
    lost = dict(shown.lost)
    for view, sight in zip(shown.views, shown.sights, strict=True):
        try:
            located[view.number] = locate_target(
                calibration,
                sight.seen,
                shown.target,
                sight.base_from_flange,
                point,
                joints_rad=sight.joints_rad,
                sigma_px=sigma_px,
                label=sight.label,
            )
        except DataError as error:
            lost[view.number] = without_label(error, sight)
    if not located:
        raise no_usable_image(shown, lost)
    return Picks(located, lost, shown.warnings)
