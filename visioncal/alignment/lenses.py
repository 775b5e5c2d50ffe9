"""Lenses and boards of a whole cell, fitted with its frames: what is free of them, and how far."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.alignment.cell import Cell
from visioncal.estimation.effects.lenses import Looks, Seen
from visioncal.estimation.joint import Fitted, settle
from visioncal.estimation.outliers import Agreed
from visioncal.estimation.problem import Effect, Noise, Problem
from visioncal.estimation.scene import CornerProblem, repeat_shares
from visioncal.stages.observed import Observed
from visioncal.stages.pnp import ViewPoses
from visioncal.stages.refine import chosen
from visioncal.types import Corners, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class CellSide:
    """The frames' side of the fit of a whole cell; see `joint.Side`.

    Attributes:
        cell: The cell.
        agreed: What its fit uses, and where it stands.
        effects: All effects but lenses and boards.
    """

    cell: Cell
    agreed: Agreed
    effects: Sequence[Effect]

    # Boards' scales are free from the start: arms' errors are no reason to hold them.
    has_errors = has_links = False

    @property
    def noise(self) -> Noise:
        """The levels of the fit so far."""
        return self.agreed.fit.noise

    @property
    def frames(self) -> Mapping[str, FloatArray]:
        """Where the unknown frames are."""
        agreed = self.agreed
        return dict(zip(agreed.problem.unknown, agreed.fit.state.edges, strict=True))

    def problem(self, seen: Seen) -> Problem:
        """The problem of the observations that agree, repeated ones sharing an error."""
        return replace(self.whole(seen), with_repeats=True).subset(self.agreed.used)

    def whole(self, seen: Seen) -> Problem:
        """The problem of all observations, with poses as lenses and boards make them."""
        places = {view: at for at, view in enumerate(seen.views)}
        rows = np.array([places.get(it.view, -1) for it in self.cell.rows], dtype=np.int64)
        mine, problem = rows >= 0, self.agreed.problem
        measured, spread = (
            it.copy() for it in (problem.observations.measured, problem.observations.covariance)
        )
        measured[mine], spread[mine] = seen.looks.poses[rows[mine]], seen.spread[rows[mine]]
        observed = replace(problem.observations, measured=measured, covariance=spread)
        effects = [seen.effect(rows), *self.effects]
        return replace(problem, observations=observed).with_effects(effects)

    def settled(self, fitted: Fitted) -> tuple[Agreed, Seen]:
        """Takes over a fit."""
        agreed = replace(self.agreed, problem=self.whole(fitted.seen), fit=fitted.fit)
        return agreed, fitted.seen


def with_looks(
    cell: Cell,
    looked: Observed,
    views: Sequence[ViewPoses],
    agreed: Agreed,
    others: Sequence[Effect],
) -> tuple[Agreed, Seen]:
    """Fits lenses and boards with the rest, and with other effects."""
    side = CellSide(cell, agreed, others)
    looks = _looks(looked, views, _shares(cell, agreed))
    return side.settled(chosen(side, settle(looks, side, looks.first, side.frames)))


def _shares(cell: Cell, agreed: Agreed) -> dict[int, float]:
    """As how much of a view each row counts for lenses and boards; see `repeat_shares`."""
    observations, tree = agreed.problem.observations, agreed.problem.tree
    pairs = list(zip(observations.observers, observations.observed, strict=True))
    parted = {it: any(step.robot for step in tree.path(*it)) for it in set(pairs)}
    return repeat_shares(
        {
            row.view: (pair, row.station if parted[pair] else None)
            for row, pair in zip(cell.rows, pairs, strict=True)
        }
    )


def _looks(looked: Observed, views: Sequence[ViewPoses], shares: Mapping[int, float]) -> Looks:
    known = {**looked.poses, **{it.view: it for it in views}}
    problems, poses = {}, {}
    for name, scene in looked.scenes.items():
        mine = [known[it] for it in looked.cameras[name].corners if it in known]
        corners: dict[int, Corners] = {
            view.view: view.corners
            for view in mine
            if view.corners is not None and view.view not in looked.held_back
        }
        problems[name] = CornerProblem.of(scene, corners, shares)
        poses[name] = np.array([known[it].cam_from_target[0] for it in corners])
    return Looks.of(problems, poses)


def settled_looks(
    cell: Cell, looks: Looks, moving: IntArray, agreed: Agreed, others: Sequence[Effect]
) -> tuple[Agreed, Seen]:
    """Linearises corners and fits the cell in turn, until lenses and boards stay."""
    side = CellSide(cell, agreed, others)
    return side.settled(settle(looks, side, moving, side.frames))
