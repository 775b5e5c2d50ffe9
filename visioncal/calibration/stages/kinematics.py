"""The arm's errors that data determine: none, offsets, links, eccentric gears, any functions."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, Mask
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.estimation.arm import SIGNIFICANT, ArmErrors
from visioncal.estimation.armmodel import COMPLIANCE, WEIGHT, ArmModel
from visioncal.estimation.joint_functions import JointFunctions, find_joint_functions, most_orders
from visioncal.estimation.kinematics import (
    LEVELS,
    ArmTrials,
    LevelFit,
    fit_level,
    resized,
    without_springs,
)
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import robot_levels, starting_noise
from visioncal.results import Rms
from visioncal.results.arm import NOMINAL, ArmLevel, ArmResult, UnseenView
from visioncal.robot import Loads

# What a zero that was found from the target's poses is still off by, before the corners are asked,
# and the zeros of the other joints with it [rad].
_ZERO_SIGMA_RAD = 5e-4
# What may be asked for: the quick one after a lost encoder, or all that the data determine.
ASKED: Mapping[str, tuple[str, ...]] = {
    "offsets": ("offsets",),
    "kinematics": ("geometry", "eccentricity"),
    "elastic": ("elastic",),
    "thermal": tuple(LEVELS),
    "auto": tuple(LEVELS),
}
# The level of an arm whose joints err by functions of their angles; of fewer stops it is not asked.
FUNCTIONS, _FEWEST_STOPS = "functions", 20
# Those that ask for no level of the geometry.
_ALL = ("auto", "thermal")


@dataclass(frozen=True, eq=False)
class Kinematics:
    """The level of the arm's model that the views speak for.

    Attributes:
        level: Its name; `nominal` where none explains more than chance.
        fits: Those of all that were tried, the nominal arm's first.
        was_asked: Whether the user named the level.
        views: (m,) by which view each residual of these goes.
        functions: Of its joints; None where they are not beyond chance.
    """

    level: str
    fits: Mapping[str, LevelFit]
    was_asked: bool
    views: tuple[int, ...] = ()
    functions: JointFunctions | None = None

    @property
    def nominal(self) -> LevelFit:
        """The fit of the nominal arm."""
        return self.fits[NOMINAL]

    @property
    def errors(self) -> Mapping[str, ArmErrors]:
        """The arm's errors by block, as the level has them."""
        return self.fits[self.level].errors

    def left_out(self) -> tuple[UnseenView, ...]:
        """How far stops that are left out in turn are off by both arms, by view."""
        before, after = (
            np.linalg.norm(level_fit.left_out.reshape(-1, 2, 3), axis=2)
            for level_fit in (self.nominal, self.fits[self.level])
        )
        return unseen_views(self.views, before, after, self.nominal.has_rotation)

    @cached_property
    def result(self) -> ArmResult:
        """The levels that were compared, as a section of a calibration."""
        return ArmResult(level=self.level, levels=tuple(map(_level, self.fits, self.fits.values())))


def unseen_views(
    views: Sequence[int], before: FloatArray, after: FloatArray, turned: Mask
) -> tuple[UnseenView, ...]:
    """How far views that no fit has seen are off by the nominal arm and by the calibrated.

    Args:
        views: (m,) the views.
        before: (m, 2) by the one, rotation [rad] and distance [m].
        after: (m, 2) by the other.
        turned: (m,) whether a rotation was measured.
    """
    columns = zip(views, before.tolist(), after.tolist(), turned.tolist(), strict=True)
    return tuple(
        UnseenView(
            view=view,
            nominal_mm=1e3 * was_m,
            mm=1e3 * now_m,
            nominal_deg=np.rad2deg(was_rad).item() if has_rotation else None,
            deg=np.rad2deg(now_rad).item() if has_rotation else None,
        )
        for view, (was_rad, was_m), (now_rad, now_m), has_rotation in columns
    )


