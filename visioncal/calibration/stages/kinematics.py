"""Selection of the arm's error model: none, offsets, links, eccentric gears, joint functions."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import figure, listed
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
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.solve import (
    robot_levels,
    starting_noise,
)
from visioncal.results import Rms
from visioncal.results.arm import NOMINAL, ArmLevel, ArmResult, UnseenView
from visioncal.robot import Loads

# Prior sigma of a zero that was found from the target's poses, and of the other joints' zeros
# [rad].
_ZERO_SIGMA_RAD = 5e-4
# Levels by what the user asks for: the quick one after a lost encoder, or all that the data
# determine.
ASKED: Mapping[str, tuple[str, ...]] = {
    "offsets": ("offsets",),
    "kinematics": ("geometry", "eccentricity"),
    "elastic": ("elastic",),
    "thermal": tuple(LEVELS),
    "auto": tuple(LEVELS),
}
# The level with joint errors that are functions of their angles, and the fewest stops for it.
FUNCTIONS, _FEWEST_STOPS = "functions", 20
# Requests that leave the level of the geometry to the data.
_AUTOMATIC = ("auto", "thermal")


@dataclass(frozen=True, eq=False)
class SelectedArmLevel:
    """The level of the arm's model that the views support."""

    level: str  # Its name; `nominal` where none explains more than chance.
    fits: Mapping[str, LevelFit]  # All fits, the nominal arm's first.
    was_asked: bool  # Whether the user named the level.
    views: tuple[int, ...] = ()  # (m,) the view of each residual of these.
    # Functions of the joints; None where these are not significant.
    functions: JointFunctions | None = None
    diverged: tuple[str, ...] = ()  # Levels whose fits diverged, so that they were not compared.

    @property
    def nominal(self) -> LevelFit:
        """The fit of the nominal arm."""
        return self.fits[NOMINAL]

    @property
    def errors(self) -> Mapping[str, ArmErrors]:
        """The arm's errors by block, at this level."""
        return self.fits[self.level].errors

    def left_out(self) -> tuple[UnseenView, ...]:
        """Residuals of held-out stops with both arms, by view."""
        before, after = (
            np.linalg.norm(level_fit.left_out.reshape(-1, 2, 3), axis=2)
            for level_fit in (self.nominal, self.fits[self.level])
        )
        return unseen_views(self.views, before, after, self.nominal.has_rotation)

    @cached_property
    def result(self) -> ArmResult:
        """The compared levels, as a section of a calibration."""
        return ArmResult(level=self.level, levels=tuple(map(_level, self.fits, self.fits.values())))


def unseen_views(
    views: Sequence[int], before: FloatArray, after: FloatArray, turned: Mask
) -> tuple[UnseenView, ...]:
    """Residuals of held-out views with the nominal arm (`before`) and with the calibrated one.

    Both are (m, 2), rotation [rad] and distance [m]; `turned` is whether a rotation was measured.
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
) -> SelectedArmLevel:
    """Selects the level of a robot's arm model.

    A level is chosen if its likelihood, with a penalty for its unknowns, exceeds the others' by
    more than chance, and it predicts held-out stops better than the nominal arm.

    Args:
        problem: The observations, without errors of this arm.
        state: The solution with the nominal arm.
        robot: The robot.
        bases: (s, 6, p) Jacobian of the flange pose by stop, for the errors of each block.
        asked: A key of `ASKED`.
        stated: The observations with zeros as in the model, where `problem` has a shifted zero
            corrected; None without one. Then offsets are the least level.
        noise: The noise's levels to start from; those from above where None.
    """
    diverged: list[str] = []

    def converged(name: str, fit: Callable[[], LevelFit | None]) -> LevelFit | None:
        """The fit of a level; None, and noted, where it diverges."""
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                return fit()
        except np.linalg.LinAlgError:
            diverged.append(name)
            return None

    with one_blas_thread():
        arm = ArmTrials(problem, state, robot, bases, noise)
        fits = {NOMINAL: fit_level(arm)}
        for name, blocks in LEVELS.items():
            fits[name] = converged(name, partial(fit_level, arm, blocks))
        if stated is not None:
            nominal = fit_level(ArmTrials(stated, state, robot, bases, noise))
            fits = _with_shifted_zero(fits, problem, stated, nominal, bases)
    possible = {name: fit for name, fit in fits.items() if fit is not None}
    always = (NOMINAL,) if stated is None else (NOMINAL, "offsets")
    allowed = (*always, *ASKED[asked])
    final = None
    while final is None:
        best = _best({name: fit for name, fit in possible.items() if name in allowed})
        # The nominal arm has nothing to resize, and ends this at the latest.
        with one_blas_thread():
            final = converged(best, partial(resized, arm, possible.pop(best)))
    fits = {name: final if name == best else possible.get(name) for name in fits}
    compared = {name: fit for name, fit in fits.items() if fit is not None}
    return SelectedArmLevel(best, compared, asked not in _AUTOMATIC, diverged=tuple(diverged))


def with_functions(
    found: SelectedArmLevel,
    problem: Problem,
    state: State,
    robot: str,
    model: ArmModel,
    stops: tuple[FloatArray, FloatArray, Loads],
    noise: Noise,
) -> SelectedArmLevel:
    """Adds functions of the joints to a level of the geometry, where they are significant.

    Args:
        found: The result of `choose_level`.
        problem: The observations, without errors of this arm.
        state: The start.
        robot: The robot.
        model: The nominal arm.
        stops: (s, m) incidence of the problem's stops and the robot's m places; (m, n) joints and
            loads at the latter.
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
    fits = {**found.fits, FUNCTIONS: fit}
    return replace(found, level=FUNCTIONS, fits=fits, functions=functions)


