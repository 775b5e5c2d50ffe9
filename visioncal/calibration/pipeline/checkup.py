"""What is wrong with a session before anything is solved, and what to type: `visioncal doctor`."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from visioncal.calibration.pipeline.exchanged_names import exchanged_names
from visioncal.calibration.pipeline.reading_hints import misreadings, reading_hint
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.running import known_at_first
from visioncal.calibration.pipeline.solving import first_inliers
from visioncal.calibration.pipeline.steps import stages_before
from visioncal.calibration.stages.cause_ranking import LEAST_RUN
from visioncal.calibration.stages.cell import Cell, read_cell
from visioncal.calibration.stages.image_size import other_images
from visioncal.calibration.stages.intrinsics import estimate_intrinsics
from visioncal.calibration.stages.observed import CameraLook, by_reason
from visioncal.calibration.stages.pictures import unnamed_images, unseen_cause
from visioncal.core.arguments import typed
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import figure, mm_and_deg, some_of
from visioncal.core.shown import html_card
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Camera, Mask, Mount, Progress
from visioncal.core.verdict import CALIBRATE, MISSING, Finding, Remedy, with_paths
from visioncal.session import Session
from visioncal.vision.finders.board import hidden_corners

# A lens is estimated by corners all over the image: so many of these parts of it need some.
_PARTS, _LEAST_PARTS = 4, 7
# So many images that show where a row should be, without it, are no chance.
_LEAST_WITHOUT = 3
# A lens's centre is nearer to the middle of its images than this share of it.
_OFF_CENTRE = 0.15
# Noise of corners beyond which a lens is in doubt [px], and of the flange [mm].
_MOST_PX, _MOST_MM = CalibrationLimits().pixel_px[0], 1.0
# What is allowed, and no mistake.
_NO_FAULT = ("unused",)


@dataclass(frozen=True)
class Checkup:
    """What is wrong with a session.

    Attributes:
        session: Its name.
        seen: What is there, in a few words each.
        findings: What is wrong, the likeliest cause first, each with what to do.
    """

    session: str
    seen: tuple[str, ...]
    findings: tuple[Finding, ...]

    @property
    def is_sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.findings

    def _repr_html_(self) -> str:
        says = [finding.reason for finding in self.findings] or ["Nothing is wrong."]
        seen = {"seen": "; ".join(self.seen)}
        return html_card(self.session, seen, "good" if self.is_sound else "check", says)

    def __repr__(self) -> str:
        lines = [f"{self.session}: {'; '.join(self.seen)}."]
        lines += [f"- {finding.reason}" for finding in self.findings] or ["Nothing is wrong."]
        return "\n".join(lines)


@typed
def doctor(session: Session | Path | str, *, progress: Progress | None = None) -> Checkup:
    """Looks for what is wrong with a session, in seconds: nothing is fitted to the chain.

    Args:
        session: A session, or the path of its folder or recording.
        progress: Told of long work.

    Returns:
        What is wrong, the likeliest cause first; commands have the session's path where one is
        given.

    Raises:
        DataError: It cannot be read.
    """
    known = known_at_first(session, progress=progress)
    with one_blas_thread():
        known, error = _looked(known)
        found = [*_findings(known, error)]
    if not isinstance(session, Session):
        found = [_of(finding, session) for finding in found]
    return Checkup(known.session.name, tuple(_seen(known)), tuple(found))


def to_document(checkup: Checkup) -> dict[str, object]:
    """Writes what was found as the content of a JSON document."""
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


def _of(found: Finding, session: Path | str) -> Finding:
    if found.do is None:
        return found
    words, command = (with_paths(text, session) for text in (found.do.words, found.do.command))
    return replace(found, do=Remedy(words, command))


def _looked(known: RunState) -> tuple[RunState, VisioncalError | None]:
    """Takes a session through the steps before the fit, as far as they go."""
    stages = stages_before("solve")
    for at, stage in enumerate(stages):
        if known.progress is not None:
            known.progress(stage.name, at, len(stages))
        try:
            known = stage.run(known)
        except VisioncalError as error:
            return known, error
    return known, None


def _findings(known: RunState, error: VisioncalError | None) -> Iterator[Finding]:
    cause = unseen_cause(known) if error is not None or known.reasons else None
    if cause is not None:
        yield cause
    hint = reading_hint(known) if error is None and known.mount is not None else None
    if hint is not None:
        yield hint
    if known.mount is None:
        readings = [*misreadings(known)] if error is None else []
        names = None if readings else exchanged_names(known)
        yield from readings if names is None else [names]
    if error is not None and cause is None:
        yield _refused("refused", error)
    said = () if cause is None else (cause.kind,)
    warned = [
        warning
        for warning in known.warnings
        if warning.kind not in (*_NO_FAULT, *said)
        and (hint is None or warning.words not in hint.words)
    ]
    is_said = "other_lens" in {finding.kind for finding in warned}
    lens = [] if error is not None or is_said else list(_lenses(known))
    yield from sorted([*lens, *warned], key=lambda value: value.do is None)
    if error is None:
        if hint is None and known.mount is not None and not lens:
            yield from _motion(known, known.mount)
        yield from _lost(known)
        yield from _coverage(known)
    if not {MISSING, "shared_image"} & {finding.kind for finding in (*warned, cause) if finding}:
        yield from unnamed_images(known.session)


def _refused(kind: str, error: VisioncalError) -> Finding:
    return Finding(kind, error.message, Remedy(error.next_step) if error.next_step else None)


def _lenses(known: RunState) -> Iterator[Finding]:
    """Lenses that are stated and not those of the images."""
    step = Remedy("In session.toml, delete matrix and distortion, so that they are estimated.")
    for frame, look in known.cameras.items():
        stated = look.table.stated
        if stated is None:
            continue
        middle = (np.array(stated.resolution) - 1.0) / 2.0
        shares = stated.matrix[2:] / middle
        words, mend = "", step
        if np.all(np.abs(shares - 1.0) > _OFF_CENTRE) and abs(shares[0] / shares[1] - 1.0) < 0.1:
            x, y = stated.matrix[2:]
            words = (
                f"The stated matrix is of images of another size: its centre is at ({x:.0f}, "
                f"{y:.0f}) px, and the middle of these is at ({middle[0]:.0f}, {middle[1]:.0f}) px."
            )
            words, mend = _resized(known, look, stated) or (words, mend)
        elif (noise_px := _measured_px(look)) > _MOST_PX:
            words = (
                f"Corners deviate by {figure(noise_px)} px from any pose of a flat board "
                f"(doubt begins at {_MOST_PX:g}): the stated lens is not this camera's, or the "
                "board is not flat."
            )
        if words:
            yield Finding("lens", words, mend).of(frame if len(known.cameras) > 1 else "")


def _resized(known: RunState, look: CameraLook, stated: Camera) -> tuple[str, Remedy] | None:
    """How much larger the images of a stated matrix are, by a lens of these images."""
    targets, model = tuple(known.session.boards.values()), look.table.model
    try:
        found = estimate_intrinsics(look.corners, targets, stated.resolution, model)
    except VisioncalError:
        return None
    words, do = other_images(stated, found.camera.matrix)
    return (words, Remedy(do)) if words else None


def _measured_px(look: CameraLook) -> float:
    """Noise of a corner's coordinate [px]; zero where it is not measured, but stated."""
    stated = {view_corners.stated_px for view_corners in look.corners.values()}
    return 0.0 if look.pixel_px is None or look.pixel_px in stated else look.pixel_px


