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
    from visioncal.calibration.verification import Guard, Look, verify
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
    from visioncal.frames.locate import Located, locate, locate_target
    from visioncal.frames.session_observations import locate_views
    from visioncal.frames.target_pose import Sight, place_seen
    from visioncal.frames.tcp import touched_tool
    from visioncal.interchange.batch import Batch, batch
    from visioncal.interchange.exports import export
    from visioncal.interchange.formats import convert
    from visioncal.live.capture.from_python import record
    from visioncal.live.drivers.protocols import ArmState
    from visioncal.live.planning.plan import make_plan
    from visioncal.present.report.page import write_report
    from visioncal.results import Calibration, Verdict
    from visioncal.results.compare import compare
    from visioncal.results.compensation import CalibratedArm, Corrected, correct
    from visioncal.robot import Loads
    from visioncal.robot.thermal import OnlineCompensator
    from visioncal.session import Session
    from visioncal.simulation import CellOptions, simulate, write_session
    from visioncal.vision.boards.identify import identify
    from visioncal.vision.targets import load_target

_HOMES = {
    "ArmState": "visioncal.live.drivers.protocols",
    "Batch": "visioncal.interchange.batch",
    "CalibratedArm": "visioncal.results.compensation",
    "Calibration": "visioncal.results",
    "CellOptions": "visioncal.simulation",
    "Checkup": "visioncal.calibration.pipeline.checkup",
    "ConvergenceError": "visioncal.core.errors",
    "Corrected": "visioncal.results.compensation",
    "DataError": "visioncal.core.errors",
    "DegenerateError": "visioncal.core.errors",
    "DriverError": "visioncal.core.errors",
    "Guard": "visioncal.calibration.verification",
    "Loads": "visioncal.robot",
    "Located": "visioncal.frames.locate",
    "Look": "visioncal.calibration.verification",
    "OnlineCompensator": "visioncal.robot.thermal",
    "Plane": "visioncal.frames.camera_chain",
    "Session": "visioncal.session",
    "Sight": "visioncal.frames.target_pose",
    "Verdict": "visioncal.results",
    "VisioncalError": "visioncal.core.errors",
    "batch": "visioncal.interchange.batch",
    "calibrate": "visioncal.calibration.run",
    "compare": "visioncal.results.compare",
    "convert": "visioncal.interchange.formats",
    "correct": "visioncal.results.compensation",
    "doctor": "visioncal.calibration.pipeline.checkup",
    "export": "visioncal.interchange.exports",
    "identify": "visioncal.vision.boards.identify",
    "load_target": "visioncal.vision.targets",
    "locate": "visioncal.frames.locate",
    "locate_target": "visioncal.frames.locate",
    "locate_views": "visioncal.frames.session_observations",
    "make_plan": "visioncal.live.planning.plan",
    "place_seen": "visioncal.frames.target_pose",
    "record": "visioncal.live.capture.from_python",
    "seen_frame": "visioncal.frames.frame_from_images",
    "simulate": "visioncal.simulation",
    "touched_fixture": "visioncal.frames.fixture",
    "touched_tool": "visioncal.frames.tcp",
    "verify": "visioncal.calibration.verification",
    "write_report": "visioncal.present.report.page",
    "write_session": "visioncal.simulation",
}

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
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
