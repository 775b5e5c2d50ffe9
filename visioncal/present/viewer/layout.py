"""The layout in which the rerun viewer opens a recording."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from visioncal.core.types import FloatArray
from visioncal.core.verdict import Verdict
from visioncal.present.recording import colours, paths
from visioncal.present.recording.coverage import AXES_RINGS_DEG, DIRECTIONS_RINGS_DEG
from visioncal.results import Calibration
from visioncal.results.arm import ArmResult
from visioncal.session import Session
from visioncal.session.table import reported_matrices

# Distance of the eye from the cell's centre, in extents of all that the cell holds.
EYE_DISTANCE = 0.8
# And in extents of the workspace, whose corners are empty.
MAP_DISTANCE = 0.55


@dataclass(frozen=True)
class _Contents:
    """What a session has to show."""

    images: bool
    joints: int
    unused: bool
    frames: bool
    turns: bool = True
    sight: bool = True


def blueprint(session: Session, calibration: Calibration | None = None) -> rrb.Blueprint:
    """Lays out a recording of a session and its result.

    The first tab shows the verdict, the cell and the image; others the calibrated arm, the
    residuals, what the views cover, and the solvers.

    Args:
        session: The session; what it does not have gets no room.
        calibration: Its result, by which the eye finds camera and target too.

    Returns:
        The layout, to be written into the recording.
    """
    if calibration is not None and calibration.cell is not None:
        # It is made of what is here.
        from visioncal.present.viewer.cells import cell_blueprint

        return cell_blueprint(session, calibration.cell)
    joints = [len(view.joints_rad) for view in session.views if view.joints_rad is not None]
    results = () if calibration is None else calibration.views
    contents = _Contents(
        any(view.image or view.has_corners for view in session.views),
        min(joints, default=0),
        not all(view.used for view in results),
        calibration is not None and bool(calibration.frames),
        not results or any(view.residual_deg is not None for view in results),
        session.mount != "instrument",
    )
    verdict = None if calibration is None else calibration.verdict
    eye = _eye(session, calibration)
    arm = None if calibration is None else calibration.arm
    tabs = rrb.Tabs(
        _overview(contents, eye, verdict),
        *([] if arm is None or not arm.is_calibrated else [_arm(arm, eye)]),
        *([] if calibration is None or calibration.thermal is None else [_warming()]),
        *([_explained()] if calibration is not None and calibration.dense is not None else []),
        _residuals(contents),
        _coverage(contents),
        rrb.Horizontal(
            rrb.TextDocumentView(name="Residuals, noise and uncertainty", origin=paths.FIGURES),
            rrb.TextDocumentView(name="Solvers", origin=paths.SOLVERS),
            name="Figures",
            column_shares=[2, 3],
        ),
        active_tab=0,
    )
    return with_panels(tabs)


def with_panels(content: rrb.Container, timeline: str = paths.TIMELINE) -> rrb.Blueprint:
    """A layout whose panels are folded, paused at the start of a timeline."""
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
    """Entities in space, with z upwards."""
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
    """An entity in a plane, with all that is drawn over it."""
    return rrb.Spatial2DView(
        name=name, origin=entity, contents=["$origin/**"], visual_bounds=bounds
    )


def series(name: str, entity: str) -> rrb.TimeSeriesView:
    """The curves of an entity, without a legend, which would hide some of them."""
    return rrb.TimeSeriesView(
        name=name,
        origin=entity,
        contents=["$origin/**"],
        plot_legend=rrb.PlotLegend(visible=False),
    )


def _overview(
    contents: _Contents, eye: rrb.EyeControls3D | None, found: Verdict | None
) -> rrb.Container:
    cell = space_view("Cell", _cell_contents(contents), eye)
    plots = _plots(contents)
    left = rrb.Vertical(cell, rrb.Horizontal(*plots[:1], *plots[1:][-1:]), row_shares=[3, 1])
    verdict = _verdict(contents, found)
    note = rrb.TextDocumentView(name="This view", origin=paths.VIEW_NOTE)
    if not contents.images:
        right = rrb.Vertical(verdict, note, row_shares=[2, 1])
        return rrb.Horizontal(left, right, name="Overview", column_shares=[1.3, 1])
    image = image_view("Image: green detected, blue predicted, red residual", paths.IMAGE)
    right = rrb.Vertical(verdict, image, note, row_shares=[3.7, 4.2, 1.5])
    return rrb.Horizontal(left, right, name="Overview", column_shares=[1.2, 1])


def _explained() -> rrb.Container:
    """The image, the board as it should look in it, and what is left."""
    images = rrb.Horizontal(
        *(
            rrb.Spatial2DView(name=name, origin=entity, contents=["$origin"])
            for name, entity in (
                ("Image", paths.IMAGE),
                ("As calibration, blur and light have it", paths.DRAWN),
                ("Not explained", paths.REST),
            )
        )
    )
    note = rrb.TextDocumentView(name="What blurs it", origin=paths.BLUR_NOTE)
    return rrb.Vertical(images, note, name="Images explained", row_shares=[4, 1])


def _warming() -> rrb.Container:
    """How the arm drifted, view by view, and how much warmer its warmest link was."""
    return rrb.Vertical(
        rrb.TimeSeriesView(name="Drift of the flange [mm]", origin=paths.DRIFT_MM),
        rrb.TimeSeriesView(name="Rise of the warmest link [K]", origin=paths.RISE_K),
        name="Temperature",
    )


def _arm(found: ArmResult, eye: rrb.EyeControls3D | None) -> rrb.Container:
    """The accuracy of the calibrated arm, how views left out speak for it, and its parameters."""
    # The places are all around the base, farther out than the views.
    wider = eye_on(found.map_places_m, MAP_DISTANCE) if found.workspace_map else eye
    places = (paths.BASE, paths.ROBOT, paths.WORKSPACE, paths.NOMINAL_ARM)
    contents = [*(f"+ {it}/**" for it in places), f"+ {paths.STOPS}/{paths.USED}"]
    cell = space_view("Sigma of a tool's place over the workspace", contents, wider)
    note = rrb.TextDocumentView(name="The arm", origin=paths.ARM_NOTE)
    if not found.left_out:
        return rrb.Horizontal(cell, note, name="Arm", column_shares=[1.4, 1])
    # What else there is to say stands in the note; a title has little room.
    words = "orange: as stated, blue: calibrated"
    unseen = [series(f"Left out [mm], {words}", paths.UNSEEN_MM)]
    if found.nominal.held_out_deg is not None:
        unseen.append(series(f"Left out [deg], {words}", paths.UNSEEN_DEG))
    left = rrb.Vertical(cell, rrb.Horizontal(*unseen), row_shares=[2.4, 1])
    return rrb.Horizontal(left, note, name="Arm", column_shares=[1.4, 1])


def verdict_views(found: Verdict | None) -> rrb.Container | rrb.View:
    """The verdict's text, below a strip in its colour once there is one."""
    text = rrb.TextDocumentView(name="Verdict", origin=paths.VERDICT)
    if found is None:
        return text
    strip = rrb.Spatial2DView(
        name=found.headline, origin=paths.VERDICT_STRIP, background=[*colours.VERDICT[found.status]]
    )
    return rrb.Vertical(strip, text, row_shares=[1, 8], name="Verdict")


