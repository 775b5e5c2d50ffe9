"""Checks a session for mistakes before anything is fitted, for `visioncal doctor`."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from visioncal.calibration.pipeline.misread_poses import (
    misread_pose_finding,
    misreadings,
    turned_boards,
)
from visioncal.calibration.pipeline.run_state import RunState, initial_state
from visioncal.calibration.pipeline.solving import first_inliers
from visioncal.calibration.run import stages_before
from visioncal.calibration.stages.cell import Cell, read_cell
from visioncal.calibration.stages.image_checks import unseen_cause
from visioncal.calibration.stages.observed import by_reason
from visioncal.calibration.suspects.ranking import LEAST_RUN
from visioncal.core.arguments import typed
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import counted, figure, mm_and_deg, some_of
from visioncal.core.summaries import html_card
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Mask, Mount, Progress
from visioncal.core.verdict import CALIBRATE, Finding, Remedy, with_paths
from visioncal.session import Session

# Noise of corners beyond which a lens is in doubt [px], and of the flange [mm].
_MOST_PX, _MOST_MM = CalibrationLimits().pixel_px[0], 1.0
# Kind of warnings that are no fault of the session.
_NO_FAULT = "unused"


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

    def _repr_html_(self) -> str:
        reasons = [finding.reason for finding in self.findings] or ["Nothing is wrong."]
        seen = {"seen": "; ".join(self.seen)}
        return html_card(self.session, seen, "good" if self.is_sound else "check", reasons)

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
        findings = [*_findings(run, error)]
    if not isinstance(session, Session):
        findings = [_with_session(finding, session) for finding in findings]
    return Checkup(run.session.name, tuple(_contents(run)), tuple(findings))


def to_document(checkup: Checkup) -> dict[str, object]:
    """Converts a checkup to a JSON document."""
    findings = []
    for finding in checkup.findings:
        step = {"do": finding.do.words, "command": finding.do.command} if finding.do else {}
        entry = {
            "kind": finding.kind,
            "sentence": finding.words,
            "views": list(finding.views),
            **step,
        }
        findings.append({name: value for name, value in entry.items() if value})
    return {"session": checkup.session, "seen": list(checkup.seen), "findings": findings}


def _with_session(finding: Finding, session: Path | str) -> Finding:
    """Fills the session's path into a finding's remedy."""
    if finding.do is None:
        return finding
    words, command = (with_paths(text, session) for text in (finding.do.words, finding.do.command))
    return replace(finding, do=Remedy(words, command))


def _run_stages(run: RunState) -> tuple[RunState, VisioncalError | None]:
    """Runs the stages before the fit up to the first error."""
    stages = stages_before("solve")
    for at, stage in enumerate(stages):
        if run.progress is not None:
            run.progress(stage.name, at, len(stages))
        try:
            run = stage.run(run)
        except VisioncalError as error:
            return run, error
    return run, None


def _findings(run: RunState, error: VisioncalError | None) -> Iterator[Finding]:
    cause = unseen_cause(run) if error is not None or run.reasons else None
    hint, read = None, list[Finding]()
    if error is None and run.mount is not None:
        hint = misread_pose_finding(run)
        read += [] if hint is None else [hint]
    elif error is None:
        read += misreadings(run)
    if error is None and not read:
        read += turned_boards(run)
    if cause is not None:
        yield cause
    yield from read
    if error is not None and cause is None:
        yield _refused("refused", error)
    warnings = [
        warning
        for warning in run.warnings
        if warning.kind != _NO_FAULT
        and (cause is None or warning.kind != cause.kind)
        and (hint is None or warning.words not in hint.words)
    ]
    has_lens = any(warning.kind == "other_lens" for warning in warnings)
    lens = [] if error is not None or has_lens else list(_lenses(run))
    yield from sorted([*lens, *warnings], key=lambda value: value.do is None)
    if error is None:
        if hint is None and run.mount is not None and not lens:
            yield from _motion(run, run.mount)
        yield from _lost(run)


def _refused(kind: str, error: VisioncalError) -> Finding:
    return Finding(kind, error.message, Remedy(error.next_step) if error.next_step else None)


def _lenses(run: RunState) -> Iterator[Finding]:
    """Findings on stated lenses that do not fit the images."""
    for frame, look in run.cameras.items():
        stated, noise_px = look.table.stated, look.pixel_px
        # Noise that is only stated says nothing of the lens.
        if stated is None or noise_px in {None, *(px.stated_px for px in look.corners.values())}:
            continue
        if noise_px is not None and noise_px > _MOST_PX:
            yield Finding(
                "lens",
                f"Corners deviate by {figure(noise_px)} px from any pose of a flat board (doubt "
                f"begins at {_MOST_PX:g}): the stated lens is not this camera's, or the board is "
                "not flat.",
                Remedy(
                    "In session.toml, delete matrix and distortion, so that they are estimated."
                ),
            ).of(frame if len(run.cameras) > 1 else "")


def _motion(run: RunState, mount: Mount) -> Iterator[Finding]:
    """Findings on too poor motion, and on outliers."""
    try:
        cell, inliers = first_inliers(read_cell(run), run, mount)
    except VisioncalError as error:
        yield _refused("motion", error)
        return
    views = tuple(cell.rows[at].view for at in np.flatnonzero(~inliers.used).tolist())
    named, one = some_of([*map(str, views)]), len(views) == 1
    if _is_run(cell, inliers.used):
        yield Finding(
            "something_moved",
            f"Views {named} disagree with the others, and follow each other: from view {views[0]} "
            f"to view {views[-1]}, something stood elsewhere or was set up otherwise.",
            Remedy(
                "Calibrate: the verdict says what it is, where one change explains it.", CALIBRATE
            ),
            views,
        )
    elif views:
        yield Finding(
            "wrong_views",
            f"{'View' if one else 'Views'} {named} {'disagrees' if one else 'disagree'} with the "
            "others: a pose or an image is wrong, or something moved.",
            Remedy(
                "Look at images and poses: repeat these views, or in views.csv, delete the "
                f"row{'' if one else 's'} of view {', '.join(map(str, views))}."
            ),
            views,
        )
    used, (enough, _) = int(inliers.used.sum()), CalibrationLimits().stops
    if used < enough:
        yield Finding(
            "few_stops",
            f"Only {counted(used, 'view')} can be used; {enough} or more give a result something "
            "to be checked with.",
            Remedy(
                f"Add {counted(enough - used, 'view')} or more, tilted by 20 to 40 degrees about "
                "different axes."
            ),
        )
    rad, metres = inliers.fit.noise.robots[0].tolist()
    if 1e3 * metres > _MOST_MM:
        yield Finding(
            "scatter",
            f"The views disagree by {mm_and_deg(1e3 * metres, np.rad2deg(rad))} "
            "from stop to stop, and arms repeat to 0.1 mm: the board is of another size than "
            "stated, the lens is not this camera's, or the poses are not of these images.",
            Remedy("Calibrate: the verdict weighs the causes.", CALIBRATE),
        )


def _is_run(cell: Cell, used: Mask) -> bool:
    """Whether the outliers are all at one end of the session, and not too few."""
    order = np.argsort([row.station for row in cell.rows], kind="stable")
    ends = np.count_nonzero(used[order][1:] != used[order][:-1])
    return bool(ends == 1 and np.sum(~used) >= LEAST_RUN)


def _lost(run: RunState) -> Iterator[Finding]:
    """Findings on views that cannot be used, except those that warnings name already."""
    reported = {view for warning in run.warnings for view in warning.views}
    reasons = {view: why for view, why in run.reasons.items() if view not in reported}
    is_read = run.mount is not None and run.robots
    posed = run.base_from_flange.keys() if is_read else reasons.keys()
    of_rows = {view: why for view, why in reasons.items() if view not in posed}
    of_images = {view: why for view, why in reasons.items() if view in posed}
    for lost, do in (
        (of_rows, "In views.csv, correct the rows that are named, or delete them."),
        (of_images, "Look at the image, and repeat the view or take it out of views.csv."),
    ):
        for words in by_reason(lost):
            yield Finding("lost_views", f"{words[0].upper()}{words[1:]}.", Remedy(do))


def _contents(run: RunState) -> Iterator[str]:
    """The contents of the session, in a few words each."""
    session = run.session
    yield counted(len(session.views), "view")
    images = [view.image for view in session.views if view.image]
    if images:
        there = sum(session.images.exists(image) for image in images)
        yield f"{there} of {counted(len(images), 'image')}"
    for look in run.cameras.values():
        blur = [corners.blur_px for corners in look.corners.values() if corners.blur_px > 0.0]
        size = "" if look.resolution is None else " of {} x {} px".format(*look.resolution)
        edges = f", edges {np.median(blur):.1f} px wide" if blur else ""
        seen = counted(len(look.corners), "image" if images else "view")
        yield f"the board in {seen}{size}{edges}"
    for robot, reported in run.robots.items():
        # Rows of one stop share a pose.
        if poses := {pose.tobytes() for pose in reported.base_from_flange.values()}:
            whose = f"robot {robot}" if len(run.robots) > 1 else "the robot"
            yield f"{counted(len(poses), 'pose')} of {whose}"
    if session.streams:
        yield f"streams {some_of(list(session.streams))}"


def next_command(checkup: Checkup, session: Path | str) -> str:
    """The command to calibrate a sound session; empty for another."""
    return "" if checkup.findings else with_paths(CALIBRATE, session, "out")
