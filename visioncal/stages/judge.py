"""Whether the result can be trusted, in plain sentences."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration import Rms, Verdict, VerdictStatus, ViewResult
from visioncal.estimation.closure import Noise
from visioncal.figures import figure
from visioncal.stages.diagnose import Diagnosis
from visioncal.stages.handeye import HandEyeResult
from visioncal.stages.proposing import with_proposal
from visioncal.types import Mount, Rejection

# Scatters under a nanometre and a micro-degree are rounding, and their ratios say nothing.
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
# So many views in a row are not left out by chance.
_LEAST_RUN = 3


@dataclass(frozen=True)
class JudgeOptions:
    """Where doubt begins and where trust ends: (check, bad) limits.

    Attributes:
        scatter_mm: Held-out scatter of the target's position [mm]. Pick cells live with 1 mm.
        scatter_deg: Held-out scatter of its orientation [deg].
        sigma_mm: Predicted sigma of the worst direction of an edge [mm].
        sigma_deg: The same in rotation [deg].
        pixel_px: Noise of a corner's coordinate [px]; sharp images give 0.05 to 0.3.
        robot_mm: Error of the flange from stop to stop [mm]; arms repeat to 0.1 mm or better, and
            what is beyond is seldom independent from stop to stop, as the covariance takes it.
        robot_deg: The same in rotation [deg].
        stops: Stops of the robot in the fit; fewer leave too little to check the result with.
        lost_share: Share of views that could not be used.
        optimism: Held-out over in-sample scatter; large where each view carries the fit.
        outlier: Residual of a view over the median of all.
        holdout: Residuals of views held back over those of views left out in turn.
    """

    scatter_mm: tuple[float, float] = (2.0, 10.0)
    scatter_deg: tuple[float, float] = (0.3, 2.0)
    sigma_mm: tuple[float, float] = (1.0, 3.0)
    sigma_deg: tuple[float, float] = (0.1, 0.3)
    pixel_px: tuple[float, float] = (0.7, 3.0)
    robot_mm: float = 0.2
    robot_deg: float = 0.02
    stops: tuple[int, int] = (10, 5)
    lost_share: tuple[float, float] = (0.25, 0.6)
    optimism: tuple[float, float] = (1.6, 4.0)
    outlier: float = 6.0
    holdout: float = 4.0


@dataclass(frozen=True)
class Findings:
    """What the verdict is made of.

    Attributes:
        views: What became of each view.
        stops: Number of the robot's stops in the fit.
        lost: Views that could not be used; those held back on purpose are not among them.
        disagreeing: Those of them whose robot pose and image do not belong together.
        hand_eye: The fit.
        rms: Residuals of the used views.
        held_out: Residuals of views left out in turn.
        holdout: Residuals of views held back by the session; None where there are none.
        pixel_px: Noise of a corner's coordinate; None without images [px].
        robot: Noise of the flange; None where it cannot be told from the camera's.
        diagnosis: What the residuals show beyond noise, and where the uncertainty comes from.
        warnings: What earlier stages had to say.
        notes: What of it is no reason for doubt.
        workspace_mm: Predicted sigma of a tool's place all over a calibrated arm's workspace, in
            the median; None for a nominal arm [mm].
        mount: What observed whom.
        modelled: Whether the robot's model is known.
    """

    views: Sequence[ViewResult]
    stops: int
    lost: Sequence[Rejection]
    disagreeing: Sequence[Rejection]
    hand_eye: HandEyeResult
    rms: Rms
    held_out: Rms
    holdout: Rms | None
    pixel_px: float | None
    robot: Noise | None
    diagnosis: Diagnosis
    warnings: Sequence[str]
    notes: Sequence[str] = ()
    workspace_mm: float | None = None
    mount: Mount = "eye-in-hand"
    modelled: bool = False


@dataclass(frozen=True)
class _Doubt:
    """A reason not to trust the result, and whether it settles the matter."""

    sentence: str
    is_fatal: bool = False


def judge(findings: Findings, options: JudgeOptions | None = None) -> Verdict:
    """Says whether the result can be trusted, why, and what to do next.

    Args:
        findings: What is known.
        options: Where doubt begins.

    Returns:
        `bad` with a reason that settles it, `check` with doubts, `good` without.
    """
    options = options or JudgeOptions()
    scatter = list(_scatter_doubts(findings, options))
    doubts = [
        *scatter,
        *_disagreement_doubts(findings),
        *_outlier_doubts(findings, options),
        *_holdout_doubts(findings, options),
        # Views that disagree wildly have no sigma worth a word about the motion.
        *([] if any(it.is_fatal for it in scatter) else _worth_doubts(findings, options)),
        *_view_doubts(findings, options),
        *_pixel_doubts(findings, options),
        *([] if scatter else _robot_doubts(findings, options)),
        *(_Doubt(sentence) for sentence in findings.warnings),
    ]
    if not doubts:
        return Verdict("good", (_praise(findings), *findings.notes))
    status: VerdictStatus = "bad" if any(doubt.is_fatal for doubt in doubts) else "check"
    ordered = sorted(doubts, key=lambda doubt: not doubt.is_fatal)
    sentences = tuple(doubt.sentence for doubt in ordered)
    if findings.pixel_px is not None:
        sentences = with_proposal(sentences, modelled=findings.modelled)
    return Verdict(status, (*sentences, *findings.notes))


def is_scattered(findings: Findings, options: JudgeOptions | None = None) -> bool:
    """Whether views disagree with each other by more than a sound cell's do."""
    return any(_scatter_doubts(findings, options or JudgeOptions()))


