"""`visioncal fixture`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from visioncal.cli.framing import FrameOptions, Place, TouchOptions, keep_and_report
from visioncal.cli.options import AsJson, PartOptions
from visioncal.cli.parsing import refuse_given
from visioncal.cli.target_in_images import PointOption, kept_by_images
from visioncal.core.choices import UNITS_M
from visioncal.core.errors import DataError

# Help does not wait for them.
if TYPE_CHECKING:
    from visioncal.frames.measured import Tool
    from visioncal.results import Calibration


def fixture_command(
    touches: Annotated[
        Path,
        typer.Argument(
            help="A table with a row a touch: the columns of views.csv, and kind (origin, x or xy) "
            "or, with --cad, point. Or a session whose images show a target on the fixture."
        ),
    ],
    goes: FrameOptions,
    written: TouchOptions,
    part: PartOptions,
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
    the reason given.
    """
    from visioncal.frames.fixture import touched_fixture
    from visioncal.interchange.formats.touches import read_nominal, read_touches
    from visioncal.session.choosing import ARM, Choice

    drawing = None if cad is None else read_nominal(cad, cad_unit)
    given = {"--tool": tool, **written.given()}
    if kept_by_images(
        touches, goes, part.choice, "fixture", point, drawing, for_touches=given, as_json=as_json
    ):
        return
    refuse_given({"--point-mm": point}, "touches say where the fixture's origin is")
    refuse_given({"--camera": part.camera, "--target": part.target}, "touches need no camera")
    place = Place.of(goes, "fixture", Choice(robot=part.robot), ARM)
    touched_with = _tool(tool, place.calibration, part.robot)
    requested = written.requested()
    frame = touched_fixture(
        read_touches(touches, requested, part.robot, positions=touched_with is None),
        touched_with,
        drawing,
        place.calibration,
        written.model,
        touch_noise_m=written.noise_m,
    )
    keep_and_report(place, frame, touches, as_json=as_json)


def _tool(said: str | None, calibration: "Calibration | None", robot: str | None) -> "Tool | None":
    """Finds the tool that the points were touched with."""
    from visioncal.frames.measured import NO_TOOL, Tool
    from visioncal.interchange.result_files import load_placed

    if said == "none":
        return None
    known = {} if calibration is None else calibration.frames
    if said is None and calibration is None:
        raise DataError("The tool that touched the points is not said.", next_step=NO_TOOL)
    if said is None or said in known or f"flange_from_{said}" in known:
        return Tool.among(known, "The calibration", said)
    path, _, name = said.rpartition(":")
    if Path(said).exists():
        return Tool.among(load_placed(Path(said), robot).frames, said, None)
    if path and Path(path).exists():
        return Tool.among(load_placed(Path(path), robot).frames, path, name)
    if known:
        return Tool.among(known, "The calibration", said)
    raise DataError(
        f"--tool {said}: there is no such file, nor a calibration (-c) that has such a tool.",
        culprits=[said],
        next_step=NO_TOOL,
    )
