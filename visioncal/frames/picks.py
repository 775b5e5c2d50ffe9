"""Picks from a session: where each of its views puts a point of the target in the base."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, Progress
from visioncal.frames.camera_chain import checked_point
from visioncal.frames.locate import locate_target
from visioncal.frames.located import Located
from visioncal.frames.session_observations import nothing_fits, session_looks, without_label
from visioncal.results import Calibration, picked
from visioncal.session import Session, View
from visioncal.session.choosing import EYE, Choice

_ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Picks:
    """Where views put a point.

    Attributes:
        found: The places, by their views' numbers.
        lost: Why other views give none, by their numbers.
        warnings: What is odd about the session, in sentences.
    """

    found: Mapping[int, Located]
    lost: Mapping[int, str]
    warnings: tuple[str, ...] = ()


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
    """Places a point of the target in the base, by each view of a session alone.

    What the views share, the camera's transform above all, is in every one of the places: their
    mean is not as much better as their number says.

    Args:
        session: Of the same camera as the calibration; it names the target.
        calibration: The camera's.
        point_target_m: (3,) the point in the target's frame [m].
        among: Those of its views to look at; all where None.
        sigma_px: Noise of a corner's coordinate [px]; the calibration's where None.
        camera: Which camera is meant, where session or calibration is of a whole cell.
        robot: Which robot, in whose base or on whose flange it is placed; likewise.
        target: Which target of the session; likewise.
        progress: Told after each image.

    Raises:
        DataError: No view shows the target and has what else it needs, or the point is none.
    """
    point = checked_point(point_target_m, "point_target_m")
    choice = Choice(camera, robot, target)
    session, calibration = picked(session, calibration, choice, EYE, parted=False)
    shown = session_looks(session, calibration, "base", among=among, progress=progress)
    found: dict[int, Located] = {}
    lost = dict(shown.lost)
    for view, sight in zip(shown.views, shown.sights, strict=True):
        try:
            found[view.number] = locate_target(
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
    if not found:
        raise nothing_fits(shown, lost)
    return Picks(found, lost, shown.warnings)
