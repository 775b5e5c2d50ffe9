"""Start of a cell's fit: its problem, initial frames, and one pose chosen for each view.

The mirrored solutions of a planar target, and the turns of a board with a rotational symmetry, look
alike in one image; the robots' motion separates them.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.pipeline.connectivity import ambiguous_error, refuse_unconnected_robots
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.error_sizes import scales_of, session_start
from visioncal.calibration.stages.observed import Observed, nothing_seen
from visioncal.core.errors import DegenerateError, VisioncalError
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.types import MOUNTS, FloatArray, Mask, Target
from visioncal.estimation.observability import refuse_too_few
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Observations, State
from visioncal.fit.consensus import Candidates
from visioncal.fit.solve import CellFit, solve_from
from visioncal.model.effects import Play
from visioncal.vision.pnp import ViewPoses

# Covariance, up to a level, of a pose that was given without one [rad^2, m^2].
_NOMINAL = np.diag(np.repeat([1e-3, 5e-4], 3) ** 2)
# Share of the rows that agree, below which something may have moved.
_MOST_AGREE = 0.9
_AMBIGUOUS = "ambiguous: two poses of the target fit image and motion alike"


@dataclass(frozen=True, eq=False)
class Start:
    """Start of a fit."""

    cell: Cell  # The connected part of the cell; its rows are in the fit's order.
    poses: tuple[ViewPoses, ...]  # The pose chosen for each row.
    problem: Problem  # The problem of these.
    state: State  # The initial frames.
    untied: tuple[str, ...]  # Frames that no observation links to the rest.
    # The one likelihood of the session; None where it was not asked for or does not come to rest.
    solved: CellFit | None = None

    @property
    def agreeing(self) -> Mask | None:
        """(n,) rows that agree by the one likelihood; None where that is no start."""
        if self.solved is None or not _is_start(self.solved, self.cell):
            return None
        used = np.flatnonzero(self.solved.used).tolist()
        views = {self.solved.fit.cell.sightings[at].view for at in used}
        agreeing = np.array([row.view in views for row in self.cell.rows], dtype=bool)
        return agreeing if np.mean(agreeing) >= _MOST_AGREE else None

    def has_play(self, robot: str) -> bool:
        """Whether joints of a robot have play, by the one likelihood."""
        if self.solved is None:
            return False
        opened, flange = self.solved.fit.unknowns.opened, self.cell.tree.flanges.get(robot, "")
        return any(isinstance(effect, Play) and effect.frame == flange for effect in opened)


def find_start(cell: Cell, observed: Observed, *, is_solved: bool) -> Start:
    """Initialises all frames, and chooses each view's pose by them.

    Args:
        cell: The cell.
        observed: The observations in it.
        is_solved: Whether the one likelihood is fitted, too.

    Raises:
        DataError: No observation gave a pose.
        DegenerateError: A robot is linked to nothing, a frame may be in two places, or the motion
            leaves most views ambiguous.
    """
    lost = {row.view for row in cell.rows} - observed.poses.keys()
    nothing = "nothing was found in its image"
    cell = cell.without({view: cell.reasons.get(view, nothing) for view in lost})
    if not cell.rows:
        raise nothing_seen(observed)
    views = [observed.poses[row.view] for row in cell.rows]
    problem = problem_of(cell, views)
    if cell.session.has_one_pair:
        refuse_too_few(problem, cell.session.mount)
    begun = session_start(observed, cell.reference, has_priors=bool(cell.priors))
    solved = None
    # Where it does not come to rest, the fit of poses says why.
    with suppress(VisioncalError):
        solved = solve_from(begun) if is_solved else None
    edges = dict(begun.edges)
    if solved is not None and _is_start(solved, cell):
        edges = {name: solved.fit.edge(name) for name in edges}
    chosen, ambiguous = _chosen(cell, problem, views, edges)
    cell = cell.without(dict.fromkeys(ambiguous, _AMBIGUOUS))
    branches, linked = cell.tree.branches, cell.connected_frames()
    untied = set(cell.tree.unknown) - edges.keys()
    apart = [name for name in branches if name not in linked or name in untied]
    refuse_unconnected_robots(cell, apart)
    if begun.ambiguous:
        raise ambiguous_error(cell, begun.ambiguous)
    cell = _without_frames(cell, apart)
    # Without their rows, the robots that saw nothing else are not linked either.
    while lone := [name for name in cell.tree.branches if name not in cell.connected_frames()]:
        cell, apart = _without_frames(cell, lone), [*apart, *lone]
    poses = tuple(chosen[row.view] for row in cell.rows)
    problem = problem_of(cell, poses)
    loose = tuple(name for name in apart if not branches[name].robot)
    return Start(cell, poses, problem, problem.start(edges), loose, solved)


def _is_start(solved: CellFit, cell: Cell) -> bool:
    """Whether a fit begins with what the one likelihood has found.

    Where many rows do not agree, something may have moved, which no single row shows. In a whole
    cell frames may have moved by less: only a board of another size is no less clear, with which
    the poses of no half of the rows agree otherwise.
    """
    is_pair, opened = cell.session.has_one_pair, solved.fit.unknowns.opened
    # Share from which a board is of another size: some sigma of a print that is as stated.
    is_sized = any(abs(share) > 5e-3 for share in scales_of(solved).values())
    is_still = not any(effect.place == "edge" for effect in opened)
    return bool(np.mean(solved.used) >= _MOST_AGREE) and (is_pair or (is_sized and is_still))


def _chosen(
    cell: Cell, problem: Problem, views: Sequence[ViewPoses], edges: Mapping[str, FloatArray]
) -> tuple[dict[int, ViewPoses], list[int]]:
    """The pose of each view that fits the frames, by view, and the views that are ambiguous.

    Raises:
        DegenerateError: The motion leaves most views ambiguous.
    """
    candidates = Candidates.of(
        [view.cam_from_target for view in views], [view.turns for view in views]
    )
    # The distances of views of unconnected frames have no meaning.
    frames = {name: edges.get(name, np.eye(4)) for name in problem.unknown}
    distances = candidates.distances(problem.predicted(problem.start(frames)))
    is_ambiguous = _ambiguous(problem, candidates, distances, edges)
    ambiguous = [view.view for view, is_one in zip(views, is_ambiguous, strict=True) if is_one]
    if len(ambiguous) > len(views) / 2:
        raise DegenerateError(
            f"pnp: {len(ambiguous)} of {len(views)} views allow two poses of the target that the "
            "robot's motion cannot distinguish.",
            culprits=[f"view {view}" for view in ambiguous],
            next_step="Add views tilted about different axes, or use a board without symmetry "
            "(ChArUco, or an odd sum of columns and rows).",
        )
    targets, picks = targets_of(cell), distances.argmin(axis=1).tolist()
    rows = zip(cell.rows, views, picks, strict=True)
    chosen = {row.view: view.chosen(pick, targets.get(row.seen)) for row, view, pick in rows}
    return chosen, ambiguous


def _ambiguous(
    problem: Problem, candidates: Candidates, distances: FloatArray, edges: Mapping[str, FloatArray]
) -> Mask:
    """(n,) whether another candidate is as likely as the nearest, by distances (n, k) [m]."""
    ordered, ambiguous = np.sort(distances, axis=1), np.zeros(len(distances), dtype=bool)
    best, second = ordered[:, 0], ordered[:, 1:].min(axis=1, initial=np.inf)
    untied = problem.unknown.keys() - edges.keys()
    for group in problem.groups:
        if not any(step.frame in untied for step in group.path):
            typical_m = max(float(np.median(best[group.rows])), float(np.median(best)))
            # Views that are far with any candidate are outliers.
            is_near = best < CLEAR_RATIO**2 * typical_m
            has_rival = second < CLEAR_RATIO * np.maximum(best, typical_m)
            ambiguous[group.rows] = (is_near & has_rival)[group.rows]
    poses = (candidates.valid & (candidates.turns == 0)).sum(axis=1)
    stated = {name for prior in problem.priors for name in (prior.first, prior.second)}
    for frame in edges.keys() - stated:
        rows = problem.observations.involves(frame)
        # Nothing else decides between the poses of a frame's only view.
        ambiguous |= rows & (rows.sum() == 1) & (poses > 1)
    return ambiguous


def targets_of(cell: Cell) -> dict[str, Target]:
    """The printed targets by their frames."""
    session = cell.session
    return {session.board_frames[name]: board for name, board in session.boards.items()}


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
    is_combined = cell.mount in MOUNTS and bool(is_given.any())
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
    if cell.session.has_one_pair:
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