def choose_level(
    problem: Problem,
    state: State,
    robot: str,
    bases: Mapping[str, FloatArray],
    asked: str,
    stated: Problem | None = None,
    noise: Noise | None = None,
) -> Kinematics:
    """Chooses how much of a robot's arm to free.

    A level is taken where it is likelier than all others by more than chance, with the price of its
    unknowns in the likelihood, and predicts stops that are left out better than the nominal arm.

    Args:
        problem: The observations, without errors of this arm.
        state: The answer with the nominal arm.
        robot: The robot.
        bases: (s, 6, p) by stop, how the flange moves with the errors of each block.
        asked: A key of `ASKED`.
        stated: The same observations with a lost zero where the model has it, where `problem` has
            it where it is; None where none is lost. Then offsets are what is taken at the least.
        noise: The noise's levels to start from; those from above where None.
    """
    with one_blas_thread():
        arm = ArmTrials(problem, state, robot, bases, noise)
        fits = {NOMINAL: fit_level(arm)}
        fits |= {name: fit_level(arm, blocks) for name, blocks in LEVELS.items()}
        if stated is not None:
            nominal = fit_level(ArmTrials(stated, state, robot, bases, noise))
            fits = _with_lost_zero(fits, problem, stated, nominal, bases)
    found = {name: fit for name, fit in fits.items() if fit is not None}
    least = (NOMINAL,) if stated is None else (NOMINAL, "offsets")
    best = _best(
        {name: level_fit for name, level_fit in found.items() if name in (*least, *ASKED[asked])}
    )
    with one_blas_thread():
        found[best] = resized(arm, found[best])
    return Kinematics(best, found, asked not in _ALL)


def with_functions(
    found: Kinematics,
    problem: Problem,
    state: State,
    robot: str,
    model: ArmModel,
    stops: tuple[FloatArray, FloatArray, Loads],
    noise: Noise,
) -> Kinematics:
    """Takes functions of the joints to a level of the geometry, where they are beyond chance.

    Args:
        found: What `choose_level` gave.
        problem: The observations, without errors of this arm.
        state: Where to start.
        robot: The robot.
        model: The arm as stated.
        stops: (s, m) which of the robot's m places each stop is at, (m, n) its joints and its loads
            there.
        noise: The noise's levels to start from.
    """
    placed, q, loads = stops
    count = model.nominal.joint_count
    names = [*dict.fromkeys(["links", "eccentricity", *found.errors])]
    names += [COMPLIANCE if model.functions is None else WEIGHT]
    bases = {
        name: np.tensordot(placed, model.columns(name, q, loads), axes=1)
        for name in dict.fromkeys(names)
        if name != "offsets"
    }
    harmonics = model.robot.harmonic_jacobian(q, most_orders()).reshape(len(q), -1)
    harmonics = (placed @ harmonics).reshape(len(placed), 6, count, -1, 2)
    with one_blas_thread():
        functions = find_joint_functions(
            problem, state, noise, robot, bases, harmonics, model.torque_nm
        )
        if functions is None:
            return found
        noise = replace(noise, robots=functions.levels)
        arm = ArmTrials(problem, state, robot, bases, noise)
        fit = arm.level(without_springs(arm, functions.errors), functions.gain)
    return replace(
        found,
        level=FUNCTIONS,
        fits={**found.fits, FUNCTIONS: fit},
        functions=functions,
    )


def _with_lost_zero(
    fits: Mapping[str, LevelFit | None],
    problem: Problem,
    stated: Problem,
    nominal: LevelFit | None,
    bases: Mapping[str, FloatArray],
) -> dict[str, LevelFit | None]:
    """The levels beside the arm as it was stated, with what the zero explains in all others."""
    zeroed = fits[NOMINAL]
    if nominal is None or zeroed is None:
        return dict(fits)
    gain = 2.0 * (_unlikeliness(stated, nominal) - _unlikeliness(problem, zeroed))
    found = {
        name: None if fit is None else replace(fit, gain=fit.gain + gain)
        for name, fit in fits.items()
    }
    if found["offsets"] is None:
        errors = ArmErrors(bases["offsets"], _ZERO_SIGMA_RAD, gain, of_links=True)
        found["offsets"] = replace(zeroed, errors={"offsets": errors}, gain=gain)
    return found | {NOMINAL: nominal}


def _unlikeliness(problem: Problem, fit: LevelFit) -> float:
    return robot_levels(problem, fit.fit.state, starting_noise(problem), from_above=True)[1]


