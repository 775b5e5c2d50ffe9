"""Calibrates a session, of one camera and robot or of a whole cell: the whole path, as a page."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Unpack

from visioncal.calibration.pipeline.assessment import assess_fit
from visioncal.calibration.pipeline.explaining import explained
from visioncal.calibration.pipeline.judging import check_answer, judge_run, judged_beside
from visioncal.calibration.pipeline.reading import (
    check_joint_angles,
    put_on_one_clock,
    read_cell_inputs,
    read_readings,
)
from visioncal.calibration.pipeline.result import result_of, view_evidence
from visioncal.calibration.pipeline.run_state import CalibrationOptions, RunState, initial_state
from visioncal.calibration.pipeline.solving import solve
from visioncal.calibration.stages.board_points import with_board_points
from visioncal.calibration.stages.cameras import detect_targets, estimate_lenses, locate_targets
from visioncal.calibration.stages.cell import read_cell
from visioncal.calibration.stages.clocks import waits_for_clock
from visioncal.calibration.stages.other_board import OtherBoardError
from visioncal.calibration.suspects.misread_poses import misreadings, with_open_chains
from visioncal.calibration.suspects.pairs_alone import found_alone, is_open, pairs_alone
from visioncal.core.arguments import typed
from visioncal.core.choices import Convention, SolverName
from visioncal.core.errors import VisioncalError
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Corners, Progress, Rejection, Searched
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session


@dataclass(frozen=True, eq=False)
class Run:
    """A calibration with its evidence."""

    calibration: Calibration  # The result.
    evidence: tuple[ViewEvidence, ...]  # One entry for each view of the session.
    # Corners found in each image, by view, from which alone the run can be repeated; empty where
    # more of the images was used.
    searches: Mapping[int, Searched] = field(default_factory=dict)

    def with_paths(self, session: Path | str, out: Path | str, need: Sequence[str] = ()) -> "Run":
        """Fills the paths of session and output, and the need, into the verdict's commands."""
        verdict = self.calibration.verdict.with_paths(session, out, need=need)
        return replace(self, calibration=replace(self.calibration, verdict=verdict))


@typed
def calibrate(
    session: Session | Path | str,
    *,
    solver: SolverName = "joint",
    level: str = "auto",
    convention: Convention | None = None,
    need_mm: float | None = None,
    need_deg: float | None = None,
    corrected: bool = False,
    progress: Progress | None = None,
    dense: bool = False,
    threads: int | None = None,
    corners: Mapping[int, Corners] | None = None,
) -> Calibration:
    """Calibrates a session.

    Several threads may calibrate at once. Meanwhile BLAS is limited to one thread per caller, and
    OpenCV, too, while targets are detected; afterwards both limits are restored.

    Args:
        session: A session, or the path of its folder or recording. Several cameras or robots are
            calibrated as a whole cell; `Calibration.of` selects one camera, robot and target.
        solver: `joint` for the fit of both edges, or the name of a closed form.
        level: How far to go: `auto` for all that the data allows, `hand-eye` without a calibrated
            arm, `offsets` of its joints, its `kinematics`, `elastic` with joint compliance, or
            `thermal` with drift over temperature.
        convention: Joint table convention of a calibrated arm's parameters: `standard`,
            `modified` or `hayati`; None for the stated one, or Hayati's where axes are parallel.
        need_mm: Required accuracy of picks [mm]; replaces that of `[need]`.
        need_deg: The same in rotation [deg].
        corrected: Whether targets are corrected for a calibrated arm before they are sent; else the
            verdict is about picks by the controller's own poses.
        progress: Called with the progress of long work.
        dense: Whether to fit a board to all pixels of images that the template refuses.
        threads: How many images are searched in parallel; one a core where None. The result is the
            same to the bit.
        corners: Corners detected before, by view; None to detect them.

    Returns:
        The result with its verdict.

    Raises:
        DataError: The input is wrong or shows no target.
        DegenerateError: The motion leaves a direction of the result undetermined.
        ConvergenceError: The intrinsics do not converge.
    """
    options = CalibrationOptions(
        solver=solver,
        level=level,
        convention=convention,
        progress=progress,
        threads=threads,
        dense=dense,
    )
    state = initial_state(session, **options)
    with_need = state.session.needing(need_mm, need_deg, corrected=corrected)
    state = replace(state, session=with_need, given_corners=corners)
    if _sees_points(state):
        return _points_run(state).calibration
    state = run_stages(state)
    return _with_depth(state)[0] if _has_depth(state) else result_of(state)


def run(session: Session | Path | str, **options: Unpack[CalibrationOptions]) -> Run:
    """Calibrates a session and keeps the evidence; see `calibrate`."""
    state = initial_state(session, **options)
    if _sees_points(state):
        return _points_run(state)
    state = run_stages(state)
    searches = {} if state.dense else state.searches
    result = _with_depth(state) if _has_depth(state) else (result_of(state), view_evidence(state))
    return Run(*result, searches)


