"""Conditions of a result: `conditions` in calibration.json, which every output carries."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from visioncal.core.number_format import figure, rounded_up
from visioncal.core.verdict import Verdict
from visioncal.results.arm import ArmSections
from visioncal.results.cell import CellResult
from visioncal.results.lens import CameraResult, sensor_tilt


@dataclass(frozen=True)
class Condition:
    """A condition under which a result holds."""

    kind: Literal["calibrated-arm", "own-lens", "load", "temperature"]  # Its kind.
    sentence: str  # The condition, with its figure.
    do: str  # Its consequence for whoever uses the result.

    @property
    def words(self) -> str:
        """The condition and what follows."""
        return f"{self.sentence} {self.do}"


def uncorrected_words(verdict: Verdict) -> str:
    """The condition of a calibrated arm, with the cost of uncorrected targets."""
    words = "The transforms belong to the calibrated arm, not to the controller's model of it"
    if verdict.good_for_mm is None or verdict.good_for_mm_uncorrected is None:
        return f"{words}."
    uncorrected, corrected = (
        figure(rounded_up(mm)) for mm in (verdict.good_for_mm_uncorrected, verdict.good_for_mm)
    )
    return (
        f"{words}: 95 % of picks by the controller's own poses land within {uncorrected} mm, with "
        f"corrected targets within {corrected} mm."
    )


def conditions_of(cell: CellResult, verdict: Verdict) -> Iterator[Condition]:
    """The conditions of a result, those of a whole cell with the name of their part."""
    for name, arm in cell.robots.items():
        yield from _of_arm(arm, verdict, name)
    # A bad result holds nowhere.
    for name, lens in cell.cameras.items() if verdict.status != "bad" else ():
        yield from _of_lens(lens, name)


def _of_lens(lens: CameraResult, camera: str) -> Iterator[Condition]:
    tilt = sensor_tilt(lens)
    # A lens that was stated is the receiving program's own. Behind one without much radial
    # distortion, any decentring passes for a tilt of many degrees.
    if tilt is None or not lens.estimated:
        return
    sigma_rad = math.hypot(tilt.sigma_rad, tilt.own_rad)
    # Tilt up to which a sensor counts as parallel to its lens [deg]: makers of industrial cameras
    # state 0.2 to 0.6 about each axis (Basler, pilot user's manual, 1.5.2.2), which is 0.8 about
    # both.
    if tilt.rad < max(math.radians(0.8), 3.0 * sigma_rad):
        return
    of, deg = f"{camera}: " if camera else "", math.degrees(tilt.rad)
    sigma = f" (sigma {figure(math.degrees(sigma_rad))})"
    yield Condition(
        "own-lens",
        f"{of}The camera's transform holds only with its own lens (matrix and distortion): p1 and "
        f"p2 are those of a sensor tilted by {figure(deg)} deg{sigma}, and by a lens model with "
        f"that tilt the camera looks elsewhere by so much, {figure(1e3 * math.tan(tilt.rad))} mm "
        "at 1 m.",
        "Where the receiving program has a lens of its own, state that one in session.toml, with "
        'intrinsics = "hold", and calibrate again.',
    )


def _of_arm(arm: ArmSections, verdict: Verdict, robot: str) -> Iterator[Condition]:
    of = f"{robot}: " if robot else ""
    if arm.arm is not None and arm.arm.robot is not None:
        yield Condition(
            "calibrated-arm",
            f"{of}{uncorrected_words(verdict)}",
            "Send targets that visioncal correct has corrected, or plan them with the calibrated "
            "arm (visioncal export --to robot-urdf).",
        )
    if arm.elastic is not None:
        yield Condition(
            "load",
            f"{of}The joints bend under load, by up to {figure(arm.elastic.sag_mm.most)} mm at the "
            f"flange under {arm.elastic.under_words}.",
            "State the payload with the targets (visioncal correct --payload-kg).",
        )
    if arm.thermal is not None:
        drift_mm = max(point.drift_mm for point in arm.thermal.course)
        degrees = sorted(joint.reference_c for joint in arm.thermal.joints)
        yield Condition(
            "temperature",
            f"{of}The arm drifts with its temperature, by up to {figure(drift_mm)} mm in the "
            f"session; the transforms are of links at {degrees[0]:.0f} to {degrees[-1]:.0f} deg C.",
            "State the temperatures with the targets (visioncal correct --temperatures).",
        )
