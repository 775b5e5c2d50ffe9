"""Fixture frame from touches of a drawing's points, or of its origin, x axis and xy plane."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, cast

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.directions import Direction
from visioncal.core.errors import DataError
from visioncal.core.limits import FixtureLimits, ToolLimits
from visioncal.core.number_format import figure, some_of
from visioncal.core.procrustes import spreads
from visioncal.core.types import FloatArray, Mask
from visioncal.core.verdict import AGAIN, AGREEMENT, Finding, Remedy, Verdict
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
from visioncal.frames.touches import (
    MeasuredPoints,
    NominalPoints,
    Tool,
    TouchRows,
    flange_poses,
    robot_noise,
    touched_points,
)
from visioncal.results import Calibration, Edge, Frame, Observation
from visioncal.robot import Robot

_NAME_AGAIN = (
    "Correct the names of what is named; where they are right, touch it once more, and write the "
    "new poses in its rows."
)
_TOUCH_AGAIN = (
    "Touch what is named once more, and write the new poses in its rows; where it is another point "
    "or kind than its row states, correct that."
)
_OTHER_DRAWING = (
    "Look at the drawing's issue, scale and unit (--cad-unit), and measure a length of the part."
)
_CAUSE = "the tip had slipped, it is of another kind, or the pose is of another moment"
_THINGS = {"origin": "the origin", "x": "the x axis", "xy": "the xy plane"}

# Thermal expansion or an arm's scale error is below this share; the wrong drawing differs by more.
_WARM = 1e-3
# Orders of names that are listed where points are symmetric.
_ORDERS = 2
# Smallest cosine between the points' plane normal and the drawing's z for the plane to be an xy
# plane, and between the tool's direction and z for the touched side to be known.
_FLAT, _ASIDE = 0.9, 0.3


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
class FitSettings:
    """Noise, limits and advice of a frame's fit."""

    # Known repeatability of a touch, per axis [m]; None where unknown.
    touch_noise_m: float | None = None
    # Findings on the tool or camera that the points were measured with.
    doubts: tuple[Finding, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)  # Its figures, for the record.
    options: FixtureLimits | ToolLimits = field(
        default_factory=FixtureLimits
    )  # Limits of the verdict.
    # Advice for noisy touches, as a sentence.
    noisy: str = (
        "Touch again with a sharp tip, and check the tool; an arm that was never calibrated is "
        "off by a millimetre from posture to posture."
    )
    # Advice for a poorly determined direction, as a sentence.
    weak: str = (
        "Touch points that are farther apart, or more of them; a tip that is known better "
        "helps where all touches share its error."
    )

    @property
    def fewest(self) -> int:
        """Number of touches or points from which on a wrong one can be found."""
        limits = self.options
        return limits.touches if isinstance(limits, ToolLimits) else limits.points


