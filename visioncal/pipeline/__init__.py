"""The way of the data: from a session, stage by stage, to a calibration."""

from visioncal.pipeline.result import Run, run
from visioncal.pipeline.steps import STAGES

__all__ = ["STAGES", "Run", "run"]
