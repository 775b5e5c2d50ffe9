"""The result of a calibration, its frames, and how they stand on disk."""

from visioncal.results.alignment import Alignment, Moved, Sight, Untied
from visioncal.results.document import to_document
from visioncal.results.edge import Edge
from visioncal.results.frame import Frame, FrameFile, Observation
from visioncal.results.parts import (
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
from visioncal.results.picking import picked
from visioncal.results.result import Calibration

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
