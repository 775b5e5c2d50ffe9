"""A camera in a result, and how it stands on disk."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from visioncal.core.types import Camera, FloatArray
from visioncal.results.edge import read_array, read_covariance
from visioncal.results.frame import present
from visioncal.results.parts import CameraResult


def camera_document(result: CameraResult) -> dict[str, Any]:
    """Writes a camera's intrinsics."""
    camera = result.camera
    return present(
        {
            "model": camera.model,
            "resolution": list(camera.resolution),
            "matrix": camera.matrix.tolist(),
            "distortion": camera.distortion.tolist(),
            "estimated": result.estimated,
            "covariance": None if result.covariance is None else result.covariance.tolist(),
            "edge_covariance": (
                None if result.edge_covariance is None else result.edge_covariance.tolist()
            ),
        }
    )


def read_camera(document: Mapping[str, Any]) -> CameraResult:
    """Reads what `camera_document` wrote.

    Raises:
        LookupError, TypeError, ValueError: The document is another.
    """
    width, height = document["resolution"]
    return CameraResult(
        Camera(
            document["model"],
            (int(width), int(height)),
            read_array(document, "matrix", (4,)),
            read_array(document, "distortion", (-1,)),
        ),
        document["estimated"],
        read_covariance(document, "covariance", (-1, -1)) if "covariance" in document else None,
        _edge_covariance(document),
    )


def _edge_covariance(document: Mapping[str, Any]) -> FloatArray | None:
    if "edge_covariance" not in document:
        return None
    rows = np.asarray(document["edge_covariance"], dtype=float)
    unknowns = 4 + len(document["distortion"])
    return read_array(document, "edge_covariance", (unknowns, rows.shape[-1]))
