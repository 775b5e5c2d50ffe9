"""Runs the stages on simulated corners, without images: what detection would give is given."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES
from visioncal.calibration.stages.arm_report import ArmReport
from visioncal.calibration.stages.cameras import detect_targets
from visioncal.calibration.stages.joints import MatchedJoints
from visioncal.calibration.stages.reported_poses import RobotReport
from visioncal.core.transforms import invert, log
from visioncal.core.types import Corners
from visioncal.robot import Robot, load_robot
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE, pose_row
from visioncal.simulation import CellOptions, SimulatedCell, cell_session


def session_of(cell: SimulatedCell) -> Session:
    """The session of a cell as it stands in memory, its images not rendered, without joints."""
    session = cell_session(cell, "cell", seen="names")
    document = {name: value for name, value in session.document.items() if name != "robot"}
    columns = [
        column
        for column in session.columns
        if column in POSE or (column[0] != "q" and column != "stamp_s")
    ]
    return Session.assemble(
        document,
        columns,
        [[view.cell(column) for column in columns] for view in session.views],
        session.images,
        target_document=session.target_document,
    )


def pairs_session(mount: str, base_from_flange: np.ndarray, cam_from_target: np.ndarray) -> Session:
    """A session of measured pairs of poses, each (m, 4, 4), as its text would be read."""
    rows = [
        [str(at), *(repr(value) for pose in pair for value in pose_row(pose).values())]
        for at, pair in enumerate(zip(base_from_flange, cam_from_target, strict=True))
    ]
    columns = ("view", *POSE, *(f"cft_{name}" for name in POSE))
    document = {"schema": 1, "name": "pairs", "mount": mount}
    return Session.assemble(document, columns, rows, MemoryImages({}))


def arm_found(known: RunState) -> ArmReport:
    """What the stops determine of the only robot's arm."""
    return next(iter(known.assessment.arms.values()))


def known_of(
    cell: SimulatedCell, *, joints: bool = True, robot: Robot | None = None, **changes
) -> RunState:
    """What is known after detection; without `joints`, poses are all that is said of the robot."""
    model = load_robot(cell.options.robot) if robot is None else robot
    known = joints or robot is not None
    stops = {sight.view: sight.stop for sight in cell.sights}
    joints_of = {view: cell.robot.joints[at] for view, at in stops.items()} if joints else {}
    reported = RobotReport(
        {view: cell.robot.base_from_flange[at] for view, at in stops.items()},
        matched=MatchedJoints(model, joints_of) if known else None,
    )
    known = replace(RunState(session_of(cell)), robots={"": reported}, **changes)
    return detect_targets(known, {view_corners.view: view_corners for view_corners in cell.corners})


def calibrated(cell: SimulatedCell, **changes) -> RunState:
    """What is known at the end of the way."""
    known = known_of(cell, **changes)
    for stage in STAGES:
        if stage.name not in ("robot", "detect"):
            known = stage.run(known)
    return known


def calibrated_sweep(moved: SimulatedCell) -> RunState:
    """What is known at the end of the way, from the corners of a sweep's frames."""
    known = replace(known_of(moved, joints=False), robots={})
    views = [
        replace(view, numbers={"stamp_s": sight.stamp_s})
        for view, sight in zip(known.session.views, moved.sights, strict=True)
    ]
    session = replace(known.session, views=tuple(views)).with_streams(moved.streams)
    known = replace(known, session=session)
    for stage in STAGES:
        if stage.name not in ("robot", "detect"):
            known = stage.run(known)
    return known


def reporting(cell: SimulatedCell, **changes) -> SimulatedCell:
    """A cell whose only robot reports otherwise."""
    return replace(cell, robots={"": replace(cell.robot, **changes)})


def showing(cell: SimulatedCell, corners: Iterable[Corners]) -> SimulatedCell:
    """A cell in whose images other corners are found."""
    sights = zip(cell.sights, corners, strict=True)
    return replace(cell, sights=tuple(replace(sight, corners=item) for sight, item in sights))


def board_numbers(cell: SimulatedCell) -> np.ndarray:
    """(m,) which of the boards each image shows."""
    names = [board.name for board in cell.layout.boards]
    return np.array([names.index(sight.board) for sight in cell.sights])


def error_of(cell: SimulatedCell, known: RunState) -> np.ndarray:
    """(6 + 6 b,) right perturbations of all edges, true to estimated (rotation, translation)."""
    true = np.array(list(cell.transforms.values()))
    return log(invert(true) @ known.assessment.fit.state.edges).ravel()


def exact(options: CellOptions | None = None) -> CellOptions:
    """A cell, the default one if none is given, without noise or error of any kind.

    Its reports, its detections and its board are the truth; its images are only rounded to grey
    levels.
    """
    sigmas = (
        *("pixel_sigma_px", "robot_sigma_m", "robot_sigma_rad", "dh_sigma_m", "dh_sigma_rad"),
        *("offset_sigma_rad", "eccentricity_sigma_rad", "ripple_sigma_rad", "function_sigma_rad"),
        *("image_noise", "lens_mismatch_px", "board_bow_m"),
    )
    sound = {"compliance_rad_per_nm": (), "backlash_rad": (), "wrong_views": 0, "board_scale": 1.0}
    return replace(options or CellOptions(), **dict.fromkeys(sigmas, 0.0), **sound)