def _motion(known: RunState, mount: Mount) -> Iterator[Finding]:
    """Motion that is too poor, and views that disagree."""
    try:
        cell, agreed = first_inliers(read_cell(known), known, mount)
    except VisioncalError as error:
        yield _refused("motion", error)
        return
    out = [row.view for row, used in zip(cell.rows, agreed.used.tolist(), strict=True) if not used]
    if _is_run(cell, agreed.used):
        yield Finding(
            "something_moved",
            f"Views {some_of([*map(str, out)])} disagree with the others, and follow each other: "
            f"from view {out[0]} to view {out[-1]}, something stood elsewhere or was set up "
            "otherwise.",
            Remedy(
                "Calibrate: the verdict says what it is, where one change explains it.", CALIBRATE
            ),
            tuple(out),
        )
    elif out:
        one = len(out) == 1
        rows = ", ".join(map(str, out))
        yield Finding(
            "wrong_views",
            f"{'View' if one else 'Views'} {some_of([*map(str, out)])} "
            f"{'disagrees' if one else 'disagree'} with the others: {'its' if one else 'their'} "
            "pose or image is wrong, or something moved.",
            Remedy(
                f"Look at {'its image and pose' if one else 'their images and poses'}: repeat "
                f"{'it' if one else 'them'}, or in views.csv, delete the row{'' if one else 's'} "
                f"of view {rows}."
            ),
            tuple(out),
        )
    used, (enough, _) = int(agreed.used.sum()), CalibrationLimits().stops
    if used < enough:
        yield Finding(
            "few_stops",
            f"Only {used} views can be used; {enough} or more give a result something to be "
            "checked with.",
            Remedy(
                f"Add {enough - used} views or more, tilted by 20 to 40 degrees about different "
                "axes."
            ),
        )
    rad, metres = agreed.fit.noise.robots[0].tolist()
    if 1e3 * metres > _MOST_MM:
        yield Finding(
            "scatter",
            f"The views disagree by {mm_and_deg(1e3 * metres, np.rad2deg(rad))} "
            "from stop to stop, and arms repeat to 0.1 mm: the board is of another size than "
            "stated, the lens is not this camera's, or the poses are not of these images.",
            Remedy("Calibrate: the verdict weighs the causes.", CALIBRATE),
        )


