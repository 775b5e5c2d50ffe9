"""Runs all stages on a session, of one camera and robot or a whole cell; result and evidence."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np

from visioncal.calibration.pipeline.assessment import held_back
from visioncal.calibration.pipeline.exchanged_names import exchanged_names
from visioncal.calibration.pipeline.judging import poor_motion
from visioncal.calibration.pipeline.misread_poses import (
    may_be_misread,
    misread_pose_finding,
    misreadings,
    turned_boards,
)
from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.steps import STAGES
from visioncal.calibration.stages.cause_ranking import with_misread, with_other_board
from visioncal.calibration.stages.cell import robot_key
from visioncal.calibration.stages.image_checks import because, unseen_cause
from visioncal.calibration.stages.kinematics import check_level
from visioncal.calibration.stages.validate import predict_corners
from visioncal.core.choices import Convention, SolverName
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Corners, FloatArray, Progress, Searched
from visioncal.core.verdict import Finding
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session
from visioncal.session.observations import Observation
from visioncal.vision.targets import first_corners

# Advice to add stops or views; and, among that, advice to add stops for calibrating the arm.
_ADD = re.compile(r"\bAdd (?:stops|views|\d+ or more)\b")
_OR_MEASURED = re.compile(r".*Where the arm cannot tilt, (measure that offset for \S+)\..*")
_ARM = re.compile(r"\bAdd (?:stops|views in which the arm)\b")


@dataclass(frozen=True, eq=False)
class Run:
    """A calibration with its evidence."""

    calibration: Calibration  # The result.
    evidence: tuple[ViewEvidence, ...]  # One entry for each view of the session.
    # Residual of each view, by a fit without its stop [m], [px].
    left_out: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    # What was found in each image, by view, from which alone the run can be repeated; empty where
    # more of the images was used.
    searches: Mapping[int, Searched] = field(default_factory=dict)

    def with_paths(self, session: Path | str, out: Path | str) -> "Run":
        """Fills the paths of session and output into the verdict's commands."""
        verdict = self.calibration.verdict.with_paths(session, out)
        return replace(self, calibration=replace(self.calibration, verdict=verdict))


class CalibrationOptions(TypedDict, total=False):
    """Options of `calibrate`, by name; the defaults are its own.

    With `pictures`, faint copies of the images are kept in `Run.searches`.
    """

    solver: SolverName
    level: str
    convention: Convention | None
    progress: Progress | None
    threads: int | None
    dense: bool
    pictures: bool


def run(session: Session | Path | str, **asked: Unpack[CalibrationOptions]) -> Run:
    """Calibrates a session and keeps the evidence; see `calibrate`."""
    state = run_stages(initial_state(session, **asked))
    held_out = state.assessment.held_out
    residuals = zip(held_out.residual_m.tolist(), held_out.rms_px.tolist(), strict=True)
    left_out = dict(zip(state.used, residuals, strict=True))
    searches = state.searches if state.dense is None else {}
    return Run(result_of(state), view_evidence(state), left_out, searches)


def initial_state(session: Session | Path | str, **asked: Unpack[CalibrationOptions]) -> RunState:
    """Loads the session and checks the options: the state before the first stage."""
    threads, solver = asked.get("threads"), asked.get("solver", "joint")
    level, convention = asked.get("level", "auto"), asked.get("convention")
    if threads is not None and threads < 1:
        raise DataError(f"threads is {threads}; at least 1 is needed.", culprits=["--threads"])
    check_level(level)
    loaded = session if isinstance(session, Session) else Session.load(session)
    state = RunState(
        loaded,
        asked.get("progress"),
        threads or 0,
        dense={} if asked.get("dense") else None,
        pictures=asked.get("pictures", False),
        solver=solver,
        level=level,
        convention=convention,
    )
    if state.mount is None and solver != "joint":
        raise DataError(
            f"solver {solver} cannot be asked of a whole cell: it has the joint solver.",
            culprits=["--solver"],
            next_step="Leave it out, or calibrate one camera and robot of it (Session.of).",
        )
    return state


def run_stages(state: RunState) -> RunState:
    """Runs all stages; an error is raised with its likeliest cause where that is known."""
    progress = state.progress
    located: RunState | None = None
    hint: Finding | None = None
    with one_blas_thread():
        for index, stage in enumerate(STAGES):
            if progress is not None:
                progress(stage.name, index, len(STAGES))
            try:
                state = stage.run(state)
            except VisioncalError as error:
                # Lost views are often why the remaining ones do not suffice.
                lost = [view for view in state.lost_views if view not in error.culprits]
                cause = unseen_cause(state) or (
                    poor_motion(state) if stage.name == "intrinsics" else None
                )
                if cause is not None:
                    raise because(error.with_culprits(lost), cause) from error
                if state.mount is None:
                    hint = hint or exchanged_names(state) or next(misreadings(state), None)
                    if hint is None:
                        raise
                    raise because(error, hint) from error
                raise _with_hint(error.with_culprits(lost), located, hint) from error
            # Misread poses are searched after misread joints were reported, which would mislead.
            if stage.name == "joints":
                located = state
                hint = next(misreadings(state), None)
                if hint is None:
                    state = state.noting((), turned_boards(state))
                # Where only some rows are exchanged, the others can still be fitted.
                state = replace(state, is_misread=hint is not None and not hint.views)
        return _with_other_board(_with_reading(state, located, hint))


