"""An arm's own errors as unknowns of the chain: offsets of its joints, its links, its gears.

Every effect is a set of columns: how the flange moves with it at each stop. All columns are
carried, however redundant, as random effects of one size a block, which restricted likelihood
estimates: what the data cannot determine stays as stated, and what they can is estimated at its
bound (Harville 1977, section 4, for the linear mixed model).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.arm import SIGNIFICANT, ArmErrors, find_arm_errors, rows_of
from visioncal.estimation.armmodel import BACKLASH, COMPLIANCE, WEIGHT
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import (
    RobotLikelihood,
    Solution,
    fit_problem,
    left_out_residuals,
    robot_likelihood,
)


@dataclass(frozen=True)
class Blocks:
    """What is free at a level.

    Attributes:
        names: Blocks of the arm's errors, in the order in which they are looked for.
        own: Those that make the level what it is: without one of them it is another.
    """

    names: tuple[str, ...]
    own: tuple[str, ...]


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
    """The fit with the errors of one level of a robot's arm free.

    Attributes:
        errors: The errors by block; empty for the arm as stated.
        fit: The unknowns and the noise.
        gain: Twice the gain in log-likelihood over the arm as stated.
        inside: (m, 6) residuals of the robot's observations (rotation [rad], translation [m]).
        left_out: (m, 6) the same of each stop from a fit without it, to first order.
        has_rotation: (m,) which of them say anything of a rotation.
    """

    errors: Mapping[str, ArmErrors]
    fit: Solution
    gain: float
    inside: FloatArray
    left_out: FloatArray
    has_rotation: Mask

    @property
    def size(self) -> int:
        """How many columns are carried."""
        return sum(error.basis.shape[2] for error in self.errors.values())


@dataclass(frozen=True, eq=False)
class ArmTrials:
    """Fits with errors of one robot's arm, each made once: levels begin with the same blocks.

    Attributes:
        problem: The observations, without errors of this arm.
        state: Where to start.
        robot: The robot.
        bases: (s, 6, p) by stop, columns of each block of errors by its name.
        noise: The noise's levels to start from; those from above where None.
    """

    problem: Problem
    state: State
    robot: str
    bases: Mapping[str, FloatArray]
    noise: Noise | None = None
    _fits: dict[tuple[ArmErrors, ...], Solution] = field(default_factory=dict)
    _likely: dict[tuple[ArmErrors, ...], RobotLikelihood] = field(default_factory=dict)
    _found: dict[tuple[int, float, tuple[ArmErrors, ...]], ArmErrors | None] = field(
        default_factory=dict
    )

    def erring(self, errors: Mapping[str, ArmErrors]) -> Problem:
        """The observations with errors of the arm among the unknowns."""
        effects = [error.effect(self.robot, name) for name, error in errors.items()]
        return self.problem.with_effects([*self.problem.effects, *effects])

    def fitted(self, errors: Mapping[str, ArmErrors]) -> Solution:
        """The fit of that."""
        key = tuple(errors.values())
        if key not in self._fits:
            problem, fewer = self.erring(errors), self._fits.get(key[:-1])
            state, noise = (self.state, self.noise) if fewer is None else (fewer.state, fewer.noise)
            if len(added := problem.start_values[len(state.values) :]):
                state = State(state.edges, np.concatenate([state.values, added]))
            self._fits[key] = fit_problem(problem, state, noise)
        return self._fits[key]

    def found(
        self, among: Mapping[str, ArmErrors], basis: FloatArray, least: float = 0.0
    ) -> ArmErrors | None:
        """Looks for errors of one more block that gain more than the least.

        Its columns stay as long as this.
        """
        known = tuple(among.values())
        key = id(basis), least, known
        if key not in self._found:
            fit = self.fitted(among)
            if known not in self._likely:
                self._likely[known] = robot_likelihood(self.erring(among), fit.state, fit.noise)
            place = self.problem.robots.index(self.robot)
            self._found[key] = find_arm_errors(
                self._likely[known], place, basis, of_links=True, least=least
            )
        return self._found[key]

    def level(self, errors: Mapping[str, ArmErrors], gain: float) -> LevelFit:
        """Puts a level's fit together."""
        problem, fit = self.erring(errors), self.fitted(errors)
        mine = rows_of(problem, self.robot)
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
            problem.linear(fit.state).residuals[mine],
            left_out_residuals(problem, fit.state, fit.noise, mine)[mine],
            np.array(rotation, dtype=bool)[mine],
        )


def fit_level(arm: ArmTrials, blocks: Blocks = _RIGID) -> LevelFit | None:
    """Fits all unknowns with some blocks of the errors of one robot's arm free.

    Args:
        arm: The observations, and what of the arm they may show.
        blocks: Those to free; those that explain no more than chance stay out.

    Returns:
        The fit; None where nothing beyond chance makes it this level.
    """
    if blocks.own and not arm.bases.keys() & set(blocks.own):
        return None
    errors: dict[str, ArmErrors] = {}
    gain, count = 0.0, -1
    # What large errors of another block hid shows once these are free.
    while len(errors) > count:
        count = len(errors)
        for name in (name for name in blocks.names if name in arm.bases and name not in errors):
            found = arm.found(errors, arm.bases[name], SIGNIFICANT)
            if found is not None:
                gain += found.gain
                errors = without_springs(arm, errors | {name: found})
    if blocks.own and not errors.keys() & set(blocks.own):
        return None
    return arm.level(errors, gain)


def resized(arm: ArmTrials, fit: LevelFit) -> LevelFit:
    """Estimates the size of each block's errors anew, beside those of all others.

    They were looked for one after the other: what explains the most takes too much at first.
    """
    if len(fit.errors) < 2:
        return fit
    errors = dict(fit.errors)
    for name, error in fit.errors.items():
        others = {other: errors[other] for other in errors if other != name}
        errors[name] = arm.found(others, error.basis) or error
    return arm.level(errors, fit.gain)


def without_springs(arm: ArmTrials, errors: Mapping[str, ArmErrors]) -> dict[str, ArmErrors]:
    """Holds joints rigid that would yield against their load: the bound of a compliance is zero.

    An active set that only grows (Lawson and Hanson 1974, chapter 23, has the way back too, which
    columns that hardly lean on one another do not need).
    """
    kept = dict(errors)
    while COMPLIANCE in kept:
        springs = kept[COMPLIANCE]
        name = springs.effect(arm.robot, COMPLIANCE).name
        bends = arm.erring(kept).values_of(name, arm.fitted(kept).state)
        if not (bends < 0.0).any():
            break
        kept[COMPLIANCE] = replace(springs, basis=springs.basis * (bends >= 0.0))
    return kept
