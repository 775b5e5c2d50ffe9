"""The result of a calibration, its frames, and how they stand on disk."""

from visioncal.calibration.alignment import Alignment, Moved, Sight, Untied
from visioncal.calibration.document import to_document
from visioncal.calibration.edge import Edge
from visioncal.calibration.frame import Frame, FrameFile, Observation
from visioncal.calibration.parts import (
    HELD_BACK,
    CameraResult,
    Cause,
    NeedMet,
    Picker,
    Rms,
    RobotResult,
    SolverResult,
    Validation,
    Verdict,
    VerdictStatus,
    ViewResult,
)
from visioncal.calibration.picking import picked
from visioncal.calibration.result import Calibration

__all__ = [
    "HELD_BACK",
    "Alignment",
    "Calibration",
    "CameraResult",
    "Cause",
    "Edge",
    "Frame",
    "FrameFile",
    "Moved",
    "NeedMet",
    "Observation",
    "Picker",
    "Rms",
    "RobotResult",
    "Sight",
    "SolverResult",
    "Untied",
    "Validation",
    "Verdict",
    "VerdictStatus",
    "ViewResult",
    "picked",
    "to_document",
]
