"""The page of the verdict states the limits that the program uses."""

from pathlib import Path

import visioncal
from visioncal.core.limits import CalibrationLimits, NeedLimits

PAGE = Path(visioncal.__file__).parent / "calibration" / "README.md"


def _row(status):
    (row,) = (line for line in PAGE.read_text().splitlines() if line.startswith(f"| `{status}` |"))
    return row


def test_the_page_states_where_doubt_begins_and_where_trust_ends():
    limits, (met, half) = CalibrationLimits(), NeedLimits().probability
    (scatter_mm, lost_mm), (scatter_deg, lost_deg) = limits.scatter_mm, limits.scatter_deg
    (sigma_mm, bad_mm), (sigma_deg, bad_deg) = limits.sigma_mm, limits.sigma_deg
    assert f"with {100 * met:g} % or more" in _row("good")
    assert f"under {scatter_mm:g} mm and {scatter_deg:g} deg" in _row("good")
    assert f"known to {sigma_mm:g} mm and {sigma_deg:g} deg" in _row("good")
    assert f"under {limits.robot_mm:g} mm and {limits.robot_deg:g} deg" in _row("good")
    assert f"corners under {limits.pixel_px[0]:g} px, {limits.stops[0]} stops" in _row("good")
    assert f"{100 * (1 - limits.lost_share[0]):g} % of the views" in _row("good")
    assert f"with {100 * half:g} % or more" in _row("check")
    assert f"{lost_mm:g} mm and {lost_deg:g} deg, {bad_mm:g} mm and {bad_deg:g} deg" in _row("bad")
    assert f"{limits.pixel_px[1]:g} px, under {limits.stops[1]} stops" in _row("bad")
    assert f"under {100 * (1 - limits.lost_share[1]):g} % of the views" in _row("bad")
