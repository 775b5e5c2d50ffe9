"""Fixture frame from touches of a drawing's points, or of its origin, x axis and xy plane."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.limits import FixtureLimits
from visioncal.core.number_format import figure, some_of
from visioncal.core.procrustes import spreads
from visioncal.core.types import FloatArray
from visioncal.core.verdict import AGAIN, Finding, Remedy
from visioncal.frames.group_outliers import GroupInliers
from visioncal.frames.other_tip import with_other_tip
from visioncal.frames.placing import TOUCH_NOISE_M, assumed_words, counted_noise_m, worst_of
from visioncal.frames.pointfit import (
    FEATURE_KINDS,
    FeatureKind,
    Mistake,
    PointPairs,
    fit_features,
    fit_points,
    mistake_of,
)
from visioncal.frames.points_frame import FitSettings, PointsFit
from visioncal.frames.touches import (
    MeasuredPoints,
    NominalPoints,
    Tool,
    TouchRows,
    flange_poses,
    robot_noise,
    touched_points,
)
from visioncal.results import Calibration, Edge, Frame
from visioncal.robot import Robot

_OTHER_DRAWING = (
    "Look at the drawing's issue, scale and unit (--cad-unit), and measure a length of the part."
)
_CAUSE = "the tip had slipped, it is of another kind, or the pose is of another moment"
_THINGS = {"origin": "the origin", "x": "the x axis", "xy": "the xy plane"}

# Thermal expansion or an arm's scale error is below this share; the wrong drawing differs by more.
_WARM = 1e-3
# Smallest cosine between the tool's direction and the drawing's z for the touched side to be known.
_ASIDE = 0.3


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
        DegenerateError: Touches do not determine the fixture in every direction.
    """
    if drawing is None:
        rows = rows.of_kinds(
            FEATURE_KINDS, hint="Give --cad FILE, where the points are those of a drawing."
        )
    else:
        rows = rows.of_kinds(
            ("point",),
            "point",
            "Leave --cad away, where the fixture's origin, x axis and xy plane were touched.",
        )
        pairs = zip(rows.places, rows.points, strict=True)
        unnamed = [place for place, point in pairs if not point.strip()]
        if unnamed:
            where = rows.source if len(unnamed) == len(rows) else some_of(unnamed)
            raise DataError(
                f"{where}: the touched point is not named.",
                culprits=[where],
                next_step="Give a column point, with the names that the drawing has.",
            )
    measured = touched_points(rows, tool, robot_noise(calibration), robot, calibration)
    details: dict[str, object] = {"tool": "none: the poses are of the tip"}
    doubts: tuple[Finding, ...] = ()
    if tool is not None:
        details = {"tool": {"name": tool.name, "sigma_mm": tool.edge.sigma_mm}}
        if tool.verdict.status != "good":
            reason = tool.verdict.reasons[0] if tool.verdict.reasons else "no reason is kept."
            words = f"The tool, {tool.name}, is in doubt itself ({tool.verdict.status}): {reason}"
            doubts = (Finding("tool", words, is_fatal=tool.verdict.status == "bad"),)
    setting = FitSettings(touch_noise_m, doubts, details, options or FixtureLimits())
    if drawing is None:
        return _feature_fixture(measured, rows.kinds, setting)
    try:
        return drawn_fixture(measured, drawing, setting)
    except DataError as error:
        drawn_pairs = drawing.pairs_of(measured.names, measured.points, measured.scattered)
        poses = rows.base_from_flange
        if tool is not None:
            poses = flange_poses(rows, robot, calibration)
        raise with_other_tip(error, drawn_pairs, poses, tool) from error


