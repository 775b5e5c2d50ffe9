"""Checks a session for mistakes before anything is fitted, for `visioncal doctor`."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from pathlib import Path

import numpy as np

from visioncal.calibration.pipeline.explaining import more_views
from visioncal.calibration.pipeline.inliers import initial_inliers
from visioncal.calibration.pipeline.judging import poor_motion, words_of
from visioncal.calibration.pipeline.run_state import RunState, initial_state
from visioncal.calibration.pipeline.starting import find_start
from visioncal.calibration.run import STAGES
from visioncal.calibration.stages.cell import read_cell
from visioncal.calibration.stages.image_checks import unseen_cause
from visioncal.calibration.stages.observed import by_reason
from visioncal.calibration.stages.other_board import OtherBoardError
from visioncal.calibration.stages.validate import pose_residuals
from visioncal.calibration.suspects.judged import Findings, JudgedArm, Sensor
from visioncal.calibration.suspects.limits import few_stops
from visioncal.calibration.suspects.mirrored_cell import of_camera
from visioncal.calibration.suspects.misread_poses import misreadings, turned_boards, with_undone
from visioncal.calibration.suspects.outliers import farthest_by_arms
from visioncal.calibration.suspects.rounded_poses import rounded
from visioncal.core.arguments import typed
from visioncal.core.directions import Turning
from visioncal.core.errors import DegenerateError, VisioncalError
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import counted, mm_and_deg, row_words, some_of, view_words
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, Progress
from visioncal.core.verdict import CALIBRATE, Finding, Remedy, of_cell, with_paths
from visioncal.estimation.observability import check_determined
from visioncal.estimation.solve import starting_noise
from visioncal.robot.model import REPEATABILITY
from visioncal.session import Session


@dataclass(frozen=True)
class Checkup:
    """Result of checking a session."""

    session: str  # The session's name.
    seen: tuple[str, ...]  # Its contents, in a few words each.
    findings: tuple[Finding, ...]  # Its faults, the likeliest cause first, each with a remedy.

    @property
    def is_sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.findings

    def __repr__(self) -> str:
        lines = [f"{self.session}: {'; '.join(self.seen)}."]
        lines += [f"- {finding.reason}" for finding in self.findings] or ["Nothing is wrong."]
        return "\n".join(lines)


@typed
def doctor(session: Session | Path | str, *, progress: Progress | None = None) -> Checkup:
    """Checks a session for mistakes, in seconds: no chain is fitted.

    Args:
        session: A session, or the path of its folder or recording.
        progress: Called with the progress of long work.

    Returns:
        The faults, the likeliest cause first; commands contain the session's path where one is
        given.

    Raises:
        DataError: The session cannot be read.
    """
    run = initial_state(session, progress=progress)
    with one_blas_thread():
        run, error = _run_stages(run)
        run = with_undone(run) if error is None else run
        findings = [*_findings(run, error)]
    if error is None:
        findings = [*of_cell(findings, len(run.robots), len(run.cameras))]
    if not isinstance(session, Session):
        fill = partial(with_paths, session=session)
        findings = [
            found.with_do(lambda do: Remedy(fill(do.words), fill(do.command))) for found in findings
        ]
    return Checkup(run.session.name, tuple(_contents(run)), tuple(findings))


def to_document(checkup: Checkup) -> dict[str, object]:
    """Converts a checkup to a JSON document."""
    findings = [
        {
            "kind": finding.kind,
            "sentence": finding.words,
            "views": list(finding.views),
            "do": finding.do.words if finding.do else "",
            "command": finding.do.command if finding.do else "",
        }
        for finding in checkup.findings
    ]
    findings = [{name: value for name, value in entry.items() if value} for entry in findings]
    return {"session": checkup.session, "seen": list(checkup.seen), "findings": findings}


def _run_stages(run: RunState) -> tuple[RunState, VisioncalError | None]:
    """Runs the stages before the fit up to the first error."""
    stages = [*takewhile(lambda stage: stage.name != "solve", STAGES)]
    for at, stage in enumerate(stages):
        if run.progress is not None:
            run.progress(stage.name, at, len(stages))
        try:
            run = stage.run(run)
        except VisioncalError as error:
            return run, error
    return run, None


def _findings(run: RunState, error: VisioncalError | None) -> Iterator[Finding]:
    cause = error.finding if isinstance(error, OtherBoardError) else None
    if cause is None and (error is not None or run.reasons):
        cause = unseen_cause(run)
    read = [*(run.misread or ())]
    if error is None and run.misread is None:
        read += misreadings(run)
    hint = " ".join(finding.words for finding in read)
    if error is None and not read:
        read += [*of_camera(run)] or turned_boards(run)
    if cause is not None:
        yield cause
    yield from read
    if error is not None and cause is None:
        # Views that leave the lens open may leave the mount open, too: one remedy is for both.
        if isinstance(error, DegenerateError) and (motion := poor_motion(run)) is not None:
            yield motion
        yield _refused("refused", error)
    warnings = [
        warning
        for warning in run.warnings
        if warning.kind != "unused"
        and (cause is None or warning.kind != cause.kind)
        and warning.words not in hint
    ]
    yield from sorted(warnings, key=lambda value: value.do is None)
    if error is None:
        if not hint:
            yield from _motion(run)
        # Views that cannot be used, but for those that warnings name already.
        named = {view for warning in run.warnings for view in warning.views}
        lost = {view: why for view, why in run.reasons.items() if view not in named}
        do = Remedy("Look at their images, and correct their rows in views.csv, or repeat them.")
        for words in by_reason(lost):
            yield Finding("lost_views", f"{words[0].upper()}{words[1:]}.", do)


def _refused(kind: str, error: VisioncalError, more: Remedy | None = None) -> Finding:
    more = more or (Remedy(error.next_step) if error.next_step else None)
    return Finding(kind, error.message, more)


def _motion(run: RunState) -> Iterator[Finding]:
    """Findings on too poor motion; of one camera and one robot on outliers and scatter, too."""
    try:
        start = find_start(read_cell(run), run, is_solved=False)
        cell, problem = start.cell, start.problem
        noise, words = starting_noise(problem), words_of(cell, problem, can_tilt=run.can_tilt)
        px = {frame: look.pixel_px for frame, look in run.cameras.items() if look.pixel_px}
        check_determined(problem, start.state, noise, words, px)
        if not run.session.has_one_pair:
            return
        inliers = initial_inliers(start)
    except VisioncalError as error:
        yield _refused("motion", error, more_views(error, run))
        return
    # Errors that arms, lenses and prints have are weighed by calibrate alone.
    away_m, away_rad = pose_residuals(problem, inliers.fit.state)
    most_mm, most_deg = farthest_by_arms([] if run.robot is None else [run.robot])
    is_far = (1e3 * away_m > most_mm) | (np.rad2deg(away_rad) > most_deg)
    views = tuple(cell.rows[at].view for at in np.flatnonzero(~inliers.used & is_far).tolist())
    if views:
        yield Finding(
            "wrong_views",
            f"{view_words(views).capitalize()}: the others disagree. A pose or an image is wrong, "
            "or something moved.",
            Remedy(
                "Look at images and poses: repeat these views, or in views.csv, delete "
                f"{row_words(views)}; or calibrate, which names what moved.",
                CALIBRATE,
            ),
            views,
        )
    limits, used = CalibrationLimits(), np.flatnonzero(inliers.used).tolist()
    poses = (run.base_from_flange.get(cell.rows[at].view) for at in used)
    if stops := {pose.tobytes(): pose for pose in poses if pose is not None}:
        yield from few_stops(_judged(run, np.array([*stops.values()])), len(used))
    repeats_mm, _ = REPEATABILITY if run.robot is None else run.robot.repeatability
    rad, metres = inliers.fit.noise.robots[0].tolist()
    too_few_digits = rounded(run, next(iter(run.session.robots)), 1e3 * metres, np.rad2deg(rad))
    if too_few_digits is not None:
        yield too_few_digits
    elif 1e3 * metres > max(limits.sigma_mm[0], limits.repeatability * repeats_mm):
        comparison = "industrial arms repeat" if run.robot is None else "this arm repeats"
        causes = "the board is of another size than stated, the lens is not this camera's"
        if not run.scenes:
            causes = "the marker has few pixels or its other pose was taken, the mount is wrong"
        servo = ", or this is a servo arm, which repeats worse" * (run.robot is None)
        yield Finding(
            "scatter",
            f"The views disagree by {mm_and_deg(1e3 * metres, np.rad2deg(rad))} from stop to stop, "
            f"and {comparison} to {repeats_mm:g} mm: {causes}, the poses are not of these "
            f"{'images' if run.scenes else 'rows'}{servo}.",
            Remedy("Calibrate: the verdict weighs the causes.", CALIBRATE),
        )


def _judged(run: RunState, poses: FloatArray) -> Findings:
    """The verdict's findings about a robot's motion, by the poses (n, 4, 4) of its stops."""
    can_tilt = len(poses) < 2 or Turning.of(poses).is_enough
    model, seen = run.robot, 0.0 if run.scenes else None
    arm = JudgedArm(
        len(poses),
        modelled=model is not None,
        can_tilt=can_tilt if model is None else model.can_tilt,
    )
    return Findings(pairs=(), sensors=[Sensor(len(poses), pixel_px=seen)], arms=[arm], worst=())


def _contents(run: RunState) -> Iterator[str]:
    """The contents of the session, in a few words each."""
    session = run.session
    yield counted(len(session.views), "view")
    images = [view.image for view in session.views if view.image]
    if images:
        existing = sum(session.images.exists(image) for image in images)
        yield f"{existing} of {counted(len(images), 'image')}"
    for look in run.cameras.values():
        seen = f"the board in {counted(len(look.corners), 'image' if images else 'view')}"
        px = np.vstack([np.zeros((0, 2)), *(at.px for at in look.corners.values())])
        if len(px) and look.resolution is not None:
            wide, high = 100.0 * np.ptp(px, axis=0) / look.resolution
            seen += f", over {wide:.0f} % of their width and {high:.0f} % of their height"
        yield seen
    for robot, reported in run.robots.items():
        # Rows of one stop share a pose.
        if poses := {pose.tobytes() for pose in reported.base_from_flange.values()}:
            label = f"robot {robot}" if len(run.robots) > 1 else "the robot"
            yield f"{counted(len(poses), 'pose')} of {label}"
    if session.streams:
        yield f"streams {some_of(list(session.streams))}"
