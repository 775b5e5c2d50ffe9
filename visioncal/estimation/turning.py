"""Whether touches turn enough to determine a tool's tip and rotation, and what they leave open."""

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import figure
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.estimation.groups import GroupFit
from visioncal.estimation.linalg import covariance_from, spectrum
from visioncal.estimation.observability import (
    SIGMA_LIMIT_M,
    SIGMA_LIMIT_RAD,
    Direction,
    axis_words,
)
from visioncal.estimation.placing import LEAST_NOISE_M
from visioncal.estimation.readings import readings_that_close
from visioncal.estimation.touching import Touches, TouchProblem, TouchUnknowns, in_tool

# Under this scaled eigenvalue ratio the touches do not determine a direction at all.
_NULL_RATIO = 1e-8
# Touches that scatter more than this are not careful ones [m]: what is undetermined is not the
# motion's fault alone.
CARELESS_M = 1e-3
_STILL_RAD = float(np.deg2rad(0.5))
FEWEST_TOUCHES = 3
_ADVICE = (
    "Touch the same point 3 or more times with the flange tilted by 20 to 45 degrees about "
    "different axes, not only turned about one."
)


def check_counts(touches: Touches) -> None:
    """Refuses too few touches, and touches of an axis whose point or partner is missing.

    Raises:
        DataError: Naming what to add.
    """
    tips = touches.points[touches.are("point")]
    counts = np.bincount(tips, minlength=len(touches.names))
    if np.maximum(counts - 1, 0).sum() < FEWEST_TOUCHES - 1:
        counted = ", ".join(
            f"{n} of {name or 'one point'}" for name, n in zip(touches.names, counts, strict=True)
        )
        raise DataError(
            f"tcp: {len(tips)} touches of kind point ({counted}): at least {FEWEST_TOUCHES} of one "
            "point, or 2 each of two points, are needed.",
            culprits=touches.names,
            next_step=_ADVICE,
        )
    axes = [at for at, kind in enumerate(touches.kinds) if kind != "point"]
    unknown = [at for at in axes if not counts[touches.points[at]]]
    if unknown:
        name = touches.names[touches.points[unknown[0]]]
        raise DataError(
            f"tcp: touch {touches.labels[unknown[0]]} of kind {touches.kinds[unknown[0]]} is of "
            f"point {name!r}, which no touch of kind point has met.",
            culprits=[touches.labels[at] for at in unknown],
            next_step=f"Touch {name!r} with the tip, too, or name the point that was touched.",
        )
    kinds = {touches.kinds[at] for at in axes}
    if len(kinds) == 1:
        (there,) = kinds
        missing = "xz" if there == "z" else "z"
        raise DataError(
            f"tcp: there are touches of kind {there} but none of kind {missing}: together they "
            "determine the tool's rotation, one alone does not.",
            culprits=[touches.labels[at] for at in axes],
            next_step=f"Add a touch of kind {missing}, or leave out those of kind {there}.",
        )


def check_turning(problem: TouchProblem, fit: GroupFit[TouchUnknowns]) -> tuple[Direction, ...]:
    """Refuses touches that leave a direction open; otherwise returns the worst ones.

    Touches that disagree wildly are no fault of the motion: it is judged by a noise of at most the
    limit, and what is beyond is the verdict's business.

    Args:
        problem: The touches.
        fit: The answer from those that agree.

    Returns:
        The worst known direction of the tip, and of the tool's rotation where that is sought.

    Raises:
        DegenerateError: A direction is numerically null, or its predicted sigma is over the limit.
    """
    level = min(max(fit.sigma, LEAST_NOISE_M), SIGMA_LIMIT_M)
    worst = _worst(problem, fit, level)
    null = spectrum(fit.groups.subset(fit.used).information(level)).ratio < _NULL_RATIO
    beyond = [direction for direction in worst if direction.sigma > direction.limit]
    if not beyond and not null:
        return _worst(problem, fit, max(fit.sigma, LEAST_NOISE_M))
    culprit = beyond[0] if beyond else max(worst, key=lambda value: value.sigma / value.limit)
    cause, next_step = _cause(problem, fit, culprit)
    fault = "is not determined at all" if null else f"has a predicted sigma of {culprit.figure}"
    raise DegenerateError(
        f"tcp: {culprit.words} {fault}: {cause}.",
        culprits=[direction.words for direction in beyond] or [culprit.words],
        next_step=next_step,
    )


