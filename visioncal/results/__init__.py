"""The result of a calibration, its frames, and how they stand on disk."""

from visioncal.core.verdict import Finding, Step, Verdict, VerdictStatus
from visioncal.results.alignment import Alignment, Moved, Sight, Untied
from visioncal.results.document import to_document
from visioncal.results.edge import Edge
from visioncal.results.frame import Frame, FrameFile, Observation
from visioncal.results.lens import CameraResult
from visioncal.results.parts import (
    HELD_BACK,
    NeedMet,
    Picker,
    Rms,
    RobotResult,
    SolverResult,
    Validation,
    ViewResult,
)
from visioncal.results.picking import picked
from visioncal.results.result import Calibration

__all__ = [
    "HELD_BACK",
    "Alignment",
    "Calibration",
    "CameraResult",
    "Edge",
    "Finding",
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
    "Step",
    "Untied",
    "Validation",
    "Verdict",
    "VerdictStatus",
    "ViewResult",
    "picked",
    "to_document",
]
