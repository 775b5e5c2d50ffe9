"""What `tcp` and `fixture` do with a session of images: a target on the tool or on the fixture."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from visioncal.cli.framing import FrameOptions, Place, keep_and_report
from visioncal.cli.parsing import numbers_in, refuse_given
from visioncal.cli.progress import shown_progress
from visioncal.core.errors import DataError
from visioncal.frames.naming import FrameKind

# Help does not wait for them.
if TYPE_CHECKING:
    from visioncal.frames.drawing_points import NominalPoints
    from visioncal.results import Calibration, Frame
    from visioncal.session import Session
    from visioncal.session.choosing import Choice

PointOption: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--point-mm",
        metavar="X,Y,Z",
        help="Of images: the frame's origin in the target's frame, such as the tool's tip.",
    ),
]


def kept_by_images(
    source: Path,
    goes: FrameOptions,
    choice: "Choice",
    kind: FrameKind,
    point_mm: str | None,
    drawing: "NominalPoints | None" = None,
    *,
    for_touches: Mapping[str, object],
    as_json: bool,
) -> bool:
    """Places a tool or a fixture by a session's images, and keeps and reports it.

    Args:
        source: What the user named.
        goes: Where the frame goes.
        choice: Which camera, robot and target are meant, of the session of a whole cell.
        kind: What it is.
        point_mm: Its origin in the target's frame, as the user wrote it.
        drawing: Where markers on a fixture are; None where the session's target is all.
        for_touches: The options that only touches have a use for, by their names; None for those
            that were not given.
        as_json: Whether to print JSON.

    Returns:
        Whether it was: not where the source has touches, as a table or as a session without images.

    Raises:
        DataError: The session has both, cannot be read, does not show what is needed, or options
            contradict each other.
    """
    from visioncal.session.choosing import EYE

    session = _image_session(source, for_touches)
    if session is None:
        return False
    place = Place.of(goes, kind, replace(choice, target=None), EYE)
    if place.calibration is None:
        raise DataError(
            f"session {session.name!r} has images, and the camera's calibration (-c) is needed to "
            "place what they show.",
            culprits=["-c"],
            next_step="Name the output folder of visioncal calibrate.",
        )
    frame = _frame(session, place.calibration, kind, point_mm, drawing, choice, quiet=as_json)
    keep_and_report(place, frame, source, as_json=as_json)
    return True


def _image_session(source: Path, for_touches: Mapping[str, object]) -> "Session | None":
    """Loads a session whose images are to place something; None where it has none."""
    from visioncal.session import Session

    if not source.is_dir() and source.suffix.lower() != ".rrd":
        return None
    session = Session.load(source)
    shown = [it.number for it in session.views if it.image or it.has_corners]
    if not shown:
        return None
    touched = [it.number for it in session.views if it.text.keys() & {"kind", "point"}]
    if touched:
        raise DataError(
            f"session {session.name!r} has images (view {shown[0]}) and touches (kind or point in "
            f"view {touched[0]}): a frame is placed by one of them.",
            culprits=[f"view {it}" for it in touched],
            next_step="Put the touches into a table or a session of their own, without images.",
        )
    refuse_given(for_touches, f"session {session.name!r} has images, and this is for touches")
    return session


def _frame(
    session: "Session",
    calibration: "Calibration",
    kind: FrameKind,
    point_mm: str | None,
    drawing: "NominalPoints | None",
    choice: "Choice",
    *,
    quiet: bool,
) -> "Frame":
    import numpy as np

    from visioncal.frames.fixture_from_markers import marked_fixture
    from visioncal.frames.frame_from_images import seen_frame
    from visioncal.session.selecting import has_several, select

    if has_several(session):
        session = select(session, choice, parted=False)
    if drawing is not None:
        refuse_given({"--point-mm": point_mm}, "beside --cad the drawing's origin is the frame's")
        return marked_fixture(session, calibration, drawing)
    point = numbers_in(point_mm or "0,0,0", "--point-mm", "x,y,z")
    with shown_progress(quiet=quiet) as progress:
        return seen_frame(session, calibration, kind, 1e-3 * np.array(point), progress=progress)
