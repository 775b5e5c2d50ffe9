"""The calibrated arm in the cell: its accuracy over the workspace, and what changed."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import rerun as rr

from visioncal.core.number_format import significant
from visioncal.core.types import FloatArray
from visioncal.present.recording import colours, paths
from visioncal.present.recording.notes import log_scalars
from visioncal.present.recording.recorder import send_rows
from visioncal.present.recording.uncertainty import round_factor
from visioncal.results import Calibration
from visioncal.results.arm import ArmResult, UnseenView
from visioncal.robot import Robot
from visioncal.session import Session, View

# Sizes of what is drawn, as shares of the cell's size.
_PLACE, _LEGEND, _LINE = 0.025, 0.035, 0.008
# How far off the arm as stated is drawn where it is farthest.
_SHARE = 0.4
# Colours end here, that a few places at the rim do not take all of them.
_LOW_PERCENT, _HIGH_PERCENT = 1.0, 98.0
_LEGEND_STEPS = 6
# The plots' series: arm as stated and calibrated, of views left out in turn and held back.
_STATED, _CALIBRATED = "as_stated", "calibrated"
_CIRCLE, _DIAMOND = rr.components.MarkerShape.Circle, rr.components.MarkerShape.Diamond


@dataclass(frozen=True, eq=False)
class ArmPicture:
    """What is drawn of a calibrated arm.

    Attributes:
        found: What is known of it.
        robot: The arm as calibrated.
        off_m: By view, (k, 3) origins of the calibrated arm's joints and flange in the base, and
            how far off these are in the arm as stated [m].
        factor: How many times farther off the arm as stated is drawn.
        size_m: The cell's size [m].
    """

    found: ArmResult
    robot: Robot
    off_m: Mapping[int, tuple[FloatArray, FloatArray]]
    factor: int
    size_m: float

    @classmethod
    def of(
        cls, session: Session, calibration: Calibration | None, size_m: float
    ) -> "ArmPicture | None":
        """Collects what there is to draw; None where the arm stays as stated."""
        if calibration is None:
            return None
        found, nominal = calibration.arm, calibration.robot
        robot = None if found is None else found.robot
        if found is None or robot is None:
            return None
        off_m = {
            view.number: _off(view, view.joints_rad, robot, nominal)
            for view in session.views
            if nominal is not None
            and view.joints_rad is not None
            and len(view.joints_rad) == robot.joint_count == nominal.joint_count
        }
        farthest_m = max((float(np.abs(pair[1]).max()) for pair in off_m.values()), default=0.0)
        return cls(found, robot, off_m, round_factor(_SHARE * size_m, farthest_m), size_m)

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Draws the map with its legend, and how the plots look."""
        frame = rr.CoordinateFrame(paths.BASE_FRAME)
        stream.log(paths.magnified_arm(self.factor), frame, static=True)
        if self.found.workspace_map:
            log_map(stream, self.found.map_places_m, self.found.map_sigmas_mm, self.size_m)
        for plot in (paths.UNSEEN_MM, paths.UNSEEN_DEG):
            for held in (False, True):
                for name, label, colour in (
                    (_STATED, "arm as stated", colours.STATED),
                    (_CALIBRATED, "calibrated arm", colours.USED),
                ):
                    points = rr.SeriesPoints(
                        colors=colour,
                        markers=_DIAMOND if held else _CIRCLE,
                        marker_sizes=5.0 if held else 3.5,
                        names=f"{label}, held back" if held else label,
                    )
                    stream.log(_series(plot, name, held=held), points, static=True)

    def log_views(self, stream: rr.RecordingStream, rows: Mapping[int, int]) -> None:
        """Draws the arm as stated in each view, and marks what both make of it.

        Args:
            stream: Where to.
            rows: The views' places in the session.
        """
        drawn = [self.off_m[view] for view in rows if view in self.off_m]
        strips = [np.vstack([np.zeros(3), at + self.factor * off]) for at, off in drawn]
        entity = paths.magnified_arm(self.factor)
        style = rr.LineStrips3D.from_fields(colors=colours.STATED, radii=_LINE * self.size_m)
        stream.log(entity, style, static=True)
        lines = rr.LineStrips3D.columns(strips=strips)
        send_rows(
            stream, entity, rows.values(), lines.partition([view in self.off_m for view in rows])
        )
        for held, views in ((False, self.found.left_out), (True, self.found.holdout)):
            _log_unseen(
                stream, {rows[view.view]: view for view in views if view.view in rows}, held=held
            )


