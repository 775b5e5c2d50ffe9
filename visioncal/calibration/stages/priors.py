"""What a session knows of a cell's frames beforehand: `[prior.A_from_B]`, and what became of it."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from visioncal.calibration.stages.measured import components, prior_of
from visioncal.core.errors import DataError
from visioncal.core.files import did_you_mean
from visioncal.core.types import FloatArray
from visioncal.core.verdict import CALIBRATE, NOTE, Finding, Step, remarks
from visioncal.estimation.parts import FramePrior, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.tree import Tree
from visioncal.session.tables import PriorTable

# A place of this sigma is overruled by any that views determine well enough to be accepted [m].
_LOOSE_M = 1.0


def priors_of(tables: Mapping[str, PriorTable], tree: Tree) -> tuple[FramePrior, ...]:
    """Reads the priors of a cell's frames.

    Args:
        tables: `[prior.A_from_B]` by its name: where frame B is in frame A.
        tree: The frames.

    Raises:
        DataError: A frame is unknown, or a robot moves one of the two before the other.
    """
    return tuple(_prior(name, table, tree) for name, table in tables.items())


def _prior(name: str, table: PriorTable, tree: Tree) -> FramePrior:
    found = prior_of(name, table)
    first, second = found.first, found.second
    label = f"session.toml: prior.{name}"
    for frame in (first, second):
        if frame not in tree.branches:
            known = [it for it in tree.branches if it != frame]
            raise DataError(
                f"{label}: {frame!r} is no frame of this cell; those are {', '.join(known)}.",
                culprits=[label],
                next_step=did_you_mean(frame, known)
                or "Name a prior A_from_B, as [prior.flange_a_from_cam_left].",
            )
    moved_by = [it.robot for it in tree.path(first, second) if it.robot]
    if moved_by or first == second:
        why = f"robot {moved_by[0]} moves one before the other" if moved_by else "they are one"
        raise DataError(
            f"{label}: {first} and {second} have no fixed place in each other: {why}.",
            culprits=[label],
            next_step="State where two frames are that stand in the cell, or on one flange.",
        )
    return found


def loosened(priors: Iterable[FramePrior]) -> tuple[FramePrior, ...]:
    """The priors with places so uncertain that the observations overrule them."""
    return tuple(replace(it, sigma_m=max(it.sigma_m, _LOOSE_M)) for it in priors)


def without_most_contradicted(
    problem: Problem, state: State, covariance: FloatArray
) -> tuple[FramePrior, ...] | None:
    """The priors without the component that the observations contradict most.

    Args:
        problem: The observations in the fit.
        state: The answer.
        covariance: (p, p) covariance of the unknowns.

    Returns:
        The others; None where the observations contradict none.
    """
    found = [
        (it.contradiction, at, it.axis)
        for at, prior in enumerate(problem.priors)
        for it in components(problem, state, covariance, [prior])
        if it.is_contradicted
    ]
    if not found:
        return None
    _, worst, axis = max(found)
    kept = [it.without(axis) if at == worst else it for at, it in enumerate(problem.priors)]
    return tuple(it for it in kept if it.axes or it.rotation is not None)


def prior_words(
    problem: Problem, state: State, covariance: FloatArray, stated: Iterable[FramePrior]
) -> Iterator[Finding]:
    """Says what became of priors; what contradicts none is a note.

    Args:
        problem: The observations in the fit, with what of priors these do not contradict.
        state: The answer.
        covariance: (p, p) covariance of the unknowns.
        stated: All priors, whole.
    """
    for it in components(problem, state, covariance, tuple(stated)):
        if it.is_used:
            yield from remarks([it.remark], NOTE)
        else:
            step = Step("Measure it again, or delete it from session.toml.", CALIBRATE)
            yield Finding("prior", it.doubt, step, mahalanobis_sq=it.contradiction**2)
