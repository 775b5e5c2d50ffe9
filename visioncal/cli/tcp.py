"""`visioncal tcp`."""

from pathlib import Path
from typing import Annotated

import typer

from visioncal.cli.framing import FrameOptions, Place, TouchOptions, keep_and_report
from visioncal.cli.options import AsJson, PartOptions
from visioncal.cli.parsing import refuse_given
from visioncal.cli.target_in_images import PointOption, kept_by_images


def tcp_command(
    touches: Annotated[
        Path,
        typer.Argument(
            help="A table with a row a touch: the columns of views.csv, kind (point, z or xz) and "
            "point. Or a session whose images show a target on the tool."
        ),
    ],
    goes: FrameOptions,
    written: TouchOptions,
    part: PartOptions,
    point: PointOption = None,
    as_json: AsJson = False,
) -> None:
    """Find a tool's tip, and its rotation, from touches of fixed points; or from images.

    A touch of kind point has the tip at the point; of kind z, the point lies on the tool's positive
    z axis; of kind xz, in its xz plane on the side of positive x. In images, a target on the tool
    gives both, by the camera that -c names. Exit status 2: nothing was written, for the reason
    given.
    """
    from visioncal.frames.tcp import touched_tool
    from visioncal.interchange.formats.touches import read_touches
    from visioncal.session.choosing import ARM, Choice

    given = written.given()
    if kept_by_images(
        touches, goes, part.choice, "tool", point, for_touches=given, as_json=as_json
    ):
        return
    refuse_given({"--camera": part.camera, "--target": part.target}, "touches need no camera")
    refuse_given({"--point-mm": point}, "touches say where the tool's point is")
    requested = written.requested()
    place = Place.of(goes, "tool", Choice(robot=part.robot), ARM)
    rows = read_touches(touches, requested, part.robot)
    frame = touched_tool(rows, place.calibration, written.model, touch_noise_m=written.noise_m)
    keep_and_report(place, frame, touches, as_json=as_json)
