"""Findings against a result, by its views, motion, corners and arms."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.cause_ranking import (
    LEAST_RUN,
    MEASURE_BOARD,
    MOVED_AT_ONCE,
    NO_JOINTS,
    REFINE_LENS,
    add_views_remedy,
    run_evidence,
)
from visioncal.calibration.stages.findings import Findings, JudgedArm, JudgedPair, Sensor
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import counted, figure, mm_and_deg
from visioncal.core.types import Mount
from visioncal.core.verdict import EXCHANGED, NO_DOUBTS, REVIEW, Finding, Remedy, look_at, or_alone
from visioncal.results import Rms, ViewResult

# Scatter below a nanometre or a micro-degree is rounding, so that ratios mean nothing.
_ROUNDING = 1e-6
_LISTED_VIEWS, _LISTED_PARTS = 3, 3
_CAMERA_CAUSES = (
    "a board that moved, images paired with other poses, units or conventions of the poses, "
    "intrinsics, a warped board"
)
_CAUSES: Mapping[Mount, str] = {
    "eye-in-hand": _CAMERA_CAUSES,
    "eye-to-hand": _CAMERA_CAUSES,
    "instrument": "an instrument or a tool that moved, readings paired with other poses, units or "
    "conventions of the poses",
}
# Ratio of the outlier limit of measured poses to that of views with corners: sound poses of a board
# that is seen squarely are off by 8 times the median now and then.
_UNEVEN = 1.5
# Kinds of findings about views that are left out.
_LEFT_OUT = (EXCHANGED, "turned_images", "wrong_pose", "something_moved")
# Largest ratio of residuals to those expected by the sensor's noise that counts as explained, as of
# a small board far away.
_OF_NOISE = 1.5


def collect_findings(findings: Findings) -> list[Finding]:
    """All findings against a result, in the order of the checks."""
    limits = CalibrationLimits()
    robots = list(_robot_doubts(findings, limits))
    scatter = list(_scatter_doubts(findings, limits))
    if scatter:
        # Scatter replaces the robot's noise, and is accepted up to the same need at least.
        least = max((doubt.until_mm for doubt in robots), default=0.0)
        scatter = [replace(doubt, until_mm=max(doubt.until_mm, least)) for doubt in scatter]
        robots = []
    pairs, sensors = findings.pairs, findings.sensors
    return [
        *scatter,
        *(doubt for pair in pairs for doubt in _disagreement_doubts(pair)),
        *_outlier_doubts(findings, limits),
        *(doubt for pair in pairs for doubt in _holdout_doubts(pair, findings.mount, limits)),
        # With fatal scatter, sigmas say nothing about the motion.
        *(
            []
            if any(finding.is_fatal for finding in scatter)
            else _accuracy_doubts(findings, limits)
        ),
        *_stop_doubts(findings, limits),
        *(doubt for sensor in sensors for doubt in _lost_doubts(sensor, limits)),
        *(doubt for sensor in sensors for doubt in _noise_doubts(sensor, limits)),
        *robots,
        *(
            _warned(warning, findings)
            for warning in findings.warnings
            if warning.kind not in NO_DOUBTS
        ),
    ]


def is_scattered(findings: Findings) -> bool:
    """Whether views disagree with each other by more than in a sound cell."""
    return any(_scatter_doubts(findings, CalibrationLimits()))


def _warned(warning: Finding, findings: Findings) -> Finding:
    """A stage's warning, with the residuals of the other views where it left some out."""
    without_it = _without(warning.views, findings.held_out)
    return replace(warning, without_it=without_it) if warning.kind in _LEFT_OUT else warning


def _without(views: Sequence[int], held_out: Rms) -> str:
    left_out = f"view {views[0]}" if len(views) == 1 else "these views"
    return f"Without {left_out}, the others predict each other to {held_out.words}."


def _pairs(first: Rms, second: Rms) -> list[tuple[float, float]]:
    """Residuals of two sets: of position and, where both are known, of rotation."""
    pairs = [(first.mm, second.mm)]
    if first.deg is not None and second.deg is not None:
        pairs.append((first.deg, second.deg))
    return pairs


def _scatter_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    yield from _pair_doubts(findings, limits)
    ratios = [
        outside / within
        for outside, within in _pairs(findings.held_out, findings.rms)
        if outside > _ROUNDING and within > 0.0
    ]
    ratio = max(ratios, default=0.0)
    followed = any(arm.by_functions for arm in findings.arms)
    if ratio > limits.optimism[0] and not followed:
        yield Finding(
            "optimism",
            f"Views left out fit {ratio:.1f} times worse than views in the fit: there are too few "
            "views for their noise.",
            _tilted(findings),
            is_fatal=ratio > limits.optimism[1],
            until_mm=0.0,
        )


