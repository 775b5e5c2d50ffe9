"""The report: one HTML file that says whether to trust a calibration, and why."""

from visioncal.report.page import write_report

__all__ = ["write_report"]
