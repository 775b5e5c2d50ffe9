"""Findings on a tool's or fixture's frame."""

from collections.abc import Iterator, Sequence

import numpy as np

from visioncal.core.number_format import figure, some_of
from visioncal.core.verdict import AGAIN, Finding, Remedy
from visioncal.estimation.group_outliers import GroupInliers
from visioncal.estimation.groups import State
from visioncal.estimation.observability import Direction

# End of the reason of an outlier that fits by another name, and its remedy.
RENAMED = ": is its name exchanged?"
_RENAME = "Correct the names of what is named; where they are right, touch it once more."


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


def outlier_findings(
    names: Sequence[str], reasons: Sequence[str], inliers: GroupInliers[State], again: str
) -> Iterator[Finding]:
    """Findings on outliers, and on contradicting measurements that were kept.

    `names` and `reasons` are (n,); `again` is the remedy, as a sentence.
    """
    for at in np.flatnonzero(~inliers.mask).tolist():
        renamed = reasons[at].endswith(RENAMED)
        words = f"{names[at]} was left out: {reasons[at]}{'' if renamed else '.'}"
        yield Finding("left_out", words, Remedy(_RENAME if renamed else again, AGAIN))
    if inliers.doubtful.any():
        some = some_of([names[at] for at in np.flatnonzero(inliers.doubtful).tolist()])
        words = f"{some} contradict each other, and which is wrong is not known: all are used."
        yield Finding("contradicting", words, Remedy(again))


def noise_findings(
    noise_mm: float,
    limits_mm: tuple[float, float],
    cause: str,
    *,
    explained: bool,
    things: str = "touches",
) -> Iterator[Finding]:
    """Findings on noise per axis above (check, bad) limits, or else unexplained by the stated one.

    `cause` is a probable cause or remedy, as a sentence; `things` names the measurements.
    """
    check, bad = limits_mm
    if noise_mm > check:
        yield Finding(
            "noise",
            f"The {things} agree to {figure(noise_mm)} mm only (per axis; doubt begins at "
            f"{check:g}).",
            Remedy(cause),
            is_fatal=noise_mm > bad,
        )
    elif not explained:
        yield Finding(
            "noise",
            f"The {things} scatter by more than they are stated to, without one that stands out: "
            f"{figure(noise_mm)} mm per axis.",
            Remedy(
                "Repeat them, or state the noise as it is.",
                f"{AGAIN} --touch-noise-mm {noise_mm:.2g}",
            ),
        )


def off_words(inliers: GroupInliers[State], at: int) -> str:
    """Words for a residual: `2.1 mm off, 5 times what the others allow`."""
    off = f"{figure(1e3 * float(inliers.off_m[at]))} mm off"
    ratio = float(np.sqrt(float(inliers.mahalanobis_sq[at]) / float(inliers.limit[at])))
    return f"{off}, {figure(ratio)} times what the others allow" if ratio > 1.0 else off


def placed_name(name: str, place: str) -> str:
    """Name with the row's place: `Touch 3 (touches.csv, line 5)`."""
    return f"{name} ({place})" if place else name
