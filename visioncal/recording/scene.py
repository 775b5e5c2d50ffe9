"""The cell in 3D: robot, camera and target, as the calibration puts them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import rerun as rr

from visioncal.calibration import Calibration
from visioncal.camera import matrix_3x3
from visioncal.evidence import ViewEvidence
from visioncal.recording import paths
from visioncal.session import Session, View
from visioncal.targets import corner_positions
from visioncal.types import FloatArray, Target

_ROBOT_RGB = (140, 150, 165)
_TARGET_RGB = (240, 180, 40)
_SEEN_RGB = (240, 90, 60)
_USED_RGB = (70, 150, 250)
_UNUSED_RGB = (230, 70, 60)

# Sizes of what is drawn, as shares of the cell's size: how far the flange is from the base.
_AXIS, _FRUSTUM, _LINE, _POINT = 0.12, 0.18, 0.002, 0.007


@dataclass(frozen=True, eq=False)
class Scene:
    """What is drawn of the cell. All poses are logged in the base frame.

    Attributes:
        session: The session.
        calibration: Its result, if there is one; without it only the flange is drawn.
        base_from_flange: (4, 4) by the view's number, where known.
        size_m: Typical distance of the flange from the base [m].
    """

    session: Session
    calibration: Calibration | None
    base_from_flange: Mapping[int, FloatArray]
    size_m: float

    @classmethod
    def of(
        cls,
        session: Session,
        calibration: Calibration | None,
        evidence: Mapping[int, ViewEvidence],
    ) -> "Scene":
        """Collects the poses of the flange, from the evidence or else as they were recorded."""
        poses: dict[int, FloatArray] = {}
        for view in session.views:
            seen = evidence.get(view.number)
            reported = view.base_from_flange()
            if seen is not None and seen.base_from_flange is not None:
                poses[view.number] = seen.base_from_flange
            elif reported is not None:
                poses[view.number] = reported.as_matrix()
        distances = [float(np.linalg.norm(pose[:3, 3])) for pose in poses.values()]
        return cls(session, calibration, poses, float(np.median(distances)) if distances else 1.0)

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Logs what does not change from view to view."""
        axis_m = _AXIS * self.size_m
        stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.log(paths.BASE, rr.TransformAxes3D(2.0 * axis_m), static=True)
        stream.log(paths.FLANGE, rr.TransformAxes3D(axis_m), static=True)
        self._log_stops(stream)
        if self.calibration is None:
            return
        stream.log(paths.CAMERA, rr.TransformAxes3D(axis_m), static=True)
        if self.calibration.camera is not None:
            self._log_frustum(stream)
        if self.session.target is not None:
            self._log_board(stream, self.session.target)

    def log_view(self, stream: rr.RecordingStream, view: View, seen: ViewEvidence) -> None:
        """Logs where everything is in one view, at the stream's current time."""
        base_from_flange = self.base_from_flange.get(view.number)
        _log_pose(stream, paths.FLANGE, base_from_flange)
        self._log_links(stream, view)
        if self.calibration is None:
            return
        base_from_cam, base_from_target = self._ends(base_from_flange)
        _log_pose(stream, paths.CAMERA, base_from_cam)
        _log_pose(stream, paths.TARGET, base_from_target)
        if seen.cam_from_target is None or base_from_cam is None:
            stream.log(paths.SEEN_TARGET, rr.Clear(recursive=True))
        else:
            _log_pose(stream, paths.SEEN_TARGET, base_from_cam @ seen.cam_from_target)
            if self.session.target is not None:
                outline = _outline(self.session.target)
                stream.log(
                    f"{paths.SEEN_TARGET}/outline",
                    rr.LineStrips3D([outline], colors=_SEEN_RGB, radii=self._radius(0.5 * _LINE)),
                )

    def _ends(
        self, base_from_flange: FloatArray | None
    ) -> tuple[FloatArray | None, FloatArray | None]:
        """Where the calibration puts camera and target in one view: `base_from_...`."""
        edges = {} if self.calibration is None else self.calibration.transforms
        known = {name: edge.as_matrix() for name, edge in edges.items()}
        ends = []
        for end in ("cam", "target"):
            if f"base_from_{end}" in known:
                ends.append(known[f"base_from_{end}"])
            elif base_from_flange is not None and f"flange_from_{end}" in known:
                ends.append(base_from_flange @ known[f"flange_from_{end}"])
            else:
                ends.append(None)
        return ends[0], ends[1]

    def _radius(self, share: float) -> float:
        return share * self.size_m

    def _log_stops(self, stream: rr.RecordingStream) -> None:
        """All places of the flange; those of views that were not used in another colour."""
        used = {
            view.view for view in (self.calibration.views if self.calibration else ()) if view.used
        }
        for name, rgb in ((paths.USED, _USED_RGB), (paths.REJECTED, _UNUSED_RGB)):
            positions = [
                pose[:3, 3]
                for view, pose in self.base_from_flange.items()
                if (view in used or self.calibration is None) is (name == paths.USED)
            ]
            if positions:
                points = rr.Points3D(positions, colors=rgb, radii=self._radius(_POINT))
                stream.log(f"{paths.STOPS}/{name}", points, static=True)

    def _log_frustum(self, stream: rr.RecordingStream) -> None:
        if self.calibration is None or self.calibration.camera is None:
            return
        camera = self.calibration.camera.camera
        matrix = matrix_3x3(camera)
        # Rerun puts the image's corner, not the first pixel's centre, at the origin.
        matrix[:2, 2] += 0.5
        pinhole = rr.Pinhole(
            image_from_camera=matrix,
            resolution=camera.resolution,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_FRUSTUM * self.size_m,
        )
        stream.log(paths.IMAGE, pinhole, static=True)

    def _log_board(self, stream: rr.RecordingStream, target: Target) -> None:
        outline = rr.LineStrips3D(
            [_outline(target)], colors=_TARGET_RGB, radii=self._radius(1.5 * _LINE)
        )
        corners = rr.Points3D(
            corner_positions(target), colors=_TARGET_RGB, radii=self._radius(_LINE)
        )
        stream.log(f"{paths.TARGET}/outline", outline, static=True)
        stream.log(f"{paths.TARGET}/corners", corners, static=True)
        stream.log(paths.TARGET, rr.TransformAxes3D(0.7 * _AXIS * self.size_m), static=True)

    def _log_links(self, stream: rr.RecordingStream, view: View) -> None:
        robot = None if self.calibration is None else self.calibration.robot
        q = view.joints_rad
        if robot is None or q is None or len(q) != robot.joint_count:
            return
        origins = np.vstack([np.zeros(3), robot.link_frames(q)[:, :3, 3]])
        links = rr.LineStrips3D([origins], colors=_ROBOT_RGB, radii=self._radius(0.012))
        joints = rr.Points3D(origins, colors=_ROBOT_RGB, radii=self._radius(0.02))
        stream.log(f"{paths.ROBOT}/links", links)
        stream.log(f"{paths.ROBOT}/joints", joints)


def _log_pose(stream: rr.RecordingStream, entity: str, pose: FloatArray | None) -> None:
    """Logs (4, 4) `base_from_entity`; an unknown one must not keep the place of the view before."""
    if pose is None:
        stream.log(entity, rr.Clear(recursive=False))
    else:
        stream.log(entity, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))


def _outline(target: Target) -> FloatArray:
    """(5, 3) closed outline of the printed pattern in the target's frame [m]."""
    side = target.square_m
    if target.kind == "marker":
        low, high = np.full(2, -0.5 * side), np.full(2, 0.5 * side)
    else:
        # A checkerboard's origin is its first inner corner, one square inside.
        low = np.full(2, 0.0 if target.kind == "charuco" else -side)
        high = side * np.array([target.columns, target.rows], dtype=float)
    x, y = np.array([low, high]).T
    return np.array(
        [[x[0], y[0], 0], [x[1], y[0], 0], [x[1], y[1], 0], [x[0], y[1], 0], [x[0], y[0], 0]]
    )
