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
    from visioncal.calibration.pipeline.checkup import Checkup, doctor
    from visioncal.calibration.run import calibrate
    from visioncal.core.errors import (
        ConvergenceError,
        DataError,
        DegenerateError,
        DriverError,
        VisioncalError,
    )
    from visioncal.frames.camera_chain import Plane
    from visioncal.frames.fixture import touched_fixture
    from visioncal.frames.frame_from_images import seen_frame
    from visioncal.frames.locate import locate, locate_target
    from visioncal.frames.located import Located
    from visioncal.frames.session_observations import locate_views
    from visioncal.frames.target_pose import Sight, place_seen
    from visioncal.frames.tcp import touched_tool
    from visioncal.interchange.batch import Batch, batch
    from visioncal.interchange.exports import export
    from visioncal.interchange.formats import convert
    from visioncal.live.capture.from_python import record
    from visioncal.live.drivers.protocols import ArmState
    from visioncal.planning.plan import make_plan
    from visioncal.present.report.page import write_report
    from visioncal.results import Calibration, Verdict
    from visioncal.results.compare import compare
    from visioncal.results.compensation import CalibratedArm, Corrected, correct
    from visioncal.robot import Loads
    from visioncal.robot.thermal import OnlineCompensator
    from visioncal.session import Session
    from visioncal.simulation import CellOptions, simulate, write_session
    from visioncal.verification import Guard, Look, verify
    from visioncal.vision.boards.identify import identify
    from visioncal.vision.targets import load_target

# Modules, and the names in each.
_HOMES = {
    "calibration.pipeline.checkup": "Checkup doctor",
    "calibration.run": "calibrate",
    "verification": "Guard Look verify",
    "core.errors": "ConvergenceError DataError DegenerateError DriverError VisioncalError",
    "frames.camera_chain": "Plane",
    "frames.fixture": "touched_fixture",
    "frames.frame_from_images": "seen_frame",
    "frames.locate": "locate locate_target",
    "frames.located": "Located",
    "frames.session_observations": "locate_views",
    "frames.target_pose": "Sight place_seen",
    "frames.tcp": "touched_tool",
    "interchange.batch": "Batch batch",
    "interchange.exports": "export",
    "interchange.formats": "convert",
    "live.capture.from_python": "record",
    "live.drivers.protocols": "ArmState",
    "planning.plan": "make_plan",
    "present.report.page": "write_report",
    "results": "Calibration Verdict",
    "results.compare": "compare",
    "results.compensation": "CalibratedArm Corrected correct",
    "robot": "Loads",
    "robot.thermal": "OnlineCompensator",
    "session": "Session",
    "simulation": "CellOptions simulate write_session",
    "vision.boards.identify": "identify",
    "vision.targets": "load_target",
}
_MODULES = {name: module for module, names in _HOMES.items() for name in names.split()}

__all__ = [
    "ArmState",
    "Batch",
    "CalibratedArm",
    "Calibration",
    "CellOptions",
    "Checkup",
    "ConvergenceError",
    "Corrected",
    "DataError",
    "DegenerateError",
    "DriverError",
    "Guard",
    "Loads",
    "Located",
    "Look",
    "OnlineCompensator",
    "Plane",
    "Session",
    "Sight",
    "Verdict",
    "VisioncalError",
    "__version__",
    "batch",
    "calibrate",
    "compare",
    "convert",
    "correct",
    "doctor",
    "export",
    "identify",
    "load_target",
    "locate",
    "locate_target",
    "locate_views",
    "make_plan",
    "place_seen",
    "record",
    "seen_frame",
    "simulate",
    "touched_fixture",
    "touched_tool",
    "verify",
    "write_report",
    "write_session",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - the type is given under TYPE_CHECKING
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
