"""`visioncal tcp`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from visioncal.cli.framing import FrameOptions, FrameRequest, PointOption, TouchOptions, place_frame
from visioncal.cli.options import AsJson, PartOptions

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.results import Calibration, Frame


def tcp_command(
    goes: FrameOptions,
    written: TouchOptions,
    part: PartOptions,
    touches: Annotated[
        Path | None,
        typer.Argument(
            help="A table with a row a touch: the columns of views.csv, kind (point, z or xz) and "
            "point. Or a session whose images show a target on the tool."
        ),
    ] = None,
    point: PointOption = None,
    as_json: AsJson = False,
) -> None:
    """Find a tool's tip, and its rotation, from touches of fixed points; or from images.

    A touch of kind point has the tip at the point; of kind z, the point lies on the tool's positive
    z axis; of kind xz, in its xz plane on the side of positive x. In images, a target on the tool
    gives both, by the camera that -c names. Exit status 2: nothing was written, for the reason
    given; 3: the tool is bad, and joins no calibration.
    """
    from visioncal.frames.tcp import touched_tool
    from visioncal.interchange.formats.touches import read_touches

    def by_touches(source: Path, calibration: "Calibration | None") -> "Frame":
        rows = read_touches(source, written.requested(), part.robot)
        return touched_tool(rows, calibration, written.model, touch_noise_m=written.noise_m)

    place_frame(FrameRequest("tool", touches, goes, written, part, point, as_json), by_touches)
