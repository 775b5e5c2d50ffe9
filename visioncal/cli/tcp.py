"""`visioncal tcp`."""

from pathlib import Path
from typing import Annotated

import typer

from visioncal.cli.convert_options import (
    JointColumns,
    JointUnit,
    RobotColumns,
    RobotForm,
    RobotInverse,
    RobotModel,
    RobotUnit,
)
from visioncal.cli.framing import (
    CalibrationOption,
    ForceOption,
    JsonOption,
    NameOption,
    OutOption,
    Place,
    TouchNoise,
    metres,
    named_robot,
    tell,
    touch_wishes,
)
from visioncal.formats.touches import read_touches
from visioncal.frames.naming import transform_name
from visioncal.frames.tcp import touched_tool


def tcp_command(
    touches: Annotated[
        Path,
        typer.Argument(
            help="A table with a row a touch: the columns of views.csv, kind (point, z or xz) and "
            "point."
        ),
    ],
    calibration: CalibrationOption = None,
    out: OutOption = None,
    name: NameOption = None,
    touch_noise: TouchNoise = None,
    robot_columns: RobotColumns = None,
    robot_form: RobotForm = None,
    robot_unit: RobotUnit = None,
    robot_inverse: RobotInverse = None,
    joint_columns: JointColumns = None,
    joint_unit: JointUnit = "rad",
    robot_model: RobotModel = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find a tool's tip, and its rotation, from touches of fixed points.

    A touch of kind point has the tip at the point; of kind z, the point lies on the tool's positive
    z axis; of kind xz, in its xz plane on the side of positive x. Exit status 2: nothing was
    written, for the reason given.
    """
    place = Place.of(transform_name("tool", name), calibration, out, force=force)
    wishes = touch_wishes(
        robot_columns, robot_form, robot_unit, robot_inverse, joint_columns, joint_unit
    )
    rows = read_touches(touches, wishes)
    frame = touched_tool(
        rows,
        place.calibration,
        named_robot(robot_model),
        touch_noise_m=metres(touch_noise, "--touch-noise-mm"),
    )
    tell(place, frame, place.keep(frame), as_json=as_json)
