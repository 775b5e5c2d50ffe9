"""Residuals over joint angles: what a hand-eye calibration cannot explain of the arm."""

from collections.abc import Collection, Sequence

import numpy as np
from markupsafe import Markup

from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.present.report import svg
from visioncal.present.report.axes import Margins, Panel, Scale, boxes, spanning
from visioncal.present.report.svg import Figure
from visioncal.present.target_frames import target_frames
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session

_AXES = (("x", svg.ACCENT), ("y", svg.CHECK), ("z", svg.GOOD))
_WIDTH_IN, _ROW_IN = 9.2, 1.25
# Few points beyond the scale do not flatten the cloud of the others.
_ROOM, _KEPT_PERCENT = 1.3, 95.0
# How wide a point is.
_DASH_PT = 2.4


def residuals_over_joints(
    calibration: Calibration,
    session: Session | None,
    evidence: Sequence[ViewEvidence],
    outlying: Collection[int] = (),
) -> Markup:
    """Residuals of the used views along the target's axes, one column a joint.

    Args:
        calibration: The result.
        session: Where the joint angles are.
        evidence: The views' poses.
        outlying: Numbers of used views to leave out, which would hide the others.

    Returns:
        The figure; empty where there are no joint angles.
    """
    if session is None:
        return Markup("")
    joints_rad = {view.number: view.joints_rad for view in session.views}
    shown = {it.view for it in calibration.views if it.used and it.view not in outlying}
    frames = target_frames(calibration, session)
    pairs = [
        (joints, residual)
        for it in evidence
        if it.view in shown
        and (joints := joints_rad.get(it.view)) is not None
        and (residual := twist_of(calibration, it, frames.get(it.view))) is not None
    ]
    if len(pairs) < 3:
        return Markup("")
    joints_deg = np.rad2deg([joints for joints, _ in pairs])
    twists = np.array([residual for _, residual in pairs])
    return _figure(joints_deg, 1e3 * twists[:, 3:], np.rad2deg(twists[:, :3]))


def twist_of(
    calibration: Calibration, seen: ViewEvidence, frame: str | None = None
) -> FloatArray | None:
    """Where a view places its target against where the result does.

    Args:
        calibration: The result.
        seen: The view's poses.
        frame: The frame of the target that it shows; that of an only one where None.

    Returns:
        (6,) of (rotation [rad], translation [m]) in the target's frame; None without poses.
    """
    if seen.base_from_flange is None or seen.cam_from_target is None:
        return None
    # The camera's edge is the first, targets' follow.
    x, *targets = calibration.edges
    eye_in_hand = calibration.mount == "eye-in-hand"
    z = next((it for it in targets if it.endswith(f"_from_{frame}")), targets[0])
    robot = seen.base_from_flange if eye_in_hand else invert(seen.base_from_flange)
    edges = calibration.edges
    return log(invert(edges[z].matrix) @ robot @ edges[x].matrix @ seen.cam_from_target)


def _figure(joints_deg: FloatArray, away_mm: FloatArray, away_deg: FloatArray) -> Markup:
    """Draws (m, n) joint angles against (m, 3) residuals of position and of orientation."""
    count = joints_deg.shape[1]
    figure = Figure(_WIDTH_IN, 2 * _ROW_IN + 0.5)
    upper, lower = boxes(figure, 2, count, Margins(0.85, top=0.3))
    for row, values, label in (
        (upper, away_mm, "position [mm]"),
        (lower, away_deg, "rotation [deg]"),
    ):
        reach = _ROOM * float(np.percentile(np.abs(values), _KEPT_PERCENT)) or 1.0
        shown, is_lower = np.clip(values, -reach, reach), row is lower
        for joint, box in enumerate(row):
            angles_deg = joints_deg[:, joint]
            panel = Panel(figure, box, spanning(angles_deg), Scale(-1.1 * reach, 1.1 * reach))
            title = f"q{joint + 1} [deg]" if is_lower else ""
            panel.x_axis(title, 3, words=is_lower, whole=True)
            panel.y_axis("" if joint else label, words=joint == 0)
            panel.level(0.0, svg.INK, 0.7)
            for column, (_, colour) in enumerate(_AXES):
                panel.marks(angles_deg, shown[:, column], "-", colour, _DASH_PT)
    sign = 2 * "\N{BOX DRAWINGS HEAVY HORIZONTAL}"
    entries = [(sign, colour, f"target {name}") for name, colour in _AXES]
    figure.legend(upper[-1].right, 12.0, entries)
    return figure.inline("Residuals of the used views over each joint's angle")
