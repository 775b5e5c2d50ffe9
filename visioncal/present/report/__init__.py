"""The report: one HTML file with the verdict on a calibration and its reasons."""
