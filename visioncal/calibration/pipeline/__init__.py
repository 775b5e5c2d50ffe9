"""The calibration pipeline: from a session, stage by stage, to a calibration."""

from visioncal.calibration.pipeline.entry import calibrate
from visioncal.calibration.pipeline.running import Run, run
from visioncal.calibration.pipeline.steps import STAGES

__all__ = ["STAGES", "Run", "calibrate", "run"]
