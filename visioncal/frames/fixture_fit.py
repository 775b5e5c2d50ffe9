"""Frame of a tool or a fixture from any fit of points: covariance, findings and messages."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Generic

import numpy as np

from visioncal.core.limits import FixtureLimits, ToolLimits
from visioncal.core.number_format import figure, some_of
from visioncal.core.types import Mask
from visioncal.core.verdict import AGAIN, AGREEMENT, Finding, Remedy, Verdict
from visioncal.estimation.group_outliers import GroupInliers
from visioncal.estimation.groups import State
from visioncal.estimation.observability import Direction
from visioncal.estimation.placing import TOUCH_NOISE_M
from visioncal.results import Edge, Frame, Observation

# End of the reason of an outlier that fits by another name, and its remedy.
RENAMED = ": is its name exchanged?"
_RENAME = "Correct the names of what is named; where they are right, touch it once more."


def sigma_findings(
    worst: Sequence[Direction],
    sigma_mm: tuple[float, float],
    sigma_deg: tuple[float, float],
    advice: str,
) -> Iterator[Finding]:
    """Findings on directions whose sigma exceeds (check, bad) limits of offset or rotation."""
    for direction in worst:
        scale, unit = (np.rad2deg(1.0), "deg") if direction.is_rotation else (1e3, "mm")
        check, bad = sigma_deg if direction.is_rotation else sigma_mm
        if direction.sigma * scale > check:
            yield Finding(
                "weak_motion",
                f"{direction.words[0].upper()}{direction.words[1:]} is known to "
                f"{figure(direction.sigma * scale)} {unit} only (doubt begins at {check:g}).",
                Remedy(advice),
                is_fatal=direction.sigma * scale > bad,
            )


@dataclass(frozen=True)
class Words:
    """Wording of messages for one way of measuring points."""

    things: str = "touches"  # What the measurements are called.
    # Advice for outliers, as a sentence.
    again: str = "Touch what is named once more, and write the new poses in its rows."
    # Advice for noisy measurements, as a sentence.
    noisy: str = (
        "Touch again with a sharp tip, and check the tool; an arm that was never calibrated is "
        "off by a millimetre from posture to posture."
    )
    # Advice for a poorly determined direction, as a sentence.
    weak: str = (
        "Touch points that are farther apart, or more of them; a tip that is known better "
        "helps where all touches share its error."
    )
    # Side that they were measured from, behind the words `the side that`.
    side: str = "the tool came from"


@dataclass(frozen=True)
class FitSettings:
    """Noise, limits and wording of a frame's fit."""

    # Known repeatability of a touch, per axis [m]; None where unknown.
    touch_noise_m: float | None = None
    # Findings on the tool or camera that the points were measured with.
    doubts: tuple[Finding, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)  # Its figures, for the record.
    options: FixtureLimits | ToolLimits = field(
        default_factory=FixtureLimits
    )  # Limits of the verdict.
    words: Words = field(default_factory=Words)  # Wording for the kind of measurement.
    # Assumed noise where it is unknown and points are few [m].
    assumed_noise_m: float = TOUCH_NOISE_M

    @property
    def fewest(self) -> int:
        """Number of touches or points from which on a wrong one can be found."""
        limits = self.options
        return limits.touches if isinstance(limits, ToolLimits) else limits.points

    @property
    def expected_m(self) -> float:
        """Expected repeatability of a touch, per axis [m]."""
        return self.assumed_noise_m if self.touch_noise_m is None else self.touch_noise_m


