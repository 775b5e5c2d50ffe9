"""The frames of the targets that views show."""

from visioncal.results import Calibration
from visioncal.session import Session


def target_frames(calibration: Calibration, session: Session | None) -> dict[int, str]:
    """The frame of the target that each view of an only camera shows, where it is placed."""
    placed = [name.rpartition("_from_")[2] for name in calibration.edges][1:]
    if session is None or calibration.cell is not None:
        return {}
    if not session.targets:
        # A target, or what an instrument reads in its place.
        return dict.fromkeys((view.number for view in session.views), placed[0])
    frames = {
        view.number: f"target_{name}" if (name := session.board_of(view)) else "target"
        for view in session.views
    }
    return {view: frame for view, frame in frames.items() if frame in placed}
