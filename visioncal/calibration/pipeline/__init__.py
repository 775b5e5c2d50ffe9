"""The way of the data: from a session, step by step, to a calibration of one pair or a cell."""

from visioncal.calibration.pipeline.entry import align, calibrate, run_dense
from visioncal.calibration.pipeline.running import Run, run
from visioncal.calibration.pipeline.steps import STAGES

__all__ = ["STAGES", "Run", "align", "calibrate", "run", "run_dense"]
