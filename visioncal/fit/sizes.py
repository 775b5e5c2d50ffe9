"""The most likely sizes of a mixed model."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.types import FloatArray, Mask
from visioncal.fit.mixed import Estimate, Mixed
from visioncal.model.effects.effect import SIGNIFICANT, Size

# Most change of a size's logarithm in one search: in the elimination, far sizes cancel to nothing.
_FAR = 3.0
# Most change in one step; gain of -2 log L that is negligible.
_STEP, _LITTLE = 1.5, 1e-3
_STEPS = 40
# Least curvature, over that of each size alone.
_FLAT = 0.1


@dataclass(frozen=True, eq=False)
class Found:
    """The most likely sizes."""

    estimate: Estimate
    evaluations: int  # How many likelihoods it took.


def most_likely(mixed: Mixed, start: FloatArray, low: FloatArray, high: FloatArray) -> Found:
    """Maximises the restricted likelihood by Fisher steps, within bounds.

    Args:
        mixed: The model.
        start: (t,) logarithms of the sizes.
        low: (t,) their bounds.
        high: (t,) those above; equal ones hold a size.
    """
    first = np.clip(start, low, high)
    least, most = np.maximum(low, first - _FAR), np.minimum(high, first + _FAR)
    found, count, damping = mixed.at(first), 1, 0.0
    for _ in range(_STEPS):
        slope = found.gradient
        inside = (most > least) & ~((found.logs <= least) & (slope > 0.0))
        inside &= ~((found.logs >= most) & (slope < 0.0))
        if not inside.any():
            break
        step = _step(found, inside, damping)
        trial_logs = np.clip(found.logs + step, least, most)
        moved = trial_logs - found.logs
        gain = -float(moved @ slope + 0.5 * moved @ found.curvature @ moved)
        if max(gain, -float(moved @ slope) / 2) < _LITTLE:
            break
        trial, count = mixed.at(trial_logs), count + 1
        if trial.value < found.value:
            found, damping = trial, damping / 10.0 if damping > 1e-2 else 0.0
        else:
            damping = max(10.0 * damping, 1.0)
            if damping > 1e6:
                break
    return Found(found, count)


def _step(found: Estimate, inside: Mask, damping: float) -> FloatArray:
    """A damped Fisher step (t,) of the sizes in a mask, at most `_STEP` long in each."""
    at = np.flatnonzero(inside)
    curvature = found.curvature[at[:, None], at]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(curvature), 1e-8))
    values, vectors = np.linalg.eigh(curvature * np.outer(scale, scale))
    values = np.maximum(values, _FLAT) + damping
    step = np.zeros(len(inside))
    pull = vectors.T @ (scale * found.gradient[at])
    step[at] = -scale * (vectors @ (pull / values))
    return step * min(1.0, _STEP / max(float(np.abs(step).max()), 1e-12))


def significant(
    mixed: Mixed,
    found: Found,
    start: FloatArray,
    low: FloatArray,
    high: FloatArray,
    random: Mapping[int, Size],
) -> tuple[Found, tuple[int, ...]]:
    """Closes, at their lower bounds, the sizes of random unknowns that chance explains.

    Those are such whose likelihood ratio is below their limit.

    They are closed together; where that is not explained by chance, they stand for each other, and
    the one that gains most is opened again.

    Returns:
        What is found without them, and which they are.
    """  # fmt: skip
    count, logs, best = found.evaluations, found.estimate.logs, found.estimate.value
    little = []
    for size, tested in random.items():
        if high[size] > low[size] and logs[size] > low[size]:
            without = logs.copy()
            without[size] = low[size]
            count += 1
            if mixed.at(without, is_sloped=False).value - best < tested.limit:
                little.append(size)
        elif high[size] > low[size]:
            little.append(size)
    owners = {at.of for size, at in random.items() if size not in little and at.of}
    little = [size for size in little if random[size].of not in owners]
    if not little:
        return replace(found, evaluations=count), ()
    top = high.copy()
    top[little] = low[little]
    closed = most_likely(mixed, logs, low, top)
    count += closed.evaluations
    if closed.estimate.value - best > SIGNIFICANT and len(little) > 1:
        gains = []
        for size in little:
            one = top.copy()
            one[size] = high[size]
            begin = np.where(np.arange(len(logs)) == size, start, closed.estimate.logs)
            gains.append((most_likely(mixed, begin, low, one), size))
            count += gains[-1][0].evaluations
        closed, opened = min(gains, key=lambda item: item[0].estimate.value)
        little.remove(opened)
    return replace(closed, evaluations=count), tuple(little)
