"""The stages of a calibration, one file each: options, a result, and the function between."""
