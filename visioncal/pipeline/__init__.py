"""The way of the data: from a session, step by step, to a calibration of one pair or a cell."""

from visioncal.pipeline.anycell import align, calibrate
from visioncal.pipeline.denser import run_dense
from visioncal.pipeline.running import Run, run
from visioncal.pipeline.steps import STAGES

__all__ = ["STAGES", "Run", "align", "calibrate", "run", "run_dense"]