def _worst(
    problem: TouchProblem, fit: GroupFit[TouchUnknowns], level: float
) -> tuple[Direction, ...]:
    covariance = covariance_from(fit.groups.subset(fit.used).information(level))
    first = 3 if problem.oriented else 0
    to_flange = fit.state.flange_from_tool[:3, :3]
    tip = to_flange @ covariance[first : first + 3, first : first + 3] @ to_flange.T
    values, vectors = np.linalg.eigh(tip)
    several = values[-2] > SIGMA_LIMIT_M**2
    words = "from the flange" if several else f"along the flange's {axis_words(vectors[:, -1])}"
    found = [_direction(f"the tip's offset {words}", values[-1], SIGMA_LIMIT_M, is_rotation=False)]
    if problem.oriented:
        values, vectors = np.linalg.eigh(covariance[:3, :3])
        words = f"the tool's rotation about its {axis_words(vectors[:, -1])}"
        found.append(_direction(words, values[-1], SIGMA_LIMIT_RAD, is_rotation=True))
    return tuple(found)


def _direction(words: str, variance: float, limit: float, *, is_rotation: bool) -> Direction:
    return Direction(words, float(np.sqrt(variance)), limit, is_rotation)


def _cause(
    problem: TouchProblem, fit: GroupFit[TouchUnknowns], culprit: Direction
) -> tuple[str, str]:
    """Why a direction is undetermined, and what to do about it."""
    used = problem.touches.subset(fit.used)
    careful = [
        direction
        for direction in _worst(problem, fit, CARELESS_M)
        if direction.words == culprit.words
    ]
    if fit.sigma > CARELESS_M and all(direction.sigma < direction.limit for direction in careful):
        readings = readings_that_close(problem.touches)
        cause = f"the touches scatter by {1e3 * fit.sigma:.3g} mm"
        if readings:
            return cause, (
                f"Read the poses {readings[0].words}: then they close to "
                f"{figure(1e3 * readings[0].rms_m)} mm."
            )
        return cause, "Look for poses of another tool or in other units, and touch again."
    if culprit.is_rotation:
        return _levers(used, fit)
    return _motion(used), _ADVICE


def _levers(used: Touches, fit: GroupFit[TouchUnknowns]) -> tuple[str, str]:
    """Says how far from the tip the touches of the axes have their points."""
    seen = np.abs(in_tool(used, fit.state))
    along = 1e3 * seen[used.are("z"), 2].max()
    aside = 1e3 * seen[used.are("xz"), 0].max()
    return (
        f"the touches of kind z have their point at most {figure(along)} mm from the tip, and "
        f"those of kind xz at most {figure(aside)} mm beside the tool's z axis"
    ), "Move the tool back by 50 mm or more along its axes before touching for z and xz."


def _motion(used: Touches) -> str:
    """Says what is wrong with the motion, of touches of one and the same point."""
    turns = _turns(used.subset(used.are("point")))
    angles = np.linalg.norm(turns, axis=1)
    largest, count = np.rad2deg(angles.max()), int(used.are("point").sum())
    if angles.max() < _STILL_RAD:
        return (
            f"the {count} used touches are all from one orientation of the flange (largest "
            f"rotation between two of them: {figure(largest)} deg)"
        )
    main = np.linalg.svd(turns, full_matrices=False)[2][0]
    aside = np.rad2deg(np.linalg.norm(turns - np.outer(turns @ main, main), axis=1).max())
    if aside < 0.1 * largest:
        return (
            f"all {count} used touches turn about the flange's {axis_words(main)} to within "
            f"{figure(max(aside, 0.01))} deg"
        )
    return (
        f"the {count} used touches turn by at most {figure(largest)} deg, and by {figure(aside)} "
        "deg about a second axis"
    )


def _turns(touches: Touches) -> FloatArray:
    """Rotation vectors (p, 3) in the flange between all pairs of touches of one point [rad]."""
    one, other = np.triu_indices(len(touches), 1)
    same = touches.points[one] == touches.points[other]
    poses = touches.base_from_flange
    relative = invert(poses[other[same]]) @ poses[one[same]]
    return np.asarray(Rotation.from_matrix(relative[:, :3, :3]).as_rotvec())