def _with_shifted_zero(
    fits: Mapping[str, LevelFit | None],
    problem: Problem,
    stated: Problem,
    nominal: LevelFit | None,
    bases: Mapping[str, FloatArray],
) -> dict[str, LevelFit | None]:
    """The levels beside the nominal arm, each with the gain of the shifted zero."""
    zeroed = fits[NOMINAL]
    if nominal is None or zeroed is None:
        return dict(fits)
    gain = 2.0 * (_neg_log_likelihood(stated, nominal) - _neg_log_likelihood(problem, zeroed))
    with_gain = {name: fit and replace(fit, gain=fit.gain + gain) for name, fit in fits.items()}
    if with_gain["offsets"] is None:
        errors = ArmErrors(bases["offsets"], _ZERO_SIGMA_RAD, gain, of_links=True)
        with_gain["offsets"] = replace(zeroed, errors={"offsets": errors}, gain=gain)
    return with_gain | {NOMINAL: nominal}


def _neg_log_likelihood(problem: Problem, fit: LevelFit) -> float:
    return robot_levels(problem, fit.fit.state, starting_noise(problem), from_above=True)[1]


def _best(fits: Mapping[str, LevelFit]) -> str:
    """The most likely level that predicts held-out stops better than the first one."""
    # A level's likelihood has the penalty for its columns, except for their prior sizes. Of two
    # levels with as many sizes, such as offsets or links, neither is simpler: preferring offsets
    # would leave links with errors as small out of the covariance.
    best, *others = fits
    held_out_mm = {name: _rms(fit.left_out, fit.has_rotation).mm for name, fit in fits.items()}
    nominal_mm = held_out_mm[best]
    for name in others:
        more_sizes = len(fits[name].errors) > len(fits[best].errors)
        margin = SIGNIFICANT if more_sizes else 0.0
        if held_out_mm[name] < nominal_mm and fits[name].gain - fits[best].gain > margin:
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
    """Whether a level allows functions of the joints, and there are enough stops for them."""
    return asked not in ("offsets", "hand-eye") and stops >= _FEWEST_STOPS


def check_level(asked: str) -> None:
    """Refuses an unknown level.

    Raises:
        DataError: It is not known.
    """
    levels = (*ASKED, "hand-eye")
    if asked not in levels:
        raise DataError(f"level {asked!r} is not one of {', '.join(levels)}.", culprits=["level"])


def check_level_is_possible(asked: str, *, can: bool, misread: str = "") -> None:
    """Refuses a level that the session cannot give.

    `can` is whether there are joint angles that belong to the robot's model and poses, `misread`
    what is wrong with them, and what to do.

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


def doubts(kinematics: SelectedArmLevel) -> Iterator[Finding]:
    """Reports where another level explains the views far better than the requested one."""
    chosen, name = kinematics.result.chosen, _best(kinematics.fits)
    best = replace(kinematics.result, level=name).chosen
    if best.likelihood_ratio - chosen.likelihood_ratio > SIGNIFICANT:
        yield Finding(
            "level",
            f"The views speak for more than the arm's {chosen.level}: with its {best.level} stops "
            f"left out are predicted to {figure(best.held_out_mm)} mm instead of "
            f"{figure(chosen.held_out_mm)} mm.",
            Remedy("Leave --level out.", CALIBRATE),
        )


def findings(kinematics: SelectedArmLevel) -> Iterator[str]:
    """States the chosen level, for the verdict."""
    if kinematics.level == NOMINAL and kinematics.was_asked:
        yield (
            "The arm stays as stated: what was asked to be found of it explains the views no "
            "better than chance, or there are too few stops to show it."
        )
    if kinematics.diverged:
        yield (
            f"The arm's level {listed(kinematics.diverged)} was not compared: a fit with these "
            "errors diverges."
        )
    result = kinematics.result
    if result.is_calibrated:
        yield (
            f"The arm was calibrated along ({result.level}): stops left out are predicted to "
            f"{figure(result.chosen.held_out_mm)} mm, with the nominal arm to "
            f"{figure(result.nominal.held_out_mm)} mm."
        )