def _praise(findings: Findings) -> str:
    used, worst = sum(view.used for view in findings.views), findings.hand_eye.worst[0]
    return (
        f"All {used} used views agree: left out of the fit, they are predicted to "
        f"{_both(findings.held_out)} (rms), and "
        f"{worst.words}, its worst direction, is known to {figure(1e3 * worst.sigma)} mm."
    )


def _both(rms: Rms) -> str:
    """Residuals in position and, where these are known, in rotation."""
    return f"{figure(rms.mm)} mm" + ("" if rms.deg is None else f" and {figure(rms.deg)} deg")


def _pairs(one: Rms, other: Rms) -> list[tuple[float, float]]:
    """Two sets' residuals side by side: of position and, where both are known, of rotation."""
    pairs = [(one.mm, other.mm)]
    if one.deg is not None and other.deg is not None:
        pairs.append((one.deg, other.deg))
    return pairs


def _scatter_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    held, inside = findings.held_out, findings.rms
    limits = (options.scatter_mm, options.scatter_deg)
    beyond = [
        (f"{figure(value)} {unit} (doubt begins at {check:g})", value > bad)
        for value, unit, (check, bad) in zip(
            (held.mm, held.deg), ("mm", "deg"), limits, strict=True
        )
        if value is not None and value > check
    ]
    if beyond:
        yield _Doubt(
            f"Left out of the fit, views disagree with the others by "
            f"{' and '.join(words for words, _ in beyond)}, rms; the worst are "
            f"{_worst_views(findings.views)}. Possible causes: {_CAUSES[findings.mount]}, or an "
            "arm with large model errors.",
            any(is_fatal for _, is_fatal in beyond),
        )
    ratios = [
        outside / within
        for outside, within in _pairs(held, inside)
        if outside > _ROUNDING and within > 0.0
    ]
    ratio = max(ratios, default=0.0)
    if ratio > options.optimism[0]:
        yield _Doubt(
            f"Views left out fit {ratio:.1f} times worse than views in the fit: there are too few "
            "views for their noise. Add 5 or more, tilted about different axes.",
            ratio > options.optimism[1],
        )


def _worst_views(views: Sequence[ViewResult]) -> str:
    measured = [view for view in views if view.used and view.residual_mm is not None]
    measured.sort(key=lambda view: -(view.residual_mm or 0.0))
    return ", ".join(f"view {view.view} ({_residual(view)})" for view in measured[:_LISTED_VIEWS])


