"""The layout in which the rerun viewer opens a recording."""

import numpy as np
import rerun.blueprint as rrb

from visioncal.recording import paths
from visioncal.session import Session

# Distance of the eye from the cell's centre, in extents of the flange's stops and the base.
_EYE_DISTANCE = 1.1


def blueprint(session: Session) -> rrb.Blueprint:
    """Lays out a recording of a session: the cell, the image, the residuals and the verdict.

    Args:
        session: The session; what it does not have gets no room.

    Returns:
        The layout, to be written into the recording.
    """
    has_images = any(view.image for view in session.views)
    cell = rrb.Spatial3DView(
        name="Cell", origin="/", contents=_cell_contents(has_images), eye_controls=_eye(session)
    )
    view_note = rrb.TextDocumentView(name="This view", origin=paths.VIEW_NOTE)
    results = rrb.Tabs(
        rrb.TextDocumentView(name="Verdict", origin=paths.VERDICT),
        rrb.TextDocumentView(name="Solvers", origin=paths.SOLVERS),
    )
    plots = rrb.Horizontal(*_plots(has_images), name="Residuals")
    if has_images:
        image = rrb.Spatial2DView(
            name="Image: green detected, blue predicted, red residual",
            origin=paths.IMAGE,
            contents=["$origin/**"],
        )
        right = rrb.Vertical(image, view_note, results, row_shares=[5, 1.7, 3.3])
    else:
        right = rrb.Vertical(view_note, results, row_shares=[1, 2])
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(cell, plots, row_shares=[3, 1.2]), right, column_shares=[1.2, 1]
        ),
        rrb.TimePanel(state=rrb.PanelState.Collapsed, timeline=paths.TIMELINE),
        rrb.SelectionPanel(state=rrb.PanelState.Collapsed),
        rrb.BlueprintPanel(state=rrb.PanelState.Collapsed),
    )


def _eye(session: Session) -> rrb.EyeControls3D | None:
    """Looks at base and flange from the side, from where both fill the view."""
    poses = [pose for view in session.views if (pose := view.base_from_flange()) is not None]
    if not poses:
        return None
    places = np.array([np.zeros(3), *(pose.translation for pose in poses)])
    low, high = places.min(axis=0), places.max(axis=0)
    centre, size_m = 0.5 * (low + high), float(np.linalg.norm(high - low))
    forward = centre[:2] / max(float(np.linalg.norm(centre[:2])), 1e-9)
    # From the robot's right and its front, above the table.
    direction = np.array([forward[1] + 0.6 * forward[0], 0.6 * forward[1] - forward[0], 0.6])
    return rrb.EyeControls3D(
        position=centre + _EYE_DISTANCE * size_m * direction, look_target=centre
    )


def _cell_contents(has_images: bool) -> list[str]:
    entities = [
        paths.BASE,
        paths.ROBOT,
        paths.FLANGE,
        paths.STOPS,
        paths.CAMERA,
        paths.TARGET,
        paths.SEEN_TARGET,
    ]
    # The image's overlays would float as a crowd of points in the frustum.
    hidden = [f"- {paths.IMAGE}/**", f"+ {paths.IMAGE}"] if has_images else []
    return ["+ /", *(f"+ {entity}/**" for entity in entities), *hidden]


def _plots(has_images: bool) -> list[rrb.TimeSeriesView]:
    wanted = [
        ("Position residual [mm]", paths.POSITION_MM),
        ("Orientation residual [deg]", paths.ORIENTATION_DEG),
    ]
    if has_images:
        wanted.append(("Reprojection error [px]", paths.REPROJECTION_PX))
    return [
        rrb.TimeSeriesView(name=name, origin=entity, contents=[f"$origin/{paths.USED}"])
        for name, entity in wanted
    ]
