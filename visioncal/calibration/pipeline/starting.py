"""Start of a cell's fit: its problem, initial frames, and one pose chosen for each view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.pipeline.connectivity import ambiguous_error, refuse_unconnected_robots
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.init_frames import init_frames
from visioncal.calibration.stages.observed import Observed, nothing_seen
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.types import Target
from visioncal.estimation.observability import refuse_too_few
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Observations, State
from visioncal.session import frame_name

# Covariance, up to a level, of a pose that was given without one [rad^2, m^2].
_NOMINAL = np.diag(np.repeat([1e-3, 5e-4], 3) ** 2)


@dataclass(frozen=True, eq=False)
class Start:
    """Start of a fit."""

    cell: Cell  # The connected part of the cell; its rows are in the fit's order.
    poses: tuple[ViewPoses, ...]  # The pose chosen for each row.
    problem: Problem  # The problem of these.
    state: State  # The initial frames.
    untied: tuple[str, ...]  # Frames that no observation links to the rest.


def find_start(cell: Cell, observed: Observed) -> Start:
    """Initialises all frames, and chooses each view's pose by them.

    Raises:
        DataError: No observation gave a pose.
        DegenerateError: A robot is linked to nothing, or a frame may be in two places.
    """
    lost = {row.view for row in cell.rows} - observed.poses.keys()
    nothing = "nothing was found in its image"
    cell = cell.without({view: cell.reasons.get(view, nothing) for view in lost})
    if not cell.rows:
        raise nothing_seen(observed)
    views = [observed.poses[row.view] for row in cell.rows]
    problem = problem_of(cell, views)
    if cell.mount is not None:
        refuse_too_few(problem, cell.mount)
    tied = init_frames(problem, views, targets_of(cell))
    chosen = {view.view: view for view in tied.views}
    cell = cell.without({rejection.view: rejection.reason for rejection in tied.rejections})
    branches, linked = cell.tree.branches, cell.connected_frames()
    apart = [name for name in branches if name not in linked or name in tied.untied]
    refuse_unconnected_robots(cell, apart)
    if tied.ambiguous:
        raise ambiguous_error(cell, tied.ambiguous)
    cell = _without_frames(cell, apart)
    # Without their rows, the robots that saw nothing else are not linked either.
    while lone := [name for name in cell.tree.branches if name not in cell.connected_frames()]:
        cell, apart = _without_frames(cell, lone), [*apart, *lone]
    poses = tuple(chosen[row.view] for row in cell.rows)
    problem = problem_of(cell, poses)
    untied = tuple(name for name in apart if not branches[name].robot)
    return Start(cell, poses, problem, problem.start(tied.edges), untied)


def targets_of(cell: Cell) -> dict[str, Target]:
    """The printed targets by their frames."""
    plates = cell.session.plates
    return {frame_name("target", name): plate for name, plate in plates.items()}


def problem_of(cell: Cell, views: Sequence[ViewPoses]) -> Problem:
    """The problem of views with one pose each, at the present lenses and boards."""
    is_given = np.array([not view.covariance.any() for view in views])
    levels = {sensor: at for at, sensor in enumerate(sensors_of(cell, views))}
    sensors = [
        levels.get(row.seer, -1) if _is_sensed(row.seer, view) else -1
        for row, view in zip(cell.rows, views, strict=True)
    ]
    covariance = np.array([view.covariance[0] for view in views])
    is_place = np.array([row.is_place for row in cell.rows], dtype=bool)
    covariance[is_given] = _NOMINAL
    oriented = {row.seen for row in cell.rows if not row.is_place}
    # Of poses without a stated noise, that of one camera and one robot is estimated as one.
    is_combined = cell.mount is not None and cell.mount != "instrument" and bool(is_given.any())
    is_uneven = is_given & [not row.seer.startswith("instrument") for row in cell.rows]
    if is_combined:
        is_uneven |= True
        sensors, covariance = [-1] * len(views), np.zeros((len(views), 6, 6))
    return Problem(
        cell.tree,
        cell.poses,
        Observations(
            tuple(row.seer for row in cell.rows),
            tuple(row.seen for row in cell.rows),
            np.array([row.station for row in cell.rows]),
            np.array(sensors, dtype=np.int64),
            np.array([view.cam_from_target[0] for view in views]),
            covariance,
            ~is_place,
            is_uneven,
        ),
        priors=cell.priors,
        points=frozenset(row.seen for row in cell.rows) - oriented,
        is_combined=is_combined,
    )


def sensors_of(cell: Cell, views: Sequence[ViewPoses]) -> tuple[str, ...]:
    """Frames whose observations have a noise known up to a level, which is then estimated.

    One camera or instrument with one robot has none: its noise is the stated one, and the excess
    is the robot's.
    """
    if cell.mount is not None:
        return ()
    pairs = zip(cell.rows, views, strict=True)
    return tuple(dict.fromkeys(row.seer for row, view in pairs if _is_sensed(row.seer, view)))


def _is_sensed(seer: str, view: ViewPoses) -> bool:
    """Whether an observation's noise is known up to a level only: that of corners is known."""
    return seer.startswith("instrument") or not view.covariance.any()


def _without_frames(cell: Cell, frames: Sequence[str]) -> Cell:
    tree = cell.tree.without(frames)
    kept = tree.branches.keys()
    reasons = {
        row.view: f"nothing ties {row.seer if row.seer in frames else row.seen} "
        "to the rest of the cell"
        for row in cell.rows
        if not {row.seer, row.seen} <= kept
    }
    robots = set(tree.robots)
    poses = {name: pose for name, pose in cell.poses.items() if name in robots}
    priors = tuple(prior for prior in cell.priors if {prior.first, prior.second} <= kept)
    return replace(cell.without(reasons), tree=tree, poses=poses, priors=priors)
