"""Results of calibrations, tool and fixture frames, and their files."""

from visioncal.core.verdict import Finding, Remedy, Verdict, VerdictStatus
from visioncal.results.cell import CellResult, Moved, UnconnectedFrame
from visioncal.results.document import to_document
from visioncal.results.edge import Edge
from visioncal.results.frame import Frame, FrameFile, Observation
from visioncal.results.lens import CameraResult
from visioncal.results.parts import NeedMet, Picker, RobotResult, SolverResult
from visioncal.results.picking import select_matching
from visioncal.results.result import Calibration
from visioncal.results.views import CONTRADICTS, HELD_BACK, Rms, Validation, ViewResult
