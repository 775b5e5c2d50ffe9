"""Options for the convention of the robot's poses."""

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from visioncal.core.choices import POSE_FORMS, UNITS_M
from visioncal.core.errors import DataError

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.interchange.formats import ImportOptions
    from visioncal.robot import Robot

poses_option = partial(typer.Option, rich_help_panel="The poses of somebody else's recording")
FORMS = f"{', '.join(POSE_FORMS)}, or a rotation such as euler-ZYX-deg, quaternion-wxyz"
UNITS = "|".join(UNITS_M)


@dataclass(frozen=True)
class RobotPoseOptions:
    """Options for the convention of the robot's poses."""

    robot_columns: Annotated[
        str | None,
        poses_option(
            "--robot-columns",
            "--robot-key",
            help="Columns or keys of the robot's poses, position first: X,Y,Z,A,B,C or O_T_EE.",
        ),
    ] = None
    robot_form: Annotated[str | None, poses_option(help=f"Their convention: {FORMS}.")] = None
    robot_unit: Annotated[
        str | None, poses_option(metavar=UNITS, help="Unit of their positions.")
    ] = None
    robot_inverse: Annotated[
        bool | None,
        poses_option("--robot-inverse/--robot-as-is", help="They give the base in the flange."),
    ] = None
    joint_columns: Annotated[
        str | None,
        poses_option("--joint-columns", "--joint-key", help="Columns or keys of the joint angles."),
    ] = None
    joint_unit: Annotated[Literal["rad", "deg"], poses_option(help="Unit of the joint angles.")] = (
        "rad"
    )
    robot_model: Annotated[
        str | None, poses_option(help="A built-in robot, or the path of a .urdf or .toml.")
    ] = None

    def requested(self) -> "ImportOptions":
        """The import options.

        Raises:
            DataError: A name is empty or occurs twice.
        """
        from visioncal.interchange.formats import ImportOptions, PoseImportOptions

        columns = names_in(self.robot_columns, "--robot-columns")
        return ImportOptions(
            robot=PoseImportOptions(columns, self.robot_form, self.robot_unit, self.robot_inverse),
            joints=names_in(self.joint_columns, "--joint-columns"),
            joints_deg=self.joint_unit == "deg",
            robot_model=self.robot_model,
        )

    @property
    def model(self) -> "Robot | None":
        """The named robot.

        Raises:
            DataError: It cannot be read.
        """
        from visioncal.robot import load_robot

        return None if self.robot_model is None else load_robot(self.robot_model)


def names_in(words: str | None, option: str) -> tuple[str, ...]:
    """Splits an option of names separated by commas.

    Raises:
        DataError: A name is empty or occurs twice.
    """
    if words is None:
        return ()
    names = tuple(part.strip() for part in words.split(","))
    if not all(names) or len(set(names)) < len(names):
        raise DataError(
            f"{option} is {words[:80]!r}; names are needed, each once, with commas between.",
            culprits=[option],
        )
    return names
