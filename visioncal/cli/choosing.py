"""Options that say which camera, robot and target of a whole cell are meant."""

from typing import Annotated, TypeAlias

import typer

CameraName: TypeAlias = Annotated[
    str | None, typer.Option("--camera", help="Of a whole cell: which camera, as left.")
]
RobotName: TypeAlias = Annotated[
    str | None, typer.Option("--robot", help="Of a whole cell: which robot, as a.")
]
TargetName: TypeAlias = Annotated[
    str | None, typer.Option("--target", help="Of a whole cell: which target, as floor.")
]
