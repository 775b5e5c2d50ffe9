"""Composes and writes the report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import write_atomically
from visioncal.core.number_format import significant
from visioncal.present import advice, facts, result_parts
from visioncal.present.advice import named
from visioncal.present.report import content, network
from visioncal.present.report.templates import template
from visioncal.present.report.thumbnails import Thumbnail, drawn, thumbnail
from visioncal.results import Calibration, ViewResult
from visioncal.results.evidence import ViewEvidence, magnification
from visioncal.session import Session

_MAX_REJECTED_PICTURES = 4
# Grey level in place of a missing image.
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
    """Writes the report as one HTML file that needs neither network nor scripts.

    Args:
        path: The file to write; it appears whole or not at all.
        calibration: Calibration to report.
        session: Session with images and joint angles; without it the report shows none.
        evidence: Evidence of the views, in any order.
        note: What the reader should know about this report itself.
        review: Command that opens the recording, to which a view's number is added; empty if there
            is none.

    Raises:
        DataError: The file cannot be written, or a section of the result cannot be read.
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
    cell, suspects = calibration.cell, advice.suspects(calibration)
    subject = calibration.mount if cell is None else network.kinds(calibration.tree)
    return template("report.html.j2").render(
        kind="Calibration report",
        name=calibration.session_name,
        subtitle=f"{subject} \N{MIDDLE DOT} {facts.readable_time(calibration.created)}",
        notes=[note] if note else [],
        judged=calibration.verdict,
        steps=calibration.next_steps,
        key_figures=content.key_figures(calibration),
        provenance={
            "session": calibration.session_name,
            "sha256": calibration.session_sha256,
            "created": calibration.created,
        },
        calibration=calibration,
        cell=cell,
        session=session,
        # Coverage and joint plots are for one camera, one board and one robot.
        evidence=evidence if cell is None else (),
        review=f"{review} --view" if review else "",
        suspects=suspects,
        outlying=advice.outlying_views(suspects),
        observed="probe" if calibration.mount == "instrument" else "target",
        **_pictures(calibration, session, evidence),
    )


def _pictures(
    calibration: Calibration, session: Session | None, evidence: Sequence[ViewEvidence]
) -> dict[str, object]:
    seen = {view.view: view for view in evidence}
    views = calibration.views
    extremes = _extremes(views, seen)
    # One magnification for all pictures, so that they can be compared.
    shown = [seen[view.view] for _, view in extremes]
    magnify = magnification(shown, result_parts.image_width(calibration) or 0)
    pictures = None if session is None else _Pictures(session, seen)
    return {
        "used_pictures": pictures.of_used(extremes, magnify) if pictures else [],
        "rejected_pictures": pictures.of_rejected(views) if pictures else [],
        "magnify": magnify,
    }


def _extremes(
    views: Sequence[ViewResult], seen: Mapping[int, ViewEvidence]
) -> list[tuple[str, ViewResult]]:
    """Captioned used views with the smallest and the largest reprojection error."""
    candidates = [
        (view.rms_px, view)
        for view in views
        if view.used
        and view.rms_px is not None
        and view.view in seen
        and seen[view.view].corners is not None
    ]
    ranked = sorted(candidates, key=lambda pair: pair[0])
    extremes = [ranked[0], ranked[-1]] if len(ranked) > 1 else ranked
    return [
        (f"{which} used view: {named(view)}, {significant(rms_px)} px rms", view)
        for which, (rms_px, view) in zip(("Best", "Worst"), extremes, strict=False)
    ]


@dataclass(frozen=True)
class _Pictures:
    """Pictures of views from the session's images."""

    session: Session
    seen: Mapping[int, ViewEvidence]

    def of_used(self, captioned: Sequence[tuple[str, ViewResult]], magnify: int) -> list[Thumbnail]:
        """Pictures with detected and predicted corners."""
        pictures = [
            self._of(view, caption, self.seen.get(view.view), magnify)
            for caption, view in captioned
        ]
        return [picture for picture in pictures if picture is not None]

    def of_rejected(self, views: Sequence[ViewResult]) -> list[Thumbnail]:
        """The first few views that were not used, with their reasons."""
        pictures = (
            self._of(
                view,
                f"View {named(view)}: {view.reason}",
                self.seen.get(view.view) if advice.contradicts(view) else None,
                1,
            )
            for view in views
            if not view.used
        )
        return list(
            islice((picture for picture in pictures if picture is not None), _MAX_REJECTED_PICTURES)
        )

    def _of(
        self, view: ViewResult, caption: str, evidence: ViewEvidence | None, magnify: int
    ) -> Thumbnail | None:
        """Picture of a view; None if it has no image, as the table of views states."""
        # Corners of an external detector are drawn on a blank image if theirs is missing.
        shown = next((row for row in self.session.views if row.number == view.view), None)
        if shown is None:
            return None
        if not shown.image or not self.session.images.exists(shown.image):
            resolution = self.session.resolution
            if not shown.has_corners or resolution is None:
                return None
            blank = np.full((resolution[1], resolution[0], 3), _PAPER, dtype=np.uint8)
            return drawn(blank, evidence, caption, view.view, magnify)
        try:
            data = self.session.images.read(shown.image)
        except DataError:
            return None
        return thumbnail(data, evidence, caption, view.view, magnify)
