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

from visioncal.version import __version__

if TYPE_CHECKING:
    from visioncal.calibration import Alignment, Calibration
    from visioncal.compensation import CalibratedArm, Corrected, correct
    from visioncal.errors import (
        ConvergenceError,
        DataError,
        DegenerateError,
        DriverError,
        VisioncalError,
    )
    from visioncal.frames.locate import locate, locate_target
    from visioncal.frames.located import Located
    from visioncal.frames.picks import locate_views
    from visioncal.frames.plane import Plane
    from visioncal.frames.seen import place_seen
    from visioncal.frames.seen_frame import seen_frame
    from visioncal.frames.sight import Sight
    from visioncal.pipeline import align, calibrate
    from visioncal.robot import Loads
    from visioncal.session import Session
    from visioncal.thermal import OnlineCompensator
    from visioncal.verification import verify

_HOMES = {
    "Alignment": "visioncal.calibration",
    "CalibratedArm": "visioncal.compensation",
    "Calibration": "visioncal.calibration",
    "Corrected": "visioncal.compensation",
    "correct": "visioncal.compensation",
    "ConvergenceError": "visioncal.errors",
    "DataError": "visioncal.errors",
    "DegenerateError": "visioncal.errors",
    "DriverError": "visioncal.errors",
    "Loads": "visioncal.robot",
    "Located": "visioncal.frames.located",
    "OnlineCompensator": "visioncal.thermal",
    "Plane": "visioncal.frames.plane",
    "Session": "visioncal.session",
    "Sight": "visioncal.frames.sight",
    "VisioncalError": "visioncal.errors",
    "align": "visioncal.pipeline",
    "calibrate": "visioncal.pipeline",
    "locate": "visioncal.frames.locate",
    "locate_target": "visioncal.frames.locate",
    "locate_views": "visioncal.frames.picks",
    "place_seen": "visioncal.frames.seen",
    "seen_frame": "visioncal.frames.seen_frame",
    "verify": "visioncal.verification",
}

__all__ = [
    "Alignment",
    "CalibratedArm",
    "Calibration",
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
    "calibrate",
    "correct",
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
