"""Selection of the arm's error model: the blocks of errors that the stops show, and their fit."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.number_format import figure
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.arm import arm_effect, rows_of, stops_of
from visioncal.estimation.arm_sizes import ArmSizes, estimate_arm_sizes
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.solve import Solution, fit_problem, left_out_residuals
from visioncal.results.arm import FUNCTIONS, NOMINAL, ArmLevel, ArmResult, UnseenView
from visioncal.robot.arm_model import BACKLASH, COMPLIANCE, HARMONICS, RIGID, WEIGHT, JointFunctions
from visioncal.robot.errors import ArmErrors

# The blocks of errors by what the user asks for: the quick one after a lost encoder, or all that
# the data determine.
_ALL = (*RIGID, COMPLIANCE, WEIGHT, BACKLASH, HARMONICS)
ASKED: Mapping[str, tuple[str, ...]] = {
    "offsets": ("offsets", BACKLASH),
    "kinematics": (*RIGID, BACKLASH, HARMONICS),
    "elastic": _ALL,
    "thermal": _ALL,
    "auto": _ALL,
}
# The name of a level by the block of errors that it has and the ones before it lack.
_LEVEL_OF = {
    BACKLASH: "backlash",
    "offsets": "offsets",
    "links": "geometry",
    "eccentricity": "eccentricity",
    "ratios": "eccentricity",
    COMPLIANCE: "elastic",
    WEIGHT: "elastic",
    HARMONICS: FUNCTIONS,
}


@dataclass(frozen=True, eq=False)
class LevelFit:
    """Fit with some blocks of errors of a robot's arm free."""

    fit: Solution
    # (m, 2, 2) squared lengths of rotation [rad^2] and translation [m^2] of the residuals of the
    # robot's observations, in the fit and to first order without the observation's stop.
    squares: FloatArray
    has_rotation: Mask  # (m,) which observations include a rotation.
    errors: Mapping[str, ArmErrors]  # The errors by block; empty for the nominal arm.
    gain: float  # Twice the gain in log-likelihood over the nominal arm.
    functions: JointFunctions | None  # Functions of the joints; None without any.

    @classmethod
    def of(
        cls, problem: Problem, state: State, robot: str, noise: Noise, sizes: ArmSizes | None
    ) -> "LevelFit":
        """Fits all unknowns with errors of some sizes; the nominal arm where `sizes` is None."""
        errors = {} if sizes is None else sizes.errors
        if sizes is not None:
            effects = [arm_effect(error, robot, name) for name, error in errors.items()]
            problem = problem.with_effects([*problem.effects, *effects])
            noise = replace(noise, robots=sizes.levels)
        values = np.append(state.values, problem.start_values[len(state.values) :])
        fit = fit_problem(problem, State(state.edges, values), noise)
        rows, seen = rows_of(problem, robot), problem.observations
        residuals = [
            problem.linear(fit.state).residuals[rows],
            left_out_residuals(problem, fit.state, fit.noise, rows)[rows],
        ]
        squares = np.sum(np.stack(residuals, axis=1).reshape(-1, 2, 2, 3) ** 2, axis=3)
        is_point = np.array([name in problem.points for name in seen.observed], dtype=bool)
        has_rotation = seen.has_rotation & ~is_point
        gain, functions = (0.0, None) if sizes is None else (sizes.gain, sizes.functions)
        return cls(fit, squares, has_rotation[rows], errors, gain, functions)

    @cached_property
    def result(self) -> ArmLevel:
        """The fit as figures."""
        names = [level for block, level in _LEVEL_OF.items() if block in self.errors]
        inside_mm, held_out_mm = (1e3 * np.sqrt(self.squares[:, :, 1].mean(axis=0))).tolist()
        turned, degs = self.squares[self.has_rotation, :, 0], (None, None)
        if len(turned):
            degs = tuple(np.rad2deg(np.sqrt(turned.mean(axis=0))).tolist())
        return ArmLevel(
            level=names[-1] if names else NOMINAL,
            unknowns=sum(error.basis.shape[2] for error in self.errors.values()),
            rms_mm=inside_mm,
            rms_deg=degs[0],
            held_out_mm=held_out_mm,
            held_out_deg=degs[1],
            likelihood_ratio=self.gain,
        )


