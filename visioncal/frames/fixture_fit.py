"""What all ways to place a fixture by points share: its covariance, its doubts, its words."""

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
from visioncal.frames.measured import MeasuredPoints
from visioncal.frames.verdicts import disputed, noisy, off_words, placed_name, weak_directions
from visioncal.results import Edge, Frame, Observation


@dataclass(frozen=True)
class Words:
    """How messages speak of what points are measured by.

    Attributes:
        things: What that is.
        again: What to do about those that disagree, as a sentence.
        noisy: What makes them noisy and what to do about it, likewise.
        weak: What to do about a direction that is known badly, likewise.
        side: From which side they were measured, behind the words `the side that`.
    """

    things: str = "touches"
    again: str = "Touch what is named once more, and write the new poses in its rows."
    noisy: str = (
        "Touch again with a sharp tip, and check the tool; an arm that was never calibrated is "
        "off by a millimetre from posture to posture."
    )
    weak: str = (
        "Touch points that are farther apart, or more of them; a tip that is known better "
        "helps where all touches share its error."
    )
    side: str = "the tool came from"


@dataclass(frozen=True)
class Setting:
    """What is known beside the points.

    Attributes:
        touch_noise_m: What a touch is known to repeat to, per axis [m]; None where unknown.
        doubts: Reasons that lie in what the points were measured with.
        details: Figures of that, for the record.
        options: Where doubt begins.
        words: For what the points are measured by.
        careful_m: What is taken for that noise where nobody knows it and points are few [m].
    """

    touch_noise_m: float | None = None
    doubts: tuple[Finding, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    options: FixtureLimits = field(default_factory=FixtureLimits)
    words: Words = field(default_factory=Words)
    careful_m: float = TOUCH_NOISE_M

    @property
    def expected_m(self) -> float:
        """What a touch is expected to repeat to, per axis [m]."""
        return self.careful_m if self.touch_noise_m is None else self.touch_noise_m


@dataclass(frozen=True, eq=False)
class FixtureFit(Generic[State]):
    """A fixture's fit to n points, whatever is known of them.

    Attributes:
        measured: The points.
        labels: (n,) what the record calls them.
        names: (n,) what messages call them: `Touch 3`, `Point P3`.
        matrix: (4, 4) `base_from_fixture`.
        covariance: (6, 6) of its right perturbation, what the points share included.
        centre: (3,) amid the points, in the fixture [m].
        agreement: Which of them agree.
        causes: (n,) what makes each one disagree, if it does.
        noise_m: Noise of a touch per axis [m].
    """

    measured: MeasuredPoints
    labels: tuple[str, ...]
    names: tuple[str, ...]
    matrix: FloatArray
    covariance: FloatArray
    centre: FloatArray
    agreement: GroupInliers[State]
    causes: Sequence[str]
    noise_m: float

    @property
    def agrees(self) -> Mask:
        """(n,) which points the answer was made from."""
        return self.agreement.agrees

    @property
    def reasons(self) -> list[str]:
        """(n,) what is wrong with each point; empty where nothing is."""
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
        """The worst known offset, amid the points, and the worst known rotation."""
        return worst_of(self.matrix, self.covariance, "fixture", "base", self.centre)

    def praise(self, things: str) -> str:
        """What speaks for the answer, as a sentence about touches or other things."""
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
    setting: Setting,
) -> Frame:
    """Puts the answer together.

    Args:
        fitted: The fit.
        kinds: (n,) what was touched; empty where points have no kinds.
        method: How the answer was obtained, in words.
        more: Doubts of this method's own.
        details: Figures of this method's own.
        setting: What is known beside the points.
    """
    doubts = [*_doubts(fitted, setting), *more, *setting.doubts]
    offset, rotation = fitted.worst
    used = fitted.agreement.off_m[fitted.agrees]
    noise_95 = [1e3 * value for value in fitted.agreement.fit.sigma_95]
    return Frame(
        Edge(fitted.matrix, fitted.covariance),
        True,
        method,
        fitted.measured.source,
        datetime.now(UTC).isoformat(timespec="seconds"),
        1e3 * float(np.sqrt(np.mean(used**2))),
        1e3 * fitted.noise_m,
        _observations(fitted, kinds),
        Verdict.by(doubts, Finding(AGREEMENT, fitted.praise(setting.words.things))),
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


def _doubts(fitted: FixtureFit[State], setting: Setting) -> list[Finding]:
    names = [
        placed_name(name, place)
        for name, place in zip(fitted.names, fitted.measured.places, strict=True)
    ]
    return [
        *disputed(names, fitted.reasons, fitted.agreement, setting.words.again),
        *noisy(
            1e3 * fitted.noise_m,
            setting.options.noise_mm,
            setting.words.noisy,
            explained=fitted.agreement.explained,
            things=setting.words.things,
        ),
        *weak_directions(
            fitted.worst,
            setting.options.sigma_mm,
            setting.options.sigma_deg,
            setting.words.weak,
        ),
    ]
