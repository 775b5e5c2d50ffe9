"""`visioncal fixture`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from visioncal.cli.framing import FrameOptions, FrameRequest, PointOption, TouchOptions, place_frame
from visioncal.cli.options import AsJson, PartOptions
from visioncal.core.choices import UNITS_M
from visioncal.core.errors import DataError

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.frames.measured_points import Tool
    from visioncal.results import Calibration, Frame


def fixture_command(
    goes: FrameOptions,
    written: TouchOptions,
    part: PartOptions,
    touches: Annotated[
        Path | None,
        typer.Argument(
            help="A table with a row a touch: the columns of views.csv, and kind (origin, x or xy) "
            "or, with --cad, point. Or a session whose images show a target on the fixture."
        ),
    ] = None,
    cad: Annotated[
        Path | None,
        typer.Option(
            help="A table of the drawing: point, x_mm, y_mm, z_mm (or x_m ...), sigma_mm."
        ),
    ] = None,
    cad_unit: Annotated[
        str | None, typer.Option(metavar="|".join(UNITS_M), help="What x, y, z in it are in.")
    ] = None,
    tool: Annotated[
        str | None,
        typer.Option(
            help="What touched: a tool of the calibration, a file of frames (frames.json, or "
            "frames.json:gripper), or none, where the poses are of the tip itself."
        ),
    ] = None,
    point: PointOption = None,
    as_json: AsJson = False,
) -> None:
    """Find a fixture in the base, from touches of it or of a drawing's points.

    A touch of kind origin is at the fixture's origin; of kind x, on its positive x axis; of kind
    xy, in its xy plane on the side of positive y: one of each at least. With --cad, three points or
    more that the drawing has, by their names. In images a target on the fixture gives its frame, or
    with --cad several markers, by the camera that -c names. Exit status 2: nothing was written, for
    the reason given; 3: the fixture is bad, and joins no calibration.
    """
    from visioncal.frames.fixture import touched_fixture
    from visioncal.interchange.formats.touches import read_nominal, read_touches

    drawing = None if cad is None else read_nominal(cad, cad_unit)

    def by_touches(source: Path, robot_calibration: "Calibration | None") -> "Frame":
        touched_with = _tool(tool, robot_calibration, part.robot)
        rows = read_touches(source, written.requested(), part.robot, positions=touched_with is None)
        noise_m = written.noise_m
        return touched_fixture(
            rows, touched_with, drawing, robot_calibration, written.model, touch_noise_m=noise_m
        )

    asked = FrameRequest("fixture", touches, goes, written, part, point, as_json)
    place_frame(asked, by_touches, drawing, tool)


def _tool(
    option: str | None, calibration: "Calibration | None", robot: str | None
) -> "Tool | None":
    """Finds the tool that touched the points."""
    from visioncal.frames.measured_points import NO_TOOL, Tool
    from visioncal.interchange.result_files import load_result_or_frames

    if option == "none":
        return None
    frames = {} if calibration is None else calibration.frames
    if option is None and calibration is None:
        raise DataError("The tool that touched the points is not said.", next_step=NO_TOOL)
    if option is None or option in frames or f"flange_from_{option}" in frames:
        return Tool.among(frames, "The calibration", option)
    path, _, name = option.rpartition(":")
    if Path(option).exists():
        return Tool.among(load_result_or_frames(Path(option), robot).frames, option, None)
    if path and Path(path).exists():
        return Tool.among(load_result_or_frames(Path(path), robot).frames, path, name)
    if frames:
        return Tool.among(frames, "The calibration", option)
    raise DataError(
        f"--tool {option}: there is no such file, nor a calibration (-c) that has such a tool.",
        culprits=[option],
        next_step=NO_TOOL,
    )
