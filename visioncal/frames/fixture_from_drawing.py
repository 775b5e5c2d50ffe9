"""A fixture from measured points and a drawing's coordinates of them."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.types import Mask
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.placing import assumed_words, counted_noise_m
from visioncal.estimation.pointfit import FixturePlacement, PointFit, PointPairs, fit_points
from visioncal.frames.drawing_points import NominalPoints
from visioncal.frames.fixture_fit import FixtureFit, Setting, fixture_frame
from visioncal.frames.measured import MeasuredPoints
from visioncal.results import Frame

# A warm part or a long arm is off by less than this; a drawing of another issue by more.
_WARM = 1e-3
# Points lie across the drawing's z if their plane's normal is this much along it, and the tool came
# from a side of that plane if its direction was this much along the normal.
_FLAT, _ASIDE = 0.9, 0.3


def drawn_fixture(measured: MeasuredPoints, drawing: NominalPoints, setting: Setting) -> Frame:
    """Finds the fixture whose drawn points were measured.

    Args:
        measured: The points; each has the name of a drawn one.
        drawing: The drawn points.
        setting: What is known beside.

    Returns:
        `base_from_fixture`.

    Raises:
        DataError: A point is not drawn, or the points do not fit the drawing.
        DegenerateError: They leave a direction open.
    """
    pairs = drawing.beside(measured.names, measured.points, measured.scattered)
    fit = fit_points(pairs, setting.touch_noise_m)
    fitted = _fitted(fit, measured, pairs, setting)
    count = len(set(pairs.labels))
    several = f"{len(measured)} {setting.words.things} of " if count < len(measured) else ""
    used = _names_used(pairs, fitted.agrees)
    less = "" if len(used) == count else f"{len(used)} of "
    return fixture_frame(
        fitted,
        ("",) * len(measured),
        f"best fit of {several}{less}{count} points to {drawing.source}",
        tuple(_doubts(fit, fitted, pairs, setting)),
        _details(fit, pairs),
        setting,
    )


def _fitted(
    fit: PointFit, measured: MeasuredPoints, pairs: PointPairs, setting: Setting
) -> FixtureFit[FixturePlacement]:
    noise_m = counted_noise_m(fit.agreement.fit, setting.expected_m)
    noise = np.hypot(noise_m, pairs.nominal_sigma_m)
    return FixtureFit(
        measured,
        _labels(measured, pairs),
        tuple(f"Point {label}" for label in pairs.labels),
        fit.base_from_fixture,
        measured.carried(fit.by_points, noise),
        np.asarray(pairs.nominal[fit.agreement.agrees].mean(axis=0)),
        fit.agreement,
        _causes(fit, pairs),
        noise_m,
    )


def _labels(measured: MeasuredPoints, pairs: PointPairs) -> tuple[str, ...]:
    """The points' names; where one was measured several times, with which time it was."""
    several = {label for label in pairs.labels if pairs.labels.count(label) > 1}
    return tuple(
        f"{name}, {label}" if name in several else name
        for name, label in zip(pairs.labels, measured.labels, strict=True)
    )


def _causes(fit: PointFit, pairs: PointPairs) -> list[str]:
    """What makes each point disagree, if it does."""
    causes = dict.fromkeys(pairs.labels, "it was missed, or the part is not there as drawn")
    if fit.numbering.is_wrong:
        points = pairs.merged()
        for at in fit.numbering.moved.tolist():
            other = points.drawn_labels[fit.numbering.assignment[at]]
            causes[points.labels[at]] = f"it is where {other} is drawn: is its name exchanged?"
    return [causes[label] for label in pairs.labels]


def _doubts(
    fit: PointFit, fitted: FixtureFit[FixturePlacement], pairs: PointPairs, setting: Setting
) -> Iterator[Finding]:
    yield from _scaled(fit, pairs)
    if not fit.hand_known:
        yield from _mirrored(fitted, pairs, setting.words.side)
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
    used = len(_names_used(pairs, fitted.agrees))
    if used < setting.options.points:
        yield Finding(
            "few_points",
            f"Only {used} points are used: with {setting.options.points} or more a wrong one can "
            f"be found.{assumed_words(fitted.noise_m, setting.touch_noise_m)}",
        )


def _names_used(pairs: PointPairs, agrees: Mask) -> set[str]:
    return {name for name, ok in zip(pairs.labels, agrees.tolist(), strict=True) if ok}


def _scaled(fit: PointFit, pairs: PointPairs) -> Iterator[Finding]:
    """Doubts a part that is not as large as drawn; the frame does not take that in."""
    if not fit.scale.differs:
        return
    off = abs(fit.scale.value - 1.0)
    reach = float(np.linalg.norm(np.ptp(pairs.nominal, axis=0)))
    cause = (
        "a part or an arm that is warm, or an arm whose links are longer or shorter than its "
        "controller has them, does that."
        if off < _WARM
        else "is it the drawing of this part, in this issue and at full scale?"
    )
    yield Finding(
        "scale",
        f"The part is {fit.scale.value:.5f} times as large as drawn (sigma {fit.scale.sigma:.5f}), "
        f"{figure(1e3 * off * reach)} mm over its {figure(1e3 * reach)} mm, which the frame does "
        f"not take in: {cause}",
        is_fatal=off > _WARM * 10,
    )


def _mirrored(
    fitted: FixtureFit[FixturePlacement], pairs: PointPairs, seen_from: str
) -> Iterator[Finding]:
    """Doubts points in a plane, unless the side of the touches determines their handedness."""
    drawn = pairs.nominal[fitted.agrees]
    normal = np.linalg.svd(drawn - drawn.mean(axis=0))[2][2]
    along = fitted.measured.outward[fitted.agrees] @ fitted.matrix[:3, 2]
    side = float(along.mean()) if abs(normal[2]) > _FLAT else 0.0
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


def _details(fit: PointFit, pairs: PointPairs) -> Mapping[str, Any]:
    spare = {"spare_points": list(pairs.spare_labels)} if pairs.spare_labels else {}
    return {
        "scale": {"value": fit.scale.value, "sigma": fit.scale.sigma},
        "coplanar": not fit.hand_known,
        "equal_orders": fit.numbering.equally_good,
        **spare,
    }
