"""Fixture frame from any point fit: covariance, findings and messages."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Generic

import numpy as np

from visioncal.core.limits import FixtureLimits
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray, Mask
from visioncal.core.verdict import AGREEMENT, Finding, Verdict
from visioncal.estimation.group_outliers import GroupInliers
from visioncal.estimation.groups import State
from visioncal.estimation.observability import Direction
from visioncal.estimation.placing import TOUCH_NOISE_M, worst_of
from visioncal.frames.findings import (
    noise_findings,
    off_words,
    outlier_findings,
    placed_name,
    sigma_findings,
)
from visioncal.frames.measured_points import MeasuredPoints
from visioncal.results import Edge, Frame, Observation


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
    """Noise, limits and wording of a fixture's fit."""

    # Known repeatability of a touch, per axis [m]; None where unknown.
    touch_noise_m: float | None = None
    # Findings on the tool or camera that the points were measured with.
    doubts: tuple[Finding, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)  # Its figures, for the record.
    options: FixtureLimits = field(default_factory=FixtureLimits)  # Limits of the verdict.
    words: Words = field(default_factory=Words)  # Wording for the kind of measurement.
    # Assumed noise where it is unknown and points are few [m].
    assumed_noise_m: float = TOUCH_NOISE_M

    @property
    def expected_m(self) -> float:
        """Expected repeatability of a touch, per axis [m]."""
        return self.assumed_noise_m if self.touch_noise_m is None else self.touch_noise_m


@dataclass(frozen=True, eq=False)
class FixtureFit(Generic[State]):
    """Fit of a fixture to n points."""

    measured: MeasuredPoints  # The points.
    labels: tuple[str, ...]  # (n,) their names in the record.
    names: tuple[str, ...]  # (n,) their names in messages: `Touch 3`, `Point P3`.
    matrix: FloatArray  # (4, 4) `base_from_fixture`.
    covariance: FloatArray  # (6, 6) of its right perturbation, with the points' common errors.
    centre: FloatArray  # (3,) centroid of the points, in the fixture [m].
    agreement: GroupInliers[State]  # The inliers.
    causes: Sequence[str]  # (n,) probable cause if the point is an outlier.
    noise_m: float  # Noise of a touch per axis [m].

    @property
    def agrees(self) -> Mask:
        """(n,) inlier mask."""
        return self.agreement.mask

    @property
    def reasons(self) -> list[str]:
        """(n,) why each point is an outlier or in doubt; else empty."""
        words = []
        for at, cause in enumerate(self.causes):
            off = off_words(self.agreement, at)
            if self.agreement.doubtful[at]:
                words.append(f"{off}: one of those that contradict each other")
            else:
                words.append("" if self.agrees[at] else f"{off}: {cause}")
        return words

    @property
    def worst(self) -> tuple[Direction, Direction]:
        """Directions of the largest sigma: of the offset at the centroid, and of the rotation."""
        return worst_of(self.matrix, self.covariance, "fixture", "base", self.centre)

    def praise(self, things: str) -> str:
        """Sentence for a good verdict; `things` names the measurements."""
        offset, rotation = self.worst
        return (
            f"{int(self.agrees.sum())} {things} agree to {figure(1e3 * self.noise_m)} mm per axis, "
            f"and {offset.words}, the worst direction, is known to {figure(1e3 * offset.sigma)} "
            f"mm; {rotation.words} to {figure(np.rad2deg(rotation.sigma))} deg."
        )


def fixture_frame(
    fitted: FixtureFit[State],
    kinds: Sequence[str],
    method: str,
    more: Sequence[Finding],
    details: Mapping[str, Any],
    setting: FitSettings,
) -> Frame:
    """Builds the fixture's frame with its verdict.

    `kinds` are the (n,) kinds of the touches, or empty texts; `more` and `details` are findings and
    figures specific to the method.
    """
    findings = [*_findings(fitted, setting), *more, *setting.doubts]
    offset, rotation = fitted.worst
    inlier_residuals_m = fitted.agreement.off_m[fitted.agrees]
    noise_95 = [1e3 * value for value in fitted.agreement.fit.sigma_95]
    return Frame(
        Edge(fitted.matrix, fitted.covariance),
        True,
        method,
        fitted.measured.source,
        datetime.now(UTC).isoformat(timespec="seconds"),
        1e3 * float(np.sqrt(np.mean(inlier_residuals_m**2))),
        1e3 * fitted.noise_m,
        _observations(fitted, kinds),
        Verdict.by(findings, Finding(AGREEMENT, fitted.praise(setting.words.things))),
        {
            **({"noise_95_mm": noise_95} if np.isfinite(noise_95).all() else {}),
            "worst": {
                "offset": offset.words,
                "offset_sigma_mm": 1e3 * offset.sigma,
                "rotation": rotation.words,
                "rotation_sigma_deg": float(np.rad2deg(rotation.sigma)),
            },
            **details,
            **setting.details,
        },
    )


def _observations(fitted: FixtureFit[State], kinds: Sequence[str]) -> tuple[Observation, ...]:
    off_m = fitted.agreement.off_m.tolist()
    rows = zip(fitted.labels, fitted.agrees.tolist(), fitted.reasons, kinds, off_m, strict=True)
    return tuple(
        Observation(label, used=used, reason=reason, kind=kind, residual_mm=1e3 * off)
        for label, used, reason, kind, off in rows
    )


def _findings(fitted: FixtureFit[State], setting: FitSettings) -> list[Finding]:
    names = [
        placed_name(name, place)
        for name, place in zip(fitted.names, fitted.measured.places, strict=True)
    ]
    return [
        *outlier_findings(names, fitted.reasons, fitted.agreement, setting.words.again),
        *noise_findings(
            1e3 * fitted.noise_m,
            setting.options.noise_mm,
            setting.words.noisy,
            explained=fitted.agreement.explained,
            things=setting.words.things,
        ),
        *sigma_findings(
            fitted.worst, setting.options.sigma_mm, setting.options.sigma_deg, setting.words.weak
        ),
    ]
