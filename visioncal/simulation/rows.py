"""Columns of a session's rows: poses and loads."""

from scipy.spatial.transform import Rotation

from visioncal.core.types import FloatArray
from visioncal.simulation.sag import Payload

POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


def load_row(load: Payload) -> dict[str, float]:
    """The columns of what the flange carries and is pushed by."""
    centre = {f"payload_{name}_m": at for name, at in zip("xyz", load.centre_m, strict=True)}
    force = {f"force_{name}_n": at for name, at in zip("xyz", load.force_n, strict=True)}
    return {"payload_kg": load.kg} | centre | force


def pose_row(pose: FloatArray) -> dict[str, float]:
    """Seven columns of a pose (4, 4)."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    return dict(zip(POSE, map(float, [*pose[:3, 3], *quaternion]), strict=True))
