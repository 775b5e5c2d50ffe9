"""Composes and writes the report, and its selection to print and sign: the certificate."""

from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import write_atomically
from visioncal.core.number_format import significant
from visioncal.present import advice, facts, result_parts
from visioncal.present.advice import named
from visioncal.present.coverage import image_coverage
from visioncal.present.report import content, network
from visioncal.present.report.performance import performance_table
from visioncal.present.report.templates import template
from visioncal.present.report.thumbnails import Thumbnail, thumbnail
from visioncal.results import Calibration, ViewResult
from visioncal.results.evidence import ViewEvidence, magnification
from visioncal.session import Session
from visioncal.vision.boards.imaging import decode_image


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
    suspects = advice.suspects(calibration)
    return template("report.html.j2").render(
        **_head("Calibration report", calibration, session),
        notes=[note] if note else [],
        steps=calibration.next_steps,
        seen=evidence,
        # Coverage and joint plots are for one camera, one board and one robot.
        evidence=evidence if calibration.cell is None else (),
        covered=image_coverage(calibration, evidence),
        review=f"{review} --view" if review else "",
        suspects=suspects,
        outlying=tuple(sorted(at for group in suspects if group.used for at in group.views)),
        observed="probe" if calibration.mount == "instrument" else "target",
        **_pictures(calibration, session, {view.view: view for view in evidence}),
    )


def write_certificate(
    path: Path,
    calibration: Calibration,
    session: Session | None,
    signed: Mapping[str, str],
    performance: Mapping[str, Any] | None = None,
) -> None:
    """Writes a selection of the report that fits one sheet of A4, with room to sign.

    Args:
        path: The file; it appears whole or not at all.
        calibration: Calibration to certify.
        session: Session of the calibration; None if it is not at hand.
        signed: What a person adds to it, by label, as the operator and serial numbers.
        performance: Content of iso9283.json; None where it was not measured.

    Raises:
        DataError: The file cannot be written.
    """
    head = _head("Certificate of calibration", calibration, session)
    measured = None if performance is None else performance_table(performance)
    stated = {} if performance is None else performance["stated"]
    page = template("certificate.html.j2").render(
        **head, notes=(), steps=(), signed={**stated, **signed}, performance=measured
    )
    write_atomically(path, page)


def _head(kind: str, calibration: Calibration, session: Session | None) -> dict[str, object]:
    """Beginning and end of report and certificate."""
    cell = calibration.cell
    subject = calibration.mount if cell is None else network.kinds(calibration.tree)
    return {
        "kind": kind,
        "name": calibration.session_name,
        "subtitle": f"{subject} \N{MIDDLE DOT} {facts.readable_time(calibration.created)}",
        "judged": calibration.verdict,
        "key_figures": content.key_figures(calibration),
        "provenance": {
            "session": calibration.session_name,
            "sha256": calibration.session_sha256,
            "created": calibration.created,
        },
        "calibration": calibration,
        "cell": cell,
        "session": session,
    }


def _pictures(
    calibration: Calibration, session: Session | None, seen: Mapping[int, ViewEvidence]
) -> dict[str, object]:
    """Used views with the smallest and the largest residuals, and the first that were not used."""
    measured = [
        (view.rms_px, view)
        for view in calibration.views
        if view.used
        and view.rms_px is not None
        and view.view in seen
        and seen[view.view].corners is not None
    ]
    ranked = sorted(measured, key=lambda pair: pair[0])
    extremes = [*ranked[:1], *ranked[1:][-1:]]
    # One magnification for all pictures, so that they can be compared.
    shown = [seen[view.view] for _, view in extremes]
    magnify = magnification(shown, result_parts.image_width(calibration) or 0)
    captions = [
        f"{which} used view: {named(view)}, {significant(rms_px)} px rms"
        for which, (rms_px, view) in zip(("Best", "Worst"), extremes, strict=False)
    ]
    used = (
        _picture(session, view, caption, seen.get(view.view), magnify)
        for caption, (_, view) in zip(captions, extremes, strict=True)
    )
    rejected = (
        _picture(
            session,
            view,
            f"View {named(view)}: {view.reason}",
            seen.get(view.view) if view.contradicts else None,
            1,
        )
        for view in calibration.views
        if not view.used
    )
    return {
        "used_pictures": [*filter(None, used)],
        "rejected_pictures": [*islice(filter(None, rejected), 4)],
        "magnify": magnify,
    }


def _picture(
    session: Session | None,
    view: ViewResult,
    caption: str,
    evidence: ViewEvidence | None,
    magnify: int,
) -> Thumbnail | None:
    """Picture of a view; None if it has no readable image, as the table of views states."""
    row = next((row for row in session.views if row.number == view.view), None) if session else None
    if session is None or row is None:
        return None
    if row.image and session.images.exists(row.image):
        try:
            pixels = decode_image(session.images.read(row.image), colour=True)
        except DataError:
            return None
        if isinstance(pixels, str):
            return None
    elif row.has_corners and session.resolution is not None:
        # Corners of an external detector are drawn on a blank image if theirs is missing.
        pixels = np.full((*session.resolution[::-1], 3), 235, dtype=np.uint8)
    else:
        return None
    return thumbnail(pixels, evidence, caption, view.view, magnify)