def _verdict(contents: _Contents, found: Verdict | None) -> rrb.Container | rrb.View:
    """The verdict, and what is said of tools and fixtures behind it."""
    verdict = verdict_views(found)
    if not contents.frames:
        return verdict
    tools = rrb.TextDocumentView(name="Tools and fixtures", origin=paths.TOOLS)
    return rrb.Tabs(verdict, tools, active_tab=0)


def _residuals(contents: _Contents) -> rrb.Container:
    over_views = rrb.Horizontal(*_plots(contents))
    if contents.joints == 0:
        return rrb.Vertical(over_views, name="Residuals")
    over_joints = rrb.Grid(
        *(
            rrb.BarChartView(
                name=f"Position residual [mm] over q{joint + 1} [deg]",
                origin=paths.over_joint(joint),
                plot_legend=rrb.PlotLegend(visible=False),
            )
            for joint in range(contents.joints)
        ),
        grid_columns=min(contents.joints, 4) if contents.joints != 6 else 3,
    )
    return rrb.Vertical(over_views, over_joints, name="Residuals", row_shares=[1, 2])


def _coverage(contents: _Contents) -> rrb.Container:
    directions, axes = disc_views()
    if not contents.sight:
        return rrb.Horizontal(axes, name="Coverage")
    if not contents.images:
        return rrb.Horizontal(directions, axes, name="Coverage")
    image = image_view("Corners of all views in the image", paths.IMAGE_COVERAGE)
    return rrb.Horizontal(
        image, rrb.Vertical(directions, axes), name="Coverage", column_shares=[1.6, 1]
    )