def _is_of_arm(findings: Findings) -> bool:
    """Whether most uncertainty comes from an arm whose joints are not known."""
    has_no_joints = any(warning.do is NO_JOINTS for warning in findings.warnings)
    return has_no_joints and _is_mostly_of(findings, "arm", "robot", "poses")


def _is_of_board(findings: Findings) -> bool:
    """Whether most uncertainty comes from the stated size of boards, which no view reduces."""
    held = () if _has_uncertain_held_lens(findings) else ("held values",)
    return _is_mostly_of(findings, "board", *held)


def _is_of_lens(findings: Findings) -> bool:
    """Whether most uncertainty comes from lenses that are held although their sigma is stated."""
    return (
        any(sensor.holds_lens and sensor.has_lens_sigma for sensor in findings.sensors)
        and _has_uncertain_held_lens(findings)
        and _is_mostly_of(findings, "intrinsics", "held values")
    )


def _has_uncertain_held_lens(findings: Findings) -> bool:
    """Whether held values are lenses rather than boards, of which the budget has less."""
    return any(sensor.holds_lens for sensor in findings.sensors) and (
        _variance_of(findings, "intrinsics") > _variance_of(findings, "board")
    )


def _is_mostly_of(findings: Findings, *sources: str) -> bool:
    return _variance_of(findings, *sources) > 0.5 * _variance_of(findings, "total")


def _variance_of(findings: Findings, *sources: str) -> float:
    """Sum of the variances of sources over the points of interest [mm^2]."""
    return sum(
        mm**2
        for place in findings.places
        for name, mm in place.budget_mm.items()
        if name.startswith(sources)
    )


def _better_stated(findings: Findings) -> Remedy | None:
    """Remedy for a held board or lens that causes most uncertainty; None for other causes."""
    if _is_of_board(findings):
        return MEASURE_BOARD
    return REFINE_LENS if _is_of_lens(findings) else None


def remedy_for_uncertainty(findings: Findings) -> Remedy | None:
    """Remedy that makes a result less uncertain; None where a finding on the arm has it."""
    if stated := _better_stated(findings):
        return stated
    if any(warning.do is NO_JOINTS for warning in findings.warnings):
        return None
    words = "Add views from other poses of the robot."
    return add_views_remedy(words, modelled=findings.plannable, purpose=findings.of_camera)


def _tilted(findings: Findings) -> Remedy:
    words = "Add 5 views or more, tilted by 20 to 40 degrees about different axes."
    if not all(arm.can_tilt for arm in findings.arms):
        words = "Add 5 views or more, all over the workspace and turned as far as the arm turns."
    return add_views_remedy(words, modelled=findings.plannable, purpose=findings.of_camera)


def _pair_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    words, views, is_fatal = [], list[ViewResult](), False
    for pair in findings.pairs:
        held = pair.weighted_held_out or pair.held_out
        beyond = [
            (f"{figure(value)} {unit} (doubt begins at {check:g})", value > bad)
            for value, unit, (check, bad), noise in zip(
                (held.mm, held.deg),
                ("mm", "deg"),
                (limits.scatter_mm, limits.scatter_deg),
                (pair.noise.mm, pair.noise.deg or 0.0),
                strict=True,
            )
            if value is not None and value > max(check, _OF_NOISE * noise)
        ]
        if beyond:
            sizes = " and ".join(name for name, _ in beyond)
            words.append(f"{sizes} ({pair.name})" if pair.name else sizes)
            views += pair.views
            is_fatal |= any(flag for _, flag in beyond)
    if words:
        worst = _worst_views(views)
        named = ", ".join(f"view {view.view} ({_residual(view)})" for view in worst)
        yield Finding(
            "unexplained",
            f"Left out of the fit, views disagree with the others by "
            f"{', '.join(words)}, rms; the worst are {named}.",
            Remedy(
                f"Look at the worst views for possible causes: {_CAUSES[findings.mount]}, or an "
                "arm with large model errors.",
                REVIEW,
            ),
            tuple(view.view for view in worst),
            is_fatal=is_fatal,
            until_mm=0.0,
        )


