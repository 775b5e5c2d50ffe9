"""The layout in which the rerun viewer opens the recording of a dynamic identification."""

import numpy as np
import rerun.blueprint as rrb

from visioncal.dynamics import Run
from visioncal.present.recording import paths
from visioncal.present.viewer.layout import eye_on, series, space_view, with_panels


def dynamics_blueprint(run: Run) -> rrb.Blueprint:
    """Lays out torques over time beside the moving arm.

    Returns:
        The layout, to be written into the recording.
    """
    tabs = rrb.Tabs(_overview(run), _figures(), active_tab=0)
    return with_panels(tabs, paths.MOTION_TIMELINE)


def _overview(run: Run) -> rrb.Container:
    robot = run.identified.robot
    joints, names = range(robot.joint_count), robot.joint_names
    torques = [
        series(f"{names[joint]} [N m]", paths.of_joint(paths.TORQUES, joint)) for joint in joints
    ]
    q = np.concatenate([prediction.q for prediction in run.predictions])
    flange = robot.base_from_flange(q)[:, :3, 3]
    contents = [f"+ {paths.BASE}/**", f"+ {paths.ROBOT}/**"]
    arm = space_view("The arm as it moved", contents, eye_on(np.array([np.zeros(3), *flange])))
    left = rrb.Vertical(
        arm,
        series("Error of all joints [N m]", paths.TORQUE_ERRORS),
        series("Speeds [rad/s]", paths.SPEEDS),
        row_shares=[2, 1, 1],
    )
    return rrb.Horizontal(
        left,
        rrb.Grid(*torques, grid_columns=2),
        name="Torques: measured grey, predicted blue, by what was known before brown",
        column_shares=[1, 2],
    )


def _figures() -> rrb.Container:
    return rrb.Horizontal(
        rrb.TextDocumentView(name="How well torques are predicted", origin=paths.DYNAMICS_NOTE),
        rrb.TextDocumentView(name="Base parameters", origin=paths.PARAMETERS_NOTE),
        name="Figures",
    )
