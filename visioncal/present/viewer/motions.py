"""The layout in which the rerun viewer opens the preview of motions."""

import rerun as rr
import rerun.blueprint as rrb

from visioncal.present.recording import paths
from visioncal.present.recording.motions import MotionPreview
from visioncal.present.viewer.layout import eye_on

_TITLES = {
    "position_deg": "Joint angles [deg]",
    "speed_deg_s": "Speeds [deg/s]",
    "acceleration_deg_s2": "Accelerations [deg/s\N{SUPERSCRIPT TWO}]",
    "torque_nm": "Torques of the nominal arm [N m]",
}


def motion_blueprint(preview: MotionPreview) -> rrb.Blueprint:
    """Lays out the preview of motions.

    Args:
        preview: What it shows.

    Returns:
        The layout, to be written into the recording.
    """
    entities = (paths.BASE, paths.ROBOT, paths.FLANGE, paths.OBSTACLES, paths.WAY)
    cell = rrb.Spatial3DView(
        name="The flange's way: exciting motion in orange, sweeps in blue",
        origin="/",
        contents=[f"+ {it}/**" for it in entities],
        eye_controls=eye_on(preview.places_m),
        spatial_information=rrb.SpatialInformation(
            paths.BASE_FRAME, axes=rr.ViewCoordinates.RIGHT_HAND_Z_UP
        ),
    )
    note = rrb.TextDocumentView(name="The plan", origin=paths.PLAN_NOTE)
    kinds: tuple[str, ...] = paths.MOTION_KINDS
    if any(it.torques_nm is None for it in preview.parts):
        kinds = kinds[:-1]
    # One legend is enough: a joint has the same colour in all curves.
    curves = [
        rrb.TimeSeriesView(
            name=_TITLES[it],
            origin=f"{paths.MOTION}/{it}",
            plot_legend=rrb.PlotLegend(visible=it == kinds[0]),
        )
        for it in kinds
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(cell, note, row_shares=[2, 1]),
            rrb.Vertical(*curves, row_shares=[2, *(1 for _ in curves[1:])]),
            column_shares=[1, 1],
        ),
        rrb.TimePanel(
            state=rrb.PanelState.Collapsed, timeline=paths.MOTION_TIMELINE, play_state="paused"
        ),
        rrb.SelectionPanel(state=rrb.PanelState.Collapsed),
        rrb.BlueprintPanel(state=rrb.PanelState.Collapsed),
    )
