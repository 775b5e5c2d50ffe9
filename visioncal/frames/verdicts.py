"""Whether a tool's or a fixture's frame can be trusted, in plain sentences."""

from collections.abc import Iterator, Sequence

import numpy as np

from visioncal.core.number_format import figure, some_of
from visioncal.core.verdict import AGAIN, Finding, Remedy
from visioncal.estimation.group_outliers import GroupInliers
from visioncal.estimation.groups import State
from visioncal.estimation.observability import Direction

# How the reason ends of a touch that would be right by another name, and what to do about it.
RENAMED = ": is its name exchanged?"
_RENAME = "Correct the names of what is named; where they are right, touch it once more."


def weak_directions(
    worst: Sequence[Direction],
    sigma_mm: tuple[float, float],
    sigma_deg: tuple[float, float],
    advice: str,
) -> Iterator[Finding]:
    """Doubts the directions that are known worst.

    Args:
        worst: These directions.
        sigma_mm: (check, bad) limits of an offset's sigma [mm].
        sigma_deg: The same of a rotation's [deg].
        advice: What to do about it, as a sentence.
    """
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


def disputed(
    names: Sequence[str], reasons: Sequence[str], found: GroupInliers[State], again: str
) -> Iterator[Finding]:
    """Doubts for what was left out, and for what stayed although it contradicts.

    Args:
        names: (n,) what messages call the touches, points or images.
        reasons: (n,) what is wrong with each.
        found: Which of them agree.
        again: What to do about either, as a sentence.
    """
    for at in np.flatnonzero(~found.agrees).tolist():
        renamed = reasons[at].endswith(RENAMED)
        words = f"{names[at]} was left out: {reasons[at]}{'' if renamed else '.'}"
        yield Finding("left_out", words, Remedy(_RENAME if renamed else again, AGAIN))
    if found.doubtful.any():
        some = some_of([names[at] for at in np.flatnonzero(found.doubtful).tolist()])
        words = f"{some} contradict each other, and which is wrong is not known: all are used."
        yield Finding("contradicting", words, Remedy(again))


def noisy(
    noise_mm: float,
    limits_mm: tuple[float, float],
    cause: str,
    *,
    explained: bool,
    things: str = "touches",
) -> Iterator[Finding]:
    """Doubts for touches that agree badly, or worse than they are stated to.

    Args:
        noise_mm: Noise of a touch per axis [mm].
        limits_mm: (check, bad) limits of it [mm].
        cause: What may have caused it or what to do, as a sentence.
        explained: Whether what is stated of a touch explains it.
        things: What agrees or does not, in words.
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


def off_words(found: GroupInliers[State], at: int) -> str:
    """Says how far off something is that does not agree: `2.1 mm off, 5 times what ... allow`."""
    off = f"{figure(1e3 * float(found.off_m[at]))} mm off"
    over = float(np.sqrt(float(found.mahalanobis_sq[at]) / float(found.limit[at])))
    return f"{off}, {figure(over)} times what the others allow" if over > 1.0 else off


def placed_name(name: str, place: str) -> str:
    """Names a row so that it is found: `Touch 3 (touches.csv, line 5)`."""
    return f"{name} ({place})" if place else name
