"""A fixture from touches, of a drawing's points or of its origin, its x axis and its xy plane."""

from collections.abc import Iterator, Sequence
from typing import cast

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.core.limits import FixtureLimits
from visioncal.core.types import FloatArray, Mask
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.features import (
    FEATURE_KINDS,
    FeatureFit,
    FeatureKind,
    FeatureTouches,
    fit_features,
)
from visioncal.estimation.placing import TOUCH_NOISE_M, assumed_words, counted_noise_m
from visioncal.frames.drawing_points import NominalPoints
from visioncal.frames.fixture_fit import FixtureFit, Setting, fixture_frame
from visioncal.frames.fixture_from_drawing import drawn_fixture
from visioncal.frames.measured import MeasuredPoints, Tool, touched_points
from visioncal.frames.touches import TouchRows, robot_noise
from visioncal.results import Calibration, Frame
from visioncal.robot import Robot

_CAUSE = "the tip had slipped, it is of another kind, or the pose is of another moment"
_THINGS = {"origin": "the origin", "x": "the x axis", "xy": "the xy plane"}


@typed
def touched_fixture(
    rows: TouchRows,
    tool: Tool | None,
    drawing: NominalPoints | None = None,
    calibration: Calibration | None = None,
    robot: Robot | None = None,
    *,
    touch_noise_m: float | None = None,
    options: FixtureLimits | None = None,
) -> Frame:
    """Finds a fixture by touches of its features, or of points that a drawing has.

    Args:
        rows: The touches. Without a drawing each is of kind `origin`, `x` (on the positive x axis)
            or `xy` (in the xy plane, on the side of positive y); with one, each names its point.
        tool: That touched; None where the poses are of the tip itself.
        drawing: The points in the fixture's frame; None for features.
        calibration: Of the same robot, where there is one: its noise and its arm are used.
        robot: A model for joint angles, where the calibration has none.
        touch_noise_m: What a touch is known to repeat to, per axis [m].
        options: Where doubt begins.

    Returns:
        `base_from_fixture`.

    Raises:
        DataError: Touches are missing, wrongly written, or contradict each other or the drawing.
        DegenerateError: They leave a direction of the fixture open.
    """
    if drawing is None:
        rows = rows.of_kinds(
            FEATURE_KINDS, hint="Say --cad FILE, where the points are those of a drawing."
        )
    else:
        rows = rows.of_kinds(
            ("point",),
            "point",
            "Leave --cad away, where the fixture's origin, x axis and xy plane were touched.",
        )
        _check_named(rows)
    measured = touched_points(rows, tool, robot_noise(calibration), robot, calibration)
    setting = Setting(
        touch_noise_m, tuple(_doubts(tool)), _details(tool), options or FixtureLimits()
    )
    if drawing is None:
        return _featured_fixture(measured, rows.kinds, setting)
    return drawn_fixture(measured, drawing, setting)


def _check_named(rows: TouchRows) -> None:
    unnamed = [
        place for place, point in zip(rows.places, rows.points, strict=True) if not point.strip()
    ]
    if unnamed:
        where = rows.source if len(unnamed) == len(rows) else some_of(unnamed)
        raise DataError(
            f"{where}: which point was touched is not said.",
            culprits=[where],
            next_step="Give a column point, with the names that the drawing has.",
        )


def _doubts(tool: Tool | None) -> list[Finding]:
    if tool is None or tool.verdict.status == "good":
        return []
    return [
        Finding(
            "tool",
            f"The tool, {tool.name}, is in doubt itself ({tool.verdict.status}): "
            f"{tool.verdict.reasons[0] if tool.verdict.reasons else 'no reason is kept.'}",
            is_fatal=tool.verdict.status == "bad",
        )
    ]


def _details(tool: Tool | None) -> dict[str, object]:
    if tool is None:
        return {"tool": "none: the poses are of the tip"}
    return {"tool": {"name": tool.name, "sigma_mm": tool.edge.sigma_mm}}


def _featured_fixture(measured: MeasuredPoints, kinds: Sequence[str], setting: Setting) -> Frame:
    """Finds the fixture whose origin, x axis and xy plane were touched."""
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
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in FEATURE_KINDS)
    return fixture_frame(
        fitted, kinds, f"{counts} touches", tuple(_unchecked(fitted, kinds, setting)), {}, setting
    )


def _fitted(fit: FeatureFit, measured: MeasuredPoints, setting: Setting) -> FixtureFit[FloatArray]:
    matrix, amid = fit.base_from_fixture, measured.points[fit.agreement.agrees].mean(axis=0)
    noise_m = counted_noise_m(fit.agreement.fit, setting.expected_m)
    return FixtureFit(
        measured,
        measured.labels,
        tuple(f"Touch {label}" for label in measured.labels),
        matrix,
        measured.carried(fit.by_points, np.full(len(measured), noise_m)),
        np.asarray((amid - matrix[:3, 3]) @ matrix[:3, :3]),
        fit.agreement,
        [_CAUSE] * len(measured),
        noise_m,
    )


def _unchecked(
    fitted: FixtureFit[FloatArray], kinds: Sequence[str], setting: Setting
) -> Iterator[Finding]:
    once = [_THINGS[kind] for kind in FEATURE_KINDS if _count(kinds, kind, fitted.agrees) == 1]
    assumed = assumed_words(fitted.noise_m, setting.touch_noise_m)
    if len(once) == len(FEATURE_KINDS):
        yield Finding(
            "unchecked",
            f"Three touches leave nothing to check the fixture with.{assumed}",
            Remedy("Touch each feature once more, elsewhere."),
        )
    elif once:
        verb = "was" if len(once) == 1 else "were"
        yield Finding(
            "unchecked",
            f"{' and '.join(once).capitalize()} {verb} touched once only, which nothing checks."
            f"{assumed}",
            Remedy("Touch again, elsewhere."),
        )


def _count(kinds: Sequence[str], kind: str, agrees: Mask) -> int:
    return sum(name == kind and used for name, used in zip(kinds, agrees.tolist(), strict=True))