@dataclass(frozen=True, eq=False)
class PointsFit(Generic[State]):
    """Fit of a tool or a fixture to n touches or other points."""

    source: str  # What the points were read from, for the record.
    labels: Sequence[str]  # (n,) their names in the record.
    names: Sequence[str]  # (n,) their names in messages: `Touch 3`, `Point P3`.
    places: Sequence[str]  # (n,) their rows: `touches.csv, line 5`; empty where there are none.
    kinds: Sequence[str]  # (n,) kinds of the touches, or empty texts.
    # The frame in its parent, with the points' common errors in the covariance.
    edge: Edge
    agreement: GroupInliers[State]  # The inliers.
    causes: Sequence[str]  # (n,) probable cause if the point is an outlier.
    noise_m: float  # Noise of a touch per axis [m].
    # Directions of the largest sigma: of the offset, and of the rotation if it was measured.
    worst: Sequence[Direction]
    oriented: bool = True  # Whether the rotation was measured.

    @property
    def agrees(self) -> Mask:
        """(n,) inlier mask."""
        return self.agreement.mask

    @property
    def reasons(self) -> list[str]:
        """(n,) why each point is an outlier or in doubt; else empty."""
        words, inliers = [], self.agreement
        for at, cause in enumerate(self.causes):
            off = f"{figure(1e3 * float(inliers.off_m[at]))} mm off"
            ratio = float(np.sqrt(float(inliers.mahalanobis_sq[at]) / float(inliers.limit[at])))
            if ratio > 1.0:
                off += f", {figure(ratio)} times what the others allow"
            if inliers.doubtful[at]:
                words.append(f"{off}: one of those that contradict each other")
            else:
                words.append("" if inliers.mask[at] else f"{off}: {cause}")
        return words

    def findings(self, setting: FitSettings) -> Iterator[Finding]:
        """Findings on outliers and contradictions, the noise, and what is poorly determined."""
        wording, reasons = setting.words, self.reasons
        names = [
            f"{name} ({place})" if place else name
            for name, place in zip(self.names, self.places, strict=True)
        ]
        for at in np.flatnonzero(~self.agrees).tolist():
            renamed = reasons[at].endswith(RENAMED)
            words = f"{names[at]} was left out: {reasons[at]}{'' if renamed else '.'}"
            yield Finding("left_out", words, Remedy(_RENAME if renamed else wording.again, AGAIN))
        if self.agreement.doubtful.any():
            some = some_of([names[at] for at in np.flatnonzero(self.agreement.doubtful).tolist()])
            words = f"{some} contradict each other, and which is wrong is not known: all are used."
            yield Finding("contradicting", words, Remedy(wording.again))
        noise_mm, (check, bad) = 1e3 * self.noise_m, setting.options.noise_mm
        if noise_mm > check:
            yield Finding(
                "noise",
                f"The {wording.things} agree to {figure(noise_mm)} mm only (per axis; doubt begins "
                f"at {check:g}).",
                Remedy(wording.noisy),
                is_fatal=noise_mm > bad,
            )
        elif not self.agreement.explained:
            yield Finding(
                "noise",
                f"The {wording.things} scatter by more than they are stated to, without one that "
                f"stands out: {figure(noise_mm)} mm per axis.",
                Remedy(
                    "Repeat them, or state the noise as it is.",
                    f"{AGAIN} --touch-noise-mm {noise_mm:.2g}",
                ),
            )
        limits = setting.options
        yield from sigma_findings(self.worst, limits.sigma_mm, limits.sigma_deg, wording.weak)

    def frame(
        self, method: str, more: Sequence[Finding], details: Mapping[str, Any], setting: FitSettings
    ) -> Frame:
        """Builds the frame with its verdict.

        `more` and `details` are findings and figures specific to the method.
        """
        off_m, offset = self.agreement.off_m, self.worst[0]
        off_mm = (1e3 * off_m).tolist()
        rows = zip(self.labels, self.agrees.tolist(), self.reasons, self.kinds, off_mm, strict=True)
        rotation = "".join(
            f"; {direction.words} to {figure(np.rad2deg(direction.sigma))} deg"
            for direction in self.worst[1:]
        )
        praise = (
            f"{int(self.agrees.sum())} {setting.words.things} agree to "
            f"{figure(1e3 * self.noise_m)} mm per axis, and {offset.words}, the worst direction, "
            f"is known to {figure(1e3 * offset.sigma)} mm{rotation}."
        )
        if not self.oriented:
            praise += " The rotation was not touched: it is the flange's own."
        noise_95 = [1e3 * value for value in self.agreement.fit.sigma_95]
        return Frame(
            self.edge,
            self.oriented,
            method,
            self.source,
            datetime.now(UTC).isoformat(timespec="seconds"),
            1e3 * float(np.sqrt(np.mean(off_m[self.agrees] ** 2))),
            1e3 * self.noise_m,
            tuple(
                Observation(
                    label, used=used, reason=reason, kind=kind, residual_mm=1e3 * float(off)
                )
                for label, used, reason, kind, off in rows
            ),
            Verdict.by(
                [*self.findings(setting), *more, *setting.doubts], Finding(AGREEMENT, praise)
            ),
            {
                **({"noise_95_mm": noise_95} if np.isfinite(noise_95).all() else {}),
                **details,
                **setting.details,
            },
        )