def disc_views() -> tuple[rrb.Spatial2DView, rrb.Spatial2DView]:
    """The charts of where the camera looks from, and of the axes of rotation."""
    directions = _disc(
        "Where the camera looks from, about the target's normal",
        paths.DIRECTIONS,
        DIRECTIONS_RINGS_DEG,
    )
    axes = _disc(
        "Axes of rotation from view to view, about the flange's z",
        paths.ROTATION_AXES,
        AXES_RINGS_DEG,
    )
    return directions, axes


def _disc(name: str, entity: str, rings_deg: tuple[int, ...]) -> rrb.Spatial2DView:
    """A chart of directions, with room for the words around its rim."""
    reach_deg = 1.2 * rings_deg[-1]
    bounds = rrb.VisualBounds2D(x_range=(-reach_deg, reach_deg), y_range=(-reach_deg, reach_deg))
    return image_view(f"{name} (rings: {rings_deg[0]}\N{DEGREE SIGN})", entity, bounds)


def _eye(session: Session, calibration: Calibration | None) -> rrb.EyeControls3D | None:
    """Looks at the cell from the side, from where all of it fills the view."""
    poses = reported_matrices(session.views)
    if not poses:
        return None
    edges = {} if calibration is None else calibration.transforms
    fixed = [edge.translation for name, edge in edges.items() if name.startswith("base_from_")]
    return eye_on(np.array([np.zeros(3), *(it[:3, 3] for it in poses.values()), *fixed]))


def eye_on(places: FloatArray, distance: float = EYE_DISTANCE) -> rrb.EyeControls3D:
    """Looks at (k, 3) places from where all of them fill the view [m]."""
    low, high = places.min(axis=0), places.max(axis=0)
    centre, size_m = 0.5 * (low + high), float(np.linalg.norm(high - low))
    forward = centre[:2] / max(float(np.linalg.norm(centre[:2])), 1e-9)
    # From the robot's right and its front, above the table.
    direction = np.array([forward[1] + 0.6 * forward[0], 0.6 * forward[1] - forward[0], 0.6])
    return rrb.EyeControls3D(position=centre + distance * size_m * direction, look_target=centre)


def _cell_contents(contents: _Contents) -> list[str]:
    entities = [
        paths.BASE,
        paths.ROBOT,
        paths.FLANGE,
        paths.STOPS,
        paths.CAMERA,
        paths.TARGET,
        paths.TARGETS,
        paths.FRAMES,
        paths.SEEN_TARGET,
    ]
    # The image's overlays would float as a crowd of points in the frustum.
    hidden = [f"- {paths.IMAGE}/**", f"+ {paths.IMAGE}"] if contents.images else []
    return [*(f"+ {entity}/**" for entity in entities), *hidden]


def _plots(contents: _Contents) -> list[rrb.TimeSeriesView]:
    wanted = [
        ("Position residual [mm]", paths.POSITION_MM),
        *([("Orientation residual [deg]", paths.ORIENTATION_DEG)] if contents.turns else []),
    ]
    if contents.images:
        wanted.append(("Reprojection error [px]", paths.REPROJECTION_PX))
    # A legend would hide the marks at the top and at the bottom, of just these views; a longer
    # title would be cut beside a plot's buttons.
    legend = "; red: not used" if contents.unused else ""
    return [series(f"{name}{legend}", entity) for name, entity in wanted]
