"""Charts of coverage over all views, with a mark for the current view."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from visioncal.present.coverage import PointChart
from visioncal.present.recording import colours, paths
from visioncal.present.recording.recorder import send_rows

# Widths in the viewer's UI points, independent of the chart's scale.
_POINT, _LINE = rr.Radius.ui_points(2.5), rr.Radius.ui_points(0.6)
_MARK = rr.Radius.ui_points(4.5)
# Rerun's default draw order of points is 30.
_ABOVE = 40.0


@dataclass(frozen=True, eq=False)
class Charts:
    """All charts of a result or a plan."""

    points: Sequence[PointChart]  # Coverage of the image, of directions, of rotation axes.
    used: frozenset[int]  # The views in the fit.

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
