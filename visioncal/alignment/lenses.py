"""Lenses and boards of a whole cell, fitted with its frames: what is free of them, and how far."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.effects.lenses import Looks, Seen
from visioncal.estimation.joint import Fitted, settle
from visioncal.estimation.outliers import Agreed
from visioncal.estimation.problem import Effect, Noise, Problem
from visioncal.estimation.scene import CornerProblem, repeat_shares
from visioncal.stages.arms import RobotArm, effects_of
from visioncal.stages.cell import Cell
from visioncal.stages.observed import Observed
from visioncal.stages.pnp import ViewPoses
from visioncal.stages.refine import refined
from visioncal.types import Corners, FloatArray


@dataclass(frozen=True, eq=False)
class CellSide:
    """The frames' side of the fit of a whole cell; see `joint.Side`.

    Attributes:
        cell: The cell.
        agreed: What its fit uses, and where it stands.
        arms: The robots' arms, and which of their errors were found.
        effects: All effects but lenses, boards and arms.
        freely: Whether all errors that were found are free, and not those alone that are estimated.
    """

    cell: Cell
    agreed: Agreed
    arms: Mapping[str, RobotArm]
    effects: Sequence[Effect]
    freely: bool = False

    @property
    def errors(self) -> tuple[ArmErrors, ...]:
        """The errors of arms that were found."""
        return tuple(it.errors for it in self.arms.values() if it.errors is not None)

    @property
    def has_errors(self) -> bool:
        """Whether errors of an arm are free."""
        return any(it.effects(freely=self.freely) for it in self.arms.values())

    @property
    def has_links(self) -> bool:
        """Whether those of an arm's own links are."""
        return self.has_errors and any(it.of_links for it in self.errors)

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
        arms = effects_of(self.arms, freely=self.freely)
        effects = [seen.effect(rows), *self.effects, *arms]
        return replace(problem, observations=observed).with_effects(effects)

    def with_errors(self, fitted: Fitted) -> Self:
        """Looks for errors of the arms; see `joint.Side`."""
        free = {name for name, it in self.arms.items() if it.effects(freely=self.freely)}
        arms = {
            name: it if name in free else it.with_errors(fitted.problem, fitted.fit)
            for name, it in self.arms.items()
        }
        return replace(self, arms=arms)

    def freed(self, *, freely: bool) -> Self:
        """Frees errors of the arms; see `joint.Side`."""
        return replace(self, freely=freely)

    def settled(self, fitted: Fitted) -> tuple[Agreed, Seen]:
        """Takes over a fit."""
        agreed = replace(self.agreed, problem=self.whole(fitted.seen), fit=fitted.fit)
        return agreed, fitted.seen


def with_looks(
    cell: Cell,
    looked: Observed,
    views: Sequence[ViewPoses],
    agreed: Agreed,
    arms: Mapping[str, RobotArm],
    others: Sequence[Effect],
) -> tuple[Agreed, Seen, Mapping[str, RobotArm]]:
    """Fits lenses and boards with the rest, with errors of the arms and with other effects."""
    looks = _looks(looked, views, _shares(cell, agreed))
    side = CellSide(cell, agreed, arms, others)
    fitted, side = refined(side, looks, side.frames)
    return *side.settled(fitted), side.arms


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
    cell: Cell,
    seen: Seen,
    agreed: Agreed,
    arms: Mapping[str, RobotArm],
    others: Sequence[Effect],
) -> tuple[Agreed, Seen]:
    """Linearises corners and fits the cell in turn, until lenses and boards stay."""
    side = CellSide(cell, agreed, arms, others)
    return side.settled(settle(seen.looks, side, seen.moving, side.frames))