def _with_hint(
    error: VisioncalError, located: RunState | None, hint: Finding | None
) -> VisioncalError:
    """Adds the likely misreading of the robot's poses to an error, or a command for more views."""
    if located is None:
        return error
    hint = hint or misread_pose_finding(located)
    if hint is not None:
        # Directions that are undetermined with misread poses mean nothing.
        return type(error)(hint.words, next_step=str(hint.do))
    robot, next_step = located.robot, error.next_step
    if robot is not None and not robot.can_tilt:
        next_step = without_tilting(next_step)
    elif located.scenes:
        (next_step,) = with_proposal([next_step], modelled=robot is not None)
    return type(error)(error.message, culprits=error.culprits, next_step=next_step)


def _with_other_board(state: RunState) -> RunState:
    """Adds to a verdict with lost views which other board they show, if any."""
    verdict = state.verdict
    if verdict is None or all(finding.kind != "lost_views" for finding in verdict.findings):
        return state
    cause = unseen_cause(state)
    if cause is None or cause.kind != "other_board":
        return state
    return replace(state, verdict=with_other_board(verdict, cause))


def _with_reading(state: RunState, located: RunState | None, hint: Finding | None) -> RunState:
    """Adds to a poor verdict the misreading of the poses that explains it, if any."""
    if state.verdict is None or located is None or not may_be_misread(state):
        return state
    if hint is None and state.mount is not None:
        hint = misread_pose_finding(located)
    return state if hint is None else replace(state, verdict=with_misread(state.verdict, hint))


def view_evidence(state: RunState) -> tuple[ViewEvidence, ...]:
    """Collects the evidence of each view: corners, predictions, poses."""
    solved, fit_state = state.cell_fit, state.assessment.state
    held, looks = held_back(solved, state), solved.camera_parameters
    problems = [(solved.cell.rows, solved.poses, solved.inlier_fit.problem)]
    problems += [] if held is None else [(held.rows, held.views, held.problem)]
    evidence = dict[int, ViewEvidence]()
    for cell_rows, views, problem in problems:
        poses = zip(problem.measured(fit_state), problem.predicted(fit_state), strict=True)
        for row, view, (measured, predicted) in zip(cell_rows, views, poses, strict=True):
            corners, px = view.corners, None
            if corners is not None and looks is not None and row.seer in looks.problems:
                camera = looks.camera(row.seer)
                px = predict_corners(camera, predicted, looks.points[corners.ids])
            evidence[row.view] = ViewEvidence(row.view, view.corners, px, None, measured)
    rows = {observation.view.number: observation for observation in state.timed.observations}
    return tuple(
        _evidence(state, view.number, evidence.get(view.number), rows.get(view.number))
        for view in state.session.views
    )


def _evidence(
    state: RunState, view: int, evidence: ViewEvidence | None, observation: Observation | None
) -> ViewEvidence:
    if evidence is None:
        poses = state.poses.get(view)
        evidence = ViewEvidence(
            view,
            state.corners.get(view) if poses is None else poses.corners,
            cam_from_target=None if poses is None else poses.cam_from_target[0],
        )
    corners = None if evidence.corners is None else _board_numbers(state, evidence.corners)
    return replace(evidence, corners=corners, base_from_flange=_flange(state, view, observation))


def _flange(state: RunState, view: int, observation: Observation | None) -> FloatArray | None:
    """(4, 4) `base_from_flange` of a view, by the calibrated arm where there is one."""
    if observation is not None and len(observation.robots) == 1:
        arm = state.cell_fit.arms.get(robot_key(next(iter(observation.robots))))
        if arm is not None and arm.has_pose[observation.station]:
            return np.asarray(arm.poses[observation.station])
    return state.base_from_flange.get(view)


def _board_numbers(state: RunState, corners: Corners) -> Corners:
    """Renumbers a view's corners from the first of its own board."""
    if len(state.session.boards) < 2 or not len(corners.ids):
        return corners
    starts = first_corners(tuple(state.session.boards.values()))
    return replace(corners, ids=corners.ids - int(starts[starts <= corners.ids[0]][-1]))


def with_proposal(sentences: Sequence[str], *, modelled: bool) -> tuple[str, ...]:
    """Appends a pointer to `visioncal plan` to the first advice to add views.

    Args:
        sentences: Advice, or a verdict's reasons.
        modelled: Whether the robot's model is known; without it no stop can be proposed.
    """
    for index, sentence in enumerate(sentences):
        if _ADD.search(sentence):
            pointed = f"{sentence} {_proposal(' '.join(sentences), modelled)}"
            return (*sentences[:index], pointed, *sentences[index + 1 :])
    return tuple(sentences)


def without_tilting(advice: str) -> str:
    """Replaces advice to tilt by that to measure the offset, where the advice names one."""
    words = r"This arm cannot tilt: \1, as z_m and sigma_m in session.toml."
    return _OR_MEASURED.sub(words, advice)


def _proposal(words: str, modelled: bool) -> str:
    if not modelled:
        return (
            "Once [robot] model in session.toml names the arm, visioncal plan SESSION --add 5 "
            "proposes them."
        )
    purpose = " --for kinematics" if _ARM.search(words) else ""
    return f"Let visioncal plan SESSION --add 5{purpose} propose them."
