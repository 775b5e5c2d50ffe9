"""Taking a session of any cell, one camera and robot or many, to result and evidence."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np

from visioncal.calibration.pipeline.answer import held_back
from visioncal.calibration.pipeline.exchanged_names import exchanged_names
from visioncal.calibration.pipeline.judging import poor_motion
from visioncal.calibration.pipeline.reading_hints import is_suspect, misreadings, reading_hint
from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.steps import STAGES
from visioncal.calibration.stages.cause_ranking import with_misread, with_other_board
from visioncal.calibration.stages.cell import robot_key
from visioncal.calibration.stages.dense import Dense
from visioncal.calibration.stages.handeye import SOLVER_NAMES
from visioncal.calibration.stages.kinematics import check_level
from visioncal.calibration.stages.pictures import because, unseen_cause
from visioncal.calibration.stages.validate import predict_corners
from visioncal.core.choices import CONVENTIONS, Convention, SolverName
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Corners, FloatArray, Progress
from visioncal.core.verdict import Finding
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session
from visioncal.session.observations import Observation
from visioncal.vision.targets import first_corners

# Advice to add stops or views of any kind; of the first, those that are about the arm.
_ADD = re.compile(r"\bAdd (?:stops|views|\d+ or more)\b")
_OR_MEASURED = re.compile(r".*Where the arm cannot tilt, (measure that offset for \S+)\..*")
_ARM = re.compile(r"\bAdd (?:stops|views in which the arm)\b")


@dataclass(frozen=True, eq=False)
class Run:
    """A calibration with what was seen and computed on the way to it.

    Attributes:
        calibration: The result.
        evidence: One entry for each view of the session.
        dense: What all pixels have of the images, where they were asked for.
        left_out: By view, how far it is predicted off by a fit without it [m], [px].
    """

    calibration: Calibration
    evidence: tuple[ViewEvidence, ...]
    dense: Dense | None = None
    left_out: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    def with_paths(self, session: Path | str, out: Path | str) -> "Run":
        """The same with the paths of a run in the verdict's commands."""
        verdict = self.calibration.verdict.with_paths(session, out)
        return replace(self, calibration=replace(self.calibration, verdict=verdict))


class Asked(TypedDict, total=False):
    """How a session is calibrated, as `calibrate` says: each by its name, or as it is there."""

    solver: SolverName
    level: str
    convention: Convention | None
    progress: Progress | None
    threads: int | None
    keep_corners: bool


def run(
    session: Session | Path | str, *, dense: Dense | None = None, **asked: Unpack[Asked]
) -> Run:
    """Calibrates a session and keeps the evidence; see `calibrate`."""
    known = run_steps(replace(known_at_first(session, **asked), dense=dense))
    held = known.solved.held_out
    pairs = zip(held.away_m.tolist(), held.rms_px.tolist(), strict=True)
    left_out = dict(zip(known.used, pairs, strict=True))
    return Run(result_of(known), view_evidence(known), known.dense, left_out)


def known_at_first(session: Session | Path | str, **asked: Unpack[Asked]) -> RunState:
    """What is known at the start, checked."""
    threads, solver = asked.get("threads"), asked.get("solver", "joint")
    level, convention = asked.get("level", "auto"), asked.get("convention")
    if threads is not None and threads < 1:
        raise DataError(f"threads is {threads}; at least 1 is needed.", culprits=["--threads"])
    if solver not in SOLVER_NAMES:
        raise DataError(
            f"solver {solver!r} is not one of {', '.join(SOLVER_NAMES)}.", culprits=["solver"]
        )
    check_level(level)
    if convention is not None and convention not in CONVENTIONS:
        words = f"convention {convention!r} is not one of {', '.join(CONVENTIONS)}."
        raise DataError(words, culprits=["convention"])
    loaded = session if isinstance(session, Session) else Session.load(session)
    known = RunState(
        loaded,
        asked.get("progress"),
        threads or 0,
        asked.get("keep_corners", False),
        solver=solver,
        level=level,
        convention=convention,
    )
    if known.mount is None and solver != "joint":
        raise DataError(
            f"solver {solver} cannot be asked of a whole cell: it has the joint solver.",
            culprits=["--solver"],
            next_step="Leave it out, or calibrate one camera and robot of it (Session.of).",
        )
    return known


def run_steps(known: RunState) -> RunState:
    """Takes a session through all steps."""
    progress = known.progress
    seen: RunState | None = None
    hint: Finding | None = None
    with one_blas_thread():
        for at, stage in enumerate(STAGES):
            if progress is not None:
                progress(stage.name, at, len(STAGES))
            try:
                known = stage.run(known)
            except VisioncalError as error:
                # Views that are out of the game are often why the rest does not suffice.
                more = [view for view in known.lost_views if view not in error.culprits]
                cause = unseen_cause(known) or (
                    poor_motion(known) if stage.name == "intrinsics" else None
                )
                if cause is not None:
                    raise because(error.with_culprits(more), cause) from error
                if known.mount is None:
                    hint = hint or exchanged_names(known) or next(misreadings(known), None)
                    if hint is None:
                        raise
                    raise because(error, hint) from error
                raise _with_hint(error.with_culprits(more), seen, hint) from error
            # Joints that are misread explain themselves, and would mislead a guess about poses.
            if stage.name == "joints":
                seen = known
                hint = next(misreadings(known), None)
                # Of exchanged rows the others are as they should be.
                known = replace(known, is_misread=hint is not None and not hint.views)
        return _with_other_board(_with_reading(known, seen, hint))


