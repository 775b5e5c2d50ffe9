"""Drawing of a robot arm, a capsule per link and a ball per joint, and of obstacles."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from visioncal.core.types import FloatArray
from visioncal.present.recording import colours, paths
from visioncal.present.recording.recorder import send_rows
from visioncal.robot import Robot

# Radii of links at the base and at the flange, as shares of the arm's length; about a UR's.
_BASE_RADIUS, _FLANGE_RADIUS = 0.03, 0.02
# Radius of joints, as a share of their link's.
_JOINT_RADIUS = 1.2
_LINKS: dict[str, Any] = {"colors": colours.LINK, "fill_mode": "solid"}
_JOINTS: dict[str, Any] = {"colors": colours.JOINT, "fill_mode": "solid"}

# Half width of the floor that is drawn, as a share of the cell's size.
_FLOOR = 1.3
# The floor is drawn a little lower, so that a board on it is visible [m].
_BELOW_M = 0.004


def log_arm(stream: rr.RecordingStream, link_frames: FloatArray) -> None:
    """Draws an arm at the stream's current time, by its (n, 4, 4) link frames in the base [m]."""
    capsules, balls = _shapes(link_frames[None])
    stream.log(f"{paths.ROBOT}/links", rr.Capsules3D(**capsules, **_LINKS))
    stream.log(f"{paths.ROBOT}/joints", rr.Ellipsoids3D(**balls, **_JOINTS))


def log_pose(
    stream: rr.RecordingStream, entity: str, frame: str, base_from_frame: FloatArray
) -> None:
    """Places a frame in the base at the stream's current time."""
    stream.log(entity, placed(base_from_frame, paths.BASE_FRAME, frame))


def log_arm_motion(
    stream: rr.RecordingStream,
    robot: Robot,
    q: FloatArray,
    times: Iterable[float | np.timedelta64],
) -> None:
    """Draws an arm and its flange over time, by (m, n) joint angles [rad] and their times [s]."""
    for time, q_then in zip(times, q, strict=True):
        stream.set_time(paths.MOTION_TIMELINE, duration=time)
        links = robot.link_frames(q_then)
        log_arm(stream, links)
        log_pose(stream, paths.FLANGE, paths.FLANGE_FRAME, links[-1])
    stream.reset_time()


def placed(pose: FloatArray, parent: str, child: str) -> rr.Transform3D:
    """Transform of a child frame on its parent, from a (4, 4) pose `parent_from_child`."""
    return rr.Transform3D(
        translation=pose[:3, 3], mat3x3=pose[:3, :3], parent_frame=parent, child_frame=child
    )


def log_frames(
    stream: rr.RecordingStream, axis_m: float, more: Sequence[tuple[str, str, float]] = ()
) -> None:
    """Draws the axes of base and flange, and places the arm in the base.

    The flange's axes have the length `axis_m`, the base's are twice as long; `more` are other
    entities with their frames and their lengths relative to the flange's.
    """
    base = rr.Transform3D(parent_frame="cell", child_frame=paths.BASE_FRAME)
    stream.log(paths.BASE, base, static=True)
    standard = ((paths.BASE, paths.BASE_FRAME, 2.0), (paths.FLANGE, paths.FLANGE_FRAME, 1.0))
    for entity, frame, scale in (*standard, *more):
        axes = rr.TransformAxes3D(scale * axis_m, show_frame=True)
        stream.log(entity, rr.CoordinateFrame(frame), axes, static=True)
    for part in ("links", "joints"):
        frame_of_arm = rr.CoordinateFrame(paths.BASE_FRAME)
        stream.log(f"{paths.ROBOT}/{part}", frame_of_arm, static=True)


