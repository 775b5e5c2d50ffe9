"""The parts of a calibration: reading, solving, assessment, result, and why a run failed."""