def _worst_views(views: Sequence[ViewResult]) -> list[ViewResult]:
    measured = [view for view in views if view.used and view.residual_mm is not None]
    return sorted(measured, key=lambda view: -(view.residual_mm or 0.0))[:_LISTED_VIEWS]


def _disagreement_doubts(pair: JudgedPair) -> Iterator[Finding]:
    """Finding on outlier views of a pair."""
    out = pair.outliers
    if not out:
        return
    views, run = tuple(rejection.view for rejection in out), _run(pair)
    if len(out) == 1:
        named, them, rows = f"view {views[0]}", "it", f"the row of view {views[0]}"
        words = f"View {views[0]} was left out. It {out[0].reason}."
    else:
        named, them, rows = f"views {', '.join(map(str, views))}", "them", "their rows"
        words = f"V{named[1:]} were left out. View {views[0]} {out[0].reason}.{run}"
    step = (
        or_alone("Fasten what moved, and calibrate the views before and after it apart.", views)
        if run
        else Remedy(
            f"Compare image and pose of {named}: record {them} again, or in views.csv, delete "
            f"{rows}.",
            look_at(views[0]),
        )
    )
    compared = sum(view.used for view in pair.views) + len(out)
    yield Finding(
        "something_moved" if run else "wrong_views",
        words,
        step,
        views,
        without_it=_without(views, pair.held_out),
        mahalanobis_sq=run_evidence(len(out), compared) if run else 0.0,
    ).of(pair.name)


def _run(pair: JudgedPair) -> str:
    """Sentence on outlier views that are consecutive; empty where they are not."""
    out = [rejection.view for rejection in pair.outliers]
    compared = [view.view for view in pair.views if view.used or view.view in out]
    first = compared.index(out[0])
    end = first + len(out)
    if len(out) < LEAST_RUN or compared[first:end] != out or compared == out:
        return ""
    when = f"from view {out[0]} on" if first else f"before view {compared[end]}"
    if first and end < len(compared):
        when = f"from view {out[0]} to view {out[-1]}"
    return f" They follow each other: {when}, something had moved."


def _outlier_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    """Findings on single views with outstanding residuals."""
    # Where corners give the noise of each view, the outlier search has judged views better.
    if any(arm.noise_mm is not None for arm in findings.arms):
        return
    for pair in findings.pairs:
        for view, ratio in _outlying_views(pair.views, limits.outlier):
            words = (
                f"View {view.view} stands out: it places the target {_residual(view, ' and ')} "
                f"from the others, {ratio:.0f} times what is typical. It is in the fit and pulls "
                "at it."
            )
            step = Remedy(
                "Look at its image and its pose, and take it out of views.csv if one is wrong.",
                look_at(view.view),
            )
            yield Finding("wrong_views", words, step, (view.view,)).of(pair.name)


def _outlying_views(
    views: Sequence[ViewResult], limit: float
) -> tuple[tuple[ViewResult, float], ...]:
    """The used views whose ratio of residual to median is above a limit, with their ratios."""
    used = [view for view in views if view.used]
    if not used:
        return ()
    residuals = np.array([[view.residual_mm or 0.0, view.residual_deg or 0.0] for view in used])
    ratios = (residuals / np.maximum(np.median(residuals, axis=0), _ROUNDING)).max(axis=1)
    return tuple(
        (view, ratio)
        for view, ratio in zip(used, ratios.tolist(), strict=True)
        if ratio > (limit if view.rms_px is not None else _UNEVEN * limit)
    )


def _residual(view: ViewResult, between: str = ", ") -> str:
    turned = "" if view.residual_deg is None else f"{between}{figure(view.residual_deg)} deg"
    return f"{figure(view.residual_mm or 0.0)} mm{turned}"


def _holdout_doubts(pair: JudgedPair, mount: Mount, limits: CalibrationLimits) -> Iterator[Finding]:
    holdout, held = pair.holdout, pair.held_out
    if holdout is None:
        return
    pairs = _pairs(holdout, held)
    ratio = max(back / max(left, _ROUNDING) for back, left in pairs)
    if ratio > limits.holdout and max(back for back, _ in pairs) > _ROUNDING:
        observed = "readings" if mount == "instrument" else "images"
        words = (
            f"The views that the session holds back are missed by {holdout.words}, {ratio:.0f} "
            "times worse than views left out in turn. They lie where the result does not hold, or "
            f"their poses or {observed} are wrong."
        )
        step = Remedy("Record views where the result is to hold, with role = fit.")
        yield Finding("holdout", words, step).of(pair.name)