def _sees_points(state: RunState) -> bool:
    return any(table.seeing == "points" for table in state.session.cameras.values())


def _points_run(state: RunState) -> Run:
    """The run of a session whose camera measures points."""
    # Imported here, as few sessions have them.
    from visioncal.calibration.stages import points

    with points.named(state.session):
        solved = run_stages(replace(state, session=points.as_instrument(state.session)))
    calibration = points.as_hand_eye(result_of(solved), state.session)
    evidence = tuple(ViewEvidence(view.number) for view in state.session.views)
    return Run(calibration, evidence)


def _has_depth(state: RunState) -> bool:
    return any(view.depth for view in state.session.views)


def _with_depth(state: RunState) -> tuple[Calibration, tuple[ViewEvidence, ...]]:
    """The result and its evidence, with the depth of its cameras."""
    # Imported here, as few sessions have depth.
    from visioncal.calibration.stages.depth import with_depth

    with one_blas_thread():
        return with_depth(result_of(state), view_evidence(state), state.session)


@dataclass(frozen=True)
class Stage:
    """One stage, by the name that progress shows."""

    name: str
    run: Callable[[RunState], RunState]


def _fit(state: RunState) -> RunState:
    """Starts by closed forms, rejects outliers, and fits frames, lenses, boards, arms and sizes."""
    cell = read_cell(state)
    fit = solve(cell, state, state.level, state.solver)
    return replace(state, cell_or_none=cell, cell_fit_or_none=fit)


def _examine(state: RunState) -> RunState:
    """Refuses what is undetermined; covariance, left-out stops, tests of the residuals, picks."""
    check_answer(state)
    answer = assess_fit(state.cell, state, state.cell_fit, state.convention)
    rejected = (view for view in answer.views if not view.used and view.view not in state.held_back)
    state = replace(state, cell_fit_or_none=answer.cell_fit, assessment_or_none=answer)
    return state.noting(Rejection(view.view, view.reason) for view in rejected)


def _judge(state: RunState) -> RunState:
    """Judges the result; of a whole cell whose causes are open, also by what its pairs show."""
    state = judge_run(state)
    if not is_open(state):
        return state
    return judged_beside(state, [*found_alone(state, pairs_alone(state, partial(_of_pair, state)))])


def _of_pair(state: RunState, session: Session, corners: Mapping[int, Corners]) -> RunState:
    """The run of one robot, camera and target of a cell, of corners that were detected."""
    pair_state = initial_state(session, level=state.level, threads=state.threads or None)
    seen = corners if session.corner_table is None else None
    return run_stages(replace(pair_state, given_corners=seen))


STAGES: tuple[Stage, ...] = (
    Stage("robot", read_cell_inputs),
    Stage("detect", lambda state: detect_targets(state, state.given_corners)),
    Stage("readings", read_readings),
    Stage("intrinsics", estimate_lenses),
    Stage("pnp", locate_targets),
    Stage("board", with_board_points),
    Stage("clock", put_on_one_clock),
    Stage("joints", check_joint_angles),
    Stage("solve", _fit),
    Stage("examine", _examine),
    Stage("judge", _judge),
)


# Findings on other readings of a run's poses that explain what its camera sees.
misread_poses = misreadings


def _explained_by_pairs(error: VisioncalError, state: RunState) -> VisioncalError | None:
    """The error of a whole cell by the first cause that a pair of it shows alone."""
    for found in found_alone(state, pairs_alone(state, partial(_of_pair, state))):
        culprits = [f"view {view}" for view in found.views] or error.culprits
        return error.but(found.in_words().words, culprits=culprits, next_step=str(found.do or ""))
    return None


def run_stages(state: RunState, stages: Sequence[Stage] = STAGES) -> RunState:
    """Runs stages; an error is raised with its likeliest cause where that is known."""
    are_located = False
    with one_blas_thread():
        for index, stage in enumerate(stages):
            if state.progress is not None:
                state.progress(stage.name, index, len(stages))
            try:
                state = stage.run(state)
            except OtherBoardError:
                raise
            except VisioncalError as error:
                # Lost views are often why the remaining ones do not suffice.
                lost = [view for view in state.lost_views if view not in error.culprits]
                fault = error.with_culprits(lost)
                likely = explained(fault, state, stage.name, are_located=are_located)
                if likely is None and stage.name in ("solve", "examine"):
                    likely = _explained_by_pairs(fault, state)
                raise likely or fault from error
            if stage.name == "joints":
                state, are_located = with_open_chains(state), True
        return state


def measured_run(session: Session, progress: Progress | None) -> RunState:
    """The run up to the camera's poses, for any of the robot's; raises as `run_stages`."""
    # The offset of a stream's clock is found by rotation angles, which no reading changes.
    by_clock = {"robot", "clock"} if waits_for_clock(session) else set()
    names = {"detect", "intrinsics", "pnp"} | by_clock
    return run_stages(RunState(session, progress), [each for each in STAGES if each.name in names])
