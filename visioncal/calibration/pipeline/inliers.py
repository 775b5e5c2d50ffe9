"""Which views, moved frames and priors of a cell are inliers, before and between the fits."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.starting import Start, sensors_of, started
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.priors import loosened, without_most_contradicted
from visioncal.core.types import Mount
from visioncal.estimation.joint import target_sizes
from visioncal.estimation.observability import check_observability
from visioncal.estimation.outliers import Agreed, agree, settle
from visioncal.estimation.parts import Observations, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import Solution, covariance_of, solve_problem, starting_noise

# What targets' sizes are known to while it is sought what agrees, as a share: prints are scaled to
# fit a page.
_SIZE_SIGMA = 0.03


def first_inliers(cell: Cell, looked: Observed, mount: Mount) -> tuple[Cell, Agreed]:
    """Takes the first steps of `solve`: which views agree, before lens, board or arm are fitted.

    Args:
        cell: A cell of one robot and one camera.
        looked: What was observed in it.
        mount: Where the camera is.

    Returns:
        The cell, its rows in the order of the fit, and what agrees.

    Raises:
        DegenerateError: The motion is too poor for any answer, by its geometry alone.
    """
    start = started(cell, looked)
    check_observability(start.problem, start.state, starting_noise(start.problem), mount)
    return start.cell, find_inliers(start)[0]


def find_inliers(start: Start) -> tuple[Agreed, Mapping[str, float]]:
    """Finds what belongs together, and what of the priors the observations do not contradict.

    Returns:
        What agrees, and by which share each printed target of a whole cell is larger than stated,
        roughly.
    """
    cell, problem, state = start.cell, start.problem, start.state
    movable, seen = _movable(cell, problem), problem.observations
    if printed := _printed(seen) if movable else []:
        # All that is seen of a board of another size disagrees with the rest, and would be out.
        problem = problem.with_effects([target_sizes(problem, printed, _SIZE_SIGMA)])
        state = State(state.edges, problem.start_values)
    if not cell.priors:
        agreed = agree(problem, state, movable)
    else:
        loose = replace(problem, priors=loosened(cell.priors))
        agreed = _with_priors(cell, agree(loose, state, movable)).refitted()
    # What corners say of sizes is found with the lenses.
    edges, sizes = agreed.fit.state.edges, agreed.fit.state.values.tolist()
    fit = replace(agreed.fit, state=State(edges, np.zeros(0)))
    agreed = replace(agreed, problem=agreed.problem.with_effects(()), fit=fit)
    return agreed, dict(zip(printed, sizes, strict=True))


def settled(cell: Cell, agreed: Agreed) -> Agreed:
    """Settles what agrees, and what of the priors the observations do not contradict."""
    if cell.priors:
        loose = replace(agreed.problem, priors=loosened(cell.priors))
        agreed = settle(replace(agreed, problem=loose), _movable(cell, loose))
        agreed = _with_priors(cell, agreed)
    return settle(agreed, _movable(cell, agreed.problem))


def levelled(cell: Cell, poses: Sequence[ViewPoses], agreed: Agreed) -> Agreed:
    """Asks for the noise level of cameras, too, now that what is wrong is out."""
    # Corners of one image may err alike, as those of small squares do: poses then scatter by more
    # than corners do about them, but never by less. Where one camera sees one robot once a stop,
    # the robot's noise has taken that up.
    is_alone = cell.mount is not None and not agreed.problem.shared_units
    if is_alone or agreed.problem.is_combined:
        return agreed
    sensors = sensors_of(cell, poses)
    frames = tuple(dict.fromkeys((*sensors, *(row.seer for row in cell.rows))))
    places = {frame: at for at, frame in enumerate(frames)}
    problem = agreed.problem
    observations = replace(
        problem.observations,
        sensors=np.array([places[row.seer] for row in cell.rows], dtype=np.int64),
    )
    more = np.ones(len(frames) - len(sensors))
    least_levels = np.concatenate([np.zeros(len(sensors)), more])
    problem = replace(problem, observations=observations, least_levels=least_levels)
    noise = agreed.fit.noise
    noise = replace(noise, sensors=np.concatenate([noise.sensors, more]))
    # All that is tried with the arms begins here.
    return replace(agreed, problem=problem, fit=replace(agreed.fit, noise=noise)).refitted()


def with_repeats(agreed: Agreed) -> Agreed:
    """Fits once more, repeated views of still boards by still cameras sharing an error."""
    # What moved was looked for without it: their differences do not share it.
    return replace(agreed, problem=replace(agreed.problem, with_repeats=True)).refitted()


def _printed(seen: Observations) -> list[str]:
    """The targets of which corners were seen: the covariances of others' poses are not known."""
    pairs = zip(seen.observed, seen.sensors.tolist(), strict=True)
    return list(dict.fromkeys(target for target, sensor in pairs if sensor < 0))


def _with_priors(cell: Cell, agreed: Agreed) -> Agreed:
    """Puts in the components of priors that the observations do not contradict."""
    # The worst is left out first: it misleads about the rest. The noise is that of a fit with loose
    # priors: estimated beside a wrong one, it would grow until it explains it.
    problem, noise = replace(agreed.problem, priors=cell.priors), agreed.fit.noise
    while True:
        part = problem.subset(agreed.used)
        fit = Solution(solve_problem(part, agreed.fit.state, noise)[0], noise)
        kept = without_most_contradicted(part, fit.state, covariance_of(part, fit))
        if kept is None:
            return replace(agreed, problem=problem, fit=fit)
        problem = replace(problem, priors=kept)


def _movable(cell: Cell, problem: Problem) -> tuple[str, ...]:
    """What may be bumped or slip: all that is unknown but bases."""
    # One camera that sees one robot move cannot distinguish what slipped from a wrong pose.
    if cell.mount is not None:
        return ()
    bases = problem.tree.bases.values()
    return tuple(name for name in problem.tree.unknown if name not in bases)
