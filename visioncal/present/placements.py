"""Target poses by single views, relative to the result."""

import numpy as np

from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session, frame_name


def target_frames(calibration: Calibration, session: Session | None) -> dict[int, str]:
    """Frame of the target in each view of a single camera, where the result places it."""
    placed = [name.rpartition("_from_")[2] for name in calibration.edges][1:]
    if session is None or calibration.cell is not None:
        return {}
    if not session.targets:
        # A target, or an instrument's probe in its place.
        return dict.fromkeys((view.number for view in session.views), placed[0])
    frames = {view.number: frame_name("target", session.board_of(view)) for view in session.views}
    return {view: frame for view, frame in frames.items() if frame in placed}


def placement(
    calibration: Calibration, view_poses: ViewEvidence, frame: str | None = None
) -> FloatArray | None:
    """Target pose by one view of a single camera, relative to the result.

    Args:
        calibration: The result.
        view_poses: Poses of the view.
        frame: Frame of its target; None for a single target.

    Returns:
        (4, 4) in the target's frame [m]; None without poses.
    """
    if view_poses.base_from_flange is None or view_poses.cam_from_target is None:
        return None
    # The first edge is the camera's or the instrument's; targets' edges follow.
    sensor, *targets = calibration.edges
    target_edge = next(
        (target for target in targets if target.endswith(f"_from_{frame}")), targets[0]
    )
    is_in_hand, edges = calibration.mount == "eye-in-hand", calibration.edges
    robot = view_poses.base_from_flange if is_in_hand else invert(view_poses.base_from_flange)
    return np.asarray(
        invert(edges[target_edge].matrix)
        @ robot
        @ edges[sensor].matrix
        @ view_poses.cam_from_target
    )
