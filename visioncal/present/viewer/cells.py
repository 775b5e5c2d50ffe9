"""The layout in which the rerun viewer opens the recording of an aligned cell."""

import numpy as np
import rerun.blueprint as rrb

from visioncal.present.recording import paths
from visioncal.present.recording.cells import residual_entity
from visioncal.present.viewer.layout import (
    eye_on,
    image_view,
    series,
    space_view,
    verdict_views,
    with_panels,
)
from visioncal.results import Alignment
from visioncal.session import Session

# Distance of the eye from the cell's centre, in extents of all that stands in it.
_DISTANCE = 0.75


def cell_blueprint(session: Session, found: Alignment) -> rrb.Blueprint:
    """Lays out a recording of a whole cell and its result.

    Args:
        session: The session; what it does not have gets no room.
        found: The result.
    """
    has_images = any(view.image for view in session.views)
    verdict = verdict_views(found.verdict)
    note = rrb.TextDocumentView(name="This view", origin=paths.VIEW_NOTE)
    image = image_view("Image", paths.IMAGE, _bounds(found))
    right = (
        rrb.Vertical(verdict, image, note, row_shares=[3.7, 3.8, 1.4])
        if has_images
        else rrb.Vertical(verdict, note, row_shares=[3, 1])
    )
    overview = rrb.Horizontal(_cell(found), right, name="Overview", column_shares=[1.4, 1])
    network = rrb.GraphView(name="Network: frames with their sigmas", origin=paths.NETWORK)
    seers = list(dict.fromkeys(it.seer for it in found.sights))
    residuals = rrb.Vertical(
        *(
            series(f"{it}: residual [mm]; red: not used", residual_entity(it, "").rstrip("/"))
            for it in seers
        ),
        name="Residuals",
    )
    return with_panels(rrb.Tabs(overview, network, residuals, active_tab=0))


def _bounds(found: Alignment) -> rrb.VisualBounds2D | None:
    """What holds the largest image of all cameras."""
    sizes = [it.camera.resolution for it in found.cameras.values()]
    if not sizes:
        return None
    width, height = (float(max(it)) for it in zip(*sizes, strict=True))
    return rrb.VisualBounds2D(x_range=(0.0, width), y_range=(0.0, height))


def _cell(found: Alignment) -> rrb.Spatial3DView:
    places = [
        found.edge_of(it).matrix[:3, 3] for it, on in found.frames.items() if on == paths.CELL_FRAME
    ]
    entities = (paths.CELL, paths.ROBOTS, paths.SIGHT_LINE)
    contents = [*(f"+ {it}/**" for it in entities), f"+ {paths.IMAGE}"]
    eye = eye_on(np.array([np.zeros(3), *places]), _DISTANCE)
    return space_view("Cell", contents, eye, paths.CELL_FRAME)