def _with_hint(
    error: VisioncalError, seen: RunState | None, hint: Finding | None
) -> VisioncalError:
    """Adds to an error, once the target's poses are known, what leads on."""
    # That is how the robot's poses should be read, or else what proposes the views that are
    # missing.
    if seen is None:
        return error
    hint = hint or reading_hint(seen)
    if hint is not None:
        # The directions that the poses, misread, leave open mean nothing.
        return type(error)(hint.words, next_step=str(hint.do))
    robot, next_step = seen.robot, error.next_step
    if robot is not None and not robot.can_tilt:
        next_step = of_arm_that_cannot_tilt(next_step)
    elif seen.scenes:
        (next_step,) = with_proposal([next_step], modelled=robot is not None)
    return type(error)(error.message, culprits=error.culprits, next_step=next_step)


def _with_other_board(known: RunState) -> RunState:
    """Adds to a verdict on views without a board which board they show."""
    verdict = known.verdict
    if verdict is None or all(finding.kind != "lost_views" for finding in verdict.findings):
        return known
    cause = unseen_cause(known)
    if cause is None or cause.kind != "other_board":
        return known
    return replace(known, verdict=with_other_board(verdict, cause))


def _with_reading(known: RunState, seen: RunState | None, hint: Finding | None) -> RunState:
    """Adds to a poor verdict how the poses should be read, where that explains it."""
    if known.verdict is None or seen is None or not is_suspect(known):
        return known
    if hint is None and known.mount is not None:
        hint = reading_hint(seen)
    if hint is None:
        return known
    return replace(known, verdict=with_misread(known.verdict, hint))


def view_evidence(known: RunState) -> tuple[ViewEvidence, ...]:
    """Collects what was seen and computed of each view."""
    solved, state = known.fitted, known.solved.state
    held = held_back(solved, known)
    problems = [(solved.cell.rows, solved.poses, solved.agreed.problem)]
    problems += [] if held is None else [(held.rows, held.views, held.problem)]
    found = dict[int, ViewEvidence]()
    for rows, views, problem in problems:
        poses = zip(problem.measured(state), problem.predicted(state), strict=True)
        for row, view, (measured, predicted) in zip(rows, views, poses, strict=True):
            px = None
            if view.corners is not None:
                px = _predicted(known, row.seer, predicted, view.corners)
            found[row.view] = ViewEvidence(row.view, view.corners, px, None, measured)
    stood = {observation.view.number: observation for observation in known.timed.observations}
    return tuple(
        _evidence(known, view.number, found.get(view.number), stood.get(view.number))
        for view in known.session.views
    )


def _evidence(
    known: RunState, view: int, found: ViewEvidence | None, row: Observation | None
) -> ViewEvidence:
    if found is None:
        poses = known.poses.get(view)
        found = ViewEvidence(
            view,
            known.corners.get(view) if poses is None else poses.corners,
            cam_from_target=None if poses is None else poses.cam_from_target[0],
        )
    corners = None if found.corners is None else _own_numbers(known, found.corners)
    return replace(found, corners=corners, base_from_flange=_flange(known, view, row))


def _flange(known: RunState, view: int, row: Observation | None) -> FloatArray | None:
    """(4, 4) where the robot stood: by the calibrated arm where there is one."""
    if row is not None and len(row.robots) == 1:
        arm = known.fitted.arms.get(robot_key(next(iter(row.robots))))
        if arm is not None and arm.stood[row.station]:
            return np.asarray(arm.poses[row.station])
    return known.base_from_flange.get(view)


def _own_numbers(known: RunState, corners: Corners) -> Corners:
    """The corners of a view by their numbers on its own board, again."""
    if len(known.session.boards) < 2 or not len(corners.ids):
        return corners
    starts = first_corners(tuple(known.session.boards.values()))
    return replace(corners, ids=corners.ids - int(starts[starts <= corners.ids[0]][-1]))


def _predicted(
    known: RunState, seer: str, cam_from_target: FloatArray, corners: Corners
) -> FloatArray | None:
    looks = known.fitted.looks
    if looks is None or seer not in looks.problems:
        return None
    positions = looks.points[corners.ids]
    return predict_corners(looks.camera(seer), cam_from_target, positions)


def with_proposal(sentences: Sequence[str], *, modelled: bool) -> tuple[str, ...]:
    """Points to `visioncal plan` behind the first advice to add views; once is enough.

    Args:
        sentences: Advice, reasons of a verdict; changed is the first that asks for views.
        modelled: Whether the robot's model is known, without which no stop can be proposed.
    """
    for at, sentence in enumerate(sentences):
        if _ADD.search(sentence):
            pointed = f"{sentence} {_proposal(' '.join(sentences), modelled)}"
            return (*sentences[:at], pointed, *sentences[at + 1 :])
    return tuple(sentences)


def of_arm_that_cannot_tilt(advice: str) -> str:
    """The same advice without views that no such arm can reach, where a measured offset helps."""
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
