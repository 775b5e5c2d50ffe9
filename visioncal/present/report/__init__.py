"""The report: one HTML file with the verdict on a calibration and its reasons."""

from visioncal.present.report.page import write_report

__all__ = ["write_report"]
