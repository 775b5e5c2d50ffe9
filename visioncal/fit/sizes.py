"""The most likely sizes of a mixed model."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.mixed import maximised
from visioncal.fit.mixed import Estimate, Mixed
from visioncal.model.effects.effect import SIGNIFICANT, Size

# Most change of a size's logarithm in one search: in the elimination, far sizes cancel to nothing.
_FAR = 3.0


@dataclass(frozen=True, eq=False)
class Found:
    """The most likely sizes."""

    estimate: Estimate
    evaluations: int  # How many likelihoods it took.


def most_likely(mixed: Mixed, start: FloatArray, low: FloatArray, high: FloatArray) -> Found:
    """Maximises the restricted likelihood within bounds; see `estimation.mixed.maximised`.

    Args:
        mixed: The model.
        start: (t,) logarithms of the sizes.
        low: (t,) their bounds.
        high: (t,) those above; equal ones hold a size.
    """
    first = np.clip(start, low, high)
    least, most = np.maximum(low, first - _FAR), np.minimum(high, first + _FAR)
    # Gain of -2 log L that is negligible.
    return Found(*maximised(mixed.at, first, least, most, 1e-3))


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