def _accuracy_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    """Findings on sigmas at points of interest and over the workspace."""
    # Edges refer to the arm's own frames. Those of a calibrated arm are as undetermined as the
    # errors of its first and last links, which compensate them in all poses.
    # A step inflates all sigmas, and more views do not help.
    if any(warning.kind in MOVED_AT_ONCE for warning in findings.warnings):
        return
    if any(arm.workspace_mm is None for arm in findings.arms):
        yield from _sigma_doubts(findings, limits)
        yield from _budget_doubts(findings, limits)
    for arm in findings.arms:
        if arm.workspace_mm is not None and arm.workspace_mm > limits.sigma_mm[0]:
            seen = any(sensor.pixel_px is not None for sensor in findings.sensors)
            board = (
                " The board's size counts in it, as no view shows when an arm and a board are "
                "both too large: measure its squares, and state square_sigma_m."
            )
            words = (
                "All over the workspace the calibrated arm places its tool to "
                f"{figure(arm.workspace_mm)} mm (sigma, in the median; doubt begins at "
                f"{limits.sigma_mm[0]:g}).{board if seen else ''}"
            )
            step = add_views_remedy(
                "Add views with other postures of the arm, all over the workspace.",
                modelled=findings.plannable,
                purpose=f" --for kinematics{findings.of_camera}",
            )
            is_fatal = arm.workspace_mm > limits.sigma_mm[1]
            finding = Finding("workspace", words, step, is_fatal=is_fatal, until_mm=0.0)
            yield finding.of(_robot(arm))


def _sigma_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    weak, is_fatal = [], False
    for direction in findings.worst:
        scale, unit, (check, bad) = (
            (np.rad2deg(1.0), "deg", limits.sigma_deg)
            if direction.is_rotation
            else (1e3, "mm", limits.sigma_mm)
        )
        sigma = direction.sigma * scale
        if sigma > check:
            weak.append(f"{direction.words} ({figure(sigma)} {unit})")
            is_fatal |= bool(sigma > bad)
    if weak:
        of_arm, stated = _is_of_arm(findings), _better_stated(findings)
        least = f"{limits.sigma_mm[0]:g} mm and {limits.sigma_deg[0]:g} deg"
        known = f"known to {', '.join(weak)} (sigma; doubt begins at {least}): most of that"
        words = (
            f"As mounts, {known} is the arm's, and is the same in every recording."
            if of_arm
            else f"Frames are {known} is the board's, as well as its size is stated."
            if stated is MEASURE_BOARD
            else f"Frames are {known} is the lens's, which is held and known too little."
            if stated is REFINE_LENS
            else f"Weakly determined, with their sigmas: {', '.join(weak)}; doubt begins at "
            f"{least}. The cause: {findings.tie.words}."
            if findings.tie
            else f"Weakly determined by the motion, with their sigmas: {', '.join(weak)}; doubt "
            f"begins at {least}."
        )
        step = Remedy(findings.tie.advice) if findings.tie else _tilted(findings)
        yield Finding(
            "weak_motion",
            words,
            NO_JOINTS if of_arm else stated or step,
            is_fatal=is_fatal,
            until_mm=0.0,
        )


def _budget_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    """Finding on the error budget of the worst point of interest."""
    beyond = [place for place in findings.places if place.budget_mm["total"] > limits.sigma_mm[0]]
    # Where errors of a lens and its mount cancel, picks are more accurate than points in the
    # camera's frame.
    if len(findings.places) == len(findings.picks) == 1:
        (picks,) = findings.picks
        beyond = beyond if picks.budget_mm["total"] > limits.sigma_mm[0] else []
    if not beyond:
        return
    worst = max(beyond, key=lambda place: place.budget_mm["total"])
    budget = worst.budget_mm
    parts = sorted((part for part in budget.items() if part[0] != "total"), key=lambda at: -at[1])
    others = [
        f"{place.words} ({figure(place.budget_mm['total'])} mm)"
        for place in beyond
        if place is not worst
    ]
    yield Finding(
        "place",
        f"{worst.words} is placed to {figure(budget['total'])} mm (sigma; 95 % "
        f"within {figure(worst.radius95_mm)} mm): "
        + ", ".join(f"{figure(mm)} mm from the {name}" for name, mm in parts[:_LISTED_PARTS])
        + "."
        + (f" Over {limits.sigma_mm[0]:g} mm are also {', '.join(others)}." if others else ""),
        _better_stated(findings),
        is_fatal=budget["total"] > limits.sigma_mm[1],
        until_mm=0.0,
    )


