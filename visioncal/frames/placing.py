"""Certainty of a placed frame: its worst directions in words, and the noise of a touch."""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations, permutations
from typing import TypeVar

import numpy as np

from visioncal.core.directions import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD, Direction, axis_words
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.linalg import covariance_from
from visioncal.core.number_format import figure, some_of
from visioncal.core.prediction import point_jacobian, through
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.points import GroupFit

# Least noise of any instrument [m]: exact coordinates would otherwise be judged by rounding.
LEAST_NOISE_M = 1e-6
# A careful touch by hand [m]: the noise where nothing determines it.
TOUCH_NOISE_M = 1e-4
# Noise beyond which touches may be of other kinds, or by another tool [m].
DISAGREE_M = 1e-3
_Kind = TypeVar("_Kind", bound=str)


def counted_noise_m(fit: GroupFit, expected_m: float) -> float:
    """Noise of a touch that counts [m]: with few degrees of freedom at least the expected one."""
    # Fewest degrees of freedom that estimate the noise: a single residual is within a tenth of its
    # sigma in one frame of twelve. Features that were touched twice leave six.
    return fit.sigma if fit.freedom >= 6 else max(fit.sigma, expected_m)


def assumed_words(noise_m: float, stated_m: float | None) -> str:
    """Sentence that a sigma rests on an assumed noise, with a leading blank; else empty."""
    if stated_m is not None or noise_m != TOUCH_NOISE_M:
        return ""
    return (
        f" Its sigma is that of touches that repeat to {1e3 * TOUCH_NOISE_M:g} mm, which is "
        "assumed: say --touch-noise-mm as it is."
    )


def check_sides(
    label: str,
    names: Sequence[str],
    kinds: Sequence[str],
    used: Mask,
    along: Mapping[str, FloatArray],
) -> None:
    """Refuses touches of a kind that lie on both sides of the frame's origin or axis.

    Args:
        label: The first word of the message.
        names: (n,) names of the touches.
        kinds: (n,) their kinds.
        used: (n,) mask of the inliers.
        along: (n,) the coordinate that has to be positive [m], by kind.
    """
    for kind, coordinate in along.items():
        rows = used & (np.array(kinds) == kind)
        # Near to the origin, by the farthest one's distance, noise may put them on either side.
        limit = 0.1 * np.abs(coordinate[rows]).max(initial=0.0)
        behind, before = (
            [names[row] for row in np.flatnonzero(rows & (side * coordinate > limit)).tolist()]
            for side in (-1.0, 1.0)
        )
        if behind:
            words = f"are on the negative side of the axis: {some_of(behind)}"
            if before:
                words = f"lie on both sides: {some_of(behind)} on the other side than "
                words += some_of(before)
            raise DataError(
                f"{label}: the touches of kind {kind} {words}.",
                culprits=[*behind, *before],
                next_step="Touch again only where the axis is positive.",
            )


def refuse_exchanged_kinds(
    label: str,
    names: Sequence[str],
    kinds: tuple[_Kind, ...],
    fitted: Callable[[tuple[_Kind, ...]], GroupFit | None],
) -> None:
    """Refuses touches that agree with other kinds, and do not with theirs.

    Args:
        label: The first word of the message.
        names: (n,) names of the touches.
        kinds: (n,) their kinds.
        fitted: The fit of all touches, of (n,) kinds; None of kinds that determine no frame.
    """
    declared = fitted(kinds)
    if declared is None or declared.sigma < DISAGREE_M:
        return
    tried = list[tuple[GroupFit | None, str, Sequence[str]]]()
    # Of many touches each two take too long, and none stands for all. Touches at most of which any
    # two are tried with each other's kinds.
    some = range(len(kinds) if len(kinds) <= 24 else 0)
    for a, b in combinations(some, 2):
        if kinds[a] != kinds[b]:
            exchanged = tuple(kinds[{a: b, b: a}.get(row, row)] for row in range(len(kinds)))
            words = f"touches {names[a]} ({kinds[a]}) and {names[b]} ({kinds[b]})"
            tried.append((fitted(exchanged), words, (names[a], names[b])))
    every = sorted(set(kinds))
    for others in permutations(every):
        renamed = dict(zip(every, others, strict=True))
        wrong = some_of([f"{a} is {b}" for a, b in renamed.items() if a != b])
        fit = fitted(tuple(renamed[kind] for kind in kinds))
        tried.append((fit, f"the touches ({wrong})", ()))
    found = [
        (fit.sigma, words, at) for fit, words, at in tried if fit is not None and fit.freedom > 1
    ]
    agree_m = min((sigma_m for sigma_m, _, _ in found), default=np.inf)
    # Kinds by which touches disagree, too, explain nothing.
    if agree_m < DISAGREE_M and CLEAR_RATIO * agree_m < declared.sigma:
        rivals = [(words, at) for sigma_m, words, at in found if sigma_m < CLEAR_RATIO * agree_m]
        raise DataError(
            f"{label}: {some_of([words for words, _ in rivals])} have each other's kinds: "
            f"corrected, all agree to {figure(1e3 * agree_m)} mm per axis, and to "
            f"{figure(1e3 * declared.sigma)} mm as they are.",
            culprits=rivals[0][1],
            next_step="Look what was touched, and correct the column kind.",
        )


