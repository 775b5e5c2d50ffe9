"""Layouts of previews of plans in the rerun viewer."""

import numpy as np
import rerun.blueprint as rrb

from visioncal.present.recording import paths
from visioncal.present.recording.preview import MotionPreview, Preview
from visioncal.present.viewer.layout import (
    disc_views,
    eye_on,
    image_view,
    space_view,
    with_panels,
)


def plan_blueprint(preview: Preview) -> rrb.Blueprint:
    """Layout of the preview of a plan."""
    flange = preview.base_from_flange
    poses = [pose for base_from_flange in flange for pose in preview.placed(base_from_flange)]
    places = np.array(
        [np.zeros(3), *flange[:, :3, 3], *(pose_in_base[:3, 3] for pose_in_base in poses)]
    )
    kinds = (paths.BASE, paths.ROBOT, paths.FLANGE, paths.CAMERA, paths.TARGET, paths.OBSTACLES)
    entities = (*kinds, paths.STOPS, paths.WAY)
    # The predicted corners would clutter the frustum.
    hidden = (f"- {paths.IMAGE}/**", f"+ {paths.IMAGE}")
    contents = [*(f"+ {entity}/**" for entity in entities), *hidden]
    cell = space_view("Cell: stops in blue, way in orange", contents, eye_on(places))
    note = rrb.TextDocumentView(name="The plan", origin=paths.PLAN_NOTE)
    stop = rrb.TextDocumentView(name="This stop", origin=paths.STOP_NOTE)
    image = image_view("The board in the image, as predicted", paths.IMAGE)
    right = rrb.Vertical(note, image, stop, row_shares=[3.4, 3.6, 1.6])
    overview = rrb.Horizontal(cell, right, name="Plan", column_shares=[1.5, 1])
    corners = image_view("Corners of all stops in the image", paths.IMAGE_COVERAGE)
    sigma = rrb.BarChartView(
        name="Predicted sigma [mm] after so many stops, the most informative first",
        origin=paths.PREDICTED_SIGMA,
        plot_legend=rrb.PlotLegend(visible=False),
    )
    coverage = rrb.Horizontal(
        rrb.Vertical(corners, sigma, row_shares=[2, 1]),
        rrb.Vertical(*disc_views()),
        name="Coverage",
        column_shares=[1.6, 1],
    )
    return with_panels(rrb.Tabs(overview, coverage, active_tab=0))


def motion_blueprint(preview: MotionPreview) -> rrb.Blueprint:
    """Layout of the preview of motions."""
    entities = (paths.BASE, paths.ROBOT, paths.FLANGE, paths.OBSTACLES, paths.WAY)
    contents = [f"+ {entity}/**" for entity in entities]
    cell = space_view("The flange's way", contents, eye_on(preview.places_m))
    note = rrb.TextDocumentView(name="The plan", origin=paths.PLAN_NOTE)
    return with_panels(
        rrb.Horizontal(cell, note, column_shares=[2, 1]), timeline=paths.MOTION_TIMELINE
    )
