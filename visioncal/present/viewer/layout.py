"""Layouts of recordings and of previews of plans in the rerun viewer."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from visioncal.core.types import FloatArray
from visioncal.present import result_parts
from visioncal.present.recording import colours, paths
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.session.table import reported_matrices

# Its import takes long, and the layout of a recording does without.
if TYPE_CHECKING:
    from visioncal.present.recording.preview import MotionPreview, Preview

_THINGS = (paths.BASE, paths.ROBOT, paths.FLANGE, paths.CAMERA, paths.TARGET)
# The overlays of the image would clutter the frustum.
_PLAIN_IMAGE = (f"- {paths.IMAGE}/**", f"+ {paths.IMAGE}")


def blueprint(session: Session, calibration: Calibration | None = None) -> rrb.Blueprint:
    """Layout of a recording of a session and its result; parts that they lack get no space.

    The first tab shows the verdict, the cell and the image. Others show the network of a cell, and
    the residuals.
    """
    views = () if calibration is None else calibration.views
    cell = None if calibration is None else calibration.cell
    seers = dict.fromkeys(view.seer for view in views) or ("",)
    has_images = any(view.image or view.has_corners for view in session.views)
    plots = {"Position residual [mm]": paths.POSITION_MM}
    if not views or any(view.residual_deg is not None for view in views):
        plots["Orientation residual [deg]"] = paths.ORIENTATION_DEG
    if has_images:
        plots["Reprojection error [px]"] = paths.REPROJECTION_PX
    # A legend would cover the marks at the top and bottom, which are of these views; a longer title
    # would be cut off.
    legend = "; red: not used" if not all(view.used for view in views) else ""

    def curves_of(seer: str) -> list[rrb.View]:
        return [
            rrb.TimeSeriesView(
                name=f"{seer}: {name}{legend}" if seer else f"{name}{legend}",
                origin=paths.part_of(plot, seer),
                contents=["$origin/**"],
                plot_legend=rrb.PlotLegend(visible=False),
            )
            for name, plot in plots.items()
        ]

    things = [*_THINGS, *(f"{thing}s" for thing in _THINGS), paths.STOPS]
    things += [paths.FRAMES, paths.SEEN_TARGET, paths.CELL]
    frame = paths.BASE_FRAME if cell is None else paths.CELL_FRAME
    fixed = result_parts.frames(calibration).fixed_m
    # With several robots, the poses have different bases.
    poses = {} if session.is_network else reported_matrices(session.views)
    places = np.array([np.zeros(3), *(pose[:3, 3] for pose in poses.values()), *fixed])
    left: rrb.Container | rrb.View = _space_view(
        "Cell", things, _eye_on(places) if len(places) > 2 else None, frame, has_image=has_images
    )
    if cell is None:
        # The residuals of one camera fit below the cell, those of several have a tab. A view has
        # one container: the tab has others.
        curves = curves_of(next(iter(seers)))
        few = rrb.Horizontal(*curves[:1], *curves[1:][-1:])
        left = rrb.Vertical(left, few, row_shares=[3, 1])
    verdict: rrb.Container | rrb.View = rrb.TextDocumentView(name="Verdict", origin=paths.VERDICT)
    if calibration is not None:
        strip = rrb.Spatial2DView(
            name=calibration.verdict.headline,
            origin=paths.VERDICT_STRIP,
            background=[*colours.VERDICT[calibration.verdict.status]],
        )
        verdict = rrb.Vertical(strip, verdict, row_shares=[1, 8], name="Verdict")
    right = [verdict, rrb.TextDocumentView(name="This view", origin=paths.VIEW_NOTE)]
    if has_images:
        title = "Image: green detected, blue predicted, red residual"
        # With several cameras, room for the largest image.
        sizes = [] if cell is None else [lens.camera.resolution for lens in cell.lenses.values()]
        bounds = None
        if sizes:
            width, height = np.max(sizes, axis=0).astype(float)
            bounds = rrb.VisualBounds2D(x_range=(0.0, width), y_range=(0.0, height))
        right.insert(1, _image_view(title, bounds))
    shares = [3.7, 4.2, 1.5] if has_images else [2, 1]
    overview = rrb.Horizontal(
        left, rrb.Vertical(*right, row_shares=shares), name="Overview", column_shares=[1.2, 1]
    )
    rows = (rrb.Horizontal(*curves_of(seer)) for seer in seers)
    residuals = rrb.Vertical(*rows, name="Residuals")
    network = rrb.GraphView(name="Network: frames with their sigmas", origin=paths.NETWORK)
    tabs = (overview, *((network,) if cell is not None else ()), residuals)
    return _with_panels(rrb.Tabs(*tabs, active_tab=0))


def plan_blueprint(preview: "Preview") -> rrb.Blueprint:
    """Layout of the preview of a plan."""
    flange = preview.base_from_flange
    poses = [pose for base_from_flange in flange for pose in preview.placed(base_from_flange)]
    places = np.array([np.zeros(3), *(pose[:3, 3] for pose in (*flange, *poses))])
    things = (*_THINGS, paths.OBSTACLES, paths.STOPS, paths.WAY)
    title = "Cell: stops in blue, way in orange"
    cell = _space_view(title, things, _eye_on(places), has_image=True)
    note = rrb.TextDocumentView(name="The plan", origin=paths.PLAN_NOTE)
    stop = rrb.TextDocumentView(name="This stop", origin=paths.STOP_NOTE)
    image = _image_view("The board in the image, as predicted")
    right = rrb.Vertical(note, image, stop, row_shares=[3.4, 3.6, 1.6])
    return _with_panels(rrb.Horizontal(cell, right, column_shares=[1.5, 1]))


def motion_blueprint(preview: "MotionPreview") -> rrb.Blueprint:
    """Layout of the preview of motions."""
    things = (paths.BASE, paths.ROBOT, paths.FLANGE, paths.OBSTACLES, paths.WAY)
    cell = _space_view("The flange's way", things, _eye_on(preview.places_m))
    note = rrb.TextDocumentView(name="The plan", origin=paths.PLAN_NOTE)
    return _with_panels(rrb.Horizontal(cell, note, column_shares=[2, 1]), paths.MOTION_TIMELINE)


def _with_panels(content: rrb.Container, timeline: str = paths.TIMELINE) -> rrb.Blueprint:
    """A layout with collapsed panels, paused at the start of a timeline."""
    folded = rrb.PanelState.Collapsed
    return rrb.Blueprint(
        content,
        rrb.TimePanel(state=folded, timeline=timeline, play_state="paused"),
        rrb.SelectionPanel(state=folded),
        rrb.BlueprintPanel(state=folded),
    )


def _space_view(
    name: str,
    things: Iterable[str],
    eye: rrb.EyeControls3D | None,
    frame: str = paths.BASE_FRAME,
    *,
    has_image: bool = False,
) -> rrb.Spatial3DView:
    """Entities in 3D, with z upwards."""
    return rrb.Spatial3DView(
        name=name,
        origin="/",
        contents=[*(f"+ {thing}/**" for thing in things), *(_PLAIN_IMAGE if has_image else ())],
        eye_controls=eye,
        spatial_information=rrb.SpatialInformation(frame, axes=rr.ViewCoordinates.RIGHT_HAND_Z_UP),
    )


def _image_view(name: str, bounds: rrb.VisualBounds2D | None = None) -> rrb.Spatial2DView:
    """The image, with its overlays."""
    return rrb.Spatial2DView(
        name=name, origin=paths.IMAGE, contents=["$origin/**"], visual_bounds=bounds
    )


def _eye_on(places: FloatArray) -> rrb.EyeControls3D:
    """Views (k, 3) points [m] from the side so that they fill the view."""
    low, high = places.min(axis=0), places.max(axis=0)
    centre, size_m = 0.5 * (low + high), float(np.linalg.norm(high - low))
    forward = centre[:2] / max(float(np.linalg.norm(centre[:2])), 1e-9)
    # From the robot's front right, above the table.
    direction = np.array([forward[1] + 0.6 * forward[0], 0.6 * forward[1] - forward[0], 0.6])
    return rrb.EyeControls3D(position=centre + 0.8 * size_m * direction, look_target=centre)