def worst_of(
    matrix: FloatArray,
    covariance: FloatArray,
    thing: str,
    parent: str,
    centre: FloatArray | None = None,
    origin: str = "",
) -> tuple[Direction, Direction]:
    """The least certain offset and rotation of a frame.

    Args:
        matrix: (4, 4) the frame in its parent.
        covariance: (6, 6) covariance of its right perturbation (rotation [rad], translation [m]).
        thing: Name of the frame's object, for messages.
        parent: Name of the parent, likewise.
        centre: (3,) reference point of the offset, in the frame [m]; its origin where None.
        origin: Name of the frame's origin, such as the tip; the thing's where empty.

    Returns:
        The offset's worst direction in the parent, and the rotation's in the frame itself.
    """
    point, where = (np.zeros(3), "") if centre is None else (centre, " amid the points")
    values, vectors = np.linalg.eigh(through(point_jacobian(matrix, point), covariance))
    # Where two directions are poor, so are all between them, and none has a name.
    along = f"along the {parent}'s {axis_words(vectors[:, -1])}"
    several = origin and values[-2] > SIGMA_LIMIT_M**2
    offset = Direction(
        f"the {origin or thing}'s offset{where} {f'from the {parent}' if several else along}",
        float(np.sqrt(values[-1])),
        SIGMA_LIMIT_M,
        is_rotation=False,
    )
    values, vectors = np.linalg.eigh(covariance[:3, :3])
    rotation = Direction(
        f"the {thing}'s rotation about its {axis_words(vectors[:, -1])}",
        float(np.sqrt(values[-1])),
        SIGMA_LIMIT_RAD,
        is_rotation=True,
    )
    return offset, rotation


def refuse_poor(
    label: str,
    fit: GroupFit,
    worst: Callable[[FloatArray], Sequence[Direction]],
    cause: Callable[[Direction], tuple[str, str]],
    culprits: Sequence[str] = (),
    wild: DataError | None = None,
) -> None:
    """Refuses a fit that leaves a direction undetermined.

    Wild disagreement of points is no fault of the geometry: it is judged by a noise of at most the
    limit, and at least of a micrometre.

    Args:
        label: The first word of the message.
        fit: The fit.
        worst: The worst directions by a covariance (p, p) of the fit's unknowns.
        cause: Cause and next step for the worst direction.
        culprits: Further culprits.
        wild: The error where the noise is beyond the limit, too; None for none of its own.

    Raises:
        DegenerateError: The predicted sigma of a direction is over the limit.
        DataError: `wild`.
    """
    level = min(max(fit.sigma, LEAST_NOISE_M), SIGMA_LIMIT_M)
    information = fit.groups.subset(fit.used).information(level)
    directions = worst(covariance_from(information))
    beyond = [direction for direction in directions if direction.sigma > direction.limit]
    if not beyond:
        return
    if wild is not None and fit.sigma > SIGMA_LIMIT_M:
        raise wild
    # The rounding of an undetermined direction leaks into the others.
    first = max(beyond, key=lambda direction: direction.sigma / direction.limit)
    words, next_step = cause(first)
    raise DegenerateError(
        f"{label}: {first.words} {first.fault('')}: {words}.",
        culprits=[*(direction.words for direction in beyond), *culprits],
        next_step=next_step,
    )
