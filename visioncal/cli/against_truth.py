"""Results of simulated cells beside the truth."""

from collections.abc import Mapping

import numpy as np
from rich.table import Table

from visioncal.core.types import Camera, FloatArray
from visioncal.live.rehearsal.compared import edge_errors
from visioncal.results import Calibration


def truth_table(
    calibration: Calibration, transforms: Mapping[str, FloatArray], camera: Camera
) -> Table:
    """Errors against the truth, in millimetres and degrees and in units of the sigma.

    Args:
        calibration: The result.
        transforms: (4, 4) the true edges by name.
        camera: The true lens.
    """
    table = Table("against the truth", "error", "sigma", "error / sigma", box=None)
    for name, it in edge_errors(calibration, transforms).items():
        for error, sigma, unit in ((it.mm, it.sigma_mm, "mm"), (it.deg, it.sigma_deg, "deg")):
            table.add_row(
                name, f"{error:.3f} {unit}", f"{sigma:.3f} {unit}", f"{error / sigma:.2f}"
            )
    if calibration.camera is not None and calibration.camera.covariance is not None:
        sigmas = np.sqrt(np.diag(calibration.camera.covariance))[:4]
        errors = calibration.camera.camera.matrix - camera.matrix
        for name, error, sigma in zip(("fx", "fy", "cx", "cy"), errors, sigmas, strict=True):
            table.add_row(name, f"{error:+.2f} px", f"{sigma:.2f} px", f"{abs(error) / sigma:.2f}")
    return table
