"""What `tcp` and `fixture` do alike: a frame by touches, or by the images of a target on it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from visioncal.cli.framing import FrameLocation, FrameOptions, TouchOptions, keep_and_report
from visioncal.cli.options import PartOptions
from visioncal.cli.parsing import numbers_in, refuse_given
from visioncal.cli.progress import shown_progress
from visioncal.core.errors import DataError
from visioncal.frames.naming import FrameKind

# Help does not wait for them.
if TYPE_CHECKING:
    from visioncal.frames.drawing_points import NominalPoints
    from visioncal.results import Calibration, Frame
    from visioncal.session import Session

PointOption: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--point-mm",
        metavar="X,Y,Z",
        help="Of images: the frame's origin in the target's frame, such as the tool's tip.",
    ),
]


@dataclass(frozen=True)
class Asked:
    """What `tcp` or `fixture` is asked for.

    Attributes:
        kind: What is to be placed.
        source: What the user named: touches, as a table or a session, or a session of images.
        goes: Where its frame goes.
        written: How touches are written.
        part: Which camera, robot and target of a whole cell are meant.
        point_mm: Of images: the frame's origin in the target's frame, as the user wrote it.
        as_json: Whether to print JSON.
    """

    kind: FrameKind
    source: Path
    goes: FrameOptions
    written: TouchOptions
    part: PartOptions
    point_mm: str | None
    as_json: bool


def place_frame(
    asked: Asked,
    by_touches: "Callable[[Calibration | None], Frame]",
    drawing: "NominalPoints | None" = None,
    tool: str | None = None,
) -> None:
    """Places a tool or a fixture by touches or by a session's images, and keeps and reports it.

    Args:
        asked: What is asked for.
        by_touches: Places it by touches, with what is known of the robot.
        drawing: Where points or markers on a fixture are; None where none is given.
        tool: What touched a fixture, as the user wrote it.

    Raises:
        DataError: The source cannot be read or does not show what is needed, or options contradict
            each other.
    """
    from visioncal.session.choosing import ARM, EYE, Choice

    kind, part = asked.kind, asked.part
    session = _image_session(asked.source, {"--tool": tool, **asked.written.given()})
    if session is None:
        own = "the tool's point" if kind == "tool" else "the fixture's origin"
        refuse_given({"--point-mm": asked.point_mm}, f"touches say where {own} is")
        refuse_given({"--camera": part.camera, "--target": part.target}, "touches need no camera")
        place = FrameLocation.of(asked.goes, kind, Choice(robot=part.robot), ARM)
        frame = by_touches(place.calibration)
    else:
        place = FrameLocation.of(asked.goes, kind, replace(part.choice, target=None), EYE)
        if place.calibration is None:
            raise DataError(
                f"session {session.name!r} has images, and the camera's calibration (-c) is needed "
                "to place what they show.",
                culprits=["-c"],
                next_step="Name the output folder of visioncal calibrate.",
            )
        frame = _by_images(asked, session, place.calibration, drawing)
    keep_and_report(place, frame, asked.source, as_json=asked.as_json)


def _image_session(source: Path, for_touches: Mapping[str, object]) -> "Session | None":
    """Loads a session whose images are to place something; None where it has none."""
    from visioncal.session import Session

    if not source.is_dir() and source.suffix.lower() != ".rrd":
        return None
    session = Session.load(source)
    shown = [view.number for view in session.views if view.image or view.has_corners]
    if not shown:
        return None
    touched = [view.number for view in session.views if view.text.keys() & {"kind", "point"}]
    if touched:
        raise DataError(
            f"session {session.name!r} has images (view {shown[0]}) and touches (kind or point in "
            f"view {touched[0]}): a frame is placed by one of them.",
            culprits=[f"view {index}" for index in touched],
            next_step="Put the touches into a table or a session of their own, without images.",
        )
    refuse_given(for_touches, f"session {session.name!r} has images, and this is for touches")
    return session


def _by_images(
    asked: Asked,
    session: "Session",
    calibration: "Calibration",
    drawing: "NominalPoints | None",
) -> "Frame":
    import numpy as np

    from visioncal.frames.fixture_from_markers import marked_fixture
    from visioncal.frames.frame_from_images import seen_frame
    from visioncal.session.selecting import has_several, select

    if has_several(session):
        session = select(session, asked.part.choice, parted=False)
    if drawing is not None:
        refuse_given(
            {"--point-mm": asked.point_mm}, "beside --cad the drawing's origin is the frame's"
        )
        return marked_fixture(session, calibration, drawing)
    point = 1e-3 * np.array(numbers_in(asked.point_mm or "0,0,0", "--point-mm", "x,y,z"))
    with shown_progress(quiet=asked.as_json) as progress:
        return seen_frame(session, calibration, asked.kind, point, progress=progress)
