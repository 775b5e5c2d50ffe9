"""`visioncal tcp`."""

from pathlib import Path
from typing import Annotated

import typer

from visioncal.cli.choosing import CameraName, RobotName, TargetName
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
from visioncal.cli.refusing import refuse_given
from visioncal.cli.target_in_images import (
    PointOption,
    frame_by_images,
    image_session,
    touch_options,
)
from visioncal.frames.naming import transform_name
from visioncal.frames.tcp import touched_tool
from visioncal.interchange.formats.touches import read_touches
from visioncal.session.choosing import ARM, EYE, Choice


def tcp_command(
    touches: Annotated[
        Path,
        typer.Argument(
            help="A table with a row a touch: the columns of views.csv, kind (point, z or xz) and "
            "point. Or a session whose images show a target on the tool."
        ),
    ],
    calibration: CalibrationOption = None,
    out: OutOption = None,
    name: NameOption = None,
    point: PointOption = None,
    touch_noise: TouchNoise = None,
    robot_columns: RobotColumns = None,
    robot_form: RobotForm = None,
    robot_unit: RobotUnit = None,
    robot_inverse: RobotInverse = None,
    joint_columns: JointColumns = None,
    joint_unit: JointUnit = "rad",
    robot_model: RobotModel = None,
    camera: CameraName = None,
    robot: RobotName = None,
    target: TargetName = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find a tool's tip, and its rotation, from touches of fixed points; or from images.

    A touch of kind point has the tip at the point; of kind z, the point lies on the tool's positive
    z axis; of kind xz, in its xz plane on the side of positive x. In images, a target on the tool
    gives both, by the camera that -c names. Exit status 2: nothing was written, for the reason
    given.
    """
    name = transform_name("tool", name)
    for_touches = touch_options(
        robot_columns,
        robot_form,
        robot_unit,
        robot_inverse,
        joint_columns,
        robot_model,
        touch_noise,
    )
    session = image_session(touches, for_touches)
    if session is not None:
        choice = Choice(camera, robot, target)
        place = Place.of(name, calibration, out, Choice(camera, robot), EYE, force=force)
        frame = frame_by_images(session, place, "tool", point, choice=choice, quiet=as_json)
        tell(place, frame, place.keep(frame), as_json=as_json)
        return
    refuse_given({"--camera": camera, "--target": target}, "touches need no camera")
    refuse_given({"--point-mm": point}, "touches say where the tool's point is")
    requested = touch_wishes(
        robot_columns, robot_form, robot_unit, robot_inverse, joint_columns, joint_unit
    )
    place = Place.of(name, calibration, out, Choice(robot=robot), ARM, force=force)
    rows = read_touches(touches, requested, robot)
    frame = touched_tool(
        rows,
        place.calibration,
        named_robot(robot_model),
        touch_noise_m=metres(touch_noise, "--touch-noise-mm"),
    )
    tell(place, frame, place.keep(frame), as_json=as_json)
