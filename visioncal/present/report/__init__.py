"""The report: one HTML file that says whether to trust a calibration, and why."""

from visioncal.present.report.page import write_report

__all__ = ["write_report"]
