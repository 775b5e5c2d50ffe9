"""Selection of the arm's error model: the blocks of errors that the stops show, and their fit."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.arms import Arm
from visioncal.core.errors import DataError
from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.number_format import figure
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import arm_effect, rows_of, stops_of
from visioncal.estimation.arm_sizes import SizedArm, estimate_arm_sizes, most_orders
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.solve import Solution, fit_problem, left_out_residuals
from visioncal.results.arm import LEVEL_WORDS, NOMINAL, ArmLevel, ArmResult, UnseenView
from visioncal.robot import Loads, Robot
from visioncal.robot.arm_model import (
    COMPLIANCE,
    GROUPS,
    HARMONICS,
    LEVELS,
    WEIGHT,
    ArmModel,
    groups_of,
    sized_groups,
)
from visioncal.robot.errors import ArmErrors

# Units of residuals that are reported.
_DEG_MM: FloatArray = np.array([np.rad2deg(1.0), 1e3])


@dataclass(frozen=True, eq=False)
class _Trial:
    """A fit with some errors of an arm's model free, or of the nominal arm."""

    fit: Solution
    figures: ArmLevel
    # (m, 2) residuals of the robot's observations, to first order without the stop of each:
    # rotation [deg], NaN where none was observed, and position [mm].
    left_out: FloatArray
    model: ArmModel | None  # The arm with these errors; None for the nominal one.

    @classmethod
    def of(
        cls, problem: Problem, state: State, noise: Noise, arm: Arm, sized: SizedArm | None
    ) -> "_Trial":
        """Fits all unknowns with errors of some sizes; those of the nominal arm where None."""
        model, gain, unknowns, level = None, 0.0, 0, NOMINAL
        if sized is not None:
            model, levels, gain = sized
            effects, q = list(problem.effects), arm.moments.joints[arm.robot]
            for name, weight in model.weights.items():
                basis, size = model.columns(name, q, arm.loads), weight * model.error_rad
                errors = ArmErrors(basis, size, gain, of_links=True)
                effects.append(arm_effect(errors, arm.robot, name))
            problem, unknowns = problem.with_effects(effects), len(model.values)
            noise = replace(noise, robots=levels)
            named = (GROUPS[name].level for name in model.weights)
            level = max(named, key=[*LEVEL_WORDS].index)
        values = np.append(state.values, problem.start_values[len(state.values) :])
        fit = fit_problem(problem, State(state.edges, values), noise)
        rows, seen = rows_of(problem, arm.robot), problem.observations
        inside, held_out = (
            np.linalg.norm(residuals[rows].reshape(-1, 2, 3), axis=2) * _DEG_MM
            for residuals in (
                problem.linear(fit.state).residuals,
                left_out_residuals(problem, fit.state, fit.noise, rows),
            )
        )
        is_point = np.array([name in problem.points for name in seen.observed], dtype=bool)
        turned = (seen.has_rotation & ~is_point)[rows]
        rms_deg, held_out_deg = (
            float(np.sqrt(np.mean(array[turned, 0] ** 2))) if turned.any() else None
            for array in (inside, held_out)
        )
        rms_mm, held_out_mm = (
            float(np.sqrt(np.mean(array[:, 1] ** 2))) for array in (inside, held_out)
        )
        held_out[~turned, 0] = np.nan
        figures = ArmLevel(
            level=level,
            unknowns=unknowns,
            rms_mm=rms_mm,
            rms_deg=rms_deg,
            held_out_mm=held_out_mm,
            held_out_deg=held_out_deg,
            likelihood_ratio=gain,
        )
        return cls(fit, figures, held_out, model)


def with_likely_errors(
    arm: Arm,
    problem: Problem,
    state: State,
    level: str,
    noise: Noise,
    views: Sequence[int],
    *,
    functions: bool = False,
    stated: Sequence[Robot] = (),
) -> Arm:
    """The arm with the errors of its model that its observations show.

    The errors' sizes are estimated together; see `arm_sizes`. An arm with such errors must also
    predict left-out stops better than the nominal arm.

    Args:
        arm: The arm.
        problem: The observations, with this arm as reported.
        state: The solution with the nominal arm.
        level: One of `LEVELS`.
        noise: The noise's levels to start from.
        views: (n,) the view of each observation.
        functions: Whether functions of the joints are among the errors; where none are significant,
            the arm stays.
        stated: Models, of which the likeliest is taken, in place of the arm's own.
    """
    used = arm.at(stops_of(problem, arm.robot))
    q, nominal, best = used.joints_rad, None, None
    # Fewest stops, and those for functions of the joints.
    fewest = 20 if functions else 1
    if q is None or len(q) < fewest or (functions and HARMONICS not in groups_of(level)):
        return arm
    # Numbers may be so large that their squares are none.
    with one_blas_thread(), np.errstate(over="ignore", invalid="ignore"):
        for robot in _hypotheses(arm, used.loads, stated):
            model = ArmModel.of(robot, q, used.reported).loaded(q, used.loads)
            sized = _sized(arm, model, problem, state, noise, level, functions=functions)
            if functions and sized is None:
                continue
            nominal = trial = nominal or _Trial.of(problem, state, noise, arm, None)
            if sized is not None:
                with suppress(np.linalg.LinAlgError):
                    found = _Trial.of(problem, state, noise, arm, sized)
                    is_better = found.figures.held_out_mm < nominal.figures.held_out_mm
                    trial = found if is_better else nominal
            if best is None or trial.figures.likelihood_ratio > best.figures.likelihood_ratio:
                best = trial
    if nominal is None or best is None:
        return arm
    levels = [trial.figures for trial in dict.fromkeys((nominal, best))]
    rows = np.flatnonzero(rows_of(problem, arm.robot)).tolist()
    unseen = _unseen([views[row] for row in rows], nominal, best) if len(levels) > 1 else ()
    result = ArmResult(level=best.figures.level, levels=tuple(levels), left_out=tuple(unseen))
    chosen = replace(arm, kinematics=result)
    if best.model is not None:
        return chosen.with_model(best.model)
    if arm.model is None:
        return chosen
    # There are fewer inliers than when it was calibrated: errors are sought at the nominal arm.
    likelihood = robot_likelihood(problem, nominal.fit.state, nominal.fit.noise)
    return replace(chosen, model=None).with_errors(likelihood, problem.robots.index(arm.robot))