def log_map(
    stream: rr.RecordingStream, places_m: FloatArray, sigma_mm: FloatArray, size_m: float
) -> None:
    """Draws standard deviations (w,) [mm] at (w, 3) places of a cell of some size [m]."""
    low, high = np.percentile(sigma_mm, [_LOW_PERCENT, _HIGH_PERCENT])
    frame = rr.CoordinateFrame(paths.BASE_FRAME)
    places = rr.Points3D(
        places_m,
        colors=_colours(sigma_mm, low, high),
        radii=_PLACE * size_m,
        labels=[f"{significant(value)} mm" for value in sigma_mm],
        show_labels=False,
    )
    stream.log(f"{paths.WORKSPACE}/sigma_of_a_tool_s_place", frame, places, static=True)
    steps_mm = np.linspace(low, high, _LEGEND_STEPS)
    # A column beside the map, as high as it.
    bottom, top = places_m[:, 2].min(), places_m[:, 2].max()
    column = np.zeros((_LEGEND_STEPS, 3))
    column[:, :2] = places_m[:, :2].min(axis=0)
    column[:, 2] = np.linspace(bottom, top, _LEGEND_STEPS)
    words = [f"{significant(step)} mm" for step in steps_mm]
    words[-1] += " sigma of a tool's place"
    legend = rr.Points3D(
        column,
        colors=_colours(steps_mm, low, high),
        radii=_LEGEND * size_m,
        labels=words,
        show_labels=True,
    )
    stream.log(f"{paths.WORKSPACE}/legend", frame, legend, static=True)


def _log_unseen(stream: rr.RecordingStream, seen: Mapping[int, UnseenView], *, held: bool) -> None:
    for plot, before, after in (
        (paths.UNSEEN_MM, "nominal_mm", "mm"),
        (paths.UNSEEN_DEG, "nominal_deg", "deg"),
    ):
        pairs = {row: (getattr(view, before), getattr(view, after)) for row, view in seen.items()}
        known = {row: pair for row, pair in pairs.items() if None not in pair}
        for at, name in enumerate((_STATED, _CALIBRATED)):
            entity = _series(plot, name, held=held)
            log_scalars(stream, entity, {row: pair[at] for row, pair in known.items()})


def _series(plot: str, name: str, *, held: bool) -> str:
    return f"{plot}/{name}_held_back" if held else f"{plot}/{name}"


def _off(view: View, q: FloatArray, robot: Robot, nominal: Robot) -> tuple[FloatArray, FloatArray]:
    """Origins of an arm's joints and flange in one view, and how far off the nominal one's are."""
    origins, stated = robot.link_frames(q)[:, :3, 3], nominal.link_frames(q)[:, :3, 3].copy()
    # The calibrated arm ends at the frame of the reported poses, which may be a tool's.
    reported = view.base_from_flange()
    if reported is None:
        return origins[:-1], stated[:-1] - origins[:-1]
    stated[-1] = reported.translation
    return origins, stated - origins


def _colours(values: FloatArray, low: float, high: float) -> FloatArray:
    """(k, 3) colours of values between two ends, 0 to 255."""
    scale = np.array(colours.SCALE, dtype=float)
    share = np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0) * (len(scale) - 1)
    at = np.arange(len(scale))
    columns = [np.interp(share, at, scale[:, channel]) for channel in range(3)]
    return np.asarray(np.stack(columns, axis=1).round(), dtype=np.uint8)
