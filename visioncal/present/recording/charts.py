"""Charts over all views, with a mark for the current view: coverage, and joints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from visioncal.core.types import FloatArray
from visioncal.present import coverage
from visioncal.present.coverage import PointChart
from visioncal.present.recording import colours, paths
from visioncal.present.recording.recorder import send_rows
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session

# Widths in the viewer's UI points, independent of the chart's scale.
_POINT, _LINE = rr.Radius.ui_points(2.5), rr.Radius.ui_points(0.6)
_MARK = rr.Radius.ui_points(4.5)
# Rerun's default draw order of points is 30.
_ABOVE = 40.0
# Width of a bar as a share of the chart's range.
_BAR = 0.012


@dataclass(frozen=True, eq=False)
class JointChart:
    """Residuals against the angle of one joint."""

    joint: int  # Its index, from 0.
    angle_deg: Mapping[int, float]  # By view [deg].
    residual_mm: Mapping[int, float]  # By view [mm].

    def log(self, stream: rr.RecordingStream) -> None:
        """Draws the bars of all views."""
        bars = self._bars([*self.angle_deg], colours.USED)
        stream.log(f"{paths.over_joint(self.joint)}/{paths.USED}", bars, static=True)

    def log_marks(self, stream: rr.RecordingStream, rows: Mapping[int, int]) -> None:
        """Marks the current view's bar, for all views, by row in the session."""
        # Rerun cannot send the tensors of several rows in one message.
        for view, row in rows.items():
            mark = self._bars([view] if view in self.angle_deg else [], colours.THIS_VIEW)
            stream.set_time(paths.TIMELINE, sequence=row)
            stream.log(f"{paths.over_joint(self.joint)}/{paths.THIS_VIEW}", mark)

    def _bars(self, views: Sequence[int], colour: tuple[int, int, int]) -> rr.BarChart:
        # Visible also for a joint that did not move.
        width_deg = _BAR * max(float(np.ptp(list(self.angle_deg.values()))), 1.0)
        return rr.BarChart(
            np.array([self.residual_mm[view] for view in views]),
            abscissa=np.array([self.angle_deg[view] for view in views]),
            widths=np.full(len(views), width_deg),
            color=colour,
        )


@dataclass(frozen=True, eq=False)
class Charts:
    """All charts of a result."""

    # Coverage of the image, of directions and of rotation axes, where known.
    points: tuple[PointChart, ...]
    joints: tuple[JointChart, ...]  # One chart per joint, if the session has joint angles.
    used: frozenset[int]  # The views in the fit.

    @classmethod
    def of(
        cls, session: Session, calibration: Calibration, evidence: Mapping[int, ViewEvidence]
    ) -> "Charts":
        """Charts of one camera and one robot; none for a cell."""
        used = frozenset(view.view for view in calibration.views if view.used)
        if calibration.cell is not None:
            # A chart has no room for several cameras, boards or robots.
            return cls((), (), used)
        charts = (
            coverage.image_chart(calibration, evidence),
            None if calibration.mount == "instrument" else coverage.directions_chart(evidence),
            coverage.rotation_axes_chart([view for view in evidence.values() if view.view in used]),
        )
        points = tuple(chart for chart in charts if chart is not None)
        return cls(points, _joint_charts(session, calibration), used)

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Draws what is the same in all views."""
        for chart in self.points:
            lines = rr.LineStrips2D(chart.lines, colors=colours.GRID, radii=_LINE)
            stream.log(f"{paths.COVERAGE}/{chart.name}/grid", lines, static=True)
            places = [place for place, _ in chart.words]
            labels = [word for _, word in chart.words]
            words = rr.Points2D(
                places, labels=labels, show_labels=True, colors=colours.WORDS, radii=0.0
            )
            stream.log(f"{paths.COVERAGE}/{chart.name}/words", words, static=True)
            for name, colour, is_used in (
                (paths.USED, colours.USED, True),
                (paths.REJECTED, colours.REJECTED, False),
            ):
                shown = [
                    point for view, point in chart.points.items() if (view in self.used) is is_used
                ]
                if shown:
                    points = rr.Points2D(np.vstack(shown), colors=colour, radii=_POINT)
                    stream.log(f"{paths.COVERAGE}/{chart.name}/{name}", points, static=True)
            style = rr.Points2D.from_fields(
                colors=colours.THIS_VIEW, radii=_MARK, draw_order=_ABOVE
            )
            stream.log(f"{paths.COVERAGE}/{chart.name}/{paths.THIS_VIEW}", style, static=True)
        for joint in self.joints:
            joint.log(stream)

    def log_views(
        self, stream: rr.RecordingStream, rows: Mapping[int, int], timeline: str = paths.TIMELINE
    ) -> None:
        """Marks the current view, for some views, by row, in one message a chart."""
        for chart in self.points:
            marked = [chart.points.get(view, np.zeros((0, 2))) for view in rows]
            points = rr.Points2D.columns(positions=np.vstack(marked))
            entity = f"{paths.COVERAGE}/{chart.name}/{paths.THIS_VIEW}"
            parts = points.partition([len(array) for array in marked])
            send_rows(stream, entity, rows.values(), parts, timeline)
        for joint in self.joints:
            joint.log_marks(stream, rows)


def _joint_charts(session: Session, calibration: Calibration) -> tuple[JointChart, ...]:
    residual_mm = {
        view.view: view.residual_mm
        for view in calibration.views
        if view.used and view.residual_mm is not None
    }
    q_deg: dict[int, FloatArray] = {}
    for view in session.views:
        if view.joints_rad is not None and view.number in residual_mm:
            q_deg[view.number] = np.rad2deg(view.joints_rad)
    joints = min((len(q) for q in q_deg.values()), default=0)
    return tuple(
        JointChart(
            joint,
            {view: float(q[joint]) for view, q in q_deg.items()},
            {view: residual_mm[view] for view in q_deg},
        )
        for joint in range(joints)
    )
