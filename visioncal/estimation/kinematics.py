"""Fits of the chain with an arm's errors as unknowns: joint offsets, links, gears, compliance.

Every effect is a set of columns: the flange's Jacobian at each stop. All columns are carried,
however redundant, as random effects of one size per block, which restricted likelihood estimates:
what the data do not determine stays nominal, and the rest is estimated at its bound (Harville 1977,
section 4, for the linear mixed model).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.arm import SIGNIFICANT, ArmErrors, find_arm_errors, rows_of
from visioncal.estimation.armmodel import BACKLASH, COMPLIANCE, WEIGHT
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import (
    RobotLikelihood,
    robot_likelihood,
)
from visioncal.estimation.solve import (
    Solution,
    fit_problem,
    left_out_residuals,
)


@dataclass(frozen=True)
class Blocks:
    """Free blocks of errors at a level."""

    names: tuple[str, ...]  # Blocks of the arm's errors, in the order of the search.
    own: tuple[str, ...]  # Blocks that define the level: without any of them it is another.


LEVELS: Mapping[str, Blocks] = MappingProxyType(
    {
        "backlash": Blocks((BACKLASH,), (BACKLASH,)),
        "offsets": Blocks(("offsets", BACKLASH), ("offsets",)),
        "geometry": Blocks(("links", BACKLASH), ("links",)),
        "eccentricity": Blocks(
            ("links", "eccentricity", "ratios", BACKLASH), ("eccentricity", "ratios")
        ),
        "elastic": Blocks(
            ("links", COMPLIANCE, WEIGHT, "eccentricity", "ratios", BACKLASH), (COMPLIANCE, WEIGHT)
        ),
    }
)
_RIGID = Blocks((), ())


@dataclass(frozen=True, eq=False)
class LevelFit:
    """Fit with the errors of one level of a robot's arm free."""

    errors: Mapping[str, ArmErrors]  # The errors by block; empty for the nominal arm.
    fit: Solution
    gain: float  # Twice the gain in log-likelihood over the nominal arm.
    # (m, 6) residuals of the robot's observations (rotation [rad], translation [m]).
    inside: FloatArray
    left_out: FloatArray  # (m, 6) leave-one-out residuals of each stop, to first order.
    has_rotation: Mask  # (m,) which observations include a rotation.

    @property
    def size(self) -> int:
        """Number of columns."""
        return sum(error.basis.shape[2] for error in self.errors.values())


@dataclass(frozen=True, eq=False)
class ArmTrials:
    """Cached fits with errors of one robot's arm: levels begin with the same blocks."""

    problem: Problem  # The observations, without errors of this arm.
    state: State
    robot: str
    # (s, 6, p) by stop, columns of each block of errors by its name.
    bases: Mapping[str, FloatArray]
    noise: Noise | None = None  # Starts of the noise levels; default starts where None.
    _fits: dict[tuple[ArmErrors, ...], Solution] = field(default_factory=dict)
    _likely: dict[tuple[ArmErrors, ...], RobotLikelihood] = field(default_factory=dict)
    _found: dict[tuple[int, float, tuple[ArmErrors, ...]], ArmErrors | None] = field(
        default_factory=dict
    )

    def erring(self, errors: Mapping[str, ArmErrors]) -> Problem:
        """The problem with errors of the arm among the unknowns."""
        effects = [error.effect(self.robot, name) for name, error in errors.items()]
        return self.problem.with_effects([*self.problem.effects, *effects])

    def fitted(self, errors: Mapping[str, ArmErrors]) -> Solution:
        """The fit with some errors of the arm."""
        key = tuple(errors.values())
        if key not in self._fits:
            problem, base = self.erring(errors), self._fits.get(key[:-1])
            state, noise = (self.state, self.noise) if base is None else (base.state, base.noise)
            if len(added := problem.start_values[len(state.values) :]):
                state = State(state.edges, np.concatenate([state.values, added]))
            self._fits[key] = fit_problem(problem, state, noise)
        return self._fits[key]

    def found(
        self, among: Mapping[str, ArmErrors], basis: FloatArray, least: float = 0.0
    ) -> ArmErrors | None:
        """Estimates the size of one more block's errors; None unless they gain more than `least`.

        The basis must outlive this object.
        """
        present = tuple(among.values())
        key = id(basis), least, present
        if key not in self._found:
            fit = self.fitted(among)
            if present not in self._likely:
                self._likely[present] = robot_likelihood(self.erring(among), fit.state, fit.noise)
            index = self.problem.robots.index(self.robot)
            self._found[key] = find_arm_errors(
                self._likely[present], index, basis, of_links=True, min_gain=least
            )
        return self._found[key]

    def level(self, errors: Mapping[str, ArmErrors], gain: float) -> LevelFit:
        """Assembles a level's fit."""
        problem, fit = self.erring(errors), self.fitted(errors)
        rows = rows_of(problem, self.robot)
        rotation = [
            has and name not in problem.points
            for has, name in zip(
                problem.observations.has_rotation, problem.observations.observed, strict=True
            )
        ]
        return LevelFit(
            errors,
            fit,
            gain,
            problem.linear(fit.state).residuals[rows],
            left_out_residuals(problem, fit.state, fit.noise, rows)[rows],
            np.array(rotation, dtype=bool)[rows],
        )


def fit_level(arm: ArmTrials, blocks: Blocks = _RIGID) -> LevelFit | None:
    """Fits all unknowns with some blocks of the errors of one robot's arm free.

    Blocks that are not significant stay out; None where no block that defines the level is.
    """
    if blocks.own and not arm.bases.keys() & set(blocks.own):
        return None
    errors: dict[str, ArmErrors] = {}
    gain, count = 0.0, -1
    # Errors hidden by large ones of another block show once these are free.
    while len(errors) > count:
        count = len(errors)
        for name in (name for name in blocks.names if name in arm.bases and name not in errors):
            block_errors = arm.found(errors, arm.bases[name], SIGNIFICANT)
            if block_errors is not None:
                gain += block_errors.gain
                errors = without_springs(arm, errors | {name: block_errors})
    if blocks.own and not errors.keys() & set(blocks.own):
        return None
    return arm.level(errors, gain)


def resized(arm: ArmTrials, fit: LevelFit) -> LevelFit:
    """Re-estimates the size of each block's errors beside those of all others.

    They were found one after the other: the first takes a part of those that follow.
    """
    if len(fit.errors) < 2:
        return fit
    errors = dict(fit.errors)
    for name, error in fit.errors.items():
        others = {other: errors[other] for other in errors if other != name}
        errors[name] = arm.found(others, error.basis) or error
    return arm.level(errors, fit.gain)


def without_springs(arm: ArmTrials, errors: Mapping[str, ArmErrors]) -> dict[str, ArmErrors]:
    """Holds joints rigid whose fitted compliance is negative: its bound is zero.

    An active set that only grows (Lawson and Hanson 1974, chapter 23, can also release constraints,
    which weakly correlated columns do not need).
    """
    kept = dict(errors)
    while COMPLIANCE in kept:
        block = kept[COMPLIANCE]
        name = block.effect(arm.robot, COMPLIANCE).name
        compliances = arm.erring(kept).values_of(name, arm.fitted(kept).state)
        if not (compliances < 0.0).any():
            break
        kept[COMPLIANCE] = replace(block, basis=block.basis * (compliances >= 0.0))
    return kept