def _best(fits: Mapping[str, LevelFit]) -> str:
    """The likeliest level that predicts better than the first one, by more than chance each."""
    # The price of all its columns is in a level's likelihood, but for that of their size. Of two
    # levels with as many sizes, such as offsets or links, neither is the simpler one: to prefer
    # offsets would leave links that are off by as little out of the covariance.
    best, *others = fits
    off_mm = {name: _rms(fit.left_out, fit.has_rotation).mm for name, fit in fits.items()}
    nominal_mm = off_mm[best]
    for name in others:
        more_sizes = len(fits[name].errors) > len(fits[best].errors)
        margin = SIGNIFICANT if more_sizes else 0.0
        if off_mm[name] < nominal_mm and fits[name].gain - fits[best].gain > margin:
            best = name
    return best


def _level(name: str, fit: LevelFit) -> ArmLevel:
    """Writes a fit as figures."""
    inside, left_out = (_rms(array, fit.has_rotation) for array in (fit.inside, fit.left_out))
    return ArmLevel(
        level=name,
        unknowns=fit.size,
        rms_mm=inside.mm,
        rms_deg=inside.deg,
        held_out_mm=left_out.mm,
        held_out_deg=left_out.deg,
        likelihood_ratio=fit.gain,
    )


def _rms(residuals: FloatArray, turned: Mask) -> Rms:
    turns, shifts = (
        np.sum(array**2, axis=1) for array in (residuals[turned, :3], residuals[:, 3:])
    )
    deg = float(np.rad2deg(np.sqrt(np.mean(turns)))) if turned.any() else None
    return Rms(mm=1e3 * float(np.sqrt(np.mean(shifts))), deg=deg)


def allows_functions(asked: str, stops: int) -> bool:
    """Whether so many stops may determine functions of the joints at a level that is asked for."""
    return asked not in ("offsets", "hand-eye") and stops >= _FEWEST_STOPS


def check_level(asked: str) -> None:
    """Refuses a level that is none.

    Raises:
        DataError: It is not known.
    """
    levels = (*ASKED, "hand-eye")
    if asked not in levels:
        raise DataError(f"level {asked!r} is not one of {', '.join(levels)}.", culprits=["level"])


def check_asked(asked: str, *, can: bool, misread: str = "") -> None:
    """Refuses a level that the session cannot give.

    Args:
        asked: The level.
        can: Whether there are joint angles that belong to the robot's model and poses.
        misread: What is wrong with those that there are, and what to do.

    Raises:
        DataError: There are no joint angles that belong to a known model.
    """
    if asked in ("offsets", "kinematics", "elastic") and not can:
        raise DataError(
            f"level {asked!r} needs the joint angles of every view and a model of the robot that "
            "they belong to.",
            culprits=["level"],
            next_step=misread or "Record q1_rad ..., and name [robot] model in session.toml.",
        )


def doubts(kinematics: Kinematics) -> Iterator[Finding]:
    """Says where another level explains the views far better than the one that was asked for."""
    chosen, likeliest = kinematics.result.chosen, _best(kinematics.fits)
    best = replace(kinematics.result, level=likeliest).chosen
    if best.likelihood_ratio - chosen.likelihood_ratio > SIGNIFICANT:
        yield Finding(
            "level",
            f"The views speak for more than the arm's {chosen.level}: with its {best.level} stops "
            f"left out are predicted to {figure(best.held_out_mm)} mm instead of "
            f"{figure(chosen.held_out_mm)} mm.",
            Remedy("Leave --level out.", CALIBRATE),
        )


def findings(kinematics: Kinematics) -> Iterator[str]:
    """Says what was found, for the verdict."""
    if kinematics.level == NOMINAL and kinematics.was_asked:
        yield (
            "The arm stays as stated: what was asked to be found of it explains the views no "
            "better than chance, or there are too few stops to show it."
        )
    found = kinematics.result
    if found.is_calibrated:
        yield (
            f"The arm was calibrated along ({found.level}): stops left out are predicted to "
            f"{figure(found.chosen.held_out_mm)} mm, with the nominal arm to "
            f"{figure(found.nominal.held_out_mm)} mm. The transforms go with this arm: take its "
            "poses (calibration.base_from_flange), not the controller's."
        )
