"""Stage 7: whether the result can be trusted, in plain sentences."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration import Rms, Verdict, VerdictStatus
from visioncal.stages.handeye import HandEyeResult
from visioncal.transforms import invert, rotation_angle
from visioncal.types import Rejection


@dataclass(frozen=True)
class JudgeOptions:
    """Where doubt begins and where trust ends: (check, bad) limits.

    Attributes:
        scatter_mm: Held-out scatter of the target's position [mm]. Pick cells live with 1 mm.
        scatter_deg: Held-out scatter of its orientation [deg].
        sigma_mm: Predicted sigma of the worst direction of the camera's edge [mm].
        sigma_deg: The same in rotation [deg].
        pixel_px: Noise of a corner's coordinate [px]; sharp images give 0.05 to 0.3.
        views: Used views; fewer leave too little to check the result with.
        lost_share: Share of views that could not be used.
        optimism: Held-out over in-sample scatter; large where each view carries the fit.
    """

    scatter_mm: tuple[float, float] = (2.0, 10.0)
    scatter_deg: tuple[float, float] = (0.3, 2.0)
    sigma_mm: tuple[float, float] = (1.0, 3.0)
    sigma_deg: tuple[float, float] = (0.1, 0.3)
    pixel_px: tuple[float, float] = (0.7, 3.0)
    views: tuple[int, int] = (10, 5)
    lost_share: tuple[float, float] = (0.25, 0.6)
    optimism: tuple[float, float] = (1.6, 4.0)


@dataclass(frozen=True)
class Findings:
    """What the verdict is made of.

    Attributes:
        used: Number of views in the fit.
        rejections: Views that could not be used; views held out on purpose are not among them.
        hand_eye: The fit.
        rms: Residuals of the used views.
        held_out: Residuals of views left out.
        pixel_px: Noise of a corner's coordinate; None without images [px].
        warnings: What earlier stages had to say.
    """

    used: int
    rejections: Sequence[Rejection]
    hand_eye: HandEyeResult
    rms: Rms
    held_out: Rms
    pixel_px: float | None
    warnings: Sequence[str]


@dataclass(frozen=True)
class _Doubt:
    """A reason not to trust the result, and whether it settles the matter."""

    sentence: str
    is_fatal: bool


def judge(findings: Findings, options: JudgeOptions | None = None) -> Verdict:
    """Says whether the result can be trusted, why, and what to do next.

    Args:
        findings: What is known.
        options: Where doubt begins.

    Returns:
        `bad` with a reason that settles it, `check` with doubts, `good` without.
    """
    options = options or JudgeOptions()
    doubts = [
        *_scatter_doubts(findings, options),
        *_observability_doubts(findings, options),
        *_view_doubts(findings, options),
        *_pixel_doubts(findings, options),
        *_solver_doubts(findings),
        *(_Doubt(sentence, is_fatal=False) for sentence in findings.warnings),
    ]
    if not doubts:
        return Verdict("good", (_praise(findings),))
    status: VerdictStatus = "bad" if any(doubt.is_fatal for doubt in doubts) else "check"
    ordered = sorted(doubts, key=lambda doubt: not doubt.is_fatal)
    return Verdict(status, tuple(doubt.sentence for doubt in ordered))


def _praise(findings: Findings) -> str:
    worst = findings.hand_eye.worst
    return (
        f"All {findings.used} used views agree: left out of the fit, they are predicted to "
        f"{findings.held_out.mm:.2g} mm and {findings.held_out.deg:.2g} deg (rms), and "
        f"{worst[0].words}, its worst direction, is known to {1e3 * worst[0].sigma:.2g} mm."
    )


def _scatter_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    held, inside = findings.held_out, findings.rms
    for value, unit, (check, bad) in (
        (held.mm, "mm", options.scatter_mm),
        (held.deg, "deg", options.scatter_deg),
    ):
        if value > check:
            yield _Doubt(
                f"Left out of the fit, views disagree with the others by {value:.2g} {unit} (rms; "
                f"doubt begins at {check:g}). Look at the worst views in the table: a board that "
                "moved, poses of other images, units, intrinsics, or an arm with large model "
                "errors.",
                value > bad,
            )
    ratio = max(held.mm / max(inside.mm, 1e-9), held.deg / max(inside.deg, 1e-9))
    # Under a nanometre both are rounding, and their ratio says nothing.
    if ratio > options.optimism[0] and held.mm > 1e-6:
        yield _Doubt(
            f"Views left out fit {ratio:.1f} times worse than views in the fit: there are too few "
            "views for their noise. Add 5 or more, tilted about different axes.",
            ratio > options.optimism[1],
        )


def _observability_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    for direction in findings.hand_eye.worst[:2]:
        scale, unit, (check, bad) = (
            (np.rad2deg(1.0), "deg", options.sigma_deg)
            if direction.is_rotation
            else (1e3, "mm", options.sigma_mm)
        )
        sigma = direction.sigma * scale
        if sigma > check:
            yield _Doubt(
                f"{direction.words[0].upper()}{direction.words[1:]} is weakly determined: its "
                f"sigma is {sigma:.2g} {unit} (doubt begins at {check:g}). Add views tilted by 20 "
                "to 40 degrees about axes across it.",
                sigma > bad,
            )


def _view_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    used, lost = findings.used, findings.rejections
    check, bad = options.views
    if used < check:
        yield _Doubt(
            f"Only {used} views are used; {check} or more give the result something to be checked "
            "with.",
            used < bad,
        )
    share = len(lost) / max(used + len(lost), 1)
    if share > options.lost_share[0]:
        yield _Doubt(
            f"{len(lost)} of {used + len(lost)} views could not be used; the first: view "
            f"{lost[0].view}, {lost[0].reason}.",
            share > options.lost_share[1],
        )


def _pixel_doubts(findings: Findings, options: JudgeOptions) -> Iterator[_Doubt]:
    check, bad = options.pixel_px
    noise = findings.pixel_px
    if noise is not None and noise > check:
        yield _Doubt(
            f"Corners deviate by {noise:.2g} px from any pose of a flat board (doubt begins at "
            f"{check:g}): the intrinsics do not fit this camera, the board is not flat, or images "
            "are blurred.",
            noise > bad,
        )


def _solver_doubts(findings: Findings) -> Iterator[_Doubt]:
    """Compares the solvers with the answer, in units of what the views leave open."""
    result = findings.hand_eye
    sigma_m = float(np.sqrt(np.trace(result.covariance[3:6, 3:6])))
    sigma_rad = float(np.sqrt(np.trace(result.covariance[:3, :3])))
    for name, other in result.solutions.items():
        step = invert(result.x) @ other.x
        away_m, away_rad = float(np.linalg.norm(step[:3, 3])), float(rotation_angle(step))
        # Closed forms use the views less well and stray by more than one sigma; five is no noise.
        if away_m > max(5 * sigma_m, 1e-4) or away_rad > max(5 * sigma_rad, 1e-4):
            yield _Doubt(
                f"Solver {name} disagrees by {1e3 * away_m:.2g} mm and "
                f"{np.rad2deg(away_rad):.2g} deg, more than noise explains. Wrong views pull "
                "solvers apart: look at the largest residuals.",
                is_fatal=False,
            )
