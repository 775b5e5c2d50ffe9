"""A fixture from touches of its origin, its x axis and its xy plane."""

from collections.abc import Iterator, Sequence
from typing import cast

import numpy as np

from visioncal.core.types import Mask
from visioncal.core.verdict import Finding, Step
from visioncal.estimation.features import (
    FEATURE_KINDS,
    FeatureFit,
    FeatureKind,
    FeatureTouches,
    fit_features,
)
from visioncal.estimation.placing import TOUCH_NOISE_M, assumed_words, counted_noise_m
from visioncal.frames.fixture_fit import Fitted, Setting, fixture_frame, reasons_of
from visioncal.frames.measured import MeasuredPoints
from visioncal.results import Frame

_CAUSE = "the tip had slipped, it is of another kind, or the pose is of another moment"
_THINGS = {"origin": "the origin", "x": "the x axis", "xy": "the xy plane"}


def featured_fixture(measured: MeasuredPoints, kinds: Sequence[str], setting: Setting) -> Frame:
    """Finds the fixture whose origin, x axis and xy plane were touched.

    Args:
        measured: Where they were touched.
        kinds: (n,) what was touched, of `FEATURE_KINDS`.
        setting: What is known beside.

    Returns:
        `base_from_fixture`.

    Raises:
        DataError: A kind is missing, or the touches contradict each other.
        DegenerateError: They leave a direction open.
    """
    touches = FeatureTouches(
        measured.labels,
        cast("tuple[FeatureKind, ...]", tuple(kinds)),
        measured.points,
        measured.scattered,
    )
    expected = setting.touch_noise_m
    if expected is None and len(measured) == len(FEATURE_KINDS):
        # One of each kind leaves no residual to estimate the noise from.
        expected = TOUCH_NOISE_M
    fitted = _fitted(fit_features(touches, expected), measured, setting)
    counts = ", ".join(f"{kinds.count(it)} {it}" for it in FEATURE_KINDS)
    return fixture_frame(
        fitted, kinds, f"{counts} touches", tuple(_doubts(fitted, kinds, setting)), {}, setting
    )


def _fitted(fit: FeatureFit, measured: MeasuredPoints, setting: Setting) -> Fitted:
    agreement, matrix = fit.agreement, fit.base_from_fixture
    noise_m = counted_noise_m(agreement.fit, setting.expected_m)
    agrees = agreement.agrees
    away = np.linalg.norm(fit.residuals, axis=1)
    return Fitted(
        measured,
        measured.labels,
        tuple(f"Touch {it}" for it in measured.labels),
        matrix,
        measured.carried(fit.by_points, np.full(len(measured), noise_m)),
        np.asarray((measured.points[agrees].mean(axis=0) - matrix[:3, 3]) @ matrix[:3, :3]),
        agrees,
        agreement.doubtful,
        agreement.explained,
        tuple(reasons_of(agreement, away, [_CAUSE] * len(measured))),
        away,
        noise_m,
        agreement.fit.sigma_95,
    )


def _doubts(fitted: Fitted, kinds: Sequence[str], setting: Setting) -> Iterator[Finding]:
    once = [_THINGS[kind] for kind in FEATURE_KINDS if _count(kinds, kind, fitted.agrees) == 1]
    assumed = assumed_words(fitted.noise_m, setting.touch_noise_m)
    if len(once) == len(FEATURE_KINDS):
        yield Finding(
            "unchecked",
            f"Three touches leave nothing to check the fixture with.{assumed}",
            Step("Touch each feature once more, elsewhere."),
        )
    elif once:
        verb = "was" if len(once) == 1 else "were"
        yield Finding(
            "unchecked",
            f"{' and '.join(once).capitalize()} {verb} touched once only, which nothing checks."
            f"{assumed}",
            Step("Touch again, elsewhere."),
        )


def _count(kinds: Sequence[str], kind: str, agrees: Mask) -> int:
    return sum(it == kind and used for it, used in zip(kinds, agrees.tolist(), strict=True))