def _feature_fixture(measured: MeasuredPoints, kinds: Sequence[str], setting: FitSettings) -> Frame:
    """Fits the fixture to touches of its origin, x axis and xy plane."""
    touches = PointPairs(
        measured.labels,
        measured.points,
        measured.scattered,
        np.zeros_like(measured.points),
        np.zeros(len(measured)),
        kinds=cast("tuple[FeatureKind, ...]", tuple(kinds)),
    )
    fit = fit_features(touches, setting.touch_noise_m)
    matrix = fit.fit.state.frame
    centroid = measured.points[fit.mask].mean(axis=0)
    centre = np.asarray((centroid - matrix[:3, 3]) @ matrix[:3, :3])
    fitted = _fitted(fit, touches, measured, [_CAUSE] * len(measured), centre, setting)
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in FEATURE_KINDS)
    used = [kind for kind, ok in zip(kinds, fitted.agrees.tolist(), strict=True) if ok]
    once = [_THINGS[kind] for kind in FEATURE_KINDS if used.count(kind) == 1]
    more: tuple[Finding, ...] = ()
    if once:
        words = f"{' and '.join(once).capitalize()} {'was' if len(once) == 1 else 'were'} touched"
        assumed = assumed_words(fitted.noise_m, setting.touch_noise_m)
        remedy = Remedy("Touch each once more, elsewhere.")
        more = (Finding("unchecked", f"{words} once only, which nothing checks.{assumed}", remedy),)
    return fitted.frame(f"{counts} touches", more, _worst_details(fitted), setting)


def _fitted(
    agreement: GroupInliers,
    pairs: PointPairs,
    measured: MeasuredPoints,
    causes: Sequence[str],
    centre: FloatArray,
    setting: FitSettings,
) -> PointsFit:
    """The fit with the points' common errors in its covariance.

    Its worst directions are those at the points' `centre` in the fixture [m].
    """
    fit, stated_m = agreement.fit, setting.touch_noise_m
    noise_m = counted_noise_m(fit, TOUCH_NOISE_M if stated_m is None else stated_m)
    covariance = measured.carried(fit.by_points, np.hypot(noise_m, pairs.nominal_sigma_m))
    thing = "Touch" if pairs.kinds else "Point"
    return PointsFit(
        measured.source,
        # A point measured several times also has the measurement's label.
        [
            f"{name}, {label}" if pairs.labels.count(name) > 1 else name
            for name, label in zip(pairs.labels, measured.labels, strict=True)
        ],
        [f"{thing} {label}" for label in pairs.labels],
        measured.places,
        pairs.kinds or ("",) * len(measured),
        Edge(fit.state.frame, covariance),
        agreement,
        causes,
        noise_m,
        worst_of(fit.state.frame, covariance, "fixture", "base", centre),
    )


def _worst_details(fitted: PointsFit) -> dict[str, Any]:
    offset, rotation = fitted.worst
    return {
        "worst": {
            "offset": offset.words,
            "offset_sigma_mm": 1e3 * offset.sigma,
            "rotation": rotation.words,
            "rotation_sigma_deg": float(np.rad2deg(rotation.sigma)),
        }
    }