def _is_run(cell: Cell, used: Mask) -> bool:
    """Whether the views that are left out are all at one end of the session, and not a few."""
    order = np.argsort([row.station for row in cell.rows], kind="stable")
    ends = np.count_nonzero(used[order][1:] != used[order][:-1])
    return bool(ends == 1 and np.sum(~used) >= LEAST_RUN)


def _lost(known: RunState) -> Iterator[Finding]:
    """Views that cannot be used, but for those whose images are missing: that was said."""
    absent = {view for found in known.warnings for view in found.views}
    reasons: Mapping[int, str] = {
        view: why for view, why in known.reasons.items() if view not in absent
    }
    is_read = known.mount is not None and known.robots
    posed = known.base_from_flange.keys() if is_read else reasons.keys()
    of_rows = {view: why for view, why in reasons.items() if view not in posed}
    of_images = {view: why for view, why in reasons.items() if view in posed}
    for some, do in (
        (of_rows, "In views.csv, correct the rows that are named, or delete them."),
        (of_images, "Look at the image, and repeat the view or take it out of views.csv."),
    ):
        for words in by_reason(some):
            yield Finding("lost_views", f"{words[0].upper()}{words[1:]}.", Remedy(do))


def _coverage(known: RunState) -> Iterator[Finding]:
    """Cameras whose lens is to be estimated, and whose corners fill little of the image."""
    for frame, look in known.cameras.items():
        if look.resolution is None or look.table.stated is not None or not look.corners:
            continue
        px = np.concatenate([view_corners.px for view_corners in look.corners.values()])
        part = np.floor(_PARTS * px / np.array(look.resolution)).clip(0, _PARTS - 1)
        filled = len(np.unique(part @ [_PARTS, 1]))
        if filled < _LEAST_PARTS:
            words = (
                f"The board was seen in {filled} of {_PARTS**2} parts of the image alone, and the "
                f"lens, which session.toml does not state, needs it all over the image: "
                f"{_LEAST_PARTS} parts and more."
            )
            step = Remedy("Add views with the board near the image's edges and corners, or nearer.")
            yield Finding("coverage", words, step).of(frame if len(known.cameras) > 1 else "")


def _seen(known: RunState) -> Iterator[str]:
    session = known.session
    yield f"{len(session.views)} views"
    images = [view.image for view in session.views if view.image]
    if images:
        there = sum(session.images.exists(image) for image in images)
        yield f"{there} of {len(images)} images"
    for look in known.cameras.values():
        blur = [
            view_corners.blur_px
            for view_corners in look.corners.values()
            if view_corners.blur_px > 0.0
        ]
        size = "" if look.resolution is None else " of {} x {} px".format(*look.resolution)
        edges = f", edges {np.median(blur):.1f} px wide" if blur else ""
        yield f"the board in {len(look.corners)} {'images' if images else 'views'}{size}{edges}"
        yield from _unseen_rows(session, look)
    for robot, reported in known.robots.items():
        # Rows of one stop share them.
        if poses := {pose.tobytes() for pose in reported.base_from_flange.values()}:
            whose = f"robot {robot}" if len(known.robots) > 1 else "the robot"
            yield f"{len(poses)} poses of {whose}"
    if session.streams:
        yield f"streams {some_of(list(session.streams))}"


def _unseen_rows(session: Session, look: CameraLook) -> Iterator[str]:
    """Says which last rows of a ChArUco board are in no image, though there is room for them."""
    # With fewer rows its markers are numbered alike: nothing else shows that too many are declared.
    target = session.target
    if target is None or session.targets or target.kind != "charuco" or look.resolution is None:
        return
    across, rows = target.columns - 1, target.rows - 1
    seen = max(
        (int(view_corners.ids.max()) // across + 1 for view_corners in look.corners.values()),
        default=rows,
    )
    last, shape = np.arange(seen * across, rows * across), look.resolution[::-1]
    # The board's place is known well by most of the corners that there may be.
    clear = [
        view_corners
        for view_corners in look.corners.values()
        if 2 * len(view_corners.ids) > seen * across
    ]
    without = [
        corners for corners in clear if np.isin(last, hidden_corners(corners, shape, target)).all()
    ]
    if len(last) and len(without) >= _LEAST_WITHOUT:
        yield (
            f"{seen + 1} rows of squares, where {target.rows} are declared and {len(without)} "
            "images have room for all: count them, unless something covers the rest"
        )


def next_command(checkup: Checkup, session: Path | str) -> str:
    """What to type where nothing is wrong."""
    return "" if checkup.findings else with_paths(CALIBRATE, session, "out")
