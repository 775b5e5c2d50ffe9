"""Charts over all views, with a mark for the current view: coverage, and joints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import rerun as rr

from visioncal.core.types import FloatArray, IntArray
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
        bars = rr.BarChart(
            list(self.residual_mm.values()),
            abscissa=np.array(list(self.angle_deg.values())),
            widths=np.full(len(self.angle_deg), self._width_deg),
            color=colours.USED,
        )
        stream.log(f"{paths.over_joint(self.joint)}/{paths.USED}", bars, static=True)

    def log_marks(self, stream: rr.RecordingStream, rows: Mapping[int, int]) -> None:
        """Marks the current view's bar, for all views, by row in the session, in one message."""
        heights = _single_tensors([self.residual_mm.get(view) for view in rows])
        angles_deg = _single_tensors([self.angle_deg.get(view) for view in rows])
        colour = rr.components.ColorBatch([colours.THIS_VIEW] * len(rows))
        widths_deg = rr.components.LengthBatch([self._width_deg] * len(rows))
        columns = {
            rr.BarChart.descriptor_values(): heights,
            rr.BarChart.descriptor_abscissa(): angles_deg,
            rr.BarChart.descriptor_color(): colour.as_arrow_array(),
            rr.BarChart.descriptor_widths(): widths_deg.as_arrow_array(),
        }
        send_rows(
            stream,
            f"{paths.over_joint(self.joint)}/{paths.THIS_VIEW}",
            rows.values(),
            [
                rr.ComponentColumn(key, rr.AnyBatchValue(key, array))
                for key, array in columns.items()
            ],
        )

    @property
    def _width_deg(self) -> float:
        """Width of a bar; visible also for a joint that did not move."""
        return _BAR * max(float(np.ptp(list(self.angle_deg.values()))), 1.0)


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

    def log_marks(self, stream: rr.RecordingStream, rows: Mapping[int, int]) -> None:
        """Marks the current view, for all views, by row in the session, in one message a chart."""
        for chart in self.points:
            marked = [chart.points.get(view, np.zeros((0, 2))) for view in rows]
            points = rr.Points2D.columns(positions=np.vstack(marked))
            entity = f"{paths.COVERAGE}/{chart.name}/{paths.THIS_VIEW}"
            parts = points.partition([len(array) for array in marked])
            send_rows(stream, entity, rows.values(), parts)
        for joint in self.joints:
            joint.log_marks(stream, rows)

    def log_view(self, stream: rr.RecordingStream, view: int) -> None:
        """Marks one view, at the stream's current time."""
        for chart in self.points:
            positions = chart.points.get(view, np.zeros((0, 2)))
            points = rr.Points2D.from_fields(positions=positions)
            stream.log(f"{paths.COVERAGE}/{chart.name}/{paths.THIS_VIEW}", points)


def _single_tensors(values: Sequence[float | None]) -> pa.Array:
    """Tensors of one number each, or of none; rerun itself cannot batch them."""
    tensor_type = rr.components.TensorDataBatch(np.zeros(1)).as_arrow_array().type
    union, count = tensor_type.field("buffer").type, len(values)
    sizes = np.array([value is not None for value in values], dtype=np.int64)
    numbers = pa.array([value for value in values if value is not None], pa.float64())
    children = [pa.nulls(0, field.type) for field in union]
    type_code = [field.name for field in union].index("F64")
    # Built from buffers: arrays that arrow builds may hold nulls, which changes their type.
    children[type_code] = _from_buffers(union[type_code].type, count, [_offsets(sizes)], [numbers])
    type_codes, indices = np.full(count, type_code, dtype=np.int8), np.arange(count, dtype=np.int32)
    buffer = _from_buffers(
        union, count, [pa.py_buffer(type_codes), pa.py_buffer(indices)], children
    )
    shapes = pa.array(sizes, pa.uint64())
    shape = _from_buffers(
        tensor_type.field("shape").type, count, [_offsets(np.ones(count, dtype=np.int64))], [shapes]
    )
    names = pa.nulls(count, tensor_type.field("names").type)
    return pa.StructArray.from_arrays([shape, names, buffer], fields=list(tensor_type))


def _offsets(sizes: IntArray) -> pa.Buffer:
    return pa.py_buffer(np.append(0, np.cumsum(sizes)).astype(np.int32))


def _from_buffers(
    kind: pa.DataType, count: int, buffers: list[pa.Buffer], children: list[pa.Array]
) -> pa.Array:
    return pa.Array.from_buffers(kind, count, [None, *buffers], children=children)


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
