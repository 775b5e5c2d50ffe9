"""What a result is valid for: `conditions` in calibration.json, which every output carries."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from visioncal.core.number_format import figure, rounded_up
from visioncal.core.verdict import Verdict
from visioncal.results.arm import ArmSections

if TYPE_CHECKING:
    from visioncal.results.result import Calibration


@dataclass(frozen=True)
class Condition:
    """A condition under which a result holds."""

    kind: Literal["calibrated-arm", "load", "temperature"]  # Its kind.
    sentence: str  # What it is, with its figure.
    do: str  # What follows for whoever uses the result.

    @property
    def words(self) -> str:
        """The condition and what follows."""
        return f"{self.sentence} {self.do}"


def uncorrected_words(verdict: Verdict) -> str:
    """That transforms belong to a calibrated arm, and what its targets cost uncorrected."""
    words = "The transforms belong to the calibrated arm, not to the controller's model of it"
    if verdict.good_for_mm is None or verdict.good_for_mm_uncorrected is None:
        return f"{words}."
    own, corrected = (
        figure(rounded_up(mm)) for mm in (verdict.good_for_mm_uncorrected, verdict.good_for_mm)
    )
    return (
        f"{words}: 95 % of picks by the controller's own poses land within {own} mm, with "
        f"corrected targets within {corrected} mm."
    )


def conditions_of(calibration: "Calibration") -> Iterator[Condition]:
    """The conditions of a calibration, those of a whole cell with the name of their part."""
    for name, arm in calibration.by_name.robots.items():
        yield from _of_arm(arm, calibration.verdict, name)


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
        least, most = (figure(mass) for mass in arm.elastic.payload_kg)
        yield Condition(
            "load",
            f"{of}The joints bend under load, by up to {figure(arm.elastic.sag_mm.most)} mm at the "
            f"flange under the {least} to {most} kg of the stops.",
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
