"""Charts of the views' coverage: the image, the viewing directions, the rotation axes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.types import FloatArray
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence

# Columns and rows of the image's grid, to show where no corner lies.
_CELLS = (8, 5)


@dataclass(frozen=True, eq=False)
class PointChart:
    """Points of views in a plane whose x goes to the right and whose y goes down."""

    name: str  # `image`, `directions` or `rotation_axes`.
    points: Mapping[int, FloatArray]  # By view, (k, 2).
    lines: Sequence[FloatArray]  # Background lines, (k, 2) each.
    words: Sequence[tuple[tuple[float, float], str]]  # Labels with their positions.


def image_coverage(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> str:
    """How much of the image the used views' corners reach, in words; empty where unknown."""
    if calibration.cell is not None or calibration.camera is None:
        return ""
    used = {view.view for view in calibration.views if view.used}
    px = [view.corners.px for view in evidence if view.corners is not None and view.view in used]
    if not px:
        return ""
    sizes = np.array(calibration.camera.camera.resolution) / _CELLS
    fields = np.unique(np.floor((np.vstack(px) + 0.5) / sizes).astype(int), axis=0)
    # Corners by another program may lie beside the image.
    fields = fields[((fields >= 0) & (fields < _CELLS)).all(axis=1)]
    return f"Corners in {len(fields)} of {_CELLS[0] * _CELLS[1]} fields of the image"


def coverage_charts(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> list[PointChart]:
    """Coverage of the image, of directions and of rotation axes, where known; none for a cell."""
    if calibration.cell is not None:
        # A chart has no room for several cameras, boards or robots.
        return []
    used = {view.view for view in calibration.views if view.used}
    corners = {view.view: view.corners.px for view in evidence if view.corners is not None}
    charts: list[PointChart | None] = []
    if corners and calibration.camera is not None:
        width, height = calibration.camera.camera.resolution
        # Pixel centres are at integers, so the image begins half a pixel before the first one.
        x = np.linspace(0, width, _CELLS[0] + 1) - 0.5
        y = np.linspace(0, height, _CELLS[1] + 1) - 0.5
        lines = [np.array([[value, y[0]], [value, y[-1]]]) for value in x]
        lines += [np.array([[x[0], value], [x[-1], value]]) for value in y]
        charts.append(PointChart("image", corners, lines, []))
    if calibration.mount != "instrument":
        charts.append(directions_chart(evidence))
    charts.append(rotation_axes_chart([view for view in evidence if view.view in used]))
    return [chart for chart in charts if chart is not None]


def directions_chart(evidence: Sequence[ViewEvidence]) -> PointChart | None:
    """Viewing directions: angle from the target's normal [deg], and azimuth."""
    points = {
        # The target's z axis points into the board, away from the camera.
        seen.view: _disc(seen.cam_from_target[2:3, :3] * [-1.0, -1.0, 1.0])
        for seen in evidence
        if seen.cam_from_target is not None
    }
    if not points:
        return None
    return _disc_chart("directions", points, (15, 30, 45, 60))


def rotation_axes_chart(evidence: Sequence[ViewEvidence]) -> PointChart | None:
    """Axis of the flange's rotation from each view to the next, in the flange's frame.

    The centre is the flange's z axis, the rim its x, y plane; opposite axes coincide.
    """
    poses = {
        view.view: view.base_from_flange for view in evidence if view.base_from_flange is not None
    }
    if len(poses) < 2:
        return None
    rotations = np.array(list(poses.values()))[:, :3, :3]
    rotvecs = Rotation.from_matrix(rotations[:-1].transpose(0, 2, 1) @ rotations[1:]).as_rotvec()
    points: dict[int, FloatArray] = {}
    for view, rotvec in zip(list(poses)[1:], rotvecs, strict=True):
        angle_rad = float(np.linalg.norm(rotvec))
        # The axes of smaller rotations are mostly noise.
        if angle_rad > np.deg2rad(1.0):
            axis = rotvec / (angle_rad if rotvec[2] > 0 else -angle_rad)
            points[view] = _disc(axis[None])
    return _disc_chart("rotation_axes", points, (30, 60, 90)) if points else None


def _disc(directions: FloatArray) -> FloatArray:
    """Azimuthal projection of (k, 3) unit vectors: (k, 2) with radius = angle from z [deg]."""
    angle_deg = np.rad2deg(np.arccos(np.clip(directions[:, 2], -1.0, 1.0)))
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    return np.asarray(angle_deg[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1))


def _disc_chart(
    name: str, points: Mapping[int, FloatArray], rings_deg: Sequence[int]
) -> PointChart:
    """A chart with rings of equal angle, and the x and y axes."""
    angles = np.linspace(0.0, 2 * np.pi, 73)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rim = float(rings_deg[-1])
    lines = [ring * circle for ring in rings_deg]
    lines += [np.array([[-rim, 0], [rim, 0]]), np.array([[0, -rim], [0, rim]])]
    diagonal = 1.06 * rim / np.sqrt(2)
    words = [
        ((1.08 * rim, 0.0), "x"),
        ((0.0, 1.08 * rim), "y"),
        # Only the rim is labelled: other labels would hide points.
        ((diagonal, -diagonal), f"{rim:g}\N{DEGREE SIGN}"),
    ]
    return PointChart(name, points, lines, words)
