"""Charts over all views, which mark the view that is looked at: coverage, and joints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from visioncal.core.types import FloatArray
from visioncal.present.recording import colours, coverage, paths
from visioncal.present.recording.coverage import PointChart
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session

# Widths in the viewer's own points, whatever the scale of the chart.
_POINT, _LINE = rr.Radius.ui_points(2.5), rr.Radius.ui_points(0.6)
_MARK = rr.Radius.ui_points(4.5)
# Rerun draws points at 30 where nothing else is said.
_ABOVE = 40.0
# A bar's share of the range of its chart.
_BAR = 0.012


@dataclass(frozen=True, eq=False)
class JointChart:
    """Residuals over the angle of one joint.

    Attributes:
        joint: Which one, counted from 0.
        angle_deg: By view [deg].
        residual_mm: Of the same views [mm].
    """

    joint: int
    angle_deg: Mapping[int, float]
    residual_mm: Mapping[int, float]

    def log(
        self, stream: rr.RecordingStream, name: str, views: Sequence[int], *, static: bool
    ) -> None:
        """Draws bars for some of the views."""
        angles = np.array([self.angle_deg[view] for view in views])
        span_deg = np.ptp(list(self.angle_deg.values()))
        marked = name == paths.THIS_VIEW
        bars = rr.BarChart(
            [self.residual_mm[view] for view in views],
            abscissa=angles,
            # A joint that stood still still needs bars that can be seen.
            widths=np.full(len(views), _BAR * max(span_deg, 1.0)),
            color=colours.THIS_VIEW if marked else colours.USED,
        )
        stream.log(f"{paths.over_joint(self.joint)}/{name}", bars, static=static)


@dataclass(frozen=True, eq=False)
class Charts:
    """All charts of a result.

    Attributes:
        points: Coverage of the image, of directions and of rotations; only what there is.
        joints: One chart a joint, where the session has joint angles.
        used: The views that the fit used.
    """

    points: tuple[PointChart, ...]
    joints: tuple[JointChart, ...]
    used: frozenset[int]

    @classmethod
    def of(
        cls, session: Session, calibration: Calibration, evidence: Mapping[int, ViewEvidence]
    ) -> "Charts":
        """Collects what there is to draw."""
        used = frozenset(view.view for view in calibration.views if view.used)
        found = (
            coverage.image_chart(calibration, evidence),
            None if calibration.mount == "instrument" else coverage.directions_chart(evidence),
            coverage.rotation_axes_chart([it for it in evidence.values() if it.view in used]),
        )
        points = tuple(chart for chart in found if chart is not None)
        return cls(points, _joint_charts(session, calibration), used)

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Draws all views."""
        for chart in self.points:
            lines = rr.LineStrips2D(chart.lines, colors=colours.GRID, radii=_LINE)
            stream.log(f"{chart.entity}/grid", lines, static=True)
            places = [place for place, _ in chart.words]
            labels = [word for _, word in chart.words]
            words = rr.Points2D(
                places, labels=labels, show_labels=True, colors=colours.WORDS, radii=0.0
            )
            stream.log(f"{chart.entity}/words", words, static=True)
            for name, colour, wanted in (
                (paths.USED, colours.USED, True),
                (paths.REJECTED, colours.REJECTED, False),
            ):
                some = [it for view, it in chart.points.items() if (view in self.used) is wanted]
                if some:
                    points = rr.Points2D(np.vstack(some), colors=colour, radii=_POINT)
                    stream.log(f"{chart.entity}/{name}", points, static=True)
        for joint in self.joints:
            joint.log(stream, paths.USED, list(joint.angle_deg), static=True)

    def log_view(self, stream: rr.RecordingStream, view: int) -> None:
        """Marks one view, at the stream's current time."""
        for chart in self.points:
            positions = chart.points.get(view, np.zeros((0, 2)))
            points = rr.Points2D(
                positions, colors=colours.THIS_VIEW, radii=_MARK, draw_order=_ABOVE
            )
            stream.log(f"{chart.entity}/{paths.THIS_VIEW}", points)
        for joint in self.joints:
            if view in joint.angle_deg:
                joint.log(stream, paths.THIS_VIEW, [view], static=False)
            else:
                entity = f"{paths.over_joint(joint.joint)}/{paths.THIS_VIEW}"
                stream.log(entity, rr.Clear(recursive=False))


def _joint_charts(session: Session, calibration: Calibration) -> tuple[JointChart, ...]:
    """Charts of the used views that have joint angles."""
    residual_mm = {
        it.view: it.residual_mm
        for it in calibration.views
        if it.used and it.residual_mm is not None
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
