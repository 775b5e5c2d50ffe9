"""Puts the report together and writes it."""

import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import write_atomically
from visioncal.core.types import Target
from visioncal.core.version import __version__
from visioncal.present import facts
from visioncal.present.report import (
    advice,
    arm,
    armplots,
    content,
    plots,
    sources,
    tools,
)
from visioncal.present.report.cells import render_cell
from visioncal.present.report.content import template
from visioncal.present.report.plots import residuals_over_joints
from visioncal.present.report.thumbnails import Thumbnail, drawn, thumbnail
from visioncal.results import Calibration, ViewResult
from visioncal.results.evidence import ViewEvidence, magnification
from visioncal.session import Session

_MAX_REJECTED_PICTURES = 4
# The grey of a picture whose image nobody has.
_PAPER = 235


@typed
def write_report(
    path: Path,
    calibration: Calibration,
    session: Session | None,
    evidence: Sequence[ViewEvidence],
    note: str = "",
    review: str = "",
) -> None:
    """Writes the report as one HTML file that needs no network and no script.

    Args:
        path: The file to write; it appears whole or not at all.
        calibration: What to report.
        session: Where its images and joint angles are; without it the report shows none.
        evidence: What was seen and computed of each view, in any order.
        note: What the reader should know of this report itself.
        review: The command that opens the recording, to which the number of a view is added; empty
            where there is none.

    Raises:
        DataError: The file cannot be written, or what was found beside the edges cannot be read.
    """
    write_atomically(path, render(calibration, session, evidence, note, review))


def render(
    calibration: Calibration,
    session: Session | None,
    evidence: Sequence[ViewEvidence],
    note: str = "",
    review: str = "",
) -> str:
    """Renders the report as HTML text; see `write_report`."""
    cell = calibration.whole_cell
    if cell is not None:
        return render_cell(cell)
    return template("report.html.j2").render(
        calibration=calibration,
        note=note,
        review=f"{review} --view" if review else "",
        version=__version__,
        python=platform.python_version(),
        versions=content.dependency_versions(),
        **_words(calibration),
        **_uncertainty(calibration, session),
        **_arm(calibration, evidence),
        **_plots(calibration, session, evidence),
        **_pictures(calibration, session, evidence),
    )


def _words(calibration: Calibration) -> dict[str, object]:
    found, touched = advice.suspects(calibration), calibration.touch_test
    outlying = advice.outlying_views(found)
    return {
        "created": content.readable_time(calibration.created),
        "touched_at": content.readable_time(touched.created) if touched else "",
        "suspects": [(advice.listed(it.views), it) for it in found],
        "has_outliers": any(it.used for it in found),
        "has_contradicting": any(it.contradict for it in found),
        "key_figures": content.key_figures(calibration),
        "edges": [content.edge_card(*it) for it in calibration.edges.items()],
        "frames": tools.frame_cards(calibration),
        "method": content.method_facts(calibration),
        "lens": content.lens_facts(calibration),
        "residuals": facts.residual_rows(calibration),
        "solvers": list(facts.solver_rows(calibration)),
        "has_pixels": calibration.rms.px is not None,
        "observed": "probe" if calibration.mount == "instrument" else "target",
        "marks": {it.view: content.view_mark(it, outlying) for it in calibration.views},
    }


def _uncertainty(calibration: Calibration, session: Session | None) -> dict[str, object]:
    arm, known = calibration.arm_errors, calibration.budget
    boards = _board_cards(calibration, {} if session is None else session.boards)
    return {
        "uncertainty": () if known is None else facts.summary(calibration, known),
        "noise": facts.noise_facts(calibration),
        "boards": tuple(boards),
        "arm": () if arm is None else facts.arm_facts(arm),
        "arm_is_estimated": arm is not None and arm.estimated,
        "budget_plot": "" if known is None else sources.budget(known),
        "spectrum_plot": "" if known is None else sources.directions(known),
    }


@dataclass(frozen=True)
class _BoardCard:
    title: str
    facts: tuple[facts.Fact, ...]
    plot: str


def _board_cards(calibration: Calibration, targets: Mapping[str, Target]) -> Iterator[_BoardCard]:
    """What was found of each board; nothing of one of which nothing was looked for."""
    for name, board in calibration.named_boards.items():
        target = targets.get(name)
        said = facts.board_facts(calibration, board, target)
        if said:
            plot = "" if target is None else sources.board_shape(board, target, name)
            yield _BoardCard(f"Board {name}".strip(), said, plot)