@dataclass(frozen=True, eq=False)
class SelectedArmLevel:
    """The errors of the arm's model that the views show."""

    nominal: LevelFit  # The fit of the nominal arm.
    fit: LevelFit  # The fit with the errors; the nominal one where none explain more than chance.
    requested: str  # The level that was requested.
    views: tuple[int, ...] = ()  # (m,) the view of each residual of these.

    @property
    def level(self) -> str:
        """Name of the level; `nominal` where no errors explain more than chance."""
        return self.fit.result.level

    def left_out(self) -> tuple[UnseenView, ...]:
        """Residuals of held-out stops with both arms, by view."""
        scale = np.array([np.rad2deg(1.0), 1e3])
        before, after = (
            (np.sqrt(level.squares[:, 1]) * scale).tolist() for level in (self.nominal, self.fit)
        )
        columns = zip(self.views, before, after, self.nominal.has_rotation, strict=True)
        return tuple(
            UnseenView(
                view=view,
                nominal_mm=was_mm,
                mm=now_mm,
                nominal_deg=was_deg if has_rotation else None,
                deg=now_deg if has_rotation else None,
            )
            for view, (was_deg, was_mm), (now_deg, now_mm), has_rotation in columns
        )

    @cached_property
    def result(self) -> ArmResult:
        """Both levels, as a section of a calibration."""
        fits = (self.nominal,) if self.fit is self.nominal else (self.nominal, self.fit)
        return ArmResult(level=self.level, levels=tuple(fit.result for fit in fits))


def select_errors(
    problem: Problem,
    state: State,
    robot: str,
    bases: Mapping[str, FloatArray],
    torque_nm: float,
    level: str,
    noise: Noise,
    harmonics: FloatArray | None,
    nominal: LevelFit | None = None,
) -> SelectedArmLevel | None:
    """Selects the errors of a robot's arm that its observations show.

    The errors' sizes are estimated together; see `arm_sizes`. An arm with such errors must also
    predict left-out stops better than the nominal arm.

    Args:
        problem: The observations, without errors of this arm.
        state: The solution with the nominal arm.
        robot: The robot.
        bases: (s, 6, p) Jacobian of the flange pose by stop, for the errors of each block.
        torque_nm: The torque of a unit compliance [N m].
        level: A key of `ASKED`.
        noise: The noise's levels to start from.
        harmonics: Jacobian by functions of the joints, or None; see `estimate_arm_sizes`.
        nominal: The fit of the nominal arm, where it is known.

    Returns:
        The errors; with `harmonics` None where no functions of the joints are significant.
    """
    is_enough = len(stops_of(problem, robot)) >= FEWEST_STOPS

    def likely(blocks: Sequence[str]) -> ArmSizes | None:
        block_bases = {name: basis for name, basis in bases.items() if name in blocks}
        waves = harmonics if HARMONICS in blocks else None
        with suppress(np.linalg.LinAlgError):
            if is_enough:
                return estimate_arm_sizes(
                    problem, state, noise, robot, block_bases, torque_nm, waves
                )
        return None

    def fitted(sizes: ArmSizes | None, nominal: LevelFit) -> LevelFit:
        """The fit with errors of some sizes; the nominal one where it is no better."""
        with suppress(np.linalg.LinAlgError):
            fit = LevelFit.of(problem, state, robot, noise, sizes) if sizes else nominal
            return fit if fit.result.held_out_mm < nominal.result.held_out_mm else nominal
        return nominal

    # Numbers may be so large that their squares are none.
    with one_blas_thread(), np.errstate(over="ignore", invalid="ignore"):
        sizes = likely(ASKED[level])
        if harmonics is not None and sizes is None:
            return None
        nominal = nominal or LevelFit.of(problem, state, robot, noise, None)
        fit = fitted(sizes, nominal)
    return SelectedArmLevel(nominal, fit, level)


def check_level(level: str) -> None:
    """Refuses an unknown level.

    Raises:
        DataError: The level is not known.
    """
    levels = (*ASKED, "hand-eye")
    if level not in levels:
        raise DataError(f"level {level!r} is not one of {', '.join(levels)}.", culprits=["level"])


def check_level_is_possible(level: str, *, can: bool, misread: str = "") -> None:
    """Refuses a level that the session cannot give.

    `can` is whether there are joint angles that belong to the robot's model and poses, `misread`
    what is wrong with them, and what to do.

    Raises:
        DataError: There are no joint angles that belong to a known model.
    """
    if level in ("offsets", "kinematics", "elastic") and not can:
        raise DataError(
            f"level {level!r} needs the joint angles of every view and a model of the robot that "
            "they belong to.",
            culprits=["level"],
            next_step=misread or "Record q1_rad ..., and name [robot] model in session.toml.",
        )


def findings(kinematics: SelectedArmLevel) -> Iterator[str]:
    """States the chosen level, for the verdict."""
    if kinematics.level == NOMINAL and kinematics.requested not in ("auto", "thermal"):
        yield (
            "The arm stays as stated: what was asked to be found of it explains the views no "
            "better than chance, or there are too few stops to show it."
        )
    elif (
        kinematics.requested == "elastic"
        and not {COMPLIANCE, WEIGHT} & kinematics.fit.errors.keys()
    ):
        yield (
            "No joint was found to bend under load, as asked: what else the arm errs by explains "
            "the views as well. State payload_kg in views.csv, and record stops with and "
            "without it."
        )
    result = kinematics.result
    if result.is_calibrated:
        yield (
            f"The arm was calibrated along ({result.level}): stops left out are predicted to "
            f"{figure(result.chosen.held_out_mm)} mm, with the nominal arm to "
            f"{figure(result.nominal.held_out_mm)} mm."
        )
