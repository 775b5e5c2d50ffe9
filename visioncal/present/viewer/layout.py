"""Layout of a recording in the rerun viewer."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from visioncal.core.types import FloatArray
from visioncal.core.verdict import Verdict
from visioncal.present import result_parts
from visioncal.present.coverage import AXES_RINGS_DEG, DIRECTIONS_RINGS_DEG
from visioncal.present.recording import colours, paths
from visioncal.results import Calibration, CellResult
from visioncal.session import Session
from visioncal.session.table import reported_matrices

# Distance of the eye from the cell's centre, in extents of the cell's content.
EYE_DISTANCE = 0.8


@dataclass(frozen=True)
class _Contents:
    """Which parts a session and its result have."""

    images: bool
    unused: bool
    frames: bool
    orientations: bool
    by_camera: bool
    seers: tuple[str, ...]
    cell: CellResult | None

    @classmethod
    def of(cls, session: Session, calibration: Calibration | None) -> "_Contents":
        cell = None if calibration is None else calibration.cell
        views = () if calibration is None else calibration.views
        return cls(
            any(view.image or view.has_corners for view in session.views),
            not all(view.used for view in views),
            calibration is not None and bool(calibration.frames),
            not views or any(view.residual_deg is not None for view in views),
            session.mount != "instrument",
            tuple(dict.fromkeys(view.seer for view in views)) or ("",),
            cell,
        )


def blueprint(session: Session, calibration: Calibration | None = None) -> rrb.Blueprint:
    """Layout of a recording of a session and its result; parts that they lack get no space.

    The first tab shows the verdict, the cell and the image. Others show the network of a cell, the
    calibrated arm, the residuals, the coverage, and the solvers.
    """
    contents, eye = _Contents.of(session, calibration), _eye(session, calibration)
    tabs: list[rrb.Container | rrb.View] = [_overview(contents, eye, calibration)]
    if contents.cell is not None:
        tabs.append(rrb.GraphView(name="Network: frames with their sigmas", origin=paths.NETWORK))
    tabs += [] if calibration is None else _arms(calibration)
    tabs.append(_residuals(contents))
    if contents.cell is None:
        tabs.append(_coverage(contents))
    tabs.append(_figures(calibration))
    return with_panels(rrb.Tabs(*tabs, active_tab=0))


def _figures(calibration: Calibration | None) -> rrb.Container:
    figures = rrb.TextDocumentView(name="Residuals, noise and uncertainty", origin=paths.FIGURES)
    if calibration is not None and not calibration.solvers:
        return rrb.Horizontal(figures, name="Figures")
    solvers = rrb.TextDocumentView(name="Solvers", origin=paths.SOLVERS)
    return rrb.Horizontal(figures, solvers, name="Figures", column_shares=[2, 3])


def with_panels(content: rrb.Container, timeline: str = paths.TIMELINE) -> rrb.Blueprint:
    """A layout with collapsed panels, paused at the start of a timeline."""
    folded = rrb.PanelState.Collapsed
    return rrb.Blueprint(
        content,
        rrb.TimePanel(state=folded, timeline=timeline, play_state="paused"),
        rrb.SelectionPanel(state=folded),
        rrb.BlueprintPanel(state=folded),
    )


def space_view(
    name: str,
    contents: Sequence[str],
    eye: rrb.EyeControls3D | None = None,
    frame: str = paths.BASE_FRAME,
) -> rrb.Spatial3DView:
    """Entities in 3D, with z upwards."""
    return rrb.Spatial3DView(
        name=name,
        origin="/",
        contents=contents,
        eye_controls=eye,
        spatial_information=rrb.SpatialInformation(frame, axes=rr.ViewCoordinates.RIGHT_HAND_Z_UP),
    )


def image_view(
    name: str, entity: str, bounds: rrb.VisualBounds2D | None = None
) -> rrb.Spatial2DView:
    """An entity in 2D, with its overlays."""
    return rrb.Spatial2DView(
        name=name, origin=entity, contents=["$origin/**"], visual_bounds=bounds
    )


def series(name: str, entity: str) -> rrb.TimeSeriesView:
    """Curves of an entity, without a legend, which would cover them."""
    return rrb.TimeSeriesView(
        name=name, origin=entity, contents=["$origin/**"], plot_legend=rrb.PlotLegend(visible=False)
    )


def _overview(
    contents: _Contents, eye: rrb.EyeControls3D | None, calibration: Calibration | None
) -> rrb.Container:
    frame = paths.BASE_FRAME if contents.cell is None else paths.CELL_FRAME
    cell = space_view("Cell", _cell_contents(contents), eye, frame)
    # The residuals of one camera fit below the cell, those of several have a tab.
    plots = _plots(contents, "") if contents.cell is None else []
    left: rrb.Container | rrb.View = cell
    if plots:
        left = rrb.Vertical(cell, rrb.Horizontal(*plots[:1], *plots[1:][-1:]), row_shares=[3, 1])
    verdict = _verdict(contents, None if calibration is None else calibration.verdict)
    note = rrb.TextDocumentView(name="This view", origin=paths.VIEW_NOTE)
    if not contents.images:
        right = rrb.Vertical(verdict, note, row_shares=[2, 1])
        return rrb.Horizontal(left, right, name="Overview", column_shares=[1.3, 1])
    title = "Image: green detected, blue predicted, red residual"
    # With several cameras, room for the largest image.
    cameras = {} if contents.cell is None else contents.cell.cameras
    sizes = np.array([camera.camera.resolution for camera in cameras.values()], dtype=float)
    width, height = sizes.max(axis=0) if len(sizes) else (0.0, 0.0)
    bounds = rrb.VisualBounds2D(x_range=(0.0, width), y_range=(0.0, height)) if width else None
    image = image_view(title, paths.IMAGE, bounds)
    right = rrb.Vertical(verdict, image, note, row_shares=[3.7, 4.2, 1.5])
    return rrb.Horizontal(left, right, name="Overview", column_shares=[1.2, 1])


def _arms(calibration: Calibration) -> list[rrb.Container]:
    """What was found of the arms, as text."""
    sections = calibration.by_name.robots.values()
    if not any(
        section.thermal is not None or (section.arm is not None and section.arm.is_calibrated)
        for section in sections
    ):
        return []
    note = rrb.TextDocumentView(name="The arms", origin=paths.ARM_NOTE)
    return [rrb.Horizontal(note, name="Arm")]


def _verdict(contents: _Contents, verdict: Verdict | None) -> rrb.Container | rrb.View:
    """The verdict's text below a strip in its colour, with tools and fixtures in a second tab."""
    view: rrb.Container | rrb.View = rrb.TextDocumentView(name="Verdict", origin=paths.VERDICT)
    if verdict is not None:
        strip = rrb.Spatial2DView(
            name=verdict.headline,
            origin=paths.VERDICT_STRIP,
            background=[*colours.VERDICT[verdict.status]],
        )
        view = rrb.Vertical(strip, view, row_shares=[1, 8], name="Verdict")
    if not contents.frames:
        return view
    tools = rrb.TextDocumentView(name="Tools and fixtures", origin=paths.TOOLS)
    return rrb.Tabs(view, tools, active_tab=0)


