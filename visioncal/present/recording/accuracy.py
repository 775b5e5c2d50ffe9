"""Accuracy in 3D: the calibrated arm over the workspace, and ellipsoids of the edges.

Ellipsoids and single views' target positions are too small to be seen at true size; both are
magnified by one factor, which their names state.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from visioncal.core.number_format import significant
from visioncal.core.types import FloatArray
from visioncal.present import result_parts
from visioncal.present.recording import colours, paths
from visioncal.present.recording.notes import log_scalars
from visioncal.present.recording.recorder import send_rows
from visioncal.present.result_parts import placement
from visioncal.results import Calibration, Edge
from visioncal.results.arm import ArmResult
from visioncal.results.evidence import ViewEvidence
from visioncal.robot import Robot
from visioncal.session import Session, View

# Sizes as shares of the cell's size.
_PLACE, _LEGEND, _LINE = 0.025, 0.035, 0.008
# Drawn size of the nominal arm's largest deviation, as a share of the cell's size.
_SHARE = 0.4
# Percentiles at the ends of the colour scale, as few places at the rim would dominate it.
_LOW_PERCENT, _HIGH_PERCENT = 1.0, 98.0
_LEGEND_STEPS = 6
# Plot series: nominal and calibrated arm; markers of cross-validation and hold-out views.
_STATED, _CALIBRATED = "as_stated", "calibrated"
_CIRCLE, _DIAMOND = rr.components.MarkerShape.Circle, rr.components.MarkerShape.Diamond

# Half axes of the 95 % ellipsoid in standard deviations: root of the chi-square quantile for three
# degrees of freedom.
SIGMAS_95 = 2.795
# Drawn size of the largest ellipsoid, as a share of the cell's size.
_LARGEST = 0.07
# Placements beyond this share of the cell's size are drawn there: wrong views lie anywhere.
_REACH = 0.2
_POINT, _FINE_LINE = 0.005, 0.0015


@dataclass(frozen=True, eq=False)
class ArmPicture:
    """Drawing of a calibrated arm."""

    result: ArmResult  # Result of its calibration.
    robot: Robot  # Calibrated model.
    # By view, (k, 3) origins of the calibrated arm's joints and flange in the base, and the
    # deviations of the nominal arm's origins [m].
    deviations_m: Mapping[int, tuple[FloatArray, FloatArray]]
    factor: int  # Magnification of the nominal arm's deviations.
    size_m: float  # Size of the cell [m].

    @classmethod
    def of(
        cls, session: Session, calibration: Calibration | None, size_m: float
    ) -> "ArmPicture | None":
        """Collects what to draw; None if the arm was not calibrated."""
        result = None if calibration is None else calibration.arm
        if calibration is None or result is None or result.robot is None:
            return None
        robot, nominal = result.robot, calibration.robot
        off_m = {
            view.number: _deviations(view, view.joints_rad, robot, nominal)
            for view in session.views
            if nominal is not None
            and view.joints_rad is not None
            and len(view.joints_rad) == robot.joint_count == nominal.joint_count
        }
        farthest_m = max((float(np.abs(pair[1]).max()) for pair in off_m.values()), default=0.0)
        return cls(result, robot, off_m, round_factor(_SHARE * size_m, farthest_m), size_m)

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Draws the map with its legend, and the style of the plots."""
        frame = rr.CoordinateFrame(paths.BASE_FRAME)
        stream.log(paths.magnified_arm(self.factor), frame, static=True)
        if self.result.workspace_map:
            log_map(stream, self.result.map_places_m, self.result.map_sigmas_mm, self.size_m)
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
                    stream.log(_series(plot, name, is_holdout=held), points, static=True)

    def log_views(self, stream: rr.RecordingStream, rows: Mapping[int, int]) -> None:
        """Draws the nominal arm in each view, by row, and plots the residuals of both arms."""
        drawn = [self.deviations_m[view] for view in rows if view in self.deviations_m]
        strips = [np.vstack([np.zeros(3), ends + self.factor * off_m]) for ends, off_m in drawn]
        entity = paths.magnified_arm(self.factor)
        style = rr.LineStrips3D.from_fields(colors=colours.STATED, radii=_LINE * self.size_m)
        stream.log(entity, style, static=True)
        parts = [view in self.deviations_m for view in rows]
        lines = rr.LineStrips3D.columns(strips=strips).partition(parts)
        send_rows(stream, entity, rows.values(), lines)
        for held, views in ((False, self.result.left_out), (True, self.result.holdout)):
            for plot, unit in ((paths.UNSEEN_MM, "mm"), (paths.UNSEEN_DEG, "deg")):
                for name, attribute in ((_STATED, f"nominal_{unit}"), (_CALIBRATED, unit)):
                    residuals = {
                        rows[view.view]: float(residual)
                        for view in views
                        if view.view in rows and (residual := getattr(view, attribute)) is not None
                    }
                    log_scalars(stream, _series(plot, name, is_holdout=held), residuals)