def _disagreement_doubts(findings: Findings) -> Iterator[_Doubt]:
    """Names the views that were left out because they contradict the others."""
    out = findings.disagreeing
    if not out:
        return
    if len(out) == 1:
        yield _Doubt(f"View {out[0].view} was left out: it {out[0].reason}.")
        return
    named, first = ", ".join(str(it.view) for it in out), out[0].view
    yield _Doubt(f"Views {named} were left out; view {first} {out[0].reason}.{_run(findings)}")


def _run(findings: Findings) -> str:
    """Says so where the views that were left out follow each other, with no other between them."""
    out = [it.view for it in findings.disagreeing]
    compared = [it.view for it in findings.views if it.used or it.view in out]
    first = compared.index(out[0])
    end = first + len(out)
    if len(out) < _LEAST_RUN or compared[first:end] != out:
        return ""
    when = f"from view {out[0]} on" if first else f"before view {compared[end]}"
    if first and end < len(compared):
        when = f"from view {out[0]} to view {out[-1]}"
    return f" They follow each other: {when}, something had moved."


def _outlier_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    """Names single views whose residual stands out from the others'.

    Where the corners tell how well each view sees the board, the consensus has judged them better.
    """
    if findings.robot is not None:
        return
    for view, ratio in outlying_views(findings.views, options.outlier):
        yield _Doubt(
            f"View {view.view} stands out: it places the target {_residual(view, ' and ')} from "
            f"the others, {ratio:.0f} times what is typical. It is in the fit and pulls at it: "
            "look at its image and its pose, and take it out of views.csv if one of them is wrong."
        )


def outlying_views(
    views: Sequence[ViewResult], limit: float = JudgeOptions.outlier
) -> tuple[tuple[ViewResult, float], ...]:
    """The used views whose residual is over so many times the median, with their ratios."""
    used = [view for view in views if view.used]
    away = np.array([[view.residual_mm or 0.0, view.residual_deg or 0.0] for view in used])
    ratios = (away / np.maximum(np.median(away, axis=0), _ROUNDING)).max(axis=1)
    return tuple((view, float(it)) for view, it in zip(used, ratios, strict=True) if it > limit)


def _residual(view: ViewResult, between: str = ", ") -> str:
    turned = "" if view.residual_deg is None else f"{between}{figure(view.residual_deg)} deg"
    return f"{figure(view.residual_mm or 0.0)} mm{turned}"


def _holdout_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    holdout, held = findings.holdout, findings.held_out
    if holdout is None:
        return
    pairs = _pairs(holdout, held)
    ratio = max(back / max(left, _ROUNDING) for back, left in pairs)
    if ratio > options.holdout and max(back for back, _ in pairs) > _ROUNDING:
        observed = "readings" if findings.mount == "instrument" else "images"
        yield _Doubt(
            f"The views that the session holds back are missed by {_both(holdout)}, {ratio:.0f} "
            "times worse than views left out in turn. They lie where the result does not hold, or "
            f"their poses or {observed} are wrong."
        )


def _worth_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    """Judges the answer where it counts.

    Edges are known in the arm's own frames. Those of a calibrated arm are as open as the errors of
    the first and the last link, which its poses make up for.
    """
    if findings.workspace_mm is None:
        yield from _sigma_doubts(findings, options)
        yield from _budget_doubts(findings, options)
    elif findings.workspace_mm > options.sigma_mm[0]:
        board = (
            "The board's size counts in it, as no view can tell an arm and a board that are both "
            "too large: measure its squares, and state square_sigma_m. "
        )
        yield _Doubt(
            "All over the workspace the calibrated arm places its tool to "
            f"{figure(findings.workspace_mm)} mm (sigma, in the median; doubt begins at "
            f"{options.sigma_mm[0]:g}). {'' if findings.pixel_px is None else board}Add views in "
            "which the arm stands otherwise, all over the workspace.",
            findings.workspace_mm > options.sigma_mm[1],
        )