def _stop_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    used = sum(view.used for view in findings.views)
    check, bad = limits.stops
    for arm in findings.arms:
        if arm.stops < check:
            thing, verbs = "view" if arm.stops == used else "stop", ("is", "are")
            words = (
                f"Only {counted(arm.stops, thing, verbs)} used; {check} or more are needed to "
                "check the result."
            )
            step, is_fatal = _tilted(findings), arm.stops < bad
            kind = "too_few_stops" if is_fatal else "few_stops"
            finding = Finding(kind, words, step, is_fatal=is_fatal, until_mm=0.0)
            yield finding.of(_robot(arm))


def _lost_doubts(sensor: Sensor, limits: CalibrationLimits) -> Iterator[Finding]:
    lost = sensor.lost
    total = sensor.used + sensor.spared + len(lost)
    share = len(lost) / max(total, 1)
    if share > limits.lost_share[0]:
        details, disagree = "", {*sensor.outliers}
        others = [rejection for rejection in lost if rejection.view not in disagree]
        if disagree:
            count = len(disagree) if others else "all"
            verb = "disagrees" if count == 1 else "disagree"
            details = f"; {count} of them {verb} with the others"
        if others:
            details += f"; the first{' but for these' if disagree else ''}: view {others[0].view}, "
            details += others[0].reason
        are = "is" if len(lost) == 1 else "are"
        words = f"{len(lost)} of {total} views {are} not used{details}."
        advice = "Correct the first of them and those like it, or repeat what is missing."
        step = Remedy(advice, look_at(others[0].view)) if others else None
        views, is_fatal = tuple(rejection.view for rejection in lost), share > limits.lost_share[1]
        # Outliers have a finding of their own.
        kind = "lost_views" if others else "left_out"
        yield Finding(kind, words, step, views, is_fatal=is_fatal).of(sensor.name)


def _noise_doubts(sensor: Sensor, limits: CalibrationLimits) -> Iterator[Finding]:
    check, bad = limits.pixel_px
    noise = sensor.pixel_px
    if noise is None:
        return
    if noise > check:
        words = (
            f"Corners deviate by {figure(noise)} px from any pose of a flat board (doubt begins at "
            f"{check:g}): the intrinsics do not fit this camera, the board is not flat, or images "
            "are blurred."
        )
        step = Remedy("Look for blur, glare, and a lens or a board that is not as stated.")
        yield Finding("corner_noise", words, step, is_fatal=noise > bad).of(sensor.name)
    if sensor.level > limits.level:
        words = (
            f"Its poses scatter {figure(sensor.level)} times as much as its corners say: squares "
            "of few pixels, blur, or a lens that is not as stated."
        )
        step = Remedy("Go nearer, or show it larger squares.")
        yield Finding("corner_noise", words, step).of(sensor.name)


def _robot(arm: JudgedArm) -> str:
    return f"Robot {arm.name}" if arm.name else ""


def _robot_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    """Findings on implausible noise of arms, which usually has another cause."""
    # Only noise whose confidence interval is above the limit counts. For a task that needs ten
    # times as much the arm is good enough.
    for arm in findings.arms:
        if arm.noise_mm is None or arm.noise_deg is None or arm.has_posture_errors:
            continue
        least_mm, least_deg = arm.lower_bounds or (arm.noise_mm, arm.noise_deg)
        ratio = max(arm.noise_mm / limits.robot_mm, arm.noise_deg / limits.robot_deg)
        if max(least_mm / limits.robot_mm, least_deg / limits.robot_deg) > 1.0:
            words = (
                "The residuals would take a flange that is off by "
                f"{mm_and_deg(arm.noise_mm, arm.noise_deg)} "
                "from stop to stop; arms repeat to 0.1 mm."
            )
            step = Remedy(
                "Read a few stops twice, with the times in stamp_s, to see how well readings "
                "repeat; more likely than the arm's noise are an instrument that reads worse than "
                "stated or was moved, or a model of the arm that is off by as much."
                if findings.mount == "instrument"
                else "Look for what is likelier than noise of the arm: a board of another size "
                "than stated (measure it over many squares) or warped, intrinsics that are not "
                "this camera's, a model of the arm that is off by as much, or poses that were read "
                "before the arm stood still (read one twice to see how well it repeats)."
            )
            until_mm = 10.0 * ratio * limits.robot_mm
            yield Finding("unexplained", words, step, until_mm=until_mm).of(_robot(arm))
