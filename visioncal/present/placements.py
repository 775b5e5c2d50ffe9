"""Where single views place their targets, against where the result does."""

import numpy as np

from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session, frame_name


def target_frames(calibration: Calibration, session: Session | None) -> dict[int, str]:
    """The frame of the target that each view of an only camera shows, where it is placed."""
    placed = [name.rpartition("_from_")[2] for name in calibration.edges][1:]
    if session is None or calibration.cell is not None:
        return {}
    if not session.targets:
        # A target, or what an instrument reads in its place.
        return dict.fromkeys((view.number for view in session.views), placed[0])
    frames = {view.number: frame_name("target", session.board_of(view)) for view in session.views}
    return {view: frame for view, frame in frames.items() if frame in placed}


def placement(
    calibration: Calibration, seen: ViewEvidence, frame: str | None = None
) -> FloatArray | None:
    """Where a view of an only camera places its target against where the result does.

    Args:
        calibration: The result.
        seen: The view's poses.
        frame: The frame of the target that it shows; that of an only one where None.

    Returns:
        (4, 4) in the target's frame [m]; None without poses.
    """
    if seen.base_from_flange is None or seen.cam_from_target is None:
        return None
    # The edge of the camera, or of the instrument, is the first; targets' follow.
    x, *targets = calibration.edges
    z = next((target for target in targets if target.endswith(f"_from_{frame}")), targets[0])
    is_in_hand, edges = calibration.mount == "eye-in-hand", calibration.edges
    robot = seen.base_from_flange if is_in_hand else invert(seen.base_from_flange)
    return np.asarray(invert(edges[z].matrix) @ robot @ edges[x].matrix @ seen.cam_from_target)
