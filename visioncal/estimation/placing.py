"""Certainty of a placed frame: its worst directions in words, and their limits."""

from collections.abc import Sequence

import numpy as np

from visioncal.core.errors import DegenerateError
from visioncal.core.number_format import figure, some_of
from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.groups import GroupFit, State
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD, Direction, axis_words

# Least noise of any instrument [m]: exact coordinates would otherwise be judged by rounding.
LEAST_NOISE_M = 1e-6
# A careful touch by hand [m]: the noise where nothing determines it.
TOUCH_NOISE_M = 1e-4
# Fewest degrees of freedom that estimate the noise: a single residual is within a tenth of its
# sigma in one frame of twelve. Features that were touched twice leave six.
_ENOUGH = 6
# Ratio of squared extents below which points are collinear.
LEAST_RATIO = 1e-8


def noise_words(sigma_m: float | None) -> str:
    """Words for the noise by which geometry was judged: `at a noise of 0.1 mm`."""
    if sigma_m is None:
        return f"at a noise of {1e3 * TOUCH_NOISE_M:g} mm, taken because nothing determines it"
    return f"at a noise of {figure(1e3 * sigma_m)} mm"


def counted_noise_m(fit: GroupFit[State], expected_m: float) -> float:
    """Noise of a touch that counts [m]: with few degrees of freedom at least the expected one."""
    return fit.sigma if fit.freedom >= _ENOUGH else max(fit.sigma, expected_m)


def assumed_words(noise_m: float, stated_m: float | None) -> str:
    """Sentence that a sigma rests on an assumed noise, with a leading blank; else empty."""
    if stated_m is not None or noise_m != TOUCH_NOISE_M:
        return ""
    return (
        f" Its sigma is that of touches that repeat to {1e3 * TOUCH_NOISE_M:g} mm, which is "
        "assumed: say --touch-noise-mm as it is."
    )


def left_out_words(labels: Sequence[str], used: Mask) -> str:
    """Words for what was left out: `without P3, which does not agree with the others, `."""
    names = [name for name, stays in zip(labels, used, strict=True) if not stays]
    verb = "does" if len(names) == 1 else "do"
    return f"without {some_of(names)}, which {verb} not agree with the others, " if names else ""


def worst_directions(
    fit: GroupFit[State], base_from_fixture: FloatArray, centre: FloatArray, sigma_m: float | None
) -> tuple[Direction, Direction]:
    """The least certain offset and rotation of a fixture.

    Wild disagreement of points is no fault of the geometry: it is judged by a noise of at most the
    limit, and at least of a micrometre.

    Args:
        fit: Its first six unknowns are the fixture's right perturbation (rotation, translation).
        base_from_fixture: (4, 4) the solution.
        centre: (3,) reference point of the offset, in the fixture's frame [m]: amid the points,
            since a drawing's origin may be far away.
        sigma_m: Noise of one coordinate [m], beyond the stated one; None where nothing determines
            it.

    Returns:
        The offset's worst direction in the base, and the rotation's in the fixture.
    """
    level = TOUCH_NOISE_M if sigma_m is None else min(max(sigma_m, LEAST_NOISE_M), SIGMA_LIMIT_M)
    covariance = covariance_from(fit.groups.subset(fit.used).information(level))[:6, :6]
    return worst_of(base_from_fixture, covariance, "fixture", "base", centre)


def worst_of(
    matrix: FloatArray,
    covariance: FloatArray,
    thing: str,
    parent: str,
    centre: FloatArray | None = None,
) -> tuple[Direction, Direction]:
    """The least certain offset and rotation of a frame.

    Args:
        matrix: (4, 4) the frame in its parent.
        covariance: (6, 6) covariance of its right perturbation (rotation [rad], translation [m]).
        thing: Name of the frame's object, for messages.
        parent: Name of the parent, likewise.
        centre: (3,) reference point of the offset, in the frame [m]; its origin where None.

    Returns:
        The offset's worst direction in the parent, and the rotation's in the frame itself.
    """
    point, where = (np.zeros(3), "") if centre is None else (centre, " amid the points")
    at_centre = matrix[:3, :3] @ np.hstack([-skew(point), np.eye(3)])
    values, vectors = np.linalg.eigh(at_centre @ covariance @ at_centre.T)
    offset = Direction(
        f"the {thing}'s offset{where} along the {parent}'s {axis_words(vectors[:, -1])}",
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
    worst: Sequence[Direction], cause: str, culprits: Sequence[str], next_step: str
) -> None:
    """Refuses a fixture whose worst directions are over their limits.

    Raises:
        DegenerateError: Naming the first that is.
    """
    beyond = [direction for direction in worst if direction.sigma > direction.limit]
    if beyond:
        raise DegenerateError(
            f"fixture: {beyond[0].words} has a predicted sigma of {beyond[0].figure}: {cause}.",
            culprits=[*(direction.words for direction in beyond), *culprits],
            next_step=next_step,
        )
