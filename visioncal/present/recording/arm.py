"""The robot as it is drawn: a capsule a link and a ball a joint, from its kinematics alone."""

import numpy as np
import rerun as rr

from visioncal.core.types import FloatArray
from visioncal.present.recording import colours, paths

# Thickness from the base to the flange, as shares of the arm's length; about that of a UR.
_BASE_RADIUS, _FLANGE_RADIUS = 0.03, 0.02
# The balls stand out between the links that they join.
_JOINT_RADIUS = 1.2


def log_arm(stream: rr.RecordingStream, link_frames: FloatArray, entity: str = paths.ROBOT) -> None:
    """Draws an arm at the stream's current time.

    Args:
        stream: Where to.
        link_frames: (n, 4, 4) the frames of its joints and its flange in the base [m].
        entity: Under which entity.
    """
    origins = np.vstack([np.zeros(3), link_frames[:, :3, 3]])
    links = np.diff(origins, axis=0)
    lengths_m = np.linalg.norm(links, axis=1)
    radii_m = lengths_m.sum() * np.linspace(_BASE_RADIUS, _FLANGE_RADIUS, len(links))
    capsules = rr.Capsules3D(
        lengths=lengths_m,
        radii=radii_m,
        translations=origins[:-1],
        quaternions=_from_z_to(links),
        colors=colours.LINK,
        fill_mode="solid",
    )
    stream.log(f"{entity}/links", capsules)
    # Neither the base nor the flange is a joint.
    balls = rr.Ellipsoids3D(
        centers=origins[1:-1],
        radii=_JOINT_RADIUS * radii_m[:-1],
        colors=colours.JOINT,
        fill_mode="solid",
    )
    stream.log(f"{entity}/joints", balls)


def _from_z_to(directions: FloatArray) -> FloatArray:
    """(n, 4) quaternions x, y, z, w that turn the z axis into (n, 3) directions of any length."""
    x, y, z = directions.T
    quaternions = np.stack([-y, x, np.zeros(len(x)), np.linalg.norm(directions, axis=1) + z], 1)
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    # Straight down every horizontal axis serves; links without length have no direction.
    return np.where(norms > 1e-9, quaternions / np.maximum(norms, 1e-9), [1.0, 0.0, 0.0, 0.0])