def log_map(
    stream: rr.RecordingStream, places_m: FloatArray, sigma_mm: FloatArray, size_m: float
) -> None:
    """Draws standard deviations (w,) [mm] at (w, 3) points, sized for a cell of `size_m` [m]."""
    low, high = np.percentile(sigma_mm, [_LOW_PERCENT, _HIGH_PERCENT])
    steps_mm = np.linspace(low, high, _LEGEND_STEPS)
    # The legend is a column beside the map, of the same height.
    column = np.zeros((_LEGEND_STEPS, 3))
    column[:, :2] = places_m[:, :2].min(axis=0)
    column[:, 2] = np.linspace(places_m[:, 2].min(), places_m[:, 2].max(), _LEGEND_STEPS)
    for entity, positions, values, radius, shown in (
        ("sigma_of_a_tool_s_place", places_m, sigma_mm, _PLACE, False),
        ("legend", column, steps_mm, _LEGEND, True),
    ):
        labels = [f"{significant(value)} mm" for value in values]
        labels[-1] += " sigma of a tool's place" if shown else ""
        points = rr.Points3D(
            positions,
            colors=_colours(values, low, high),
            radii=radius * size_m,
            labels=labels,
            show_labels=shown,
        )
        frame = rr.CoordinateFrame(paths.BASE_FRAME)
        stream.log(f"{paths.WORKSPACE}/{entity}", frame, points, static=True)


def _series(plot: str, name: str, *, is_holdout: bool) -> str:
    return f"{plot}/{name}_held_back" if is_holdout else f"{plot}/{name}"


def _deviations(
    view: View, q: FloatArray, robot: Robot, nominal: Robot
) -> tuple[FloatArray, FloatArray]:
    """Origins of an arm's joints and flange in one view, and the nominal arm's deviations."""
    origins, nominal_origins = (
        robot.link_frames(q)[:, :3, 3],
        nominal.link_frames(q)[:, :3, 3].copy(),
    )
    # The calibrated arm ends at the frame of the reported poses, possibly a tool's.
    reported = view.base_from_flange()
    if reported is None:
        return origins[:-1], nominal_origins[:-1] - origins[:-1]
    nominal_origins[-1] = reported.translation
    return origins, nominal_origins - origins


