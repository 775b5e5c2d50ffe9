"""The way of the data: from a session, stage by stage, to a calibration of one pair or a cell."""

from visioncal.pipeline.anycell import calibrate, check_whole
from visioncal.pipeline.denser import run_dense
from visioncal.pipeline.result import Run, run
from visioncal.pipeline.steps import STAGES
from visioncal.pipeline.whole import align

__all__ = ["STAGES", "Run", "align", "calibrate", "check_whole", "run", "run_dense"]
