"""A transform with its covariance, and how both stand on disk."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray

# Forms of one pose that were rounded to six places agree to this [m, rad]; no cell is known better.
_SAME = 5e-6
# What rounding leaves of a symmetric product: millionths of its correlations, where a rotation is
# known a million times better than the levers that it is carried by [m].
_ROUNDING = 1e-3


@dataclass(frozen=True, eq=False)
class Edge:
    """An edge of the tree of frames that was estimated.

    Attributes:
        matrix: (4, 4) the edge, named `a_from_b` by its owner, exactly as it stands on disk.
        covariance: (6, 6) of its (rotation [rad], translation [m]) perturbation on the right.
    """

    matrix: FloatArray
    covariance: FloatArray

    @property
    def transform(self) -> RigidTransform:
        """The edge as a transform; scipy makes it orthonormal anew, to the last digit."""
        return RigidTransform.from_matrix(self.matrix)

    @property
    def oriented(self) -> bool:
        """Whether its rotation was measured; else it is chosen, and has no covariance."""
        return bool(self.covariance[:3, :3].any())

    @property
    def sigma_mm(self) -> float:
        """Root of the trace of the translation's covariance [mm]."""
        return float(1e3 * np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def sigma_deg(self) -> float:
        """Root of the trace of the rotation's covariance [deg]."""
        return float(np.rad2deg(np.sqrt(np.trace(self.covariance[:3, :3]))))


def pose_document(matrix: FloatArray) -> dict[str, Any]:
    """Writes a (4, 4) transform in the forms that readers ask for."""
    transform = RigidTransform.from_matrix(matrix)
    return {
        "matrix": matrix.tolist(),
        "quaternion_xyzw": transform.rotation.as_quat().tolist(),
        "translation_m": matrix[:3, 3].tolist(),
    }


def edge_document(edge: Edge) -> dict[str, Any]:
    """Writes a transform with its covariance."""
    return pose_document(edge.matrix) | {
        "covariance": edge.covariance.tolist(),
        "sigma_mm": edge.sigma_mm,
        "sigma_deg": edge.sigma_deg,
    }


def read_edge(document: Mapping[str, Any], name: str) -> Edge:
    """Reads what `edge_document` wrote.

    Args:
        document: What was written.
        name: Of the edge, for messages.

    Raises:
        LookupError, TypeError, ValueError: The document is another.
        DataError: Its forms are of different poses.
    """
    return Edge(read_pose(document, name), read_covariance(document, "covariance", (6, 6)))


def read_pose(document: Mapping[str, Any], name: str) -> FloatArray:
    """Reads the (4, 4) matrix of a pose; its errors are those of `read_edge`."""
    matrix = read_array(document, "matrix", (4, 4))
    rotation = matrix[:3, :3]
    if (
        matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]
        or np.abs(rotation).max() > 2.0
        or not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-9)
        or np.linalg.det(rotation) < 0
    ):
        raise ValueError("a matrix is not a rigid transform")
    translation = read_array(document, "translation_m", (3,))
    quaternion = read_array(document, "quaternion_xyzw", (4,))
    turned = Rotation.from_quat(quaternion).as_matrix()
    for form, said, same in (
        ("translation_m", translation, np.allclose(translation, matrix[:3, 3], 0.0, _SAME)),
        ("quaternion_xyzw", quaternion, np.allclose(turned, rotation, 0.0, _SAME)),
    ):
        if not same:
            raise DataError(
                f"{name}: {form} is {said.tolist()}, and its matrix is that of another pose: "
                f"{matrix.tolist()}.",
                culprits=[f"{name}: {form}", f"{name}: matrix"],
                next_step="Somebody changed one of them: take the file as calibrate wrote it.",
            )
    return matrix


def read_covariance(document: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> FloatArray:
    """Reads a covariance as `read_array` does; its correlations are checked.

    Raises:
        LookupError, TypeError, ValueError: The document is another.
    """
    matrix = read_array(document, key, shape)
    variance = np.diagonal(matrix)
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    with np.errstate(over="ignore"):
        scaled = matrix / scale[:, None] / scale
    if (
        (variance < 0.0).any()
        or np.abs(scaled).max(initial=0.0) > 1.0 + _ROUNDING
        or np.abs(scaled - scaled.T).max(initial=0.0) > _ROUNDING
        or (len(scaled) and np.linalg.eigvalsh(scaled)[0] < -_ROUNDING)
    ):
        raise ValueError(f"{key} is no covariance")
    return matrix


def read_array(document: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> FloatArray:
    """Reads an array of finite numbers; a dimension of -1 is any, but the same throughout."""
    array = np.asarray(document[key], dtype=float)
    size = array.shape[0] if array.ndim else 0
    if array.shape != tuple(size if it < 0 else it for it in shape):
        raise ValueError(f"{key} has the shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{key} has entries that are no finite numbers")
    return array
