"""visioncal: calibrates vision-guided robot cells and says how far the result can be trusted.

    >>> import visioncal
    >>> calibration = visioncal.calibrate(visioncal.Session.load("session"))
    >>> calibration.transforms["flange_from_cam"]
    >>> calibration.covariance("flange_from_cam")
    >>> calibration.verdict
    >>> visioncal.locate(calibration, px, visioncal.Plane.horizontal(0.02), base_from_flange)

The names below are imported on first use, so that `import visioncal` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from visioncal.core.version import __version__

if TYPE_CHECKING:
    from visioncal.calibration.pipeline import align, calibrate
    from visioncal.calibration.pipeline.checkup import Checkup, doctor
    from visioncal.calibration.verification import verify
    from visioncal.core.errors import (
        ConvergenceError,
        DataError,
        DegenerateError,
        DriverError,
        VisioncalError,
    )
    from visioncal.frames.frame_from_images import seen_frame
    from visioncal.frames.locate import locate, locate_target
    from visioncal.frames.located import Located
    from visioncal.frames.picks import locate_views
    from visioncal.frames.plane import Plane
    from visioncal.frames.single_view import Sight
    from visioncal.frames.target_pose import place_seen
    from visioncal.interchange.batch import Batch, batch
    from visioncal.results import Alignment, Calibration
    from visioncal.results.compensation import CalibratedArm, Corrected, correct
    from visioncal.robot import Loads
    from visioncal.robot.thermal import OnlineCompensator
    from visioncal.session import Session

_HOMES = {
    "Alignment": "visioncal.results",
    "Batch": "visioncal.interchange.batch",
    "CalibratedArm": "visioncal.results.compensation",
    "Calibration": "visioncal.results",
    "Checkup": "visioncal.calibration.pipeline.checkup",
    "Corrected": "visioncal.results.compensation",
    "correct": "visioncal.results.compensation",
    "ConvergenceError": "visioncal.core.errors",
    "DataError": "visioncal.core.errors",
    "DegenerateError": "visioncal.core.errors",
    "DriverError": "visioncal.core.errors",
    "Loads": "visioncal.robot",
    "Located": "visioncal.frames.located",
    "OnlineCompensator": "visioncal.robot.thermal",
    "Plane": "visioncal.frames.plane",
    "Session": "visioncal.session",
    "Sight": "visioncal.frames.single_view",
    "VisioncalError": "visioncal.core.errors",
    "align": "visioncal.calibration.pipeline",
    "batch": "visioncal.interchange.batch",
    "calibrate": "visioncal.calibration.pipeline",
    "doctor": "visioncal.calibration.pipeline.checkup",
    "locate": "visioncal.frames.locate",
    "locate_target": "visioncal.frames.locate",
    "locate_views": "visioncal.frames.picks",
    "place_seen": "visioncal.frames.target_pose",
    "seen_frame": "visioncal.frames.frame_from_images",
    "verify": "visioncal.calibration.verification",
}

__all__ = [
    "Alignment",
    "Batch",
    "CalibratedArm",
    "Calibration",
    "Checkup",
    "ConvergenceError",
    "Corrected",
    "DataError",
    "DegenerateError",
    "DriverError",
    "Loads",
    "Located",
    "OnlineCompensator",
    "Plane",
    "Session",
    "Sight",
    "VisioncalError",
    "__version__",
    "align",
    "batch",
    "calibrate",
    "correct",
    "doctor",
    "locate",
    "locate_target",
    "locate_views",
    "place_seen",
    "seen_frame",
    "verify",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - the type is given under TYPE_CHECKING
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
