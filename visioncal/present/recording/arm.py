"""Drawing of a robot arm, a capsule per link and a ball per joint, and of obstacles."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import rerun as rr

from visioncal.core.types import FloatArray
from visioncal.present.recording import colours, paths
from visioncal.present.recording.recorder import Row, send_rows
from visioncal.robot.collision import Body

_LINKS: dict[str, Any] = {"colors": colours.LINK, "fill_mode": "solid"}
_JOINTS: dict[str, Any] = {"colors": colours.JOINT, "fill_mode": "solid"}


def placed(pose: FloatArray, parent: str, child: str) -> rr.Transform3D:
    """Transform of a child frame on its parent, from a (4, 4) pose `parent_from_child`."""
    return rr.Transform3D(
        translation=pose[:3, 3], mat3x3=pose[:3, :3], parent_frame=parent, child_frame=child
    )


def log_arms(
    stream: rr.RecordingStream,
    views: Sequence[FloatArray | None],
    rows: Iterable[Row],
    entity: str = paths.ROBOT,
    timeline: str = paths.TIMELINE,
) -> None:
    """Draws an arm in some views by (n, 4, 4) link frames; None clears the previous view's arm."""
    known_views, rows = [view for view in views if view is not None], list(rows)
    link_frames = np.array(known_views or [np.zeros((0, 4, 4))])
    counts = link_frames.shape[1] * np.array([view is not None for view in views])
    (capsules, balls), links, joints = _shapes(link_frames), f"{entity}/links", f"{entity}/joints"
    stream.log(links, rr.Capsules3D.from_fields(**_LINKS), static=True)
    parts = rr.Capsules3D.columns(**capsules).partition(counts)
    send_rows(stream, links, rows, parts, timeline)
    stream.log(joints, rr.Ellipsoids3D.from_fields(**_JOINTS), static=True)
    parts = rr.Ellipsoids3D.columns(**balls).partition(np.maximum(counts - 1, 0))
    send_rows(stream, joints, rows, parts, timeline)


def _shapes(link_frames: FloatArray) -> tuple[dict[str, Any], dict[str, Any]]:
    """Capsules and balls of arms by their (m, n, 4, 4) frames of joints and flange [m]."""
    origins = np.insert(link_frames[:, :, :3, 3], 0, 0.0, axis=1)
    links = np.diff(origins, axis=1)
    lengths_m = np.linalg.norm(links, axis=2)
    # Shares of the arm's length; about a UR's.
    shares = np.linspace(0.03, 0.02, links.shape[1])
    radii_m = lengths_m.sum(axis=1)[:, None] * shares
    # Rotations that turn z to the links.
    directions = links.reshape(-1, 3)
    x, y, z = directions.T
    quaternions = np.stack([-y, x, np.zeros(len(x)), np.linalg.norm(directions, axis=1) + z], 1)
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    # For -z any horizontal axis will do; links without length have no direction.
    capsules = {
        "lengths": lengths_m.ravel(),
        "radii": radii_m.ravel(),
        "translations": origins[:, :-1].reshape(-1, 3),
        "quaternions": np.where(
            norms > 1e-9, quaternions / np.maximum(norms, 1e-9), [1.0, 0.0, 0.0, 0.0]
        ),
    }
    half_sizes = np.repeat(1.2 * radii_m[:, :-1].reshape(-1, 1), 3, axis=1)
    return capsules, {"centers": origins[:, 1:-1].reshape(-1, 3), "half_sizes": half_sizes}


def log_obstacles(
    stream: rr.RecordingStream, obstacles: Sequence[Body], floor_m: float | None, size_m: float
) -> None:
    """Draws the boxes, and the floor of a cell of `size_m` at a height in the base, if any [m]."""
    frame = rr.CoordinateFrame(paths.BASE_FRAME)
    if floor_m is not None:
        half = 1.3 * size_m
        # A little lower, so that a board on the floor is visible.
        floor = rr.Boxes3D(
            centers=[[0.0, 0.0, floor_m - 0.004]],
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
        pose = placed(box.link_from_body, paths.BASE_FRAME, name)
        entity = f"{paths.OBSTACLES}/{name}"
        stream.log(entity, pose, rr.CoordinateFrame(name), shape, static=True)