@dataclass(frozen=True, eq=False)
class PointsFit:
    """Fit of a tool or a fixture to n touches or other points."""

    source: str  # Origin of the points, for the record.
    labels: Sequence[str]  # (n,) their names in the record.
    names: Sequence[str]  # (n,) their names in messages: `Touch 3`, `Point P3`.
    places: Sequence[str]  # (n,) their rows: `touches.csv, line 5`; empty where there are none.
    kinds: Sequence[str]  # (n,) kinds of the touches, or empty texts.
    # The frame in its parent, with the points' common errors in the covariance.
    edge: Edge
    agreement: GroupInliers  # The inliers.
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
            ratio = float(np.sqrt(inliers.beyond[at]))
            if ratio > 1.0:
                off += f", {figure(ratio)} times what the others allow"
            if inliers.doubtful[at]:
                words.append(f"{off}: one of those that contradict each other")
            else:
                words.append("" if inliers.mask[at] else f"{off}: {cause}")
        return words

    @property
    def again(self) -> str:
        """Advice on a touch that is wrong: those of a drawing have names alone."""
        return _TOUCH_AGAIN if any(self.kinds) else _NAME_AGAIN

    def findings(self, setting: FitSettings) -> Iterator[Finding]:
        """Findings on the fit, led by the touch without which the others agree, if it is one."""
        found = [*self._doubts(setting)]
        suspected = self.agreement.suspected if found and self.agrees.all() else None
        if suspected is not None:
            at, level_m = suspected
            place = f" ({self.places[at]})" if self.places[at] else ""
            words = (
                f"{self.names[at]}{place} is the likeliest to be wrong: without it the others "
                f"agree to {figure(1e3 * level_m)} mm per axis, and with it to "
                f"{figure(1e3 * self.agreement.fit.sigma)} mm: too little to leave it out."
            )
            yield Finding("suspected", words, Remedy(self.again, AGAIN))
        yield from found

    def _doubts(self, setting: FitSettings) -> Iterator[Finding]:
        """Findings on outliers and contradictions, the noise, and what is poorly determined."""
        reasons = self.reasons
        names = [
            f"{name} ({place})" if place else name
            for name, place in zip(self.names, self.places, strict=True)
        ]
        for at in np.flatnonzero(~self.agrees).tolist():
            words = f"{names[at]} was left out: {reasons[at]}."
            yield Finding("left_out", words, Remedy(self.again, AGAIN))
        if self.agreement.doubtful.any():
            some = some_of([names[at] for at in np.flatnonzero(self.agreement.doubtful).tolist()])
            words = f"{some} contradict each other, and which is wrong is not known: all are used."
            yield Finding("contradicting", words, Remedy(self.again))
        noise_mm, (check, bad) = 1e3 * self.noise_m, setting.options.noise_mm
        if noise_mm > check:
            yield Finding(
                "noise",
                f"The touches agree to {figure(noise_mm)} mm only (per axis; doubt begins at "
                f"{check:g}).",
                Remedy(setting.noisy),
                is_fatal=noise_mm > bad,
            )
        elif not self.agreement.explained:
            yield Finding(
                "noise",
                "The touches scatter by more than they are stated to, without one that stands out: "
                f"{figure(noise_mm)} mm per axis.",
                Remedy(
                    "Repeat them, or state the noise as it is.",
                    f"{AGAIN} --touch-noise-mm {noise_mm:.2g}",
                ),
            )
        limits = setting.options
        yield from sigma_findings(self.worst, limits.sigma_mm, limits.sigma_deg, setting.weak)

    def frame(
        self,
        method: str,
        more: Sequence[Finding],
        details: Mapping[str, Any],
        setting: FitSettings,
        first: Sequence[Finding] = (),
    ) -> Frame:
        """Builds the frame with its verdict.

        `more` and `details` are findings and figures of the method; `first` are more, in front.
        """
        off_m, offset = self.agreement.off_m, self.worst[0]
        off_mm = (1e3 * off_m).tolist()
        rows = zip(self.labels, self.agrees.tolist(), self.reasons, self.kinds, off_mm, strict=True)
        rotation = "".join(
            f"; {direction.words} to {figure(np.rad2deg(direction.sigma))} deg"
            for direction in self.worst[1:]
        )
        rms_m = float(np.sqrt(np.mean(off_m[self.agrees] ** 2)))
        # Where the arm's own errors explain all, no noise of touches is left.
        agreed_mm = 1e3 * max(self.noise_m, rms_m / np.sqrt(3.0))
        praise = (
            f"{int(self.agrees.sum())} touches agree to {figure(agreed_mm)} mm per axis, "
            f"and {offset.words}, the worst direction, is known to "
            f"{figure(1e3 * offset.sigma)} mm{rotation}."
        )
        if not self.oriented:
            praise += " The rotation was not touched: it is the flange's own."
        return Frame(
            self.edge,
            self.oriented,
            method,
            self.source,
            datetime.now(UTC).isoformat(timespec="seconds"),
            1e3 * rms_m,
            1e3 * self.noise_m,
            tuple(
                Observation(label, used=used, reason=reason, kind=kind, residual_mm=off)
                for label, used, reason, kind, off in rows
            ),
            Verdict.by(
                [*first, *self.findings(setting), *more, *setting.doubts],
                Finding(AGREEMENT, praise),
            ),
            {**details, **setting.details},
        )


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
        beside = drawing.beside(measured.names, measured.points, measured.scattered)
        poses = rows.base_from_flange
        if tool is not None:
            poses = flange_poses(rows, robot, calibration)
        raise with_other_tip(error, beside, poses, tool) from error


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
        DegenerateError: They do not determine the fixture in every direction.
    """
    pairs = drawing.beside(measured.names, measured.points, measured.scattered)
    mistake = mistake_of(pairs)
    named = () if mistake is None else (_finding_of(mistake, drawing),)
    try:
        fit = fit_points(pairs, setting.touch_noise_m)
    except DataError as error:
        for finding in named:
            words, step = f"fixture: {finding.words}", finding.do.words if finding.do else ""
            raise DataError(words, culprits=error.culprits, next_step=step) from error
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
        side = float(cosines.mean()) if abs(normal[2]) > _FLAT else 0.0
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
        orders = (
            ", ".join(f"{a} is {b}" for a, b in renamed.items()) for renamed in rivals[:_ORDERS]
        )
        words = f"The points have each other's names ({'; or '.join(orders)}): corrected, {agree}"
    words += f" Or {mirror}" * ({} in mistake.renamed)
    do = Remedy("Look which points were touched, and write their names in the rows.", AGAIN)
    return Finding("exchanged_names", words, do)