def _arm(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> dict[str, object]:
    found = calibration.arm
    mapped = found is not None and bool(found.workspace_map)
    used = {it.view for it in calibration.views if it.used}
    poses = [it.base_from_flange for it in evidence if it.view in used]
    stops_m = np.reshape([it[:3, 3] for it in poses if it is not None], (-1, 3))
    return {
        "arm_is_calibrated": found is not None and found.is_calibrated,
        "arm_result": found,
        **({} if found is None else arm.arm_words(found)),
        "unseen_plot": "" if found is None else armplots.before_and_after(found),
        "side_plot": armplots.side_map(found, stops_m) if found and mapped else "",
        "top_plot": armplots.top_map(found, stops_m) if found and mapped else "",
        "has_stops": len(stops_m) > 0,
        **_springs(calibration),
        **_drift(calibration),
    }


def _springs(calibration: Calibration) -> dict[str, object]:
    found = calibration.elastic
    if found is None:
        return {"springs": (), "spring_facts": (), "spring_plot": ""}
    return {
        "springs": found.joints,
        "spring_facts": tuple(facts.spring_facts(found)),
        "spring_plot": arm.deflection_against_load(found),
    }


def _drift(calibration: Calibration) -> dict[str, object]:
    found = calibration.thermal
    if found is None:
        return {}
    return {"drift_sentence": arm.drift_sentence(found), "drift_plot": arm.course(found)}


def _plots(
    calibration: Calibration, session: Session | None, evidence: Sequence[ViewEvidence]
) -> dict[str, object]:
    outlying = advice.outlying_views(advice.suspects(calibration))
    return {
        "residual_plot": plots.residuals(calibration, outlying),
        "trend_plot": residuals_over_joints(calibration, session, evidence, outlying),
        "coverage_plot": plots.image_coverage(calibration, evidence),
        "direction_plot": plots.viewing_directions(calibration, evidence),
        "rotation_plot": plots.flange_rotations(calibration, evidence),
    }


def _pictures(
    calibration: Calibration, session: Session | None, evidence: Sequence[ViewEvidence]
) -> dict[str, object]:
    seen = {it.view: it for it in evidence}
    extremes = _extremes(calibration, seen)
    magnify = _magnification(calibration, [seen[view.view] for _, view in extremes])
    pictures = None if session is None else _Pictures(session, seen)
    return {
        "used_pictures": pictures.of_used(extremes, magnify) if pictures else [],
        "rejected_pictures": pictures.of_rejected(calibration.views) if pictures else [],
        "magnify": magnify,
    }


def _magnification(calibration: Calibration, shown: Sequence[ViewEvidence]) -> int:
    """One factor for all pictures, so that they can be compared."""
    if calibration.camera is None:
        return 1
    return magnification(shown, calibration.camera.camera.resolution[0])


def _extremes(
    calibration: Calibration, seen: Mapping[int, ViewEvidence]
) -> list[tuple[str, ViewResult]]:
    """The used views with the smallest and the largest reprojection error, and words for them."""
    drawn = [
        (view.rms_px, view)
        for view in calibration.views
        if view.used
        and view.rms_px is not None
        and view.view in seen
        and seen[view.view].corners is not None
    ]
    ranked = sorted(drawn, key=lambda it: it[0])
    picked = [ranked[0], ranked[-1]] if len(ranked) > 1 else ranked
    return [
        (f"{which} used view: {view.view}, {rms_px:.2g} px rms", view)
        for which, (rms_px, view) in zip(("Best", "Worst"), picked, strict=False)
    ]


@dataclass(frozen=True)
class _Pictures:
    """Takes pictures of views out of the session's images."""

    session: Session
    seen: Mapping[int, ViewEvidence]

    def of_used(self, captioned: Sequence[tuple[str, ViewResult]], magnify: int) -> list[Thumbnail]:
        """Pictures with what was detected and predicted over them."""
        found = [
            self._of(view, caption, self.seen.get(view.view), magnify)
            for caption, view in captioned
        ]
        return [it for it in found if it is not None]

    def of_rejected(self, views: Sequence[ViewResult]) -> list[Thumbnail]:
        """The first few of the views that were not used, with their reasons."""
        found = (
            self._of(
                view,
                f"View {view.view}: {view.reason}",
                self.seen.get(view.view) if advice.contradicts(view) else None,
                1,
            )
            for view in views
            if not view.used
        )
        return list(islice((it for it in found if it is not None), _MAX_REJECTED_PICTURES))

    def _of(
        self, view: ViewResult, caption: str, evidence: ViewEvidence | None, magnify: int
    ) -> Thumbnail | None:
        """A view's picture; None where it has no image, which the table of views says anyway."""
        # Corners that another detector found are drawn on nothing where there is no image of them.
        shown = next((it for it in self.session.views if it.number == view.view), None)
        if shown is None:
            return None
        if not shown.image or not self.session.images.exists(shown.image):
            resolution = self.session.resolution
            if not shown.has_corners or resolution is None:
                return None
            nothing = np.full((resolution[1], resolution[0], 3), _PAPER, dtype=np.uint8)
            return drawn(nothing, evidence, caption, view.view, magnify)
        try:
            data = self.session.images.read(shown.image)
        except DataError:
            return None
        return thumbnail(data, evidence, caption, view.view, magnify)