def _residuals(contents: _Contents) -> rrb.Container:
    over_views = [rrb.Horizontal(*_plots(contents, seer)) for seer in contents.seers]
    return rrb.Vertical(*over_views, name="Residuals")


def _coverage(contents: _Contents) -> rrb.Container:
    directions, axes = disc_views()
    if not contents.by_camera:
        return rrb.Horizontal(axes, name="Coverage")
    if not contents.images:
        return rrb.Horizontal(directions, axes, name="Coverage")
    image = image_view("Corners of all views in the image", paths.IMAGE_COVERAGE)
    return rrb.Horizontal(
        image, rrb.Vertical(directions, axes), name="Coverage", column_shares=[1.6, 1]
    )


def disc_views() -> tuple[rrb.Spatial2DView, rrb.Spatial2DView]:
    """Charts of viewing directions and rotation axes."""
    views = []
    for name, entity, rings_deg in (
        ("Where the camera looks from, about the target's normal", paths.DIRECTIONS,
         DIRECTIONS_RINGS_DEG),
        ("Axes of rotation from view to view, about the flange's z", paths.ROTATION_AXES,
         AXES_RINGS_DEG),
    ):  # fmt: skip
        # With room for labels around the rim.
        reach_deg = (-1.2 * rings_deg[-1], 1.2 * rings_deg[-1])
        bounds = rrb.VisualBounds2D(x_range=reach_deg, y_range=reach_deg)
        title = f"{name} (rings: {rings_deg[0]}\N{DEGREE SIGN})"
        views.append(image_view(title, entity, bounds))
    return views[0], views[1]


def _eye(session: Session, calibration: Calibration | None) -> rrb.EyeControls3D | None:
    """Views the cell from the side so that it fills the view; None without known positions."""
    frames = result_parts.frames(calibration)
    parents = {paths.CELL_FRAME, paths.BASE_FRAME}
    fixed = [
        matrix[:3, 3]
        for frame, matrix in frames.matrices.items()
        if frames.parents[frame] in parents
    ]
    # With several robots, the poses have different bases.
    poses = {} if session.is_network else reported_matrices(session.views)
    places = np.array([np.zeros(3), *(pose[:3, 3] for pose in poses.values()), *fixed])
    return eye_on(places) if len(places) > 2 else None


def eye_on(places: FloatArray, distance: float = EYE_DISTANCE) -> rrb.EyeControls3D:
    """Views (k, 3) points [m] from the side so that they fill the view."""
    low, high = places.min(axis=0), places.max(axis=0)
    centre, size_m = 0.5 * (low + high), float(np.linalg.norm(high - low))
    forward = centre[:2] / max(float(np.linalg.norm(centre[:2])), 1e-9)
    # From the robot's front right, above the table.
    direction = np.array([forward[1] + 0.6 * forward[0], 0.6 * forward[1] - forward[0], 0.6])
    return rrb.EyeControls3D(position=centre + distance * size_m * direction, look_target=centre)


def _cell_contents(contents: _Contents) -> list[str]:
    kinds = (paths.BASE, paths.ROBOT, paths.FLANGE, paths.CAMERA, paths.TARGET)
    entities = [
        *(name for entity in kinds for name in (entity, f"{entity}s")),
        paths.STOPS,
        paths.FRAMES,
        paths.SEEN_TARGET,
        paths.CELL,
        paths.SIGHT_LINE,
    ]
    # The image's overlays would clutter the frustum.
    hidden = [f"- {paths.IMAGE}/**", f"+ {paths.IMAGE}"] if contents.images else []
    return [*(f"+ {entity}/**" for entity in entities), *hidden]


def _plots(contents: _Contents, seer: str) -> list[rrb.TimeSeriesView]:
    plots = [
        ("Position residual [mm]", paths.POSITION_MM),
        *([("Orientation residual [deg]", paths.ORIENTATION_DEG)] if contents.orientations else []),
    ]
    if contents.images:
        plots.append(("Reprojection error [px]", paths.REPROJECTION_PX))
    # A legend would cover the marks at the top and bottom, which are of these views; a longer title
    # would be cut off.
    legend = "; red: not used" if contents.unused else ""
    of = f"{seer}: " if seer else ""
    return [series(f"{of}{name}{legend}", paths.part_of(word, seer)) for name, word in plots]
