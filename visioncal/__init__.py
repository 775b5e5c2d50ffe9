"""visioncal: calibrates vision-guided robot cells and says how far the result can be trusted.

    >>> import visioncal
    >>> calibration = visioncal.calibrate(visioncal.Session.load("session"))
    >>> calibration.transforms["flange_from_cam"]
    >>> calibration.covariance("flange_from_cam")
    >>> calibration.verdict

The names below are imported on first use, so that `import visioncal` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from visioncal.version import __version__

if TYPE_CHECKING:
    from visioncal.calibration import Calibration
    from visioncal.errors import (
        ConvergenceError,
        DataError,
        DegenerateError,
        DriverError,
        VisioncalError,
    )
    from visioncal.pipeline import calibrate
    from visioncal.session import Session

_HOMES = {
    "Calibration": "visioncal.calibration",
    "ConvergenceError": "visioncal.errors",
    "DataError": "visioncal.errors",
    "DegenerateError": "visioncal.errors",
    "DriverError": "visioncal.errors",
    "Session": "visioncal.session",
    "VisioncalError": "visioncal.errors",
    "calibrate": "visioncal.pipeline",
}

__all__ = [
    "Calibration",
    "ConvergenceError",
    "DataError",
    "DegenerateError",
    "DriverError",
    "Session",
    "VisioncalError",
    "__version__",
    "calibrate",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - the type is given under TYPE_CHECKING
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