def _sigma_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    weak, is_fatal = [], False
    for direction in findings.hand_eye.worst:
        scale, unit, (check, bad) = (
            (np.rad2deg(1.0), "deg", options.sigma_deg)
            if direction.is_rotation
            else (1e3, "mm", options.sigma_mm)
        )
        sigma = direction.sigma * scale
        if sigma > check:
            weak.append(f"{direction.words} ({figure(sigma)} {unit})")
            is_fatal |= bool(sigma > bad)
    if weak:
        yield _Doubt(
            f"Weakly determined by the motion, with their sigmas: {', '.join(weak)}; doubt begins "
            f"at {options.sigma_mm[0]:g} mm and {options.sigma_deg[0]:g} deg. Add views tilted by "
            "20 to 40 degrees about axes across these directions.",
            is_fatal,
        )


def _budget_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    """Says what makes the result uncertain where it is to be used."""
    budget = findings.diagnosis.budget_mm
    if not budget["total"] > options.sigma_mm[0]:
        return
    parts = sorted((it for it in budget.items() if it[0] != "total"), key=lambda it: -it[1])
    yield _Doubt(
        f"Where the views look, a point is placed to {figure(budget['total'])} mm (sigma; 95 % "
        f"within {figure(findings.diagnosis.radius95_mm)} mm): "
        + ", ".join(
            f"{figure(mm)} mm from the {name.replace('_', ' ')}"
            for name, mm in parts[:_LISTED_PARTS]
        )
        + ".",
        budget["total"] > options.sigma_mm[1],
    )


def _view_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    used, lost = sum(view.used for view in findings.views), findings.lost
    check, bad = options.stops
    if findings.stops < check:
        counted = f"{used} views" if findings.stops == used else f"{findings.stops} stops"
        yield _Doubt(
            f"Only {counted} are used; {check} or more give the result something to be checked "
            "with.",
            findings.stops < bad,
        )
    share = len(lost) / max(used + len(lost), 1)
    if share > options.lost_share[0]:
        told, disagree = "", {it.view for it in findings.disagreeing}
        others = [it for it in lost if it.view not in disagree]
        if disagree:
            count = len(disagree) if others else "all"
            told = f"; {count} of them disagree with the others"
        if others:
            told += f"; the first{' but for these' if disagree else ''}: view {others[0].view}, "
            told += others[0].reason
        yield _Doubt(
            f"{len(lost)} of {used + len(lost)} views are not used{told}.",
            share > options.lost_share[1],
        )


def _pixel_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    check, bad = options.pixel_px
    noise = findings.pixel_px
    if noise is not None and noise > check:
        yield _Doubt(
            f"Corners deviate by {figure(noise)} px from any pose of a flat board (doubt begins at "
            f"{check:g}): the intrinsics do not fit this camera, the board is not flat, or images "
            "are blurred.",
            noise > bad,
        )


def _robot_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    """An arm is a good instrument: what looks like its error is often something else's."""
    if findings.robot is None or findings.diagnosis.arm is not None:
        return
    away_mm, away_deg = 1e3 * findings.robot.sigma_m, np.rad2deg(findings.robot.sigma_rad)
    if away_mm > options.robot_mm or away_deg > options.robot_deg:
        cause = (
            "the instrument reads worse than is stated of it, was moved, or the arm's model is off "
            "by as much. Read a few stops twice to see how well readings repeat."
            if findings.mount == "instrument"
            else "the board is of another size than stated, or warped, the intrinsics are not this "
            "camera's, or the arm's model is off by as much. Measure the board's squares first."
        )
        yield _Doubt(
            f"To explain what is seen, the flange would have to be off by {figure(away_mm)} mm "
            f"and {figure(away_deg)} deg from stop to stop; arms repeat to 0.1 mm. More likely "
            f"{cause}"
        )