def log_arms(
    stream: rr.RecordingStream, views: Sequence[FloatArray | None], entity: str = paths.ROBOT
) -> None:
    """Draws an arm in every view by (n, 4, 4) link frames; None clears the previous view's arm."""
    known_views = [view for view in views if view is not None]
    link_frames, rows = np.array(known_views or [np.zeros((0, 4, 4))]), range(len(views))
    counts = link_frames.shape[1] * np.array([view is not None for view in views])
    (capsules, balls), links, joints = _shapes(link_frames), f"{entity}/links", f"{entity}/joints"
    stream.log(links, rr.Capsules3D.from_fields(**_LINKS), static=True)
    send_rows(stream, links, rows, rr.Capsules3D.columns(**capsules).partition(counts))
    stream.log(joints, rr.Ellipsoids3D.from_fields(**_JOINTS), static=True)
    parts = rr.Ellipsoids3D.columns(**balls).partition(np.maximum(counts - 1, 0))
    send_rows(stream, joints, rows, parts)


def _shapes(link_frames: FloatArray) -> tuple[dict[str, Any], dict[str, Any]]:
    """Capsules and balls of arms by their (m, n, 4, 4) frames of joints and flange [m].

    Returns:
        For m n links their lengths, radii, start points and rotations from the z axis, and for
        m (n - 1) joints their centres and radii, arm after arm; neither base nor flange is a joint.
    """
    origins = np.insert(link_frames[:, :, :3, 3], 0, 0.0, axis=1)
    links = np.diff(origins, axis=1)
    lengths_m = np.linalg.norm(links, axis=2)
    shares = np.linspace(_BASE_RADIUS, _FLANGE_RADIUS, links.shape[1])
    radii_m = lengths_m.sum(axis=1)[:, None] * shares
    capsules = {
        "lengths": lengths_m.ravel(),
        "radii": radii_m.ravel(),
        "translations": origins[:, :-1].reshape(-1, 3),
        "quaternions": _from_z_to(links.reshape(-1, 3)),
    }
    half_sizes = np.repeat(_JOINT_RADIUS * radii_m[:, :-1].reshape(-1, 1), 3, axis=1)
    return capsules, {"centers": origins[:, 1:-1].reshape(-1, 3), "half_sizes": half_sizes}


def _from_z_to(directions: FloatArray) -> FloatArray:
    """(n, 4) quaternions x, y, z, w that rotate the z axis onto (n, 3) directions."""
    x, y, z = directions.T
    quaternions = np.stack([-y, x, np.zeros(len(x)), np.linalg.norm(directions, axis=1) + z], 1)
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    # For -z any horizontal axis will do; links without length have no direction.
    return np.where(norms > 1e-9, quaternions / np.maximum(norms, 1e-9), [1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A box: pose of its centre in the base (4, 4) and its side lengths (3,) [m]."""

    name: str
    base_from_box: FloatArray
    size_m: FloatArray


def log_obstacles(
    stream: rr.RecordingStream, obstacles: Sequence[Obstacle], floor_m: float | None, size_m: float
) -> None:
    """Draws the boxes, and the floor of a cell of `size_m` at a height in the base, if any [m]."""
    frame = rr.CoordinateFrame(paths.BASE_FRAME)
    if floor_m is not None:
        half = _FLOOR * size_m
        floor = rr.Boxes3D(
            centers=[[0.0, 0.0, floor_m - _BELOW_M]],
            half_sizes=[[half, half, 0.0]],
            colors=colours.GRID,
        )
        stream.log(f"{paths.OBSTACLES}/floor", frame, floor, static=True)
    for index, box in enumerate(obstacles):
        shape = rr.Boxes3D(
            centers=[np.zeros(3)],
            half_sizes=[0.5 * np.asarray(box.size_m)],
            colors=[(*colours.REJECTED, 90)],
            labels=[box.name],
            fill_mode="solid",
        )
        name = f"box_{index + 1}"
        pose = placed(box.base_from_box, paths.BASE_FRAME, name)
        entity = f"{paths.OBSTACLES}/{name}"
        stream.log(entity, pose, rr.CoordinateFrame(name), shape, static=True)
