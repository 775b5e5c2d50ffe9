"""Fixture frame from touches of a drawing's points, or of its origin, x axis and xy plane."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, cast

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.limits import FixtureLimits
from visioncal.core.number_format import figure, some_of
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
from visioncal.estimation.pointfit import FixturePlacement, PointFit, PointPairs, fit_points
from visioncal.frames.drawing_points import NominalPoints
from visioncal.frames.findings import RENAMED
from visioncal.frames.fixture_fit import FitSettings, FixtureFit, fixture_frame
from visioncal.frames.measured_points import MeasuredPoints, Tool, touched_points
from visioncal.frames.touches import TouchRows, robot_noise
from visioncal.results import Calibration, Frame
from visioncal.robot import Robot

_CAUSE = "the tip had slipped, it is of another kind, or the pose is of another moment"
_THINGS = {"origin": "the origin", "x": "the x axis", "xy": "the xy plane"}

# Thermal expansion or an arm's scale error is below this share; the wrong drawing differs by more.
_WARM = 1e-3
# Smallest cosine between the points' plane normal and the drawing's z for the plane to be an xy
# plane, and between the tool's direction and z for the touched side to be known.
_FLAT, _ASIDE = 0.9, 0.3


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
    """Estimates a fixture's frame from touches of its features or of a drawing's points.

    Args:
        rows: The touches. Without a drawing each is of kind `origin`, `x` (on the positive x axis)
            or `xy` (in the xy plane, on the side of positive y); with one, each names its point.
        tool: The touching tool; None where the poses are of the tip itself.
        drawing: The points in the fixture's frame; None for features.
        calibration: Of the same robot, for its noise and arm; optional.
        robot: The model for joint angles, where the calibration has none.
        touch_noise_m: Known repeatability of a touch, per axis [m].
        options: Limits of the verdict.

    Returns:
        `base_from_fixture`.

    Raises:
        DataError: Touches are missing, wrongly written, or contradict each other or the drawing.
        DegenerateError: They do not determine the fixture in every direction.
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
    details: dict[str, object] = {"tool": "none: the poses are of the tip"}
    if tool is not None:
        details = {"tool": {"name": tool.name, "sigma_mm": tool.edge.sigma_mm}}
    findings = tuple(_tool_findings(tool))
    setting = FitSettings(touch_noise_m, findings, details, options or FixtureLimits())
    if drawing is None:
        return _feature_fixture(measured, rows.kinds, setting)
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


def _tool_findings(tool: Tool | None) -> list[Finding]:
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


def _feature_fixture(measured: MeasuredPoints, kinds: Sequence[str], setting: FitSettings) -> Frame:
    """Fits the fixture to touches of its origin, x axis and xy plane."""
    touches = FeatureTouches(
        measured.labels,
        cast("tuple[FeatureKind, ...]", tuple(kinds)),
        measured.points,
        measured.scattered,
    )
    noise_m = setting.touch_noise_m
    if noise_m is None and len(measured) == len(FEATURE_KINDS):
        # One of each kind leaves no residual to estimate the noise from.
        noise_m = TOUCH_NOISE_M
    fitted = _feature_fit(fit_features(touches, noise_m), measured, setting)
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in FEATURE_KINDS)
    return fixture_frame(
        fitted,
        kinds,
        f"{counts} touches",
        tuple(_redundancy_findings(fitted, kinds, setting)),
        {},
        setting,
    )


def _feature_fit(
    fit: FeatureFit, measured: MeasuredPoints, setting: FitSettings
) -> FixtureFit[FloatArray]:
    matrix, centroid = fit.base_from_fixture, measured.points[fit.agreement.mask].mean(axis=0)
    noise_m = counted_noise_m(fit.agreement.fit, setting.expected_m)
    return FixtureFit(
        measured,
        measured.labels,
        tuple(f"Touch {label}" for label in measured.labels),
        matrix,
        measured.carried(fit.by_points, np.full(len(measured), noise_m)),
        np.asarray((centroid - matrix[:3, 3]) @ matrix[:3, :3]),
        fit.agreement,
        [_CAUSE] * len(measured),
        noise_m,
    )


def _redundancy_findings(
    fitted: FixtureFit[FloatArray], kinds: Sequence[str], setting: FitSettings
) -> Iterator[Finding]:
    used = [kind for kind, ok in zip(kinds, fitted.agrees.tolist(), strict=True) if ok]
    once = [_THINGS[kind] for kind in FEATURE_KINDS if used.count(kind) == 1]
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


def drawn_fixture(measured: MeasuredPoints, drawing: NominalPoints, setting: FitSettings) -> Frame:
    """Fits `base_from_fixture` to measured points, which are named as in the drawing.

    Raises:
        DataError: A point is not drawn, or the points do not fit the drawing.
        DegenerateError: They do not determine the fixture in every direction.
    """
    pairs = drawing.beside(measured.names, measured.points, measured.scattered)
    fit = fit_points(pairs, setting.touch_noise_m)
    fitted = _drawing_fit(fit, measured, pairs, setting)
    count = len(set(pairs.labels))
    several = f"{len(measured)} {setting.words.things} of " if count < len(measured) else ""
    used = _inlier_names(pairs, fitted.agrees)
    share = "" if len(used) == count else f"{len(used)} of "
    return fixture_frame(
        fitted,
        ("",) * len(measured),
        f"best fit of {several}{share}{count} points to {drawing.source}",
        tuple(_drawing_findings(fit, fitted, pairs, setting)),
        _drawing_details(fit, pairs),
        setting,
    )


