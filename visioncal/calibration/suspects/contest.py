"""The contest of causes: each is applied and refitted, and proven only by what it then leaves.

A test shows a cause beside noise alone; errors of an arm by its posture, say, follow whatever
follows the posture. A cause is proven where its cure, applied, leaves what such arms and cameras
have, without a pattern, and where no other cause does about as well. The others are ranked.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from visioncal.calibration.pipeline.arm_results import joint_offsets
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.likely_steps import likely_steps
from visioncal.calibration.stages.pose_errors import find_pose_errors
from visioncal.calibration.stages.random_effects import KINDS
from visioncal.calibration.suspects.suspect import ARM_ERRORS, STEPS
from visioncal.core.limits import CLEAR_RATIO, CalibrationLimits, CheckLimits
from visioncal.core.number_format import mm_and_deg
from visioncal.core.transforms import LEVER_M, exp
from visioncal.core.types import FloatArray, IntArray
from visioncal.core.verdict import Finding
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.solve import Solution, fit_problem
from visioncal.estimation.steps import FRAME, with_step
from visioncal.estimation.unknowns import BOARD, LENS, SIZE
from visioncal.model.effects import Creeps, JointsCreep
from visioncal.model.effects.posture import Stretches
from visioncal.robot.model import REPEATABILITY
from visioncal.vision.board_shape import SCALE
from visioncal.vision.camera import intrinsics

_LIMITS = CalibrationLimits()
# Scatter that arms have anyway [mm, deg].
_USUAL = _LIMITS.repeatability * np.array(REPEATABILITY)
_OF_LENSES = ("focus", "image_shifted")
_CREEPS = [name for name, kind in KINDS.items() if issubclass(kind, Creeps | JointsCreep)]


@dataclass(frozen=True, eq=False)
class Trial:
    """Fits without a cause and with its cure."""

    without: tuple[Problem, Solution]
    cured: tuple[Problem, Solution]
    # Whether the fit of the session has the cure, so that steps were not sought without it.
    is_in_fit: bool = True

    @property
    def levels(self) -> FloatArray:
        """(2, 2) noise of the worst flange, without and with the cure, [mm] and [deg] an axis."""
        noise = np.array([fit.noise.robots.max(axis=0) for _, fit in (self.without, self.cured)])
        return np.asarray(noise[:, ::-1] * [1e3, np.rad2deg(1.0)])


def contested(run: RunState, found: Iterable[Finding]) -> Iterator[Finding]:
    """Findings with what their cures leave: whether that proves them, and how much they explain.

    Errors of arms follow the posture beside all that the fit has: of a misfit that a cure there
    clearly removes, they explain what it leaves.
    """
    # Findings of several cameras have one trial.
    trial_of, is_proof = cache(lambda kind: _TRIALS[kind](run, kind)), cache(partial(_proves, run))
    by_arms, rest, found = list[Finding](), 1.0, [*found]
    by_lens = max((at.mahalanobis_sq for at in found if at.kind in _OF_LENSES), default=0.0)
    is_stepped, is_creeping = False, any(finding.kind in _CREEPS for finding in found)
    for finding in found:
        if finding.kind == ARM_ERRORS:
            by_arms.append(finding)
            continue
        if is_stepped and finding.kind in _CREEPS:
            # A frame that was moved at once looks as if it crept.
            continue
        is_held = finding.kind == LENS and finding.mahalanobis_sq
        if finding.kind not in _TRIALS or not finding.until_mm or is_held:
            yield finding
            continue
        trial = trial_of(finding.kind)
        before, after = (mm_and_deg(*at) for at in trial.levels.tolist())
        # Turns count by what they move at a typical distance.
        left = np.sum((trial.levels * [1.0, 1e3 * LEVER_M * np.deg2rad(1.0)]) ** 2, axis=1)
        share = max(1.0 - float(left[1] / max(left[0], np.finfo(float).tiny)), 0.0)
        leaves_most = (trial.levels[1] ** 2 > 0.75 * trial.levels[0] ** 2).all()
        if is_creeping and finding.kind in STEPS and leaves_most:
            # Creep of another course than the fitted one leaves a step, which takes less than a
            # quarter of the noise beside it, of shifts as of turns.
            continue
        is_apart = bool(trial.is_in_fit and CLEAR_RATIO**2 * left[1] < left[0])
        if is_apart:
            rest = min(rest, 1.0 - share)
        # Of what no view distinguishes, no cure proves one.
        is_proven = bool(finding.mahalanobis_sq) and not finding.rivals
        is_proven, instead = is_proven and is_proof(trial), tuple[str, ...]()
        if finding.kind in KINDS:
            # The fit here knows of a lens what the one likelihood of all corners found, which is no
            # rival's: there they were tried.
            kind, sizes = KINDS[finding.kind].kind, run.cell_fit.sizes
            is_proven &= kind in sizes.rivals and not sizes.rivals[kind]
            instead = sizes.instead_of(kind) or _of_joint(run, finding.kind)
            is_proven &= not instead
        if finding.kind in STEPS:
            is_stepped |= is_proven
            # Others about as likely are named with it.
            is_proven &= not _may_be_of_arm(run) and len(run.assessment.steps) == 1
            # Images that moved look as if the camera had, and corners show more than the robot.
            is_proven &= by_lens < finding.mahalanobis_sq
        yield replace(
            finding,
            rivals=(*finding.rivals, *instead),
            without_it=f"Applied and refitted, it leaves noise of {after} an axis; else it is "
            f"{before}.",
            is_proven=is_proven,
            is_apart=is_apart,
            # Without evidence of its own, or where most of a misfit remains, it stands for what it
            # removes.
            explains=1.0
            if finding.mahalanobis_sq and (share > 0.5 or (trial.levels[1] < _USUAL).all())
            else share,
        )
    yield from (replace(finding, explains=rest) for finding in by_arms)


def _proves(run: RunState, trial: Trial) -> bool:
    """Whether a cure leaves mere noise, and no other cause leaves about as little."""
    (before, after), (problem, fit) = trial.levels, trial.cured
    # Scatter that such arms have anyway needs no cure.
    is_noise = bool((after < _USUAL).all() and not (before < _USUAL).all())
    # Noise of poses that a program measured may be left; that of corners is known.
    is_less = problem.is_combined and (CLEAR_RATIO * after < before).any()
    is_less &= (after < (_LIMITS.scatter_mm[0], _LIMITS.scatter_deg[0])).all()
    if not is_noise and not is_less:
        return False
    arms = {name: arm for name, arm in run.cell_fit.arms.items() if not arm.is_modelled}
    patterns = (find_pose_errors(problem, fit.state, fit.noise, name) for name in arms)
    if any(errors is not None and errors.is_significant for errors in patterns):
        return False
    if not trial.is_in_fit:
        return True
    # A step is sought in the fit, which has the cure.
    errors = {name: arm.errors for name, arm in arms.items() if arm.errors}
    offsets, lenses = joint_offsets(run.cell_fit.arms), run.cell_fit.lens_changes
    rivals = likely_steps(*trial.without, errors, offsets, lenses)
    lost, least = (
        robot_likelihood(part, solved.state, fit.noise).negative_log_likelihood
        for part, solved in (trial.without, trial.cured)
    )
    gain = 2.0 * (lost - least - float(np.log(CheckLimits.ruled_out)))
    return all(step.gain <= gain for step in rivals)


def _of_joint(run: RunState, kind: str) -> tuple[str, ...]:
    """A joint in place of a linear axis, as a clause; empty where the joints are known."""
    if not issubclass(KINDS[kind], Stretches) or all(
        arm.is_modelled for arm in run.cell_fit.arms.values()
    ):
        return ()
    return ("a joint of the arm turns by another share than it reports",)


def _may_be_of_arm(run: RunState) -> bool:
    """Whether errors of an arm without joint angles, in two postures, look as a step does."""
    step = run.assessment.steps[0]
    return step.kind == FRAME and run.cell_fit.may_be_of_arms(exp(step.value))


def _of_step(run: RunState, _: str) -> Trial:
    fit = run.assessment.sized
    without = fit.problem, fit.solution
    return Trial(without, with_step(*without, run.assessment.steps[0]), is_in_fit=False)


def _held(run: RunState, columns: IntArray, at: FloatArray | float = 0.0) -> Trial:
    """A trial of what is in the fit, without which some values are as they are given."""
    fit, first = run.assessment.fit, 6 * len(run.assessment.fit.frames)
    problem, effects = fit.problem, []
    for effect in problem.effects:
        places = problem.effect_columns[effect.name]
        held = effect.held | np.isin(np.arange(places.start, places.stop), columns)
        effects.append(replace(effect, held=held))
    values = fit.state.values.copy()
    values[columns - first] = at
    without = problem.with_effects(effects)
    solved = fit_problem(without, State(fit.state.edges, values), fit.noise)
    return Trial((without, solved), (problem, fit.solution))


def _of_growth(run: RunState, kind: str) -> Trial:
    unknowns, sizes = run.assessment.fit.unknowns, run.cell_fit.sizes
    columns = {owner: unknowns.columns((kind, owner)) for owner in unknowns.of(kind)}
    taken = [0.0 * at + sizes.steadied_by(kind, owner) for owner, at in columns.items()]
    return _held(run, np.concatenate([*columns.values()]), -np.concatenate(taken))


def _of_board(run: RunState, kind: str) -> Trial:
    """Trial of sizes or shapes of boards; of other distances for poses and exact points."""
    fit, sized = run.assessment.fit, run.assessment.sized
    if sizes := fit.unknowns.all_of(SIZE):
        return _held(run, fit.unknowns.columns(*sizes))
    if kind == "board_size" and sized.unknowns.all_of(SIZE):
        stated, cured = ((at.problem, at.solution) for at in (fit, sized))
        return Trial(stated, cured, is_in_fit=False)
    columns = [
        fit.unknowns.columns(board)[
            (fit.unknowns.values_of(board) == SCALE) == (kind == "board_size")
        ]
        for board in fit.unknowns.all_of(BOARD)
    ]
    return _held(run, np.concatenate(columns))


def _of_lens(run: RunState, _: str) -> Trial:
    """Trial of stated lenses that were refined."""
    fit, optics = run.assessment.fit, run.assessment.fit.camera_parameters
    columns, stated = np.zeros(0, int), np.zeros(0)
    for lens in fit.unknowns.all_of(LENS):
        scene = optics.problems[lens.name].scene
        if not scene.estimated:
            columns = np.append(columns, fit.unknowns.columns(lens))
            given = intrinsics(scene.camera)[fit.unknowns.values_of(lens)]
            stated = np.append(stated, given)
    return _held(run, columns, stated)


_TRIALS: Mapping[str, Callable[[RunState, str], Trial]] = {
    **dict.fromkeys(STEPS, _of_step),
    **dict.fromkeys(KINDS, _of_growth),
    LENS: _of_lens,
    **dict.fromkeys(("board_size", "board_shape"), _of_board),
}