def _hypotheses(arm: Arm, loads: Loads, stated: Sequence[Robot]) -> Iterator[Robot]:
    """The arm as stated; where loads could show it, also with its weight compensated."""
    # Of functions of the joints only that arm is tried which the loads have shown.
    shown = None if arm.model is None else arm.model.nominal.weight_compensated
    for robot in stated or ([] if arm.nominal is None else [arm.nominal]):
        is_testable = robot.masses is not None and loads.any and not robot.weight_compensated
        if not (shown and is_testable):
            yield robot
        if shown is not False and is_testable:
            yield robot.with_weight_compensated


def _sized(
    arm: Arm,
    model: ArmModel,
    problem: Problem,
    state: State,
    noise: Noise,
    level: str,
    *,
    functions: bool,
) -> SizedArm | None:
    """Errors of a model with their sizes; None where none are likely, or there are few stops."""
    if len(stops_of(problem, arm.robot)) < FEWEST_STOPS:
        return None
    q, groups = arm.moments.joints[arm.robot], sized_groups(level, model.nominal, arm.loads)
    columns = {name: model.columns(name, q, arm.loads) for name in groups}
    waves = model.robot.harmonic_jacobian(q, most_orders()) if functions else None
    with suppress(np.linalg.LinAlgError):
        return estimate_arm_sizes(problem, state, noise, arm.robot, model, columns, waves)
    return None


def _unseen(views: Sequence[int], nominal: _Trial, chosen: _Trial) -> Iterator[UnseenView]:
    """Residuals of left-out stops with both arms, by view."""
    rows = np.concatenate([nominal.left_out, chosen.left_out], axis=1).tolist()
    for view, (was_deg, was_mm, now_deg, now_mm) in zip(views, rows, strict=True):
        of_places = UnseenView(view=view, nominal_mm=was_mm, mm=now_mm)
        is_turned = not np.isnan(was_deg)
        yield replace(of_places, nominal_deg=was_deg, deg=now_deg) if is_turned else of_places


def check_level(level: str) -> None:
    """Refuses an unknown level.

    Raises:
        DataError: The level is not known.
    """
    if level not in LEVELS:
        raise DataError(f"level {level!r} is not one of {', '.join(LEVELS)}.", culprits=["level"])


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


def check_arms(arms: Mapping[str, Arm], level: str) -> None:
    """Refuses a level that the loads cannot give.

    Raises:
        DataError: Compliance is requested, and no load bends the joints.
    """
    for arm in arms.values():
        robot = arm.nominal
        if level == "elastic" and robot and robot.masses is None and not arm.loads.any:
            raise DataError(
                f"level 'elastic' needs to know what bends the arm: the model of {robot.name} does "
                "not state the masses of its links, and no view has a payload_kg or a force.",
                culprits=["level", robot.name],
                next_step="Add mass_kg and com_m to each [[joint]] of its table, take its URDF, or "
                "record payload_kg (with payload_x_m, payload_y_m, payload_z_m) with every view.",
            )


def findings(arm: Arm, requested: str) -> Iterator[str]:
    """States the chosen level, for the verdict."""
    result = arm.kinematics
    if result is None:
        return
    if not result.is_calibrated and requested not in ("auto", "thermal"):
        yield (
            "The arm stays as stated: what was asked to be found of it explains the views no "
            "better than chance, or there are too few stops to show it."
        )
    elif requested == "elastic" and not (
        arm.model is not None and {COMPLIANCE, WEIGHT} & arm.model.weights.keys()
    ):
        yield (
            "No joint was found to bend under load, as asked: what else the arm errs by explains "
            "the views as well. State payload_kg in views.csv, and record stops with and "
            "without it."
        )
    if result.is_calibrated:
        yield (
            f"The arm was calibrated along ({result.level}): stops left out are predicted to "
            f"{figure(result.chosen.held_out_mm)} mm, with the nominal arm to "
            f"{figure(result.nominal.held_out_mm)} mm."
        )