def _drawing_fit(
    fit: PointFit, measured: MeasuredPoints, pairs: PointPairs, setting: FitSettings
) -> FixtureFit[FixturePlacement]:
    noise_m = counted_noise_m(fit.agreement.fit, setting.expected_m)
    noise = np.hypot(noise_m, pairs.nominal_sigma_m)
    return FixtureFit(
        measured,
        _labels(measured, pairs),
        tuple(f"Point {label}" for label in pairs.labels),
        fit.base_from_fixture,
        measured.carried(fit.by_points, noise),
        np.asarray(pairs.nominal[fit.agreement.mask].mean(axis=0)),
        fit.agreement,
        _causes(fit, pairs),
        noise_m,
    )


def _labels(measured: MeasuredPoints, pairs: PointPairs) -> tuple[str, ...]:
    """Point names; a point measured several times also has the measurement's label."""
    several = {label for label in pairs.labels if pairs.labels.count(label) > 1}
    return tuple(
        f"{name}, {label}" if name in several else name
        for name, label in zip(pairs.labels, measured.labels, strict=True)
    )


def _causes(fit: PointFit, pairs: PointPairs) -> list[str]:
    """(n,) probable cause if the point is an outlier."""
    causes = dict.fromkeys(pairs.labels, "it was missed, or the part is not there as drawn")
    if fit.numbering.is_wrong:
        points = pairs.merged()
        for at in fit.numbering.moved.tolist():
            other = points.drawn_labels[fit.numbering.assignment[at]]
            causes[points.labels[at]] = f"it is where {other} is drawn{RENAMED}"
    return [causes[label] for label in pairs.labels]


def _drawing_findings(
    fit: PointFit, fitted: FixtureFit[FixturePlacement], pairs: PointPairs, setting: FitSettings
) -> Iterator[Finding]:
    yield from _scale_findings(fit, pairs)
    if not fit.hand_known:
        yield from _mirror_findings(fitted, pairs, setting.words.side)
    if not fit.numbering.is_unique:
        yield Finding(
            "symmetric",
            f"The pattern of the points is symmetric: they fit the drawing in "
            f"{fit.numbering.equally_good} orders alike, and exchanged names would not be noticed.",
            Remedy(
                f"Check that {pairs.labels[0]} is where the drawing has it, or measure one more "
                "point that breaks the symmetry."
            ),
        )
    used = len(_inlier_names(pairs, fitted.agrees))
    if used < setting.options.points:
        yield Finding(
            "few_points",
            f"Only {used} points are used: with {setting.options.points} or more a wrong one can "
            f"be found.{assumed_words(fitted.noise_m, setting.touch_noise_m)}",
        )


def _inlier_names(pairs: PointPairs, agrees: Mask) -> set[str]:
    return {name for name, ok in zip(pairs.labels, agrees.tolist(), strict=True) if ok}


def _scale_findings(fit: PointFit, pairs: PointPairs) -> Iterator[Finding]:
    """Finding on a part whose size differs from the drawing; the frame does not absorb scale."""
    if not fit.scale.differs:
        return
    deviation = abs(fit.scale.value - 1.0)
    extent_m = float(np.linalg.norm(np.ptp(pairs.nominal, axis=0)))
    cause = (
        "a part or an arm that is warm, or an arm whose links are longer or shorter than its "
        "controller has them, does that."
        if deviation < _WARM
        else "is it the drawing of this part, in this issue and at full scale?"
    )
    yield Finding(
        "scale",
        f"The part is {fit.scale.value:.5f} times as large as drawn (sigma {fit.scale.sigma:.5f}), "
        f"{figure(1e3 * deviation * extent_m)} mm over its {figure(1e3 * extent_m)} mm, which the "
        f"frame does not take in: {cause}",
        is_fatal=deviation > _WARM * 10,
    )


def _mirror_findings(
    fitted: FixtureFit[FixturePlacement], pairs: PointPairs, seen_from: str
) -> Iterator[Finding]:
    """Finding on coplanar points, unless the side of the touches determines their handedness."""
    nominal = pairs.nominal[fitted.agrees]
    normal = np.linalg.svd(nominal - nominal.mean(axis=0))[2][2]
    cosines = fitted.measured.outward[fitted.agrees] @ fitted.matrix[:3, 2]
    side = float(cosines.mean()) if abs(normal[2]) > _FLAT else 0.0
    if side > _ASIDE:
        return
    if side < -_ASIDE:
        yield Finding(
            "mirrored",
            "The points lie in one plane, and the fixture's z axis points away from the side that "
            f"{seen_from}: a mirrored drawing looks like this.",
            Remedy("Check that z of the drawing points into the part."),
        )
        return
    yield Finding(
        "mirrored",
        "The points lie in one plane, and a mirrored drawing would fit them as well, turned to the "
        "other side.",
        Remedy(
            "Check to which side the fixture's axes point, or measure a point beside the plane."
        ),
    )


def _drawing_details(fit: PointFit, pairs: PointPairs) -> Mapping[str, Any]:
    spare = {"spare_points": list(pairs.spare_labels)} if pairs.spare_labels else {}
    return {
        "scale": {"value": fit.scale.value, "sigma": fit.scale.sigma},
        "coplanar": not fit.hand_known,
        "equal_orders": fit.numbering.equally_good,
        **spare,
    }