def _colours(values: FloatArray, low: float, high: float) -> FloatArray:
    """(k, 3) colours of values on the scale between two ends, 0 to 255."""
    scale = np.array(colours.SCALE, dtype=float)
    share = np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0) * (len(scale) - 1)
    stops = np.arange(len(scale))
    columns = [np.interp(share, stops, scale[:, channel]) for channel in range(3)]
    return np.asarray(np.stack(columns, axis=1).round(), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Drawing of the result's uncertainty."""

    edges: Mapping[str, Edge]  # Edges with a covariance, by name, including tools and fixtures.
    # By view, deviation of its target position from the result: (3,) in the target's frame.
    scatter_m: Mapping[int, FloatArray]
    frames: Mapping[int, str]  # By view, frame of its target.
    used: frozenset[int]  # The views in the fit.
    factor: int  # Magnification of everything.
    size_m: float  # Size of the cell [m].

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        evidence: Mapping[int, ViewEvidence],
        size_m: float,
        frames: Mapping[int, str] | None = None,
    ) -> "Uncertainty":
        """Collects the placements, and chooses the magnification by the used views.

        `frames` is the frame of each view's target; None for a single target.
        """
        used = frozenset(view.view for view in calibration.views if view.used)
        if frames is None:
            frames = dict.fromkeys(evidence, list(calibration.edges)[1].rpartition("_from_")[2])
        scatter_m = {
            view: placed[:3, 3]
            for view, seen in evidence.items()
            if view in frames and (placed := placement(calibration, seen, frames[view])) is not None
        }
        final_frames = result_parts.frames(calibration).matrices
        edges = {
            name: edge
            for name, edge in calibration.placed.items()
            if edge.covariance.any() and name.rpartition("_from_")[2] in final_frames
        }
        sizes_m = [SIGMAS_95 * _principal_sigmas(edge)[0].max() for edge in edges.values()]
        sizes_m += [float(np.linalg.norm(scatter_m[view])) for view in scatter_m.keys() & used]
        factor = round_factor(_LARGEST * size_m, max(sizes_m, default=0.0))
        return cls(edges, scatter_m, frames, used, factor, size_m)

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Draws the ellipsoids, and the target positions by all views."""
        for name, edge in self.edges.items():
            self._log_ellipsoid(stream, name, edge)
        for frame in self._target_frames:
            in_frame, placements = rr.CoordinateFrame(frame), self._placements(frame)
            views = [view for view in self.scatter_m if self.frames[view] == frame]
            for name, colour, is_used in (
                (paths.USED, colours.USED, True),
                (paths.REJECTED, colours.REJECTED, False),
            ):
                shown = [view for view in views if (view in self.used) is is_used]
                if shown:
                    places_m = self._positions_m(shown)
                    points = rr.Points3D(places_m, colors=colour, radii=_POINT * self.size_m)
                    stream.log(f"{placements}/{name}", in_frame, points, static=True)
            # Arrows towards positions that lie too far out to be drawn.
            beyond = [
                view
                for view in views
                if np.linalg.norm(self.factor * self.scatter_m[view]) > _REACH * self.size_m
            ]
            if beyond:
                arrows = rr.Arrows3D(
                    vectors=self._positions_m(beyond),
                    origins=np.zeros((len(beyond), 3)),
                    colors=colours.REJECTED,
                    radii=_FINE_LINE * self.size_m,
                )
                stream.log(f"{placements}/{paths.BEYOND}", in_frame, arrows, static=True)

    @property
    def _target_frames(self) -> list[str]:
        return sorted({self.frames[view] for view in self.scatter_m})

    def _log_ellipsoid(self, stream: rr.RecordingStream, name: str, edge: Edge) -> None:
        child = name.rpartition("_from_")[2]
        entity = f"{paths.entity_of(child)}/{name}_95_percent_magnified_{self.factor}x"
        frame = rr.CoordinateFrame(child)
        sigmas_m, axes = _principal_sigmas(edge)
        ellipsoid = rr.Ellipsoids3D(
            half_sizes=[SIGMAS_95 * self.factor * sigmas_m],
            quaternions=[Rotation.from_matrix(axes).as_quat()],
            colors=colours.UNCERTAINTY,
            line_radii=_FINE_LINE * self.size_m,
        )
        stream.log(entity, frame, ellipsoid, static=True)
        if child not in (paths.TARGET_FRAME, *self.frames.values()):
            # Only targets are labelled: tools are close to the camera, and labels would hide them.
            return
        # Beside the board, clear of the frame's name.
        label = rr.Points3D(
            [[0.0, -2.0 * _LARGEST * self.size_m, 0.0]],
            radii=0.0,
            colors=colours.UNCERTAINTY,
            labels=f"95 %, {self.factor} x",
            show_labels=True,
        )
        stream.log(f"{entity}/label", frame, label, static=True)

    def log_views(self, stream: rr.RecordingStream, rows: Mapping[int, int]) -> None:
        """Marks the current view's target position, for all views, by row."""
        for frame in self._target_frames:
            # For other targets, an empty part clears the mark of the previous view.
            marked = [
                self._positions_m(
                    [view] if view in self.scatter_m and self.frames[view] == frame else []
                )
                for view in rows
            ]
            entity = f"{self._placements(frame)}/{paths.THIS_VIEW}"
            radius = 1.5 * _POINT * self.size_m
            style = rr.Points3D.from_fields(colors=colours.THIS_VIEW, radii=radius)
            stream.log(entity, rr.CoordinateFrame(frame), style, static=True)
            points = rr.Points3D.columns(positions=np.vstack(marked))
            parts = points.partition([len(array) for array in marked])
            send_rows(stream, entity, rows.values(), parts)

    def _positions_m(self, views: Sequence[int]) -> FloatArray:
        """(k, 3) drawn positions of targets by some views, in their frames."""
        drawn_m = np.reshape([self.factor * self.scatter_m[view] for view in views], (-1, 3))
        lengths = np.maximum(np.linalg.norm(drawn_m, axis=1, keepdims=True), 1e-12)
        return np.asarray(drawn_m * np.minimum(1.0, _REACH * self.size_m / lengths))

    def _placements(self, frame: str) -> str:
        return f"{paths.entity_of(frame)}/placements_magnified_{self.factor}x"


def _principal_sigmas(edge: Edge) -> tuple[FloatArray, FloatArray]:
    """Standard deviations (3,) [m] along the columns of a (3, 3) rotation, in the child's frame."""
    variances_m2, axes = np.linalg.eigh(edge.covariance[3:, 3:])
    return np.sqrt(np.clip(variances_m2, 0.0, None)), axes * np.sign(np.linalg.det(axes))


def round_factor(wanted_m: float, size_m: float) -> int:
    """Largest of 1, 2, 5, 10, 20 ... that keeps a size within the wanted one."""
    if not size_m > 0.0:
        return 1
    ratio = max(wanted_m / size_m, 1.0)
    decade = 10 ** int(np.floor(np.log10(ratio)))
    return int(max(step * decade for step in (1, 2, 5) if step * decade <= ratio))