def drawn_fixture(measured: MeasuredPoints, drawing: NominalPoints, setting: FitSettings) -> Frame:
    """Fits `base_from_fixture` to measured points, which are named as in the drawing.

    Raises:
        DataError: A point is not drawn, or the points do not fit the drawing.
        DegenerateError: Touches do not determine the fixture in every direction.
    """
    pairs = drawing.pairs_of(measured.names, measured.points, measured.scattered)
    mistake = mistake_of(pairs)
    named = () if mistake is None else (_finding_of(mistake, drawing),)
    try:
        fit = fit_points(pairs, setting.touch_noise_m)
    except DataError as error:
        for finding in named:
            words, step = f"fixture: {finding.words}", finding.do.words if finding.do else ""
            raise error.but(words, next_step=step) from error
        raise
    # Probable cause if a point is an outlier.
    cause = "it was missed, or named as another, or the part is not there as drawn"
    centre = np.asarray(pairs.nominal[fit.agreement.mask].mean(axis=0))
    fitted = _fitted(fit.agreement, pairs, measured, [cause] * len(pairs), centre, setting)
    count = len(set(pairs.labels))
    several = f"{len(measured)} touches of " if count < len(measured) else ""
    used = len({name for name, ok in zip(pairs.labels, fitted.agrees, strict=True) if ok})
    share = "" if used == count else f"{used} of "
    deviation, more = abs(fit.scale.value - 1.0), list[Finding]()
    first = [*named]
    if fit.scale.differs:
        # The frame does not absorb scale.
        extent_m = float(np.linalg.norm(np.ptp(pairs.nominal, axis=0)))
        cause = (
            "a part or an arm that is warm, or an arm whose links are longer or shorter than its "
            "controller has them, does that."
            if deviation < _WARM
            else "is it the drawing of this part, in this issue and unit, at full scale?"
        )
        words = (
            f"The part is {fit.scale.value:.5f} times as large as drawn (sigma "
            f"{fit.scale.sigma:.5f}), {figure(1e3 * deviation * extent_m)} mm over its "
            f"{figure(1e3 * extent_m)} mm, which the frame does not take in: {cause}"
        )
        # Another drawing explains the noise and weak directions that follow.
        if deviation < _WARM:
            more.append(Finding("scale", words))
        else:
            is_fatal, do = deviation > 10 * _WARM, Remedy(_OTHER_DRAWING)
            first.append(Finding("scale", words, do, is_fatal=is_fatal))
    if fit.is_flat and not named:
        normal = spreads(pairs.nominal[fitted.agrees])[1][2]
        cosines = measured.outward[fitted.agrees] @ fitted.edge.matrix[:3, 2]
        # The side of the touches determines the handedness of points in the drawing's xy plane.
        # Smallest cosine between the points' plane normal and the drawing's z for the plane to be
        # an xy plane.
        side = float(cosines.mean()) if abs(normal[2]) > 0.9 else 0.0
        if side < -_ASIDE:
            words = (
                "and the fixture's z axis points away from the side that the tool came from: a "
                "mirrored drawing looks like this."
            )
            step = "Check that z of the drawing points into the part."
        else:
            words = "and a mirrored drawing would fit them as well, turned to the other side."
            step = "Check to which side its axes point, or measure a point beside the plane."
        if not side > _ASIDE:
            words = f"The points lie in one plane, {words}"
            more.append(Finding("mirrored", words, Remedy(step)))
    if used < setting.fewest:
        words = (
            f"Only {used} points are used: with {setting.fewest} or more a wrong one can "
            f"be found.{assumed_words(fitted.noise_m, setting.touch_noise_m)}"
        )
        more.append(Finding("few_points", words))
    return fitted.frame(
        f"best fit of {several}{share}{count} points to {drawing.source}",
        more,
        {
            "scale": {"value": fit.scale.value, "sigma": fit.scale.sigma},
            "coplanar": fit.is_flat,
            **_worst_details(fitted),
        },
        setting,
        first,
    )


def _finding_of(mistake: Mistake, drawing: NominalPoints) -> Finding:
    """The finding that points have wrong names, or the drawing is mirrored."""
    good, off = (figure(1e3 * rms_m) for rms_m in (mistake.rms_m, mistake.declared_m))
    mirror = f"{drawing.source} is a mirror image of the part: with the other sign of one axis, or "
    mirror += (
        f"two axes exchanged, all points agree to {good} mm (rms), and to {off} mm as they are."
    )
    rivals = [renamed for renamed in mistake.renamed if renamed]
    if not rivals:
        do = Remedy("Correct the sign or the order of its columns, as the part has them.", AGAIN)
        return Finding("mirrored", mirror, do, is_fatal=True)
    agree = f"all points agree to {good} mm (rms), and to {off} mm as they are."
    if len(rivals[0]) == 2:
        pairs = ", or of ".join(" and ".join(renamed) for renamed in rivals)
        words = f"Of {pairs}, the names are exchanged: with the other name for each, {agree}"
    else:
        # Orders of names that are listed where points are symmetric.
        orders = (", ".join(f"{a} is {b}" for a, b in renamed.items()) for renamed in rivals[:2])
        words = f"The points have each other's names ({'; or '.join(orders)}): corrected, {agree}"
    words += f" Or {mirror}" * ({} in mistake.renamed)
    do = Remedy("Look which points were touched, and write their names in the rows.", AGAIN)
    return Finding("exchanged_names", words, do)
