"""What calibrations say beside their edges, for tests of the report and the recording."""

from dataclasses import replace
from typing import Any

from support.samples import Sample

from visioncal.core.codec import read_fields
from visioncal.results import Calibration
from visioncal.results.sections import CalibrationSections
from visioncal.vision.board_shape import BOARD_NAMES

# So begins the reason of a view that contradicts the others; test_report checks it on a real one.
CONTRADICTS = "disagrees with the other views: it places the target 36 mm and 1.5 deg away"
_FLAT = dict.fromkeys(BOARD_NAMES, 0.0)


def sick() -> dict[str, dict[str, Any]]:
    """A larger board that is bent, and an arm whose links are off."""
    noise = {"robot_translation_mm": [0.041, 0.062], "robot_rotation_deg": [0.0033, 0.0052]}
    arm = {"sigma_mm": 0.46, "sigma_deg": 0.053, "likelihood_ratio": 356.3, "estimated": True}
    return {
        "board": {
            "shape": _FLAT | {"scale": 2e-3, "aspect": 1e-3, "bow_xx": 3e-4},
            "sigma": {"scale": 1e-3, "aspect": 2e-5, "bow_xx": 1e-5},
            "estimated": ["scale", "aspect", "bow_xx"],
            "bend_mm": 0.29,
        },
        "uncertainty": {
            "point_cam_m": [0.0, 0.3, 0.4],
            "budget_mm": {"robot": 0.3, "arm": 1.2, "total": 1.237},
            "radius95_mm": 0.163,
            "noise_95": noise,
            "spectrum": [0.001 * index for index in range(1, 13)],
        },
        "arm_errors": arm,
    }


def with_findings(sample: Sample, documents: dict[str, dict[str, Any]]) -> Calibration:
    """The sample's calibration with what else was found."""
    return replace(sample.calibration, **read_fields(CalibrationSections, documents, ""))


def with_contradiction(sample: Sample) -> Calibration:
    """The sample's calibration, whose view 6 was left out because it contradicts the others."""
    views = tuple(
        replace(view, reason=CONTRADICTS) if view.view == 6 else view
        for view in sample.calibration.views
    )
    return replace(sample.calibration, views=views)
